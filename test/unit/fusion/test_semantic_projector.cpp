// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <Eigen/Dense>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <memory>
#include <numeric>
#include <opencv2/imgproc.hpp>
#include <random>
#include <string>

#include "not_finite.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/fusion/semantic_projector.h"
#include "semantic_lidar_fusion/projection/cloud_projector.h"
#include "semantic_lidar_fusion/superpixel/superpixel_map.h"

namespace semantic_lidar_fusion {
namespace {

constexpr StampNs kReference = 1600000000000000000;

std::shared_ptr<const CameraModel> makeModel(const std::string& distortion, const ImageSize& size,
                                             double focal_px) {
  CameraInfo info;
  info.size = size;
  info.distortion_model = distortion;
  if (distortion == "equidistant") info.d = {0.0, 0.0, 0.0, 0.0};
  const double cx = 0.5 * (size.width - 1), cy = 0.5 * (size.height - 1);
  info.k = {focal_px, 0, cx, 0, focal_px, cy, 0, 0, 1};
  info.p = {focal_px, 0, cx, 0, 0, focal_px, cy, 0, 0, 0, 1, 0};
  return std::make_shared<CameraModel>(info, CameraModelOptions{});
}

/// An optical frame at `position` in the lidar's frame that looks along `yaw` (0 = lidar x).
Transform lookAlong(double yaw_rad, const Eigen::Vector3d& position) {
  Eigen::Matrix3d R_body_optical;
  R_body_optical << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  Transform T_lidar_camera = Transform::Identity();
  T_lidar_camera.translation() = position;
  T_lidar_camera.linear() =
      Eigen::AngleAxisd(yaw_rad, Eigen::Vector3d::UnitZ()).toRotationMatrix() * R_body_optical;
  return T_lidar_camera.inverse();
}

void addPoint(Cloud* cloud, const Eigen::Vector3d& p, std::uint16_t ring = 0, float dt = 0,
              PointStatus status = PointStatus::kFused) {
  cloud->x.push_back(static_cast<float>(p.x()));
  cloud->y.push_back(static_cast<float>(p.y()));
  cloud->z.push_back(static_cast<float>(p.z()));
  cloud->intensity.push_back(static_cast<float>(cloud->x.size()));
  cloud->ring.push_back(ring);
  cloud->dt.push_back(dt);
  cloud->status.push_back(static_cast<std::uint8_t>(status));
}

/// A sixteen-ring scan of random ranges: walls, with posts in front of them.
Cloud randomScan(std::mt19937* random, int azimuths) {
  std::uniform_real_distribution<double> far_m(8, 40), near_m(2, 6), uniform(0, 1);
  Cloud cloud;
  cloud.frame_id = "lidar";
  cloud.stamp = kReference;
  cloud.first_point_ns = kReference - 50000000;
  for (int a = 0; a < azimuths; ++a) {
    const bool post = uniform(*random) < 0.2;
    const double azimuth = 2 * M_PI * a / azimuths;
    for (int ring = 0; ring < 16; ++ring) {
      const double elevation = (2.0 * ring - 15.0) * M_PI / 180;
      const double range = post ? near_m(*random) : far_m(*random);
      const auto status = uniform(*random) < 0.03 ? PointStatus::kNoOdometry : PointStatus::kFused;
      addPoint(
          &cloud,
          range * Eigen::Vector3d(std::cos(elevation) * std::cos(azimuth),
                                  -std::cos(elevation) * std::sin(azimuth), std::sin(elevation)),
          static_cast<std::uint16_t>(ring), static_cast<float>(0.1 * a / azimuths - 0.05), status);
    }
  }
  return cloud;
}

cv::Mat randomScores(const ImageSize& size, int class_count, std::mt19937* random) {
  std::uniform_real_distribution<float> score(-6, 6);
  std::uniform_int_distribution<int> rare(0, 199);
  cv::Mat scores(size.height, size.width, CV_32FC(class_count));
  for (int i = 0; i < size.width * size.height * class_count; ++i) {
    scores.ptr<float>()[i] = rare(*random) == 0 ? kNan : score(*random);
  }
  return scores;
}

/// Blocks of `block` pixels that share a random value in `low`..`high`.
cv::Mat randomShare(const ImageSize& size, int block, std::mt19937* random) {
  std::uniform_real_distribution<float> value(0.2f, 1.0f);
  std::map<int, float> of_block;
  cv::Mat share(size.height, size.width, CV_32FC1);
  for (int y = 0; y < size.height; ++y) {
    for (int x = 0; x < size.width; ++x) {
      const int k = y / block * 1000 + x / block;
      if (of_block.count(k) == 0) of_block[k] = value(*random);
      share.at<float>(y, x) = of_block[k];
    }
  }
  return share;
}

cv::Mat randomMask(const ImageSize& size, std::mt19937* random) {
  std::bernoulli_distribution masked(0.25);
  cv::Mat mask(size.height, size.width, CV_8UC1);
  for (int i = 0; i < size.width * size.height; ++i) {
    mask.data[i] = masked(*random) ? 0 : static_cast<std::uint8_t>(1 + i % 255);
  }
  return mask;
}

// ---------------------------------------------------------------------------------------------
// The plain reference, written from the interface's rules, point by point.

int gridCell(int i, int n, int m) {
  return static_cast<int>(std::floor((i + 0.5L) * static_cast<long double>(m) / n));
}

std::vector<double> referenceDistribution(const ImageSemantics& semantics, const cv::Mat& scores,
                                          int px, int py, const ImageSize& image,
                                          const UncertaintyConfig& config, int class_count) {
  const bool lazy = semantics.probabilities.empty();
  const cv::Mat& grid = lazy ? semantics.share : semantics.probabilities;
  const int qx = gridCell(px, image.width, grid.cols), qy = gridCell(py, image.height, grid.rows);
  std::vector<double> p(static_cast<std::size_t>(class_count));
  if (!lazy) {
    const float* values = grid.ptr<float>(qy) + qx * class_count;
    std::copy(values, values + class_count, p.begin());
    return p;
  }
  const float* s = scores.ptr<float>(gridCell(qy, grid.rows, scores.rows)) +
                   gridCell(qx, grid.cols, scores.cols) * class_count;
  const double tau = config.temperature / std::pow(grid.at<float>(qy, qx), config.exponent);
  long double sum = 0;
  for (int c = 0; c < class_count; ++c) {
    if (!std::isfinite(s[c])) return std::vector<double>(p.size(), 1.0 / class_count);
    sum += std::exp(static_cast<long double>(s[c] / tau));
  }
  for (int c = 0; c < class_count; ++c) {
    p[c] = static_cast<double>(std::exp(static_cast<long double>(s[c] / tau)) / sum);
  }
  return p;
}

struct ReferencePoint {
  int status = 2;
  unsigned cameras = 0;
  std::vector<double> p;
};

/// One camera's say on one point.
struct ReferenceVote {
  int rig_index = 0;
  std::vector<double> p;
  std::int64_t time_difference_ns = 0;
  double theta = 0;
};

/// `scores_of`: the score images of the views with scores, by name.
std::vector<ReferencePoint> referenceFuse(const Cloud& cloud, const std::vector<CameraView>& views,
                                          const std::map<std::string, cv::Mat>& scores_of,
                                          const FusionConfig& config) {
  std::vector<ReferencePoint> out(cloud.size());
  std::vector<std::vector<ReferenceVote>> votes(cloud.size());
  std::vector<std::vector<int>> statuses(cloud.size());
  for (const CameraView& view : views) {
    if (!view.model) continue;
    const ImageSize size = view.model->imageSize();
    const auto masked = [&](double u, double v) {
      if (view.ego_mask.empty()) return false;
      const int x = gridCell(static_cast<int>(std::floor(u + 0.5)), size.width, view.ego_mask.cols);
      const int y =
          gridCell(static_cast<int>(std::floor(v + 0.5)), size.height, view.ego_mask.rows);
      return view.ego_mask.at<std::uint8_t>(y, x) == 0;
    };
    const auto inside = [&](double u, double v) {
      return u >= -0.5 && v >= -0.5 && u < size.width - 0.5 && v < size.height - 0.5;
    };
    const Transform& T = view.has_image ? view.T_camera_lidar : view.T_camera_lidar_static;
    const BeamGrid grid = beamGrid(cloud, config.occlusion);
    const double margin_px =
        view.has_image ? castMarginPx(*view.model, grid, config.occlusion) : 0.0;
    const ProjectedPoints points = projectCloud(cloud, T, *view.model, margin_px);

    std::vector<std::uint8_t> visible(points.size(), 1);
    if (config.occlusion.mode == &OcclusionMode::kAdaptive) {
      visible = visiblePoints(cloud, points, T, *view.model, grid, config.occlusion);
    } else if (config.occlusion.mode == &OcclusionMode::kPaper) {
      const MaskSize mask =
          paperMaskSize(*view.model, grid.horizontal_step_rad, grid.vertical_step_rad);
      std::vector<std::size_t> order(points.size());
      std::iota(order.begin(), order.end(), 0);
      std::sort(order.begin(), order.end(), [&points](std::size_t a, std::size_t b) {
        if (points.distance[a] != points.distance[b]) {
          return points.distance[a] < points.distance[b];
        }
        return points.index[a] < points.index[b];
      });
      for (std::size_t a = 0; a < order.size(); ++a) {
        const std::size_t k = order[a];
        for (std::size_t b = 0; b < a && visible[k]; ++b) {
          const std::size_t j = order[b];
          if (!visible[j] || !inside(points.u[j], points.v[j])) continue;
          const double du = std::floor(points.u[k] + 0.5) - std::floor(points.u[j] + 0.5);
          const double dv = std::floor(points.v[k] + 0.5) - std::floor(points.v[j] + 0.5);
          visible[k] = std::abs(du) > (mask.width - 1) / 2 || std::abs(dv) > (mask.height - 1) / 2;
        }
      }
    }

    for (std::size_t k = 0; k < points.size(); ++k) {
      const std::size_t i = points.index[k];
      const double u = points.u[k], v = points.v[k];
      const Eigen::Vector3d p_camera = T * Eigen::Vector3d(cloud.x[i], cloud.y[i], cloud.z[i]);
      const auto exact = view.model->project(p_camera);
      EXPECT_TRUE(exact && std::abs(exact->x() - u) < 0.05 && std::abs(exact->y() - v) < 0.05);
      if (!inside(u, v) || masked(u, v)) continue;
      if (!view.has_image) {
        statuses[i].push_back(3);
      } else if (!visible[k]) {
        statuses[i].push_back(1);
      } else {
        statuses[i].push_back(0);
        const cv::Mat scores = scores_of.count(view.name) ? scores_of.at(view.name) : cv::Mat();
        ReferenceVote vote;
        vote.rig_index = view.rig_index;
        vote.p = referenceDistribution(
            view.semantics, scores, static_cast<int>(std::floor(u + 0.5)),
            static_cast<int>(std::floor(v + 0.5)), size, config.uncertainty, config.class_count);
        vote.time_difference_ns = std::llabs(
            kReference + std::llround(static_cast<double>(cloud.dt[i]) * 1e9) - view.image_ns);
        vote.theta = std::atan2(std::hypot(p_camera.x(), p_camera.y()), p_camera.z());
        votes[i].push_back(vote);
      }
    }
  }

  for (std::size_t i = 0; i < cloud.size(); ++i) {
    ReferencePoint& point = out[i];
    const auto has = [&](int status) {
      return std::count(statuses[i].begin(), statuses[i].end(), status) > 0;
    };
    point.status = cloud.status[i] == 4 ? 4 : has(0) ? 0 : has(1) ? 1 : has(3) ? 3 : 2;
    if (point.status != 0) continue;
    std::vector<ReferenceVote> used = votes[i];
    const auto keepBest = [&used](auto key, double tolerance) {
      double least = 1e300;
      for (const ReferenceVote& vote : used) {
        least = std::min(least, static_cast<double>(key(vote)));
      }
      used.erase(std::remove_if(used.begin(), used.end(),
                                [&](const ReferenceVote& vote) {
                                  return static_cast<double>(key(vote)) > least + tolerance;
                                }),
                 used.end());
    };
    if (config.overlap == OverlapRule::kNearestInTime) {
      keepBest([](const ReferenceVote& vote) { return vote.time_difference_ns; }, 0);
    } else if (config.overlap == OverlapRule::kMostCentral) {
      keepBest([](const ReferenceVote& vote) { return vote.theta; }, 1e-6);
    }
    point.p.assign(static_cast<std::size_t>(config.class_count),
                   config.overlap == OverlapRule::kProduct ? 1.0 : 0.0);
    double sum = 0;
    for (std::size_t c = 0; c < point.p.size(); ++c) {
      for (const ReferenceVote& vote : used) {
        if (config.overlap == OverlapRule::kProduct) {
          point.p[c] *= vote.p[c];
        } else {
          point.p[c] += vote.p[c];
        }
      }
      sum += point.p[c];
    }
    for (double& p : point.p) p /= sum;
    for (const ReferenceVote& vote : used) point.cameras |= 1u << vote.rig_index;
  }
  return out;
}

/// A rig of six cameras with overlap: lazy scores of other sizes, dense probabilities, histograms
/// of labels, one without image, one without model.
struct Scene {
  static constexpr int kClasses = 6;
  Cloud cloud;
  std::vector<CameraView> views;
  std::map<std::string, cv::Mat> scores;

  explicit Scene(unsigned seed) {
    std::mt19937 random(seed);
    cloud = randomScan(&random, 150);
    const ImageSize size{97, 61};
    const auto add = [&](const std::string& name, int rig_index, double yaw_rad) -> CameraView& {
      CameraView view;
      view.name = name;
      view.rig_index = rig_index;
      view.model =
          rig_index % 2 == 0 ? makeModel("equidistant", size, 45.0) : makeModel("", size, 45.0);
      view.T_camera_lidar_static = lookAlong(yaw_rad, {0.3, 0.1 * rig_index, -0.4});
      view.T_camera_lidar = lookAlong(yaw_rad + 0.02, {0.35, 0.1 * rig_index, -0.4});
      view.has_image = true;
      view.image_ns = kReference + 7000000 * (rig_index - 2);
      views.push_back(view);
      return views.back();
    };
    const auto addScores = [&](CameraView* view, const ImageSize& share, const ImageSize& cells) {
      scores[view->name] = randomScores(cells, kClasses, &random);
      view->semantics.scores = ScoreMap(scores[view->name], kClasses, ScoreFormat{});
      view->semantics.share = randomShare(share, 5, &random);
    };
    addScores(&add("front", 4, 0.0), size, size);
    CameraView& left = add("left", 1, 0.9);
    addScores(&left, {48, 30}, {24, 15});
    left.ego_mask = randomMask({200, 90}, &random);
    // The scores are finer than the superpixels, which are coarser than the image.
    addScores(&add("close", 2, 0.3), {31, 17}, {101, 67});
    CameraView& dense = add("dense", 0, -0.8);
    dense.semantics.probabilities = denseProbabilities(
        ScoreMap(randomScores({20, 30}, kClasses, &random), kClasses, ScoreFormat{}),
        randomShare({40, 30}, 4, &random), UncertaintyConfig{});
    CameraView& labels = add("labels", 5, -0.4);
    SuperpixelMap superpixels;
    superpixels.ids = cv::Mat(12, 16, CV_32SC1);
    superpixels.count = 12;
    superpixels.sizes.assign(12, 16);
    cv::Mat label_image(60, 80, CV_8UC1);
    for (int y = 0; y < 12; ++y) {
      for (int x = 0; x < 16; ++x) superpixels.ids.at<int>(y, x) = y / 4 * 4 + x / 4;
    }
    std::uniform_int_distribution<int> label(0, kClasses);
    for (int i = 0; i < 60 * 80; ++i)
      label_image.data[i] = static_cast<std::uint8_t>(label(random));
    labels.semantics.probabilities = histogramProbabilities(superpixels, label_image, kClasses);
    labels.ego_mask = randomMask({97, 61}, &random);
    CameraView& missing = add("missing", 7, 1.9);
    missing.model = makeModel("", {97, 61}, 20.0);
    missing.has_image = false;
    missing.ego_mask = randomMask({40, 20}, &random);
    CameraView& no_info = add("no_info", 3, M_PI);
    no_info.model = nullptr;
  }
};

struct Variant {
  OverlapRule overlap;
  const OcclusionMode* occlusion;
};

class RandomScenes : public ::testing::TestWithParam<Variant> {};

TEST_P(RandomScenes, EqualTheReference) {
  std::map<int, int> points_of_status;
  int shared_points = 0;
  for (unsigned seed = 0; seed < 2; ++seed) {
    const Scene scene(seed);
    FusionConfig config;
    config.class_count = Scene::kClasses;
    config.overlap = GetParam().overlap;
    config.occlusion.mode = GetParam().occlusion;
    config.occlusion.horizontal_step_deg = 2.4;
    config.occlusion.vertical_step_deg = 3.0;
    config.uncertainty.exponent = seed == 0 ? 2.0 : 1.5;
    config.uncertainty.temperature = seed == 0 ? 1.0 : 1.3;
    const FusionResult result = SemanticProjector(config).fuse(scene.cloud, scene.views);
    const std::vector<ReferencePoint> want =
        referenceFuse(scene.cloud, scene.views, scene.scores, config);
    ASSERT_EQ(result.cloud.size(), scene.cloud.size());
    for (std::size_t i = 0; i < want.size(); ++i) {
      const int status = result.cloud.points.status[i];
      ++points_of_status[status];
      ASSERT_EQ(status, want[i].status) << "point " << i << " seed " << seed;
      EXPECT_EQ(result.cloud.points.x[i], scene.cloud.x[i]);
      EXPECT_EQ(result.cloud.points.intensity[i], scene.cloud.intensity[i]);
      const float* p = &result.cloud.probabilities[i * Scene::kClasses];
      if (status != 0) {
        EXPECT_EQ(result.cloud.label[i], kNoLabel);
        EXPECT_EQ(result.cloud.confidence[i], 0.0f);
        EXPECT_EQ(result.cloud.entropy[i], 1.0f);
        EXPECT_EQ(result.cloud.cameras[i], 0);
        EXPECT_EQ(std::count(p, p + Scene::kClasses, 0.0f), Scene::kClasses);
        continue;
      }
      EXPECT_EQ(result.cloud.cameras[i], want[i].cameras) << "point " << i;
      if ((want[i].cameras & (want[i].cameras - 1)) != 0) ++shared_points;
      double sum = 0;
      for (int c = 0; c < Scene::kClasses; ++c) {
        EXPECT_NEAR(p[c], want[i].p[c], 2e-6) << "point " << i << " class " << c;
        sum += p[c];
      }
      EXPECT_NEAR(sum, 1.0, 1e-6);
      EXPECT_EQ(result.cloud.label[i], std::max_element(p, p + Scene::kClasses) - p);
      EXPECT_EQ(result.cloud.confidence[i], p[result.cloud.label[i]]);
    }
  }
  // The scenes reach every status and rule.
  for (const int status : {0, 2, 3, 4}) EXPECT_GT(points_of_status[status], 20) << status;
  EXPECT_EQ(points_of_status[1] > 20, GetParam().occlusion != &OcclusionMode::kOff);
  const bool merges =
      GetParam().overlap == OverlapRule::kMean || GetParam().overlap == OverlapRule::kProduct;
  EXPECT_EQ(shared_points > 20, merges);
}

INSTANTIATE_TEST_SUITE_P(
    SemanticProjector, RandomScenes,
    ::testing::Values(Variant{OverlapRule::kMean, &OcclusionMode::kOff},
                      Variant{OverlapRule::kProduct, &OcclusionMode::kOff},
                      Variant{OverlapRule::kNearestInTime, &OcclusionMode::kOff},
                      Variant{OverlapRule::kMostCentral, &OcclusionMode::kOff},
                      Variant{OverlapRule::kMean, &OcclusionMode::kPaper},
                      Variant{OverlapRule::kProduct, &OcclusionMode::kPaper},
                      Variant{OverlapRule::kNearestInTime, &OcclusionMode::kAdaptive},
                      Variant{OverlapRule::kMean, &OcclusionMode::kAdaptive}));

void expectSameBytes(const FusionResult& a, const FusionResult& b) {
  EXPECT_EQ(a.cloud.points.status, b.cloud.points.status);
  EXPECT_EQ(a.cloud.label, b.cloud.label);
  EXPECT_EQ(a.cloud.confidence, b.cloud.confidence);
  EXPECT_EQ(a.cloud.entropy, b.cloud.entropy);
  EXPECT_EQ(a.cloud.cameras, b.cloud.cameras);
  EXPECT_EQ(a.cloud.probabilities, b.cloud.probabilities);
  ASSERT_EQ(a.cameras.size(), b.cameras.size());
  for (std::size_t k = 0; k < a.cameras.size(); ++k) {
    EXPECT_EQ(a.cameras[k].name, b.cameras[k].name);
    EXPECT_EQ(a.cameras[k].index, b.cameras[k].index);
    EXPECT_EQ(a.cameras[k].status, b.cameras[k].status);
    EXPECT_EQ(a.cameras[k].label, b.cameras[k].label);
  }
}

TEST(SemanticProjector, GivesTheSameBytesForEveryOrderOfCameras) {
  Scene scene(3);
  scene.cloud = [] {
    std::mt19937 random(3);
    return randomScan(&random, 40);
  }();
  // The front camera four times in slightly different poses: sums of four and more terms.
  const CameraView front = scene.views[0];
  scene.views.erase(scene.views.begin() + 2, scene.views.end());
  for (int k = 0; k < 3; ++k) {
    scene.views.push_back(front);
    scene.views.back().name = std::string(1, static_cast<char>('z' - k));
    scene.views.back().rig_index = 8 + k;
    scene.views.back().T_camera_lidar = lookAlong(0.01 * k, {0.3, 0.0, -0.4});
  }
  for (const OverlapRule rule : {OverlapRule::kMean, OverlapRule::kProduct,
                                 OverlapRule::kNearestInTime, OverlapRule::kMostCentral}) {
    FusionConfig config;
    config.class_count = Scene::kClasses;
    config.overlap = rule;
    config.occlusion.mode = &OcclusionMode::kPaper;
    const SemanticProjector projector(config);
    std::vector<int> order(scene.views.size());
    std::iota(order.begin(), order.end(), 0);
    const FusionResult first = projector.fuse(scene.cloud, scene.views);
    int orders = 0;
    do {
      std::vector<CameraView> views;
      for (const int k : order) views.push_back(scene.views[static_cast<std::size_t>(k)]);
      expectSameBytes(first, projector.fuse(scene.cloud, views));
      ++orders;
    } while (std::next_permutation(order.begin(), order.end()) && !HasFailure());
    EXPECT_EQ(orders, 120);
  }
}

// ---------------------------------------------------------------------------------------------
// Small cases by hand: a pinhole camera at the lidar that looks along x, 21x11 px, f = 10 px.

constexpr int kWidth = 21, kHeight = 11;

/// A point at `range_m` along x that falls on pixel (column, row).
Eigen::Vector3d pointAt(int column, int row, double range_m) {
  return {range_m, -range_m * (column - 10) / 10.0, -range_m * (row - 5) / 10.0};
}

CameraView handCamera(const std::string& name = "cam", int rig_index = 0) {
  CameraView view;
  view.name = name;
  view.rig_index = rig_index;
  view.model = makeModel("", {kWidth, kHeight}, 10.0);
  view.T_camera_lidar_static = lookAlong(0, {0, 0, 0});
  view.T_camera_lidar = view.T_camera_lidar_static;
  view.has_image = true;
  view.image_ns = kReference;
  view.semantics.probabilities = cv::Mat(kHeight, kWidth, CV_32FC2, cv::Scalar(0.25, 0.75));
  return view;
}

Cloud handCloud() {
  Cloud cloud;
  cloud.frame_id = "lidar";
  cloud.stamp = kReference;
  return cloud;
}

FusionConfig handConfig() {
  FusionConfig config;
  config.class_count = 2;
  config.occlusion.mode = &OcclusionMode::kPaper;  // a step of 2 deg is 0.35 px: one-pixel masks
  config.occlusion.horizontal_step_deg = 2.0;
  config.occlusion.vertical_step_deg = 2.0;
  return config;
}

std::vector<int> statuses(const FusionResult& result) {
  return {result.cloud.points.status.begin(), result.cloud.points.status.end()};
}

/// A mode of occlusion made of one row: it hides what has no left or right neighbour on its
/// surface.
std::vector<std::uint8_t> visibleIfLinked(const MaskInput& input) {
  std::vector<std::uint8_t> visible;
  for (const std::uint32_t i : input.points.index) {
    const BeamGrid::Links& links = input.grid.links[i];
    visible.push_back(links.left != BeamGrid::kNoLink || links.right != BeamGrid::kNoLink);
  }
  return visible;
}

TEST(SemanticProjector, TakesAModeOfOcclusionOfSomebodyElse) {
  const OcclusionMode linked{"linked", OcclusionMode::Needs::kLinks,
                             [](const CameraModel&, const BeamGrid&) { return 7.0; },
                             visibleIfLinked};
  FusionConfig config = handConfig();
  config.occlusion.mode = &linked;
  Cloud cloud = handCloud();
  for (const int column : {8, 9, 10}) addPoint(&cloud, pointAt(column, 5, 10.0), 0);
  addPoint(&cloud, pointAt(10, 3, 4.0), 1);  // nothing beside it
  config.occlusion.horizontal_step_deg = 5.0;
  config.occlusion.vertical_step_deg = 10.0;
  const FusionResult result = SemanticProjector(config).fuse(cloud, {handCamera()});
  EXPECT_EQ(statuses(result), (std::vector<int>{0, 0, 0, 1}));
  EXPECT_EQ(castMarginPx(*handCamera().model, {}, config.occlusion), 7.0);
}

TEST(SemanticProjector, GivesTheSameBytesForEveryNumberOfThreads) {
  for (const OcclusionMode* occlusion : {&OcclusionMode::kPaper, &OcclusionMode::kAdaptive}) {
    Scene scene(4);
    scene.cloud = [] {
      std::mt19937 random(4);
      return randomScan(&random, 600);  // more than one thread's share of the points
    }();
    FusionConfig config;
    config.class_count = Scene::kClasses;
    config.occlusion.mode = occlusion;
    const FusionResult first = SemanticProjector(config).fuse(scene.cloud, scene.views);
    ASSERT_GT(first.cloud.size(), 4096u);
    for (const int threads : {2, 5}) {
      config.threads = threads;
      const SemanticProjector projector(config);
      for (int scan = 0; scan < 3; ++scan) {
        expectSameBytes(first, projector.fuse(scene.cloud, scene.views));
      }
    }
  }
}

/// The views of a scene, whose cameras' poses err by this around and along each axis.
std::vector<CameraView> erring(std::vector<CameraView> views, double deg, double m) {
  for (CameraView& view : views) {
    view.errors.common.diagonal().head<3>().setConstant(m * m);
    view.errors.common.diagonal().tail<3>().setConstant(std::pow(deg * M_PI / 180, 2));
  }
  return views;
}

/// Equation of the transfer, point by point: the mean of P over nine points of the ellipse, read
/// where they are in the image and not masked.
TEST(SemanticProjector, ExpectsDistributionsOverTheEllipse) {
  const Scene scene(8);
  FusionConfig config;
  config.class_count = Scene::kClasses;
  int compared = 0, different = 0, dropped = 0;
  for (CameraView view : erring(scene.views, 3.0, 0.03)) {
    if (view.semantics.probabilities.empty() || !view.has_image) continue;
    // A score for each pixel, so that no axis is negligible.
    const ImageSize size = view.model->imageSize();
    cv::resize(view.semantics.probabilities, view.semantics.probabilities,
               {size.width, size.height}, 0, 0, cv::INTER_NEAREST);
    if (view.ego_mask.empty()) {
      std::mt19937 random(2);
      view.ego_mask = randomMask({97, 61}, &random);
    }
    const FusionResult result = SemanticProjector(config).fuse(scene.cloud, {view});
    const CameraFusionReport& report = result.cameras.at(0);
    ASSERT_EQ(report.covariances.size(), report.index.size());
    for (std::size_t k = 0; k < report.index.size(); ++k) {
      if (report.status[k] != PointStatus::kFused) continue;
      Eigen::Matrix2d covariance;
      covariance << report.covariances.uu[k], report.covariances.uv[k], report.covariances.uv[k],
          report.covariances.vv[k];
      const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> axes(covariance);
      std::vector<double> want(Scene::kClasses, 0.0);
      double total = 0;
      for (const int a : {0, 1, -1}) {
        for (const int b : {0, 1, -1}) {
          const Eigen::Vector2d at =
              Eigen::Vector2d(report.u[k], report.v[k]) +
              std::sqrt(3.0) * (a * std::sqrt(axes.eigenvalues()[0]) * axes.eigenvectors().col(0) +
                                b * std::sqrt(axes.eigenvalues()[1]) * axes.eigenvectors().col(1));
          const double weight = (a == 0 ? 4.0 : 1.0) * (b == 0 ? 4.0 : 1.0) / 36.0;
          const int column = static_cast<int>(std::floor(at.x() + 0.5));
          const int row = static_cast<int>(std::floor(at.y() + 0.5));
          const bool inside = column >= 0 && column < size.width && row >= 0 && row < size.height;
          if (!inside || view.ego_mask.at<std::uint8_t>(
                             gridCell(row, size.height, view.ego_mask.rows),
                             gridCell(column, size.width, view.ego_mask.cols)) == 0) {
            ++dropped;
            continue;
          }
          const float* p = view.semantics.probabilities.ptr<float>(row) + column * Scene::kClasses;
          for (int c = 0; c < Scene::kClasses; ++c) want[c] += weight * p[c];
          total += weight;
        }
      }
      ++compared;
      const float* got = &result.cloud.probabilities[report.index[k] * Scene::kClasses];
      double largest = 0;
      for (int c = 0; c < Scene::kClasses; ++c) {
        largest = std::max(largest, std::abs(got[c] - want[c] / total));
      }
      // A point next to a pixel's border may be rounded to the other side.
      different += largest > 1e-5 ? 1 : 0;
    }
  }
  EXPECT_GT(compared, 150);
  EXPECT_GT(dropped, 100);
  EXPECT_LE(different, compared / 100);
}

TEST(SemanticProjector, ExpectsWithoutErrorsWhatPixelsSay) {
  const Scene scene(8);
  FusionConfig config;
  config.class_count = Scene::kClasses;
  config.transfer = TransferRule::kPixel;
  const FusionResult pixel = SemanticProjector(config).fuse(scene.cloud, scene.views);
  // What errs does not matter where distributions are those of pixels,
  expectSameBytes(pixel, SemanticProjector(config).fuse(scene.cloud, erring(scene.views, 3, 0.1)));
  config.transfer = TransferRule::kExpected;
  expectSameBytes(pixel, SemanticProjector(config).fuse(scene.cloud, scene.views));
  // nor where it is small next to a score's cell.
  expectSameBytes(pixel,
                  SemanticProjector(config).fuse(scene.cloud, erring(scene.views, 1e-3, 1e-6)));
  const FusionResult expected =
      SemanticProjector(config).fuse(scene.cloud, erring(scene.views, 3, 0.1));
  EXPECT_NE(expected.cloud.probabilities, pixel.cloud.probabilities);
  EXPECT_EQ(expected.cloud.points.status, pixel.cloud.points.status);
  config.threads = 3;
  expectSameBytes(expected,
                  SemanticProjector(config).fuse(scene.cloud, erring(scene.views, 3, 0.1)));
}

TEST(SemanticProjector, TellsOfPixelsOnlyIfAsked) {
  const Scene scene(6);
  FusionConfig config;
  config.class_count = Scene::kClasses;
  const SemanticProjector projector(config);
  const FusionResult with = projector.fuse(scene.cloud, scene.views);
  const FusionResult without = projector.fuse(scene.cloud, scene.views, false);
  ASSERT_EQ(without.cameras.size(), with.cameras.size());
  std::size_t pixels = 0;
  for (std::size_t k = 0; k < with.cameras.size(); ++k) {
    EXPECT_EQ(without.cameras[k].name, with.cameras[k].name);
    EXPECT_EQ(without.cameras[k].nonfinite, with.cameras[k].nonfinite);
    EXPECT_TRUE(without.cameras[k].index.empty());
    EXPECT_TRUE(without.cameras[k].label.empty());
    pixels += with.cameras[k].label.size();
  }
  EXPECT_GT(pixels, 100u);
  EXPECT_EQ(without.cloud.probabilities, with.cloud.probabilities);
  EXPECT_EQ(without.cloud.points.status, with.cloud.points.status);
}

TEST(SemanticProjector, GivesEachStatusItsMeaning) {
  Cloud cloud = handCloud();
  addPoint(&cloud, pointAt(3, 4, 5));                                  // fused
  addPoint(&cloud, pointAt(3, 4, 9));                                  // behind it
  addPoint(&cloud, pointAt(-4, 4, 5));                                 // left of the image
  addPoint(&cloud, {-5, 0, 0});                                        // behind the camera
  addPoint(&cloud, pointAt(8, 4, 5), 0, 0, PointStatus::kNoOdometry);  // not projected
  addPoint(&cloud, pointAt(8, 4, 9));                                  // seen past that one
  const FusionResult result = SemanticProjector(handConfig()).fuse(cloud, {handCamera("cam", 5)});
  EXPECT_EQ(statuses(result), (std::vector<int>{0, 1, 2, 2, 4, 0}));
  EXPECT_EQ(result.cloud.label, (std::vector<std::uint8_t>{1, 255, 255, 255, 255, 1}));
  EXPECT_EQ(result.cloud.cameras, (std::vector<std::uint16_t>{32, 0, 0, 0, 0, 32}));
  EXPECT_EQ(result.cloud.confidence[0], 0.75f);
  // H(1/4, 3/4) / ln 2 = 2 - 3/4 log2 3.
  EXPECT_NEAR(result.cloud.entropy[0], 2 - 0.75 * std::log2(3.0), 1e-6);
  ASSERT_EQ(result.cameras.size(), 1u);
  const CameraFusionReport& report = result.cameras[0];
  EXPECT_EQ(report.index, (std::vector<std::uint32_t>{0, 1, 5}));
  EXPECT_EQ(report.status, (std::vector<PointStatus>{PointStatus::kFused, PointStatus::kOccluded,
                                                     PointStatus::kFused}));
  EXPECT_EQ(report.label, (std::vector<std::uint8_t>{1, 255, 1}));
  EXPECT_NEAR(report.u[0], 3, 0.02);
  EXPECT_NEAR(report.v[0], 4, 0.02);
}

TEST(SemanticProjector, CountsTheVisiblePointsBeyondTheRowsOfTheLidar) {
  Cloud cloud = handCloud();
  for (const int row : {1, 2, 3, 6, 7}) addPoint(&cloud, pointAt(row, row, 5), 0);
  CameraView view = handCamera();
  const int height = view.model->imageSize().height;
  EXPECT_EQ(SemanticProjector(handConfig()).fuse(cloud, {view}).cameras[0].beyond_rows, 0u);
  view.lidar_rows = {2.0 / height, 6.0 / height};  // rows 2 to 5
  const FusionResult result = SemanticProjector(handConfig()).fuse(cloud, {view});
  EXPECT_EQ(statuses(result), (std::vector<int>{0, 0, 0, 0, 0}));
  EXPECT_EQ(result.cameras[0].beyond_rows, 3u);
  view.lidar_rows = {2.5 / height, 6.5 / height};  // parts of rows 2 and 6
  EXPECT_EQ(SemanticProjector(handConfig()).fuse(cloud, {view}).cameras[0].beyond_rows, 2u);
}

TEST(SemanticProjector, KnownVisibilityStandsInForTheMask) {
  Cloud cloud = handCloud();
  addPoint(&cloud, pointAt(3, 4, 5));   // said to be hidden
  addPoint(&cloud, pointAt(3, 4, 9));   // behind it, said to be seen
  addPoint(&cloud, pointAt(-4, 4, 5));  // left of the image whatever is said
  CameraView view = handCamera();
  view.known_visible = {0, 1, 1};
  const FusionResult result = SemanticProjector(handConfig()).fuse(cloud, {view});
  EXPECT_EQ(statuses(result), (std::vector<int>{1, 0, 2}));
}

TEST(SemanticProjector, MaskedPointsCastAndAreOutsideEvenIfHidden) {
  Cloud cloud = handCloud();
  addPoint(&cloud, pointAt(3, 4, 2));  // on the mask
  addPoint(&cloud, pointAt(3, 4, 9));  // behind it, on the mask too
  addPoint(&cloud, pointAt(4, 4, 9));  // beside it, hidden by the three-pixel mask of the first
  addPoint(&cloud, pointAt(9, 4, 9));
  CameraView view = handCamera();
  view.ego_mask = cv::Mat(kHeight, kWidth, CV_8UC1, cv::Scalar(7));
  view.ego_mask.at<std::uint8_t>(4, 3) = 0;
  FusionConfig config = handConfig();
  config.occlusion.horizontal_step_deg = 14.0;  // 2.49 px: min(3, 2 * 2 - 1) = 3 px
  const FusionResult result = SemanticProjector(config).fuse(cloud, {view});
  EXPECT_EQ(statuses(result), (std::vector<int>{2, 2, 1, 0}));
  EXPECT_EQ(result.cameras[0].status[0], PointStatus::kOutsideImages);
}

TEST(SemanticProjector, ReadsAMaskOfAnotherSizeUnderThePixelsCentre) {
  CameraView view = handCamera();
  view.ego_mask = cv::Mat(1, 2, CV_8UC1, cv::Scalar(255));
  view.ego_mask.at<std::uint8_t>(0, 0) = 0;
  Cloud cloud = handCloud();
  // floor((i + 0.5) * 2 / 21) is 0 for i = 9 and 1 for i = 10.
  addPoint(&cloud, pointAt(9, 5, 5));
  addPoint(&cloud, pointAt(10, 5, 5));
  EXPECT_EQ(statuses(SemanticProjector(handConfig()).fuse(cloud, {view})),
            (std::vector<int>{2, 0}));
}

TEST(SemanticProjector, JudgesAMissingImageByStaticExtrinsics) {
  Cloud cloud = handCloud();
  addPoint(&cloud, pointAt(3, 4, 5));
  addPoint(&cloud, pointAt(3, 4, 9));  // hidden, but without an image nothing is judged hidden
  addPoint(&cloud, pointAt(40, 4, 5));
  addPoint(&cloud, pointAt(18, 4, 5));
  CameraView view = handCamera();
  view.has_image = false;
  view.semantics = {};
  view.T_camera_lidar = lookAlong(M_PI, {0, 0, 0});
  view.ego_mask = cv::Mat(kHeight, kWidth, CV_8UC1, cv::Scalar(255));
  view.ego_mask.at<std::uint8_t>(4, 18) = 0;
  const FusionResult result = SemanticProjector(handConfig()).fuse(cloud, {view});
  EXPECT_EQ(statuses(result), (std::vector<int>{3, 3, 2, 2}));
  ASSERT_EQ(result.cameras.size(), 1u);
  EXPECT_TRUE(result.cameras[0].index.empty());

  view.model = nullptr;
  for (const bool has_image : {false, true}) {
    view.has_image = has_image;
    EXPECT_EQ(statuses(SemanticProjector(handConfig()).fuse(cloud, {view})),
              (std::vector<int>{2, 2, 2, 2}));
  }
}

TEST(SemanticProjector, TakesTheBestStatusOfSeveralCameras) {
  Cloud cloud = handCloud();
  addPoint(&cloud, pointAt(3, 4, 9));
  addPoint(&cloud, pointAt(3, 4, 5));
  const auto statusOfFirst = [&](const std::vector<CameraView>& views) {
    return statuses(SemanticProjector(handConfig()).fuse(cloud, views))[0];
  };
  const CameraView hides = handCamera("a_hides", 0);
  CameraView sees = handCamera("b_sees", 1);  // 2 m to the side: no point in front
  sees.T_camera_lidar = lookAlong(0, {0, 2, 0});
  CameraView no_image = handCamera("c_no_image", 2);
  no_image.has_image = false;
  CameraView away = handCamera("d_away", 3);
  away.T_camera_lidar = lookAlong(M_PI, {0, 0, 0});
  CameraView masked = handCamera("e_masked", 4);
  masked.ego_mask = cv::Mat::zeros(1, 1, CV_8UC1);
  EXPECT_EQ(statusOfFirst({hides, sees, no_image, away, masked}), 0);
  EXPECT_EQ(statusOfFirst({no_image, hides, away, masked}), 1);
  EXPECT_EQ(statusOfFirst({away, no_image, masked}), 3);
  EXPECT_EQ(statusOfFirst({masked, away}), 2);
  EXPECT_EQ(statusOfFirst({}), 2);
}

TEST(SemanticProjector, ReadsScoresThroughTheSuperpixelGrid) {
  // Image 21x11, superpixels 7x11, scores 3x1. Image column 13 -> q = floor(13.5 * 7 / 21) = 4 ->
  // cell floor(4.5 * 3 / 7) = 1; column 14 -> q = floor(14.5 / 3) = 4; column 15 -> 5 -> 2.
  cv::Mat scores(1, 3, CV_32FC2);
  scores.at<cv::Vec2f>(0, 0) = {9, -9};
  scores.at<cv::Vec2f>(0, 1) = {0, 1};
  scores.at<cv::Vec2f>(0, 2) = {kNan, 1};
  CameraView view = handCamera();
  view.semantics = {};
  view.semantics.scores = ScoreMap(scores, 2, ScoreFormat{});
  view.semantics.share = cv::Mat(11, 7, CV_32FC1, cv::Scalar(1.0));
  view.semantics.share.at<float>(2, 4) = 0.5f;
  Cloud cloud = handCloud();
  addPoint(&cloud, pointAt(13, 1, 5));
  addPoint(&cloud, pointAt(14, 2, 5));
  addPoint(&cloud, pointAt(15, 2, 5));
  const FusionResult result = SemanticProjector(handConfig()).fuse(cloud, {view});
  EXPECT_EQ(statuses(result), (std::vector<int>{0, 0, 0}));
  const auto p = [&result](int i, int c) { return result.cloud.probabilities[2 * i + c]; };
  EXPECT_NEAR(p(0, 1), 1 / (1 + std::exp(-1.0)), 1e-6);   // tau = 1
  EXPECT_NEAR(p(1, 1), 1 / (1 + std::exp(-0.25)), 1e-6);  // tau = 1 / 0.5^2 = 4
  EXPECT_EQ(p(2, 0), 0.5f);
  EXPECT_EQ(p(2, 1), 0.5f);
  EXPECT_EQ(result.cloud.label[2], 0);
  EXPECT_EQ(result.cloud.entropy[2], 1.0f);
  EXPECT_EQ(result.cameras[0].nonfinite, 1u);
}

TEST(SemanticProjector, LazyAndDenseGiveTheSameNumbers) {
  std::mt19937 random(11);
  const cv::Mat scores = randomScores({15, 9}, 2, &random);
  const cv::Mat share = randomShare({20, 10}, 3, &random);
  CameraView lazy = handCamera(), dense = handCamera();
  lazy.semantics = {};
  lazy.semantics.scores = ScoreMap(scores, 2, ScoreFormat{});
  lazy.semantics.share = share;
  dense.semantics.probabilities = denseProbabilities(lazy.semantics.scores, share, {});
  Cloud cloud = handCloud();
  for (int row = 0; row < kHeight; ++row) {
    for (int column = 0; column < kWidth; ++column) addPoint(&cloud, pointAt(column, row, 5));
  }
  const SemanticProjector projector(handConfig());
  const FusionResult a = projector.fuse(cloud, {lazy}), b = projector.fuse(cloud, {dense});
  EXPECT_EQ(a.cloud.points.status, b.cloud.points.status);
  EXPECT_EQ(std::count(a.cloud.points.status.begin(), a.cloud.points.status.end(), 0),
            kWidth * kHeight);
  EXPECT_EQ(a.cloud.probabilities, b.cloud.probabilities);
  EXPECT_EQ(a.cloud.label, b.cloud.label);
}

TEST(SemanticProjector, NormalisesForeignProbabilitiesAndCountsInvalidOnes) {
  CameraView view = handCamera();
  cv::Mat& p = view.semantics.probabilities;
  p.at<cv::Vec2f>(5, 0) = {1, 3};
  p.at<cv::Vec2f>(5, 1) = {0, 0};
  p.at<cv::Vec2f>(5, 2) = {kNan, 1};
  p.at<cv::Vec2f>(5, 3) = {-0.5, 1.5};
  p.at<cv::Vec2f>(5, 4) = {std::numeric_limits<float>::infinity(), 1};
  Cloud cloud = handCloud();
  for (int column = 0; column < 5; ++column) addPoint(&cloud, pointAt(column, 5, 5));
  const FusionResult result = SemanticProjector(handConfig()).fuse(cloud, {view});
  EXPECT_EQ(result.cloud.probabilities,
            (std::vector<float>{0.25f, 0.75f, 0.5f, 0.5f, 0.5f, 0.5f, 0.5f, 0.5f, 0.5f, 0.5f}));
  EXPECT_EQ(result.cameras[0].nonfinite, 4u);
}

TEST(SemanticProjector, DropsWhatIsNotFusedIfAsked) {
  Cloud cloud = handCloud();
  cloud.first_point_ns = kReference - 5;
  addPoint(&cloud, pointAt(-9, 4, 5), 1, -0.01f);
  addPoint(&cloud, pointAt(3, 4, 5), 2, 0.01f);
  addPoint(&cloud, pointAt(3, 4, 9), 3, 0.02f);
  addPoint(&cloud, pointAt(7, 4, 9), 4, 0.03f);
  FusionConfig config = handConfig();
  config.keep_unlabelled = false;
  CameraView view = handCamera();
  view.semantics.probabilities.at<cv::Vec2f>(4, 7) = {0.875f, 0.125f};
  const FusionResult result = SemanticProjector(config).fuse(cloud, {view});
  EXPECT_EQ(statuses(result), (std::vector<int>{0, 0}));
  EXPECT_EQ(result.cloud.points.x, (std::vector<float>{cloud.x[1], cloud.x[3]}));
  EXPECT_EQ(result.cloud.points.y, (std::vector<float>{cloud.y[1], cloud.y[3]}));
  EXPECT_EQ(result.cloud.points.z, (std::vector<float>{cloud.z[1], cloud.z[3]}));
  EXPECT_EQ(result.cloud.points.intensity, (std::vector<float>{2, 4}));
  EXPECT_EQ(result.cloud.points.ring, (std::vector<std::uint16_t>{2, 4}));
  EXPECT_EQ(result.cloud.points.dt, (std::vector<float>{0.01f, 0.03f}));
  EXPECT_EQ(result.cloud.probabilities, (std::vector<float>{0.25f, 0.75f, 0.875f, 0.125f}));
  EXPECT_EQ(result.cloud.label, (std::vector<std::uint8_t>{1, 0}));
  EXPECT_EQ(result.cloud.confidence, (std::vector<float>{0.75f, 0.875f}));
  EXPECT_EQ(result.cloud.entropy.size(), 2u);
  EXPECT_EQ(result.cloud.cameras, (std::vector<std::uint16_t>{1, 1}));
  EXPECT_EQ(result.cloud.points.first_point_ns, kReference - 5);
  // The report speaks of the input cloud.
  EXPECT_EQ(result.cameras[0].index, (std::vector<std::uint32_t>{1, 2, 3}));
  EXPECT_EQ(result.cameras[0].label, (std::vector<std::uint8_t>{1, 255, 0}));
}

TEST(SemanticProjector, AcceptsEmptyCloudsAndRigs) {
  const SemanticProjector projector([] {
    FusionConfig config = handConfig();
    config.occlusion = OcclusionConfig{};
    return config;
  }());
  Cloud cloud = handCloud();
  FusionResult result = projector.fuse(cloud, {handCamera()});
  EXPECT_EQ(result.cloud.size(), 0u);
  EXPECT_EQ(result.cloud.points.stamp, kReference);
  EXPECT_EQ(result.cloud.class_count, 2);
  EXPECT_EQ(result.cameras.size(), 1u);
  addPoint(&cloud, {5, 0, 0}, kNoRing);
  result = projector.fuse(cloud, {});
  EXPECT_EQ(statuses(result), (std::vector<int>{2}));
  EXPECT_TRUE(result.cameras.empty());
}

/// The message of the error that `fuse` throws, or empty.
std::string refusal(const std::vector<CameraView>& views) {
  Cloud cloud = handCloud();
  addPoint(&cloud, pointAt(3, 4, 5));
  try {
    SemanticProjector(handConfig()).fuse(cloud, views);
  } catch (const DataError& error) {
    return error.what();
  }
  return "";
}

void expectRefused(const CameraView& view, const std::string& part) {
  const std::string message = refusal({view});
  EXPECT_NE(message.find("camera 'cam': "), std::string::npos) << message;
  EXPECT_NE(message.find(part), std::string::npos) << message;
}

TEST(SemanticProjector, RefusesViewsThatDoNotFit) {
  EXPECT_EQ(refusal({handCamera()}), "");
  CameraView view = handCamera();
  view.known_visible = {1, 1};
  expectRefused(view, "visibility of 2 points is known, the cloud has 1");
  view.known_visible.clear();
  view.semantics = {};
  expectRefused(view, "neither");
  view.semantics.scores = ScoreMap(cv::Mat(4, 4, CV_32FC3, cv::Scalar::all(0)), 3, ScoreFormat{});
  view.semantics.share = cv::Mat(4, 4, CV_32FC1, cv::Scalar(1));
  expectRefused(view, "scores have 3 channels, must have 2");
  view.semantics.scores = ScoreMap(cv::Mat(4, 4, CV_32FC2, cv::Scalar::all(0)), 2, ScoreFormat{});
  EXPECT_EQ(refusal({view}), "");
  view.semantics.share = cv::Mat(4, 4, CV_64FC1, cv::Scalar(1));
  expectRefused(view, "share is 4x4");
  view.semantics.share = cv::Mat();
  expectRefused(view, "no share");
  view.semantics.scores = ScoreMap();
  view.semantics.share = cv::Mat(4, 4, CV_32FC1, cv::Scalar(1));
  expectRefused(view, "no scores");
  view.semantics.probabilities = cv::Mat(4, 4, CV_32FC2, cv::Scalar::all(0.5));
  expectRefused(view, "both");
  view.semantics.share = cv::Mat();
  EXPECT_EQ(refusal({view}), "");
  view.semantics.probabilities = cv::Mat(4, 4, CV_32FC3, cv::Scalar::all(0.3));
  expectRefused(view, "4x4 with 3 channels");
  view = handCamera();
  view.ego_mask = cv::Mat(4, 4, CV_8UC3, cv::Scalar::all(1));
  expectRefused(view, "mask is 4x4 with 3 channels");
  view = handCamera();
  view.T_camera_lidar.translation().x() = std::numeric_limits<double>::quiet_NaN();
  expectRefused(view, "must be finite");
  view = handCamera();
  view.rig_index = 16;
  expectRefused(view, "rig_index 16");

  EXPECT_NE(refusal({handCamera("cam", 0), handCamera("cam", 1)}).find("twice"), std::string::npos);
  EXPECT_NE(refusal({handCamera("a", 1), handCamera("b", 1)}).find("rig_index 1"),
            std::string::npos);
  // An unused input is not judged: a camera without an image has no semantics.
  view = handCamera();
  view.has_image = false;
  view.semantics = {};
  EXPECT_EQ(refusal({view}), "");
}

TEST(SemanticProjector, RefusesABadConfigurationNamingEveryProblem) {
  FusionConfig config = handConfig();
  config.class_count = 0;
  config.uncertainty.temperature = 0;
  config.uncertainty.exponent = -1;
  config.occlusion.depth_margin_ratio = std::numeric_limits<double>::quiet_NaN();
  try {
    SemanticProjector projector(config);
    FAIL() << "accepted";
  } catch (const ConfigError& error) {
    EXPECT_EQ(error.problems().size(), 4u);
    const std::string text = error.what();
    for (const char* key : {"class_count", "uncertainty.temperature", "uncertainty.exponent",
                            "occlusion.depth_margin_ratio"}) {
      EXPECT_NE(text.find(key), std::string::npos) << text;
    }
  }
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Projection and occlusion of one camera of the reference rig beside what a user would pick
/// instead, one thread: OpenCV's fisheye model; a k-d tree (FLANN) that visits the points nearest
/// first and `cv::rectangle` masks, as in the paper; and the fusion of a whole scan. Compare rows
/// of one run: absolute times depend on the machine and on its other work.
#include <benchmark/benchmark.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <memory>
#include <opencv2/calib3d.hpp>
#include <opencv2/core/utility.hpp>
#include <opencv2/flann.hpp>
#include <opencv2/imgproc.hpp>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "benchmark_main.h"
#include "semantic_lidar_fusion/fusion/semantic_projector.h"
#include "semantic_lidar_fusion/projection/cloud_projector.h"
#include "semantic_lidar_fusion/projection/occlusion_mask.h"

namespace semantic_lidar_fusion {
namespace {

constexpr int kCameras = 5;
constexpr int kClasses = 12;

/// A lidar's turn in a street of facades with cars and poles, second returns left out. Its rings
/// are evenly spread over 30 deg.
Cloud turnOf(int rings, int steps) {
  Cloud cloud;
  std::mt19937 random(1);
  std::normal_distribution<double> noise(0.0, 0.01);
  for (int step = 0; step < steps; ++step) {
    const double degrees = 360.0 * step / steps;
    const double azimuth = -degrees * kPi / 180.0;
    const double facade = 9.0 / std::max(0.15, std::abs(std::sin(azimuth)));
    const bool car = static_cast<int>(degrees / 8.0) % 4 == 0,
               pole = std::fmod(degrees, 18.0) < 0.6;
    for (int ring = 0; ring < rings; ++ring) {
      const double elevation = (30.0 * ring / (rings - 1) - 15.0) * kPi / 180.0;
      double range = facade / std::cos(elevation);
      if (car && elevation < 0.0) range = std::min(range, 7.0);
      if (pole) range = std::min(range, 5.0);
      if (elevation < 0.0) range = std::min(range, 1.7 / std::sin(-elevation));
      if (range > 100.0 || random() % 40 == 0) continue;
      range += noise(random);
      cloud.x.push_back(static_cast<float>(range * std::cos(elevation) * std::cos(azimuth)));
      cloud.y.push_back(static_cast<float>(range * std::cos(elevation) * std::sin(azimuth)));
      cloud.z.push_back(static_cast<float>(range * std::sin(elevation)));
      cloud.ring.push_back(static_cast<std::uint16_t>(ring));
      cloud.dt.push_back(static_cast<float>(step * 0.1 / steps - 0.05));
    }
  }
  cloud.intensity.assign(cloud.x.size(), 0.0f);
  cloud.status.assign(cloud.x.size(), 0);
  return cloud;
}

/// A turn of a VLP-16.
const Cloud& scan() {
  static const Cloud made = turnOf(16, 1800);
  return made;
}

CameraInfo lens() {
  CameraInfo info;
  info.size = {1920, 1208};
  info.distortion_model = "equidistant";
  info.d = {-0.0557, 0.0173, -0.0019, 0.00007};
  info.k = {1166.0, 0.0, 959.5, 0.0, 1166.0, 603.5, 0.0, 0.0, 1.0};
  return info;
}

Transform cameraFromLidar(double yaw_deg) {
  Eigen::Matrix3d body_from_optical;
  body_from_optical << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  Transform T_lidar_camera = Transform::Identity();
  T_lidar_camera.linear() =
      Eigen::AngleAxisd(yaw_deg * kPi / 180.0, Eigen::Vector3d::UnitZ()) * body_from_optical;
  T_lidar_camera.translation() = Eigen::Vector3d(0.3, 0.1, -0.4);
  return T_lidar_camera.inverse();
}

void projectionOurs(benchmark::State& state) {
  const CameraModel camera(lens(), {});
  const Transform T_camera_lidar = cameraFromLidar(0.0);
  std::size_t points = 0;
  for (auto _ : state) {
    const ProjectedPoints projected = projectCloud(scan(), T_camera_lidar, camera, 0.0);
    points = projected.size();
    benchmark::DoNotOptimize(projected.u.data());
  }
  state.counters["cloud"] = static_cast<double>(scan().size());
  state.counters["in_view"] = static_cast<double>(points);
}
BENCHMARK(projectionOurs)->Name("projection/ours")->Unit(benchmark::kMicrosecond);

/// The same with 20 ms of readout at 15 m/s and 30 deg/s.
void projectionRollingShutter(benchmark::State& state) {
  CameraModelOptions options;
  options.shutter.readout_s = 0.02;
  const CameraModel camera(lens(), options);
  const Transform T_camera_lidar = cameraFromLidar(0.0);
  const Twist motion{{0.0, 0.0, 15.0}, {0.0, 30.0 * kPi / 180.0, 0.0}};
  std::size_t points = 0;
  for (auto _ : state) {
    const ProjectedPoints projected = projectCloud(scan(), T_camera_lidar, camera, 0.0, &motion);
    points = projected.size();
    benchmark::DoNotOptimize(projected.u.data());
  }
  state.counters["in_view"] = static_cast<double>(points);
}
BENCHMARK(projectionRollingShutter)
    ->Name("projection/ours_rolling_shutter")
    ->Unit(benchmark::kMicrosecond);

void projectionOpencv(benchmark::State& state) {
  const CameraInfo info = lens();
  const Transform T_camera_lidar = cameraFromLidar(0.0);
  cv::Mat rotation(3, 3, CV_64F), rotation_vector;
  for (int i = 0; i < 9; ++i)
    rotation.at<double>(i / 3, i % 3) = T_camera_lidar.linear()(i / 3, i % 3);
  cv::Rodrigues(rotation, rotation_vector);
  const Eigen::Vector3d t = T_camera_lidar.translation();
  const cv::Matx33d k(info.k.data());
  std::vector<cv::Point3f> cloud;
  for (std::size_t i = 0; i < scan().size(); ++i) {
    cloud.emplace_back(scan().x[i], scan().y[i], scan().z[i]);
  }
  std::vector<cv::Point2f> pixels;
  for (auto _ : state) {
    cv::fisheye::projectPoints(cloud, pixels, rotation_vector, cv::Vec3d(t.x(), t.y(), t.z()), k,
                               info.d);
    benchmark::DoNotOptimize(pixels.data());
  }
}
BENCHMARK(projectionOpencv)
    ->Name("projection/cv::fisheye::projectPoints")
    ->Unit(benchmark::kMicrosecond);

void occlusionOurs(benchmark::State& state, const OcclusionMode* mode) {
  const CameraModel camera(lens(), {});
  const Transform T_camera_lidar = cameraFromLidar(0.0);
  OcclusionConfig config;
  config.mode = mode;
  if (mode == &OcclusionMode::kPaper) {
    config.vertical_step_deg = 2.0;
    config.horizontal_step_deg = 0.1;
  }
  const BeamGrid grid = beamGrid(scan(), config);
  const ProjectedPoints points =
      projectCloud(scan(), T_camera_lidar, camera, castMarginPx(camera, grid, config));
  for (auto _ : state) {
    benchmark::DoNotOptimize(
        visiblePoints(scan(), points, T_camera_lidar, camera, grid, config).data());
  }
  state.counters["points"] = static_cast<double>(points.size());
}
BENCHMARK_CAPTURE(occlusionOurs, paper, &OcclusionMode::kPaper)
    ->Name("occlusion/ours")
    ->Unit(benchmark::kMicrosecond);
BENCHMARK_CAPTURE(occlusionOurs, adaptive, &OcclusionMode::kAdaptive)
    ->Name("occlusion_adaptive/ours")
    ->Unit(benchmark::kMicrosecond);

/// As in the paper: a k-d tree gives the points by distance, masks are filled rectangles.
void occlusionPeer(benchmark::State& state) {
  const CameraModel camera(lens(), {});
  const Transform T_camera_lidar = cameraFromLidar(0.0);
  const ProjectedPoints points = projectCloud(scan(), T_camera_lidar, camera, 0.0);
  const MaskSize size = paperMaskSize(camera, 0.1 * kPi / 180.0, 2.0 * kPi / 180.0);
  const int count = static_cast<int>(points.size());
  cv::Mat cloud(count, 3, CV_32F);
  for (int k = 0; k < count; ++k) {
    const std::uint32_t i = points.index[static_cast<std::size_t>(k)];
    const Eigen::Vector3d p =
        T_camera_lidar * Eigen::Vector3d(scan().x[i], scan().y[i], scan().z[i]);
    for (int axis = 0; axis < 3; ++axis) cloud.at<float>(k, axis) = static_cast<float>(p[axis]);
  }
  const cv::Mat origin = cv::Mat::zeros(1, 3, CV_32F);
  for (auto _ : state) {
    cv::flann::Index tree(cloud, cv::flann::KDTreeIndexParams(1));
    cv::Mat order, distances;
    tree.knnSearch(origin, order, distances, count, cv::flann::SearchParams(count));
    cv::Mat mask = cv::Mat::zeros(camera.imageSize().height, camera.imageSize().width, CV_8UC1);
    std::vector<std::uint8_t> visible(points.size(), 0);
    for (int k = 0; k < count; ++k) {
      const int i = order.at<int>(0, k);
      if (i < 0) continue;
      const auto at = static_cast<std::size_t>(i);
      const cv::Point pixel(pixelIndex(points.u[at]), pixelIndex(points.v[at]));
      if (mask.at<std::uint8_t>(pixel) != 0) continue;
      visible[at] = 1;
      const cv::Point half((size.width - 1) / 2, (size.height - 1) / 2);
      cv::rectangle(mask, pixel - half, pixel + half, cv::Scalar(255), cv::FILLED);
    }
    benchmark::DoNotOptimize(visible.data());
  }
}
BENCHMARK(occlusionPeer)->Name("occlusion/kdtree+cv::rectangle")->Unit(benchmark::kMicrosecond);

/// All of the reference rig's five cameras, scores and share of `cells`. The cameras' poses err by
/// `deg` around each axis, and 2 cm along it.
void fuseRig(benchmark::State& state, const OcclusionMode* mode, int threads,
             const cv::Size& cells = {640, 402}, double deg = 0.0) {
  const auto model = std::make_shared<const CameraModel>(lens(), CameraModelOptions{});
  cv::RNG random(3);
  std::vector<CameraView> views;
  for (int c = 0; c < kCameras; ++c) {
    cv::Mat scores(cells, CV_32FC(kClasses)), share(cells, CV_32FC1);
    random.fill(scores, cv::RNG::NORMAL, 0.0, 4.0);
    random.fill(share, cv::RNG::UNIFORM, 0.3, 1.0);
    CameraView view;
    view.name = std::string(1, static_cast<char>('A' + c));
    view.rig_index = c;
    view.model = model;
    view.T_camera_lidar = view.T_camera_lidar_static = cameraFromLidar(72.0 * c);
    view.has_image = true;
    if (deg > 0.0) {
      view.errors.common.diagonal().head<3>().setConstant(4e-4);
      view.errors.common.diagonal().tail<3>().setConstant(std::pow(deg * kPi / 180.0, 2));
    }
    view.semantics.scores = ScoreMap(scores, kClasses, {});
    view.semantics.share = share;
    views.push_back(view);
  }
  FusionConfig config;
  config.class_count = kClasses;
  config.occlusion.mode = mode;
  config.threads = threads;
  const SemanticProjector projector(config);
  std::size_t fused = 0;
  for (auto _ : state) {
    const FusionResult result = projector.fuse(scan(), views, false);
    fused = static_cast<std::size_t>(
        std::count(result.cloud.points.status.begin(), result.cloud.points.status.end(), 0));
    benchmark::DoNotOptimize(result.cloud.probabilities.data());
  }
  state.counters["fused"] = static_cast<double>(fused);
}
BENCHMARK_CAPTURE(fuseRig, paper, &OcclusionMode::kPaper, 1)
    ->Name("fuse_five_cameras/ours_paper")
    ->Unit(benchmark::kMicrosecond);
BENCHMARK_CAPTURE(fuseRig, adaptive, &OcclusionMode::kAdaptive, 1)
    ->Name("fuse_five_cameras/ours_adaptive")
    ->Unit(benchmark::kMicrosecond);
/// With and without known errors, at a network's stride of 8 pixels and at 3.
BENCHMARK_CAPTURE(fuseRig, stride_8, &OcclusionMode::kAdaptive, 1, {240, 151})
    ->Name("fuse_five_cameras/ours_adaptive_stride_8")
    ->Unit(benchmark::kMicrosecond);
BENCHMARK_CAPTURE(fuseRig, stride_8_uncertain, &OcclusionMode::kAdaptive, 1, {240, 151}, 0.25)
    ->Name("fuse_five_cameras/ours_adaptive_stride_8_uncertain")
    ->Unit(benchmark::kMicrosecond);
BENCHMARK_CAPTURE(fuseRig, uncertain, &OcclusionMode::kAdaptive, 1, {640, 402}, 0.25)
    ->Name("fuse_five_cameras/ours_adaptive_uncertain")
    ->Unit(benchmark::kMicrosecond);
BENCHMARK_CAPTURE(fuseRig, off, &OcclusionMode::kOff, 1)
    ->Name("fuse_five_cameras/ours_off")
    ->Unit(benchmark::kMicrosecond);
/// Time on the clock, which means nothing unless a second core is idle.
BENCHMARK_CAPTURE(fuseRig, paper_two_threads, &OcclusionMode::kPaper, 2)
    ->Name("fuse_five_cameras/ours_paper_two_threads")
    ->UseRealTime()
    ->Unit(benchmark::kMicrosecond);
BENCHMARK_CAPTURE(fuseRig, two_threads, &OcclusionMode::kAdaptive, 2)
    ->Name("fuse_five_cameras/ours_adaptive_two_threads")
    ->UseRealTime()
    ->Unit(benchmark::kMicrosecond);

/// The turns of the rows below, which are made once each.
const Cloud& turnOf(const benchmark::State& state) {
  static std::map<std::pair<std::int64_t, std::int64_t>, Cloud> made;
  const std::pair<std::int64_t, std::int64_t> key{state.range(0), state.range(1)};
  auto found = made.find(key);
  if (found == made.end()) {
    const Cloud cloud = turnOf(static_cast<int>(key.first), static_cast<int>(key.second));
    found = made.emplace(key, cloud).first;
  }
  return found->second;
}

/// The lidar's part of a scan: beam grid, projection, masks, transfer and merging. Arguments:
/// rings, steps of a turn, cameras, classes.
void lidarOurs(benchmark::State& state) {
  const Cloud& cloud = turnOf(state);
  const auto cameras = static_cast<int>(state.range(2)), classes = static_cast<int>(state.range(3));
  const auto model = std::make_shared<const CameraModel>(lens(), CameraModelOptions{});
  cv::RNG random(3);
  std::vector<CameraView> views;
  for (int c = 0; c < cameras; ++c) {
    cv::Mat scores(151, 240, CV_32FC(classes)), share(151, 240, CV_32FC1);
    random.fill(scores.reshape(1), cv::RNG::NORMAL, 0.0, 4.0);
    random.fill(share, cv::RNG::UNIFORM, 0.3, 1.0);
    CameraView view;
    view.name = std::string(1, static_cast<char>('A' + c));
    view.rig_index = c;
    view.model = model;
    view.T_camera_lidar = view.T_camera_lidar_static = cameraFromLidar(360.0 / cameras * c);
    view.has_image = true;
    view.semantics.scores = ScoreMap(scores, classes, {});
    view.semantics.share = share;
    views.push_back(view);
  }
  FusionConfig config;
  config.class_count = classes;
  const SemanticProjector projector(config);
  for (auto _ : state) {
    benchmark::DoNotOptimize(projector.fuse(cloud, views, false).cloud.probabilities.data());
  }
  state.counters["points"] = static_cast<double>(cloud.size());
}

/// Projection and masks of the same cameras alone, of OpenCV's parts: cv::fisheye, the points
/// sorted by distance, a rectangle for each that is seen. No transfer and no merging.
void lidarPeer(benchmark::State& state) {
  const Cloud& cloud = turnOf(state);
  const auto cameras = static_cast<int>(state.range(2));
  const CameraInfo info = lens();
  const CameraModel model(info, {});
  const MaskSize size =
      paperMaskSize(model, 360.0 / static_cast<double>(state.range(1)) * kPi / 180.0,
                    30.0 / static_cast<double>(state.range(0) - 1) * kPi / 180.0);
  const cv::Point half((size.width - 1) / 2, (size.height - 1) / 2);
  const cv::Rect image(0, 0, info.size.width, info.size.height);
  for (auto _ : state) {
    for (int c = 0; c < cameras; ++c) {
      const Transform T = cameraFromLidar(360.0 / cameras * c);
      std::vector<cv::Point3f> seen;
      std::vector<std::pair<float, int>> order;
      for (std::size_t i = 0; i < cloud.size(); ++i) {
        const Eigen::Vector3d p = T * Eigen::Vector3d(cloud.x[i], cloud.y[i], cloud.z[i]);
        if (p.z() <= 0.1) continue;
        order.emplace_back(static_cast<float>(p.norm()), static_cast<int>(seen.size()));
        seen.emplace_back(static_cast<float>(p.x()), static_cast<float>(p.y()),
                          static_cast<float>(p.z()));
      }
      std::vector<cv::Point2f> pixels;
      cv::fisheye::projectPoints(seen, pixels, cv::Vec3d(), cv::Vec3d(), cv::Matx33d(info.k.data()),
                                 info.d);
      std::sort(order.begin(), order.end());
      cv::Mat mask = cv::Mat::zeros(info.size.height, info.size.width, CV_8UC1);
      int visible = 0;
      for (const auto& [distance, at] : order) {
        const cv::Point pixel(pixelIndex(pixels[static_cast<std::size_t>(at)].x),
                              pixelIndex(pixels[static_cast<std::size_t>(at)].y));
        if (!image.contains(pixel) || mask.at<std::uint8_t>(pixel) != 0) continue;
        ++visible;
        cv::rectangle(mask, pixel - half, pixel + half, cv::Scalar(255), cv::FILLED);
      }
      benchmark::DoNotOptimize(visible);
    }
  }
}

/// 10 and 20 turns a second of lidars that fire as often; many cameras; many classes.
void lidarArguments(benchmark::internal::Benchmark* rows) {
  rows->Args({16, 1800, 5, 12});
  for (const int rings : {64, 128}) {
    for (const int steps : {2048, 1024}) rows->Args({rings, steps, 5, 12});
  }
  rows->Args({16, 1800, 16, 12});
  rows->Unit(benchmark::kMicrosecond);
}
BENCHMARK(lidarOurs)->Name("lidar/ours")->Apply(lidarArguments)->Args({16, 1800, 5, 150});
BENCHMARK(lidarPeer)->Name("lidar/cv::fisheye+cv::rectangle")->Apply(lidarArguments);

}  // namespace
}  // namespace semantic_lidar_fusion

int main(int argc, char** argv) {
  cv::setNumThreads(1);
  return semantic_lidar_fusion::runBenchmarksWithWarmHeap(argc, argv);
}

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <random>

#include "ray_scene.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/thread_pool.h"
#include "semantic_lidar_fusion/smoothing/surface_smoother.h"
#include "smoothing/smoothing_kernels.h"

namespace semantic_lidar_fusion {
namespace {

Cloud streetScan(const LidarPattern& pattern, std::uint32_t seed) {
  RayScene scene;
  scene.addGround(0.0);
  scene.addPanel(8.0, -2.0, 8.0, 2.0, 0.0, 1.5);
  scene.addPanel(-20.0, 6.0, 25.0, 6.0, 0.0, 8.0);
  scene.addBox({6.0, -4.0, 0.8}, {4.0, 1.8, 1.6}, 0.1);
  scene.addPole(5.0, 3.0, 0.15, 0.0, 3.0);
  Transform T_world_lidar = Transform::Identity();
  T_world_lidar.translation().z() = 1.8;
  return scanScene(scene, T_world_lidar, pattern, seed).cloud;
}

/// A quarter of the points is not fused; intensities of 0..255; some probabilities are 0.
SemanticCloud randomSemantics(const Cloud& cloud, int class_count, std::uint32_t seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<float> uniform(0.0f, 1.0f);
  SemanticCloud result;
  result.points = cloud;
  result.points.intensity.resize(cloud.size());
  result.class_count = class_count;
  result.label.assign(cloud.size(), kNoLabel);
  result.confidence.assign(cloud.size(), 0.0f);
  result.entropy.assign(cloud.size(), 1.0f);
  result.cameras.assign(cloud.size(), 0);
  result.probabilities.assign(cloud.size() * static_cast<std::size_t>(class_count), 0.0f);
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    result.points.intensity[i] = std::floor(256.0f * uniform(random) * uniform(random));
    if (uniform(random) < 0.25f) {
      result.points.status[i] = static_cast<std::uint8_t>(PointStatus::kOccluded);
      continue;
    }
    result.points.status[i] = static_cast<std::uint8_t>(PointStatus::kFused);
    float* p = &result.probabilities[i * static_cast<std::size_t>(class_count)];
    float sum = 0.0f;
    for (int c = 0; c < class_count; ++c) {
      p[c] = uniform(random) < 0.2f ? 0.0f : std::exp(8.0f * uniform(random));
      sum += p[c];
    }
    if (sum == 0.0f) sum = p[0] = 1.0f;
    for (int c = 0; c < class_count; ++c) p[c] /= sum;
  }
  return result;
}

bool fused(const SemanticCloud& cloud, std::size_t i) {
  return cloud.points.status[i] == static_cast<std::uint8_t>(PointStatus::kFused);
}

/// The formula of surface_smoother.h in double precision, point by point.
std::vector<std::vector<double>> reference(const BeamGrid& grid, const SmoothingConfig& config,
                                           const SemanticCloud& cloud, double per_intensity) {
  const auto classes = static_cast<std::size_t>(cloud.class_count);
  std::vector<std::vector<double>> a(cloud.size(), std::vector<double>(classes));
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    for (std::size_t c = 0; c < classes; ++c) {
      a[i][c] = std::log(std::max<double>(cloud.probabilities[i * classes + c], 1e-4));
    }
  }
  const Cloud& points = cloud.points;
  for (int round = 0; round < config.iterations; ++round) {
    std::vector<std::vector<double>> next = a;
    for (std::size_t i = 0; i < cloud.size(); ++i) {
      if (!fused(cloud, i)) continue;
      double total = 1.0;
      const BeamGrid::Links& links = grid.links[i];
      for (const std::int32_t link : {links.left, links.right, links.up, links.down}) {
        if (link == BeamGrid::kNoLink || !fused(cloud, static_cast<std::size_t>(link))) continue;
        const auto j = static_cast<std::size_t>(link);
        const Eigen::Vector3d between(double{points.x[i]} - points.x[j],
                                      double{points.y[i]} - points.y[j],
                                      double{points.z[i]} - points.z[j]);
        const double step = per_intensity * (double{points.intensity[i]} - points.intensity[j]);
        const double w =
            std::exp(-between.squaredNorm() / std::pow(config.distance_m, 2) - step * step);
        total += w;
        for (std::size_t c = 0; c < classes; ++c) next[i][c] += w * a[j][c];
      }
      for (double& value : next[i]) value /= total;
    }
    a = next;
  }
  for (std::vector<double>& row : a) {
    const double most = *std::max_element(row.begin(), row.end());
    double sum = 0.0;
    for (double& value : row) sum += value = std::exp(value - most);
    for (double& value : row) value /= sum;
  }
  return a;
}

void expectEqualsReference(const Cloud& cloud, int class_count, const SmoothingConfig& config,
                           double intensity_scale = 1.0) {
  SemanticCloud semantic = randomSemantics(cloud, class_count, 5);
  for (float& value : semantic.points.intensity) {
    value = static_cast<float>(value / intensity_scale);
  }
  const SemanticCloud before = semantic;
  const BeamGrid grid = beamGrid(cloud, {}, nullptr, true);
  const double per_intensity =
      config.intensity > 0.0 ? double{intensityFactor(semantic.points.intensity)} / config.intensity
                             : 0.0;
  const auto expected = reference(grid, config, semantic, per_intensity);
  smoothAlongSurfaces(grid, config, &semantic);
  // Single precision: A is at most 9.2, a round adds three roundings of it, and the logarithm and
  // exponential err by 1e-6.
  const double tolerance = 2e-6 + 4e-6 * (1 + config.iterations);
  std::size_t changed = 0;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const auto classes = static_cast<std::size_t>(class_count);
    const float* p = &semantic.probabilities[i * classes];
    if (!fused(before, i)) {
      EXPECT_EQ(semantic.label[i], kNoLabel);
      EXPECT_EQ(semantic.entropy[i], 1.0f);
      EXPECT_EQ(*std::max_element(p, p + classes), 0.0f);
      continue;
    }
    double entropy = 0.0;
    for (std::size_t c = 0; c < classes; ++c) {
      ASSERT_NEAR(p[c], expected[i][c], tolerance) << i << " " << c;
      if (expected[i][c] > 0.0) entropy -= expected[i][c] * std::log(expected[i][c]);
      changed += std::abs(p[c] - before.probabilities[i * classes + c]) > 0.05f;
    }
    EXPECT_EQ(semantic.label[i], std::max_element(p, p + classes) - p);
    EXPECT_EQ(semantic.confidence[i], p[semantic.label[i]]);
    if (class_count > 1) {
      EXPECT_NEAR(semantic.entropy[i], entropy / std::log(class_count), 10 * tolerance);
    }
  }
  if (class_count > 1) {
    EXPECT_GT(changed, cloud.size() / 4);
  }
}

SmoothingConfig rounds(int iterations, double distance_m = 0.6, double intensity = 20.0) {
  SmoothingConfig config;
  config.iterations = iterations;
  config.distance_m = distance_m;
  config.intensity = intensity;
  return config;
}

TEST(SurfaceSmoother, EqualsThePlainReference) {
  const Cloud cloud = streetScan(LidarPattern::vlp16(0.4), 3);
  for (const int class_count : {1, 2, 7, 8, 12, 19}) {
    expectEqualsReference(cloud, class_count, rounds(4));
  }
  expectEqualsReference(cloud, 12, rounds(1, 0.2));
  expectEqualsReference(cloud, 12, rounds(8, 2.0, 0.0));
  expectEqualsReference(cloud, 12, rounds(4), 255.0);     // parts of 1
  expectEqualsReference(cloud, 12, rounds(4), 1.0 / 16);  // beyond 255
}

TEST(SurfaceSmoother, ServesManyRingsAndNone) {
  LidarPattern many = LidarPattern::vlp16(1.0);
  many.elevation_deg.clear();
  for (int k = 0; k < 128; ++k) many.elevation_deg.push_back(-25.0 + 0.31 * k);
  Cloud cloud = streetScan(many, 3);
  expectEqualsReference(cloud, 12, rounds(4));

  std::fill(cloud.ring.begin(), cloud.ring.end(), kNoRing);
  OcclusionConfig off;
  off.mode = &OcclusionMode::kOff;
  const BeamGrid grid = beamGrid(cloud, off, nullptr, true);
  const auto linked =
      std::count_if(grid.links.begin(), grid.links.end(),
                    [](const BeamGrid::Links& links) { return links.left != BeamGrid::kNoLink; });
  EXPECT_GT(static_cast<std::size_t>(linked), cloud.size() / 2);
}

TEST(SurfaceSmoother, MendsAWrongLabelOnASurfaceAndKeepsAnEdge) {
  Cloud cloud;
  const auto add = [&](double x, double y) {
    cloud.x.push_back(static_cast<float>(x));
    cloud.y.push_back(static_cast<float>(y));
    cloud.z.push_back(0.0f);
    cloud.status.push_back(0);
  };
  for (int k = 0; k < 6; ++k) add(10.0, 0.1 * k);
  SemanticCloud semantic = randomSemantics(cloud, 2, 1);
  BeamGrid grid;
  constexpr std::int32_t kNone = BeamGrid::kNoLink;
  for (std::int32_t k = 0; k < 6; ++k) {
    // The surface ends between 3 and 4.
    grid.links.push_back(
        {k == 3 || k == 5 ? kNone : k + 1, k == 0 || k == 4 ? kNone : k - 1, kNone, kNone});
  }
  const float first_class[6] = {0.9f, 0.3f, 0.9f, 0.9f, 0.05f, 0.05f};
  for (std::size_t k = 0; k < 6; ++k) {
    semantic.points.status[k] = 0;
    semantic.points.intensity[k] = 10.0f;
    semantic.probabilities[2 * k] = first_class[k];
    semantic.probabilities[2 * k + 1] = 1.0f - first_class[k];
  }
  smoothAlongSurfaces(grid, rounds(4), &semantic);
  EXPECT_EQ(semantic.label, (std::vector<std::uint8_t>{0, 0, 0, 0, 1, 1}));
  EXPECT_NEAR(semantic.probabilities[8], 0.05f, 1e-6);  // equal neighbours change nothing
  // An intensity that is no number counts as no difference.
  semantic.points.intensity[4] = std::numeric_limits<float>::quiet_NaN();
  smoothAlongSurfaces(grid, rounds(4), &semantic);
  EXPECT_NEAR(semantic.probabilities[8], 0.05f, 1e-6);
}

TEST(SurfaceSmoother, IsTheSameForEveryNumberOfThreadsAndOffAtZero) {
  const Cloud cloud = streetScan(LidarPattern::vlp16(0.2), 3);
  const BeamGrid grid = beamGrid(cloud, {}, nullptr, true);
  const SemanticCloud before = randomSemantics(cloud, 12, 2);
  SemanticCloud alone = before, off = before;
  smoothAlongSurfaces(grid, rounds(0), &off);
  EXPECT_EQ(off.probabilities, before.probabilities);
  EXPECT_EQ(off.label, before.label);
  smoothAlongSurfaces(grid, rounds(4), &alone);
  for (const int threads : {2, 3, 8}) {
    ThreadPool pool(threads);
    SemanticCloud shared = before;
    smoothAlongSurfaces(grid, rounds(4), &shared, &pool);
    EXPECT_EQ(shared.probabilities, alone.probabilities);
    EXPECT_EQ(shared.entropy, alone.entropy);
    EXPECT_EQ(shared.label, alone.label);
  }
}

TEST(SurfaceSmoother, RefusesTheGridOfAnotherCloud) {
  const Cloud cloud = streetScan(LidarPattern::vlp16(2.0), 3);
  SemanticCloud semantic = randomSemantics(cloud, 3, 2);
  EXPECT_THROW(smoothAlongSurfaces({}, rounds(4), &semantic), DataError);
}

TEST(SurfaceSmoother, BringsIntensitiesToOneScale) {
  const auto ramp = [](float most) {
    std::vector<float> values(5000);
    for (std::size_t k = 0; k < values.size(); ++k) {
      values[k] = most * static_cast<float>(k) / static_cast<float>(values.size() - 1);
    }
    return values;
  };
  EXPECT_EQ(intensityFactor({}), 1.0f);
  EXPECT_EQ(intensityFactor(std::vector<float>(100, 0.0f)), 1.0f);
  EXPECT_EQ(intensityFactor(ramp(255.0f)), 1.0f);
  EXPECT_EQ(intensityFactor(ramp(40.0f)), 1.0f);
  EXPECT_EQ(intensityFactor(ramp(1.0f)), 255.0f);
  EXPECT_NEAR(intensityFactor(ramp(4096.0f)), 255.0 / (0.99 * 4096.0), 1e-3);
  std::vector<float> one_wild = ramp(255.0f);
  one_wild[7] = 1e9f;
  one_wild[8] = std::numeric_limits<float>::quiet_NaN();
  EXPECT_EQ(intensityFactor(one_wild), 1.0f);
}

TEST(SmoothingKernels, AreExactToSinglePrecisionAndEqualToTheByte) {
  std::mt19937 random(4);
  std::uniform_real_distribution<float> exponent(-86.9f, 0.0f), log_probability(-9.3f, 0.1f);
  std::vector<float> x(8000), p(8000);
  for (float& value : x) value = exponent(random);
  for (float& value : p) value = std::exp(log_probability(random));
  x[0] = 0.0f;
  x[1] = -1e30f;
  x[2] = -87.1f;
  p[0] = 1.0f;
  std::vector<float> exponentials = x, logarithms = p;
  const int count = static_cast<int>(x.size());
  kPlainSmoothingKernels.exponentials(exponentials.data(), count);
  kPlainSmoothingKernels.logarithms(logarithms.data(), count);
  EXPECT_EQ(exponentials[0], 1.0f);
  EXPECT_EQ(exponentials[1], 0.0f);
  EXPECT_EQ(exponentials[2], 0.0f);
  for (std::size_t k = 3; k < x.size(); ++k) {
    const double exact = std::exp(double{x[k]});
    ASSERT_NEAR(exponentials[k], exact, 2e-7 * exact) << x[k];
    ASSERT_NEAR(logarithms[k], std::log(double{p[k]}), 1e-6) << p[k];
  }

  constexpr int kStride = 16, kRows = 400;
  std::vector<float> rows(kStride * kRows), weights(4 * kRows), inverse(kRows, 0.3f);
  std::vector<std::int32_t> slots(4 * kRows);
  for (float& value : rows) value = log_probability(random);
  for (float& value : weights) value = std::exp(log_probability(random));
  for (std::int32_t& slot : slots) slot = static_cast<std::int32_t>(random() % kRows);
  const auto averaged = [&](const SmoothingKernels& kernels, std::vector<float>* entropy) {
    std::vector<float> out = rows;
    kernels.average(rows.data(), slots.data(), weights.data(), inverse.data(), kStride, 3, kRows,
                    out.data());
    entropy->resize(kRows);
    kernels.softmax(out.data(), kStride, kRows, entropy->data());
    return out;
  };
  const auto sameBytes = [](const std::vector<float>& a, const std::vector<float>& b) {
    return a.size() == b.size() && std::memcmp(a.data(), b.data(), sizeof(float) * a.size()) == 0;
  };
  std::vector<float> entropy, other_entropy;
  const std::vector<float> plain = averaged(kPlainSmoothingKernels, &entropy);
  const SmoothingKernelList list = usableSmoothingKernels();
  for (int n = 1; n < list.count; ++n) {
    const SmoothingKernels& kernels = *list.kernels[n];
    std::vector<float> other = x;
    kernels.exponentials(other.data(), count);
    EXPECT_TRUE(sameBytes(other, exponentials)) << kernels.name;
    other = p;
    kernels.logarithms(other.data(), count);
    EXPECT_TRUE(sameBytes(other, logarithms)) << kernels.name;
    EXPECT_TRUE(sameBytes(averaged(kernels, &other_entropy), plain)) << kernels.name;
    EXPECT_TRUE(sameBytes(other_entropy, entropy)) << kernels.name;
  }
}

}  // namespace
}  // namespace semantic_lidar_fusion

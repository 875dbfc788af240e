// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <random>
#include <vector>

#include "not_finite.h"
#include "projection/mask_kernels.h"
#include "semantic_lidar_fusion/camera/camera_model.h"

namespace semantic_lidar_fusion {
namespace {

CameraModel camera(double max_theta_deg) {
  CameraInfo info;
  info.size = {1920, 1208};
  info.distortion_model = "equidistant";
  info.d = {-0.0557, 0.0173, -0.0019, 0.00007};
  info.k = {1166.0, 5.0, 959.5, 0.0, 1160.0, 603.5, 0.0, 0.0, 1.0};
  CameraModelOptions options;
  options.max_theta_deg = max_theta_deg;
  return CameraModel(info, options);
}

ExactLens lensOf(const CameraModel& model) {
  ExactLens lens{{0, -1, 0, 0.1, 0, 0, -1, -0.4, 1, 0, 0, 0.3},
                 model.fx(),
                 model.fy(),
                 model.skew(),
                 model.cx(),
                 model.cy(),
                 {},
                 0.0};
  std::copy(model.lens().kannalaBrandt()->begin(), model.lens().kannalaBrandt()->end(), lens.k);
  lens.theta_end = model.maxThetaRad();
  return lens;
}

Eigen::Vector3d inCamera(const ExactLens& lens, const ArmTargets& targets, int i) {
  const double* m = lens.matrix;
  const Eigen::Vector3d p(targets.x[i], targets.y[i], targets.z[i]);
  return {m[0] * p.x() + m[1] * p.y() + m[2] * p.z() + m[3],
          m[4] * p.x() + m[5] * p.y() + m[6] * p.z() + m[7],
          m[8] * p.x() + m[9] * p.y() + m[10] * p.z() + m[11]};
}

TEST(MaskKernels, TargetsHaveThePixelsOfTheCameraModel) {
  std::mt19937 random(5);
  std::normal_distribution<float> coordinate(0.0f, 10.0f);
  for (const double max_theta_deg : {0.0, 95.0, 40.0}) {
    const CameraModel model = camera(max_theta_deg);
    const ExactLens lens = lensOf(model);
    int seen_count = 0;
    for (int trial = 0; trial < 20; ++trial) {
      ArmTargets targets;
      const int count = kMaskSides * kMaskBlock - trial;
      for (int i = 0; i < count; ++i) {
        const float scale = i % 10 == 0 ? 1e-3f : 1.0f;
        targets.x[i] = scale * coordinate(random);
        targets.y[i] = scale * coordinate(random);
        targets.z[i] = scale * coordinate(random);
      }
      // In the camera's centre, and on its axis before and behind it.
      for (int i = 0; i < 3; ++i) {
        targets.x[i] = static_cast<float>(-0.3 + (i - 1)), targets.y[i] = 0.1f,
        targets.z[i] = -0.4f;
      }
      maskKernels().projectTargets(lens, count, &targets);
      for (int i = 0; i < count; ++i) {
        const Eigen::Vector3d p = inCamera(lens, targets, i);
        const auto pixel = model.project(p);
        // Within 1e-9 rad of the domain's end either answer is right.
        if (std::abs(model.theta(p) - model.maxThetaRad()) < 1e-9) continue;
        ASSERT_EQ(!std::isnan(targets.u[i]), pixel.has_value()) << p.transpose();
        if (!pixel) continue;
        ++seen_count;
        // Half a unit in the last place of a float, and what double precision adds.
        const auto tolerance = [](double value) { return 6.1e-8 * std::abs(value) + 1e-9; };
        ASSERT_NEAR(targets.u[i], pixel->x(), tolerance(pixel->x()));
        ASSERT_NEAR(targets.v[i], pixel->y(), tolerance(pixel->y()));
        const double nearness = 1.0 / std::max(p.norm(), 1e-3);
        ASSERT_NEAR(targets.nearness[i], nearness, tolerance(nearness));
      }
    }
    EXPECT_GT(seen_count, 1000);
  }
}

template <typename T>
void expectSameBytes(const T* a, const T* b, std::size_t count) {
  EXPECT_EQ(std::memcmp(a, b, sizeof(T) * count), 0);
}

TEST(MaskKernels, WideOnesProjectTheSameBytes) {
  std::mt19937 random(6);
  std::normal_distribution<float> coordinate(0.0f, 10.0f);
  const float odd[] = {0.0f, -0.0f, 1e-30f, 3e38f, -3e38f, kInfinity, -kInfinity, kNan};
  for (int count = 1; count < 60; ++count) {
    ArmTargets plain{};
    for (int i = 0; i < count; ++i) {
      for (float* value : {plain.x + i, plain.y + i, plain.z + i}) {
        *value = random() % 8 == 0 ? odd[random() % 8] : coordinate(random);
      }
    }
    ArmTargets wide = plain;
    const ExactLens lens = lensOf(camera(count % 2 == 0 ? 0.0 : 60.0));
    kPlainMaskKernels.projectTargets(lens, count, &plain);
    maskKernels().projectTargets(lens, count, &wide);
    const auto n = static_cast<std::size_t>(count);
    for (int i = 0; i < count; ++i) {
      ASSERT_EQ(std::isnan(plain.u[i]), std::isnan(wide.u[i]));
      if (std::isnan(plain.u[i])) plain.u[i] = wide.u[i] = plain.v[i] = wide.v[i] = 0.0f;
      // One that is no number has no sign that counts.
      if (std::isnan(plain.nearness[i])) plain.nearness[i] = wide.nearness[i] = 0.0f;
    }
    expectSameBytes(plain.u, wide.u, n);
    expectSameBytes(plain.v, wide.v, n);
    expectSameBytes(plain.nearness, wide.nearness, n);
  }
}

/// Points in an image of 100 x 60 px, in tiles of 10 px.
class Scene {
 public:
  explicit Scene(std::uint32_t seed) {
    constexpr int kColumns = 11, kRows = 7;
    std::mt19937 random(seed);
    std::uniform_real_distribution<float> across(0.0f, 99.0f), down(0.0f, 59.0f), far(2.0f, 30.0f);
    begin_.assign(kColumns * kRows + 1, 0);
    far_.assign(kColumns * kRows + 1, 0.0f);
    four_ = far_;
    std::vector<std::array<float, 3>> points(200 + random() % 100);
    for (auto& point : points) point = {across(random), down(random), far(random)};
    const auto tileOf = [&](const std::array<float, 3>& point) {
      return static_cast<int>((point[1] + 0.5f) * 0.1f) * kColumns +
             static_cast<int>((point[0] + 0.5f) * 0.1f);
    };
    std::stable_sort(points.begin(), points.end(),
                     [&](const auto& a, const auto& b) { return tileOf(a) < tileOf(b); });
    for (std::size_t i = 0; i < points.size(); ++i) {
      u_.push_back(points[i][0]);
      v_.push_back(points[i][1]);
      distance_.push_back(points[i][2]);
      place_.push_back(static_cast<std::uint32_t>(points.size() - 1 - i));
      const auto tile = static_cast<std::size_t>(tileOf(points[i]));
      ++begin_[tile + 1];
      far_[tile] = std::max(far_[tile], points[i][2]);
    }
    for (std::size_t k = 1; k < begin_.size(); ++k) begin_[k] += begin_[k - 1];
    for (int y = 0; y < kRows; ++y) {
      for (int x = 0; x < kColumns; ++x) {
        for (const int below : {y, std::min(y + 1, kRows - 1)}) {
          for (const int right : {x, std::min(x + 1, kColumns - 1)}) {
            float& four = four_[static_cast<std::size_t>(y * kColumns + x)];
            four = std::max(four, far_[static_cast<std::size_t>(below * kColumns + right)]);
          }
        }
      }
    }
    for (std::vector<float>* values : {&u_, &v_, &distance_}) values->resize(values->size() + 8);
    tiled_ = {0.1f,         kColumns,  kRows,     begin_.data(),    far_.data(),
              four_.data(), u_.data(), v_.data(), distance_.data(), place_.data(),
              0.3f,         0.1f};
  }
  Scene(const Scene&) = delete;
  Scene& operator=(const Scene&) = delete;

  const TiledPoints& tiled() const { return tiled_; }
  std::size_t size() const { return place_.size(); }

 private:
  std::vector<std::uint32_t> begin_, place_;
  std::vector<float> far_, four_, u_, v_, distance_;
  TiledPoints tiled_;
};

MaskCasters randomCasters(int count, std::uint32_t seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<float> across(-20.0f, 120.0f), down(-20.0f, 80.0f);
  std::uniform_real_distribution<float> nearness(0.05f, 0.5f), arm(0.5f, 12.0f);
  const float odd[] = {0.0f, 1e-6f, -40.0f, 3e38f, kInfinity, kNan};
  MaskCasters casters;
  for (int i = 0; i < count; ++i) {
    casters.u[i] = across(random);
    casters.v[i] = down(random);
    casters.nearness[i] = nearness(random);
    const float signs[kMaskSides][2] = {{-1.0f, 0.1f}, {1.0f, 0.1f}, {0.1f, -1.0f}, {0.1f, 1.0f}};
    for (int side = 0; side < kMaskSides; ++side) {
      casters.arm_u[side][i] = signs[side][0] * arm(random);
      casters.arm_v[side][i] = signs[side][1] * arm(random);
      casters.arm_nearness[side][i] = casters.nearness[i] * (0.5f + 2.0f * nearness(random));
      if (random() % 40 == 0) casters.arm_u[side][i] = odd[random() % 6];
      if (random() % 40 == 0) casters.arm_nearness[side][i] = odd[random() % 6];
    }
  }
  return casters;
}

TEST(MaskKernels, WideOnesHideTheSamePoints) {
  std::size_t hidden = 0;
  for (std::uint32_t seed = 1; seed <= 40; ++seed) {
    const Scene scene(seed);
    const int count = kMaskBlock - static_cast<int>(seed);
    const MaskCasters casters = randomCasters(count, seed);
    std::vector<std::uint8_t> visible[2];
    std::vector<HalfMask> halves[2];
    int which = 0;
    for (const MaskKernels* kernels : {&kPlainMaskKernels, &maskKernels()}) {
      halves[which].resize(2 * kMaskBlock);
      halves[which].resize(static_cast<std::size_t>(
          kernels->castHalves(casters, count, scene.tiled(), halves[which].data())));
      visible[which].assign(scene.size(), 1);
      for (const HalfMask& half : halves[which]) {
        kernels->hide(half, scene.tiled(), visible[which].data());
      }
      ++which;
    }
    EXPECT_GT(halves[0].size(), 10u);
    ASSERT_EQ(halves[0].size(), halves[1].size());
    EXPECT_EQ(visible[0], visible[1]) << "seed " << seed;
    hidden += static_cast<std::size_t>(std::count(visible[0].begin(), visible[0].end(), 0));
  }
  EXPECT_GT(hidden, 1000u);
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <vector>

#include "semantic_lidar_fusion/lidar/firing_times.h"

namespace semantic_lidar_fusion {
namespace {

constexpr double kDegPerRad = 180.0 / 3.14159265358979323846;

std::vector<LidarModel> allModels() {
  return {LidarModel::kVlp16, LidarModel::kPuckHiRes, LidarModel::kVlp32c, LidarModel::kHdl32e};
}

TEST(FiringTimes, FillAPacketForEachModel) {
  for (const LidarModel model : allModels()) {
    const FiringTimes& times = firingTimes(model);
    SCOPED_TRACE(times.model_name);
    EXPECT_EQ(times.laser_count * times.firings_per_block, kReturnsPerBlock);
    // The last laser fires before the next firing begins.
    EXPECT_LT(times.lasers[times.laser_count - 1].time_ns, times.firing_ns);
  }
  // The manuals' 754 packets a second of the VLP-16, and twice as many in dual return mode.
  EXPECT_EQ(firingTimes(LidarModel::kVlp16).packetNs(false), 1327104);
  EXPECT_EQ(firingTimes(LidarModel::kVlp16).packetNs(true), 663552);
  EXPECT_EQ(firingTimes(LidarModel::kVlp32c).packetNs(false), 663552);
  EXPECT_EQ(firingTimes(LidarModel::kHdl32e).packetNs(false), 552960);
}

TEST(FiringTimes, NumberRingsFromTheLowestLaserUp) {
  for (const LidarModel model : allModels()) {
    const FiringTimes& times = firingTimes(model);
    SCOPED_TRACE(times.model_name);
    std::vector<double> elevation_of_ring(times.laser_count, 1e9);
    for (int i = 0; i < times.laser_count; ++i) {
      ASSERT_LT(times.lasers[i].ring, times.laser_count);
      elevation_of_ring[times.lasers[i].ring] = times.lasers[i].elevation_rad;
    }
    EXPECT_TRUE(std::is_sorted(elevation_of_ring.begin(), elevation_of_ring.end()));
    EXPECT_LT(elevation_of_ring.back(), 1.0) << "every ring is somebody's";
  }
}

TEST(FiringTimes, SpanTheManualsFieldsOfView) {
  const auto span = [](LidarModel model) {
    const FiringTimes& times = firingTimes(model);
    double lowest = 1.0, highest = -1.0;
    for (int i = 0; i < times.laser_count; ++i) {
      lowest = std::min(lowest, times.lasers[i].elevation_rad);
      highest = std::max(highest, times.lasers[i].elevation_rad);
    }
    return std::make_pair(lowest * kDegPerRad, highest * kDegPerRad);
  };
  EXPECT_NEAR(span(LidarModel::kVlp16).first, -15.0, 1e-9);
  EXPECT_NEAR(span(LidarModel::kVlp16).second, 15.0, 1e-9);
  EXPECT_NEAR(span(LidarModel::kPuckHiRes).first, -10.0, 1e-9);
  EXPECT_NEAR(span(LidarModel::kPuckHiRes).second, 10.0, 1e-9);
  EXPECT_NEAR(span(LidarModel::kVlp32c).first, -25.0, 1e-9);
  EXPECT_NEAR(span(LidarModel::kVlp32c).second, 15.0, 1e-9);
  EXPECT_NEAR(span(LidarModel::kHdl32e).first, -30.67, 1e-9);
  EXPECT_NEAR(span(LidarModel::kHdl32e).second, 10.67, 1e-9);
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include "semantic_lidar_fusion/sync/epoch_monitor.h"

namespace semantic_lidar_fusion {
namespace {

constexpr StampNs kMs = 1000000;
constexpr StampNs kStart = 1500000000 * kNsPerSecond;

TEST(EpochMonitor, OrdinaryDisorderIsOneEpoch) {
  EpochMonitor monitor;
  for (int i = 0; i < 300; ++i) {
    EXPECT_EQ(monitor.observe("lidar", kStart + i * 100 * kMs), StampVerdict::kCurrent);
    // A network that lags by 0.9 s, with neighbours swapped.
    const StampNs lagging = kStart + (i - 9) * 100 * kMs + (i % 2 ? -150 : 150) * kMs;
    EXPECT_EQ(monitor.observe("scores", lagging), StampVerdict::kCurrent);
  }
}

TEST(EpochMonitor, SourceThatAlwaysLagsByMoreIsNoJump) {
  EpochMonitor monitor;
  for (int i = 0; i < 100; ++i) {
    EXPECT_EQ(monitor.observe("lidar", kStart + i * 100 * kMs), StampVerdict::kCurrent);
    EXPECT_EQ(monitor.observe("slow", kStart + i * 100 * kMs - 3 * kNsPerSecond),
              StampVerdict::kCurrent);
  }
}

TEST(EpochMonitor, BagLoopGivesOneNewEpochAndDropsStragglers) {
  EpochMonitor monitor;
  for (int i = 0; i < 100; ++i) {
    monitor.observe("lidar", kStart + i * 100 * kMs);
    monitor.observe("image", kStart + i * 100 * kMs + 20 * kMs);
  }
  const StampNs end = kStart + 99 * 100 * kMs;
  EXPECT_EQ(monitor.observe("lidar", kStart), StampVerdict::kNewEpoch);
  EXPECT_EQ(monitor.observe("image", end + 20 * kMs), StampVerdict::kStale);
  EXPECT_EQ(monitor.observe("lidar", kStart + 100 * kMs), StampVerdict::kCurrent);
  EXPECT_EQ(monitor.observe("image", kStart + 20 * kMs), StampVerdict::kCurrent);
  EXPECT_EQ(monitor.observe("image", kStart + 120 * kMs), StampVerdict::kCurrent);
  // The end of the second pass is reached in ordinary steps.
  for (int i = 2; i < 100; ++i) {
    EXPECT_EQ(monitor.observe("lidar", kStart + i * 100 * kMs), StampVerdict::kCurrent);
    EXPECT_EQ(monitor.observe("image", kStart + i * 100 * kMs + 20 * kMs), StampVerdict::kCurrent);
  }
}

TEST(EpochMonitor, ForwardJumpIsANewEpochAndAGapIsNot) {
  EpochMonitor monitor;
  EXPECT_EQ(monitor.observe("lidar", kStart), StampVerdict::kCurrent);
  EXPECT_EQ(monitor.observe("lidar", kStart + 4 * kNsPerSecond), StampVerdict::kCurrent);
  EXPECT_EQ(monitor.observe("lidar", kStart + 10 * kNsPerSecond), StampVerdict::kNewEpoch);
  EXPECT_EQ(monitor.observe("lidar", kStart + 10 * kNsPerSecond + 100 * kMs),
            StampVerdict::kCurrent);
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/point_cloud.h"

namespace semantic_lidar_fusion {
namespace {

TEST(ConfigErrorTest, ListsEveryProblemOnALineOfItsOwn) {
  const ConfigError error({"a = 1: must be 2", "b: is missing"});
  EXPECT_STREQ(error.what(), "a = 1: must be 2\nb: is missing");
  EXPECT_EQ(error.problems().size(), 2u);
  EXPECT_STRNE(ConfigError({}).what(), "");
  EXPECT_STREQ(ConfigError({"a\nb: is \r missing"}).what(), "a?b: is ? missing");
}

TEST(ScanIntervalTest, IsTheEarliestAndLatestTimeInAnyOrder) {
  TimedCloud cloud;
  cloud.header_stamp = 7;
  EXPECT_EQ(scanInterval(cloud).first_ns, 7);
  EXPECT_EQ(scanInterval(cloud).last_ns, 7);
  cloud.time_ns = {50, 20, 91, 30};
  EXPECT_EQ(scanInterval(cloud).first_ns, 20);
  EXPECT_EQ(scanInterval(cloud).last_ns, 91);
  EXPECT_EQ(scanInterval(cloud).middleNs(), 55);  // 55.5 rounded down
}

TEST(ScanIntervalTest, MiddleOfLargeStampsDoesNotOverflow) {
  const StampNs late = 4000000000LL * kNsPerSecond;
  EXPECT_EQ((ScanInterval{late, late + 100000001}.middleNs()), late + 50000000);
}

TEST(CloudTest, ResizeKeepsArraysEqualAndMarksAbsentRings) {
  Cloud cloud;
  cloud.resize(3);
  EXPECT_EQ(cloud.size(), 3u);
  for (const std::size_t size : {cloud.y.size(), cloud.z.size(), cloud.intensity.size(),
                                 cloud.ring.size(), cloud.dt.size(), cloud.status.size()}) {
    EXPECT_EQ(size, 3u);
  }
  EXPECT_EQ(cloud.ring[2], kNoRing);
  EXPECT_EQ(cloud.status[2], static_cast<std::uint8_t>(PointStatus::kFused));
}

TEST(TimedCloudTest, ReserveAddsNoPoint) {
  TimedCloud cloud;
  cloud.reserve(100);
  EXPECT_TRUE(cloud.empty());
  EXPECT_GE(cloud.firing.capacity(), 100u);
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include "semantic_lidar_fusion/sync/waiting_room.h"
#include "stamps.h"

namespace semantic_lidar_fusion {
namespace {

TEST(WaitingRoom, AsManyScansMayWaitAsComeInTheWait) {
  EXPECT_EQ(scansThatWait(0), 4u);
  EXPECT_EQ(scansThatWait(150 * kMs), 4u);
  EXPECT_EQ(scansThatWait(150 * kMs + 1), 5u);
  EXPECT_EQ(scansThatWait(kNsPerSecond), 21u);
  EXPECT_EQ(scansThatWait(kNsPerSecond, 10 * kMs), 101u);
  EXPECT_EQ(scansThatWait(3600 * kNsPerSecond), 4096u);
}

TEST(WaitingRoom, FollowsTheRateOfTheScansAndNoSingleStamp) {
  WaitingRoom room(kNsPerSecond);
  EXPECT_EQ(room.capacity(), 21u);
  for (int i = 0; i < 20; ++i) room.observe(kStart + i * 100 * kMs);
  EXPECT_EQ(room.capacity(), 21u);  // 10 Hz: no less than at 20 Hz
  for (int i = 200; i < 220; ++i) room.observe(kStart + i * 10 * kMs);
  EXPECT_EQ(room.capacity(), 135u);  // a quarter more than 100 Hz
  room.observe(kStart + 3600 * kNsPerSecond);
  room.observe(kStart + 2200 * kMs);
  room.observe(kStart + 2210 * kMs);
  EXPECT_EQ(room.capacity(), 135u);
  for (int i = 0; i < 20; ++i) room.observe(kStart + 2220 * kMs + i);  // a nanosecond apart
  EXPECT_EQ(room.capacity(), 4001u);
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include "semantic_lidar_fusion/sync/fusion_queue.h"

namespace semantic_lidar_fusion {
namespace {

constexpr StampNs kMs = 1000000;
constexpr StampNs kStart = 1500000000 * kNsPerSecond;

std::shared_ptr<Cloud> cloudAt(StampNs first_ns, StampNs reference_ns) {
  auto cloud = std::make_shared<Cloud>();
  cloud->stamp = reference_ns;
  cloud->first_point_ns = first_ns;
  return cloud;
}

FusionQueueConfig twoCameras() {
  FusionQueueConfig config;
  config.timeout_ns = {200 * kMs, 300 * kMs};
  return config;
}

TEST(FusionQueue, CompletesWhenEveryCameraHasSpokenInAnyOrder) {
  const StampNs t_ref = kStart + 50 * kMs;
  for (int order = 0; order < 4; ++order) {
    FusionQueue queue(twoCameras());
    const auto decide = [&] {
      queue.addReference(kStart, t_ref);
      queue.addSelection(kStart, 0, t_ref);
      queue.addSelection(kStart, 1, std::nullopt);
    };
    const auto semantics = [&] { queue.setSemantics(0, t_ref, true); };
    const auto cloud = [&] { queue.addCloud(cloudAt(kStart + 7, t_ref), 0); };
    if (order == 0) {
      decide();
      semantics();
      cloud();
    }
    if (order == 1) {
      semantics();
      decide();
      cloud();
    }
    if (order == 2) {
      cloud();
      decide();
      EXPECT_TRUE(queue.advance(kMs).empty());
      semantics();
    }
    if (order == 3) {
      cloud();
      semantics();
      EXPECT_TRUE(queue.advance(kMs).empty());
      decide();
    }
    const auto completed = queue.advance(kMs);
    ASSERT_EQ(completed.size(), 1u) << "order " << order;
    EXPECT_EQ(completed[0].views[0].state, ViewState::kReady);
    EXPECT_EQ(completed[0].views[0].image_stamp, t_ref);
    EXPECT_EQ(completed[0].views[1].state, ViewState::kNone);
    EXPECT_EQ(queue.pending(), 0u);
  }
}

TEST(FusionQueue, DeadlineOfEachCameraDecidesForItAlone) {
  FusionQueue queue(twoCameras());
  const StampNs t_ref = kStart + 50 * kMs;
  queue.addReference(kStart, t_ref);
  queue.addSelection(kStart, 0, t_ref);
  queue.addSelection(kStart, 1, t_ref + kMs);
  queue.addCloud(cloudAt(kStart, t_ref), 0);
  queue.setSemantics(0, t_ref, true);
  EXPECT_TRUE(queue.advance(299 * kMs).empty());
  const auto completed = queue.advance(300 * kMs);
  ASSERT_EQ(completed.size(), 1u);
  EXPECT_EQ(completed[0].views[0].state, ViewState::kReady);
  EXPECT_FALSE(completed[0].views[0].timed_out);
  EXPECT_EQ(completed[0].views[1].state, ViewState::kFailed);
  EXPECT_TRUE(completed[0].views[1].timed_out);
}

TEST(FusionQueue, ReportedFailureDoesNotWait) {
  FusionQueue queue(twoCameras());
  const StampNs t_ref = kStart + 50 * kMs;
  queue.addReference(kStart, t_ref);
  for (int camera = 0; camera < 2; ++camera) {
    queue.addSelection(kStart, camera, t_ref);
    queue.setSemantics(camera, t_ref, camera == 0);
  }
  queue.addCloud(cloudAt(kStart, t_ref), 0);
  const auto completed = queue.advance(0);
  ASSERT_EQ(completed.size(), 1u);
  EXPECT_EQ(completed[0].views[1].state, ViewState::kFailed);
  EXPECT_FALSE(completed[0].views[1].timed_out);
}

TEST(FusionQueue, TwoScansMayShareOneReferenceAndOneImage) {
  FusionQueueConfig config = twoCameras();
  config.timeout_ns = {200 * kMs};
  FusionQueue queue(config);
  const StampNs t_ref = kStart + 100 * kMs;
  const StampNs second = kStart + 100 * kMs + 1;
  queue.setSemantics(0, t_ref, true);
  queue.setSemantics(0, t_ref + 30 * kMs, true);
  queue.addReference(kStart, t_ref);
  queue.addSelection(kStart, 0, t_ref);
  queue.addCloud(cloudAt(kStart, t_ref), 0);
  // The second cloud arrives before its own decision: it must not take the first one's.
  queue.addCloud(cloudAt(second, t_ref), 0);
  auto completed = queue.advance(0);
  ASSERT_EQ(completed.size(), 1u);
  EXPECT_EQ(completed[0].cloud->first_point_ns, kStart);
  queue.addReference(second, t_ref);
  queue.addSelection(second, 0, t_ref + 30 * kMs);
  completed = queue.advance(0);
  ASSERT_EQ(completed.size(), 1u);
  EXPECT_EQ(completed[0].cloud->first_point_ns, second);
  EXPECT_EQ(completed[0].views[0].image_stamp, t_ref + 30 * kMs);
}

TEST(FusionQueue, ScansLeaveInOrderAndOverflowIsCounted) {
  FusionQueueConfig config;
  config.timeout_ns = {200 * kMs};
  config.max_pending = 2;
  FusionQueue queue(config);
  for (int i = 0; i < 3; ++i) {
    const StampNs key = kStart + i * 100 * kMs;
    queue.addReference(key, key + 50 * kMs);
    queue.addSelection(key, 0, key + 50 * kMs);
    queue.addCloud(cloudAt(key, key + 50 * kMs), 0);
  }
  EXPECT_EQ(queue.droppedPending(), 1u);
  // The later scan is ready first, but waits for its turn.
  queue.setSemantics(0, kStart + 250 * kMs, true);
  EXPECT_TRUE(queue.advance(0).empty());
  queue.setSemantics(0, kStart + 150 * kMs, true);
  const auto completed = queue.advance(0);
  ASSERT_EQ(completed.size(), 2u);
  EXPECT_LT(completed[0].cloud->stamp, completed[1].cloud->stamp);
}

TEST(FusionQueue, CloudWithoutDecisionsLeavesAtTheLastDeadline) {
  FusionQueue queue(twoCameras());
  queue.addCloud(cloudAt(kStart, kStart), 0);
  EXPECT_TRUE(queue.advance(299 * kMs).empty());
  const auto completed = queue.advance(300 * kMs);
  ASSERT_EQ(completed.size(), 1u);
  EXPECT_EQ(completed[0].views[0].state, ViewState::kFailed);
}

TEST(FusionQueue, RigWithoutCamerasPassesScansThrough) {
  FusionQueue queue(FusionQueueConfig{});
  queue.addCloud(cloudAt(kStart, kStart), 0);
  EXPECT_EQ(queue.advance(0).size(), 1u);
}

}  // namespace
}  // namespace semantic_lidar_fusion

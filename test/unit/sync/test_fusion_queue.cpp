// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include "semantic_lidar_fusion/sync/fusion_queue.h"
#include "stamps.h"

namespace semantic_lidar_fusion {
namespace {

std::shared_ptr<Cloud> cloudAt(StampNs first_ns, StampNs reference_ns) {
  auto cloud = std::make_shared<Cloud>();
  cloud->stamp = reference_ns;
  cloud->first_point_ns = first_ns;
  cloud->resize(1);
  return cloud;
}

FusionQueueConfig twoCameras() {
  FusionQueueConfig config;
  config.timeout_ns = {200 * kMs, 300 * kMs};
  config.selection_grace_ns = 100 * kMs;
  return config;
}

TEST(FusionQueue, CompletesWhenEveryCameraHasSpokenInAnyOrder) {
  const StampNs t_ref = kStart + 50 * kMs;
  for (int order = 0; order < 4; ++order) {
    FusionQueue queue(twoCameras());
    const auto decide = [&] {
      queue.addReference(kStart, t_ref);
      queue.addSelection(kStart, 0, t_ref, 0);
      queue.addSelection(kStart, 1, std::nullopt, 0);
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
  queue.addSelection(kStart, 0, t_ref, 0);
  queue.addSelection(kStart, 1, t_ref + kMs, 0);
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
    queue.addSelection(kStart, camera, t_ref, 0);
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
  queue.addSelection(kStart, 0, t_ref, 0);
  queue.addCloud(cloudAt(kStart, t_ref), 0);
  // The second cloud arrives before its own decision: it must not take the first one's.
  queue.addCloud(cloudAt(second, t_ref), 0);
  auto completed = queue.advance(0);
  ASSERT_EQ(completed.size(), 1u);
  EXPECT_EQ(completed[0].cloud->first_point_ns, kStart);
  queue.addReference(second, t_ref);
  queue.addSelection(second, 0, t_ref + 30 * kMs, 0);
  completed = queue.advance(0);
  ASSERT_EQ(completed.size(), 1u);
  EXPECT_EQ(completed[0].cloud->first_point_ns, second);
  EXPECT_EQ(completed[0].views[0].image_stamp, t_ref + 30 * kMs);
}

TEST(FusionQueue, ScansLeaveInOrderAndOverflowIsCounted) {
  FusionQueueConfig config;
  config.timeout_ns = {0};
  config.selection_grace_ns = 100 * kMs;  // 3 scans a period of 50 ms, and never less than 4
  FusionQueue queue(config);
  for (int i = 0; i < 6; ++i) {
    const StampNs key = kStart + i * 100 * kMs;
    queue.addReference(key, key + 50 * kMs);
    queue.addSelection(key, 0, key + 50 * kMs, 0);
    queue.addCloud(cloudAt(key, key + 50 * kMs), 0);
  }
  EXPECT_EQ(queue.counters().overflow, 2u);
  // The later scans are ready first, but wait for their turn.
  for (int i = 5; i > 2; --i) {
    queue.setSemantics(0, kStart + i * 100 * kMs + 50 * kMs, true);
    EXPECT_TRUE(queue.advance(-1).empty());
  }
  queue.setSemantics(0, kStart + 250 * kMs, true);
  const auto completed = queue.advance(-1);
  ASSERT_EQ(completed.size(), 4u);
  for (std::size_t i = 1; i < 4; ++i) {
    EXPECT_LT(completed[i - 1].cloud->stamp, completed[i].cloud->stamp);
  }
}

TEST(FusionQueue, AnOlderDecisionThanAllThatAreKnownIsCountedAndHarmsNothing) {
  FusionQueue queue(twoCameras());
  for (int i = 1; i <= 32; ++i) queue.addReference(kStart + i * kMs, kStart + i * kMs);
  queue.addReference(kStart, kStart);
  queue.addSelection(kStart, 1, std::nullopt, 0);
  EXPECT_EQ(queue.counters().old_decisions, 2u);
  queue.addSelection(kStart + kMs, 0, std::nullopt, 0);
  queue.addSelection(kStart + kMs, 1, std::nullopt, 0);
  queue.addCloud(cloudAt(kStart + kMs, kStart + kMs), 0);
  EXPECT_EQ(queue.advance(0).size(), 1u);
}

TEST(FusionQueue, TheSemanticsOfAnImageThatADeadlineChoseAreWaitedFor) {
  FusionQueue queue(twoCameras());
  const StampNs t_ref = kStart + 50 * kMs;
  queue.addReference(kStart, t_ref);
  queue.addSelection(kStart, 0, std::nullopt, 0);
  queue.addCloud(cloudAt(kStart, t_ref), 0);
  // Settled by its timeout of 300 ms, as the selector counts it from the scan.
  EXPECT_TRUE(queue.advance(300 * kMs).empty());
  queue.addSelection(kStart, 1, t_ref, 300 * kMs);
  EXPECT_TRUE(queue.advance(599 * kMs).empty());
  queue.setSemantics(1, t_ref, true);
  const auto completed = queue.advance(599 * kMs);
  ASSERT_EQ(completed.size(), 1u);
  EXPECT_EQ(completed[0].views[1].state, ViewState::kReady);
}

TEST(FusionQueue, AScanThatIsKnownOrBehindTheLastIsDroppedAndCounted) {
  FusionQueue queue(FusionQueueConfig{});
  queue.addCloud(cloudAt(kStart + 100 * kMs, kStart + 150 * kMs), 0);
  queue.addCloud(cloudAt(kStart + 100 * kMs, kStart + 150 * kMs), 0);
  queue.addCloud(cloudAt(kStart, kStart + 50 * kMs), 0);
  EXPECT_EQ(queue.counters().out_of_order, 2u);
  EXPECT_EQ(queue.advance(0).size(), 1u);
  queue.reset();
  queue.addCloud(cloudAt(kStart, kStart + 50 * kMs), 0);
  EXPECT_EQ(queue.advance(0).size(), 1u);
}

TEST(FusionQueue, ACloudWithoutPointsWaitsForThoseBeforeItAlone) {
  // Its header may be anywhere, also of a time that the queue has not heard of.
  for (const StampNs stamp : {kStart, kStart + 100 * kMs, kStart - 20 * kNsPerSecond}) {
    FusionQueue queue(twoCameras());
    const auto empty = std::make_shared<Cloud>();
    empty->stamp = empty->first_point_ns = stamp;
    const StampNs t_ref = kStart + 50 * kMs;
    queue.addCloud(cloudAt(kStart, t_ref), 0);
    queue.addCloud(empty, 0);
    queue.addReference(kStart, t_ref);
    EXPECT_TRUE(queue.advance(0).empty());
    for (int camera = 0; camera < 2; ++camera) queue.addSelection(kStart, camera, std::nullopt, 0);
    const auto completed = queue.advance(0);
    ASSERT_EQ(completed.size(), 2u);
    EXPECT_EQ(completed[1].cloud, empty);
    for (const auto& view : completed[1].views) {
      EXPECT_EQ(view.state, ViewState::kNone);
      EXPECT_FALSE(view.timed_out);
    }
    queue.addCloud(empty, 0);
    EXPECT_EQ(queue.advance(0).size(), 1u);
    EXPECT_EQ(queue.counters().out_of_order, 0u);
  }
}

TEST(FusionQueue, AFastLidarWithADeadCameraLosesNothing) {
  for (const StampNs period : {100 * kMs, 10 * kMs, 1326 * kMs / 1000}) {  // to a packet a cloud
    FusionQueue queue(twoCameras());
    std::size_t out = 0;
    constexpr int kScans = 1600;
    for (int i = 0; i < kScans; ++i) {
      const StampNs now = i * period;
      const StampNs key = kStart + now;
      queue.addReference(key, key);
      queue.addCloud(cloudAt(key, key), now);
      // Camera 0 answers at once; what the dead one brings is settled by its timeout, 300 ms.
      queue.addSelection(key, 0, key, now);
      queue.setSemantics(0, key, true);
      const StampNs settled = now / period - (300 * kMs + period - 1) / period;
      if (settled >= 0) queue.addSelection(kStart + settled * period, 1, std::nullopt, now);
      out += queue.advance(now).size();
    }
    out += queue.advance(kScans * period + kNsPerSecond).size();
    EXPECT_EQ(queue.counters().overflow, 0u) << period;
    EXPECT_EQ(out, static_cast<std::size_t>(kScans)) << period;
  }
}

TEST(FusionQueue, CloudWithoutDecisionsLeavesAtTheLastDeadline) {
  FusionQueue queue(twoCameras());
  queue.addCloud(cloudAt(kStart, kStart), 0);
  EXPECT_TRUE(queue.advance(399 * kMs).empty());
  const auto completed = queue.advance(400 * kMs);
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

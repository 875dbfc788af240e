// SPDX-License-Identifier: MIT
/// The parts of nodelets/base/ that need no ROS master.
#include <gtest/gtest.h>

#include <atomic>
#include <chrono>
#include <string>
#include <thread>
#include <vector>

#include "base/callback_gate.h"
#include "base/deadline_clock.h"
#include "base/report_throttle.h"
#include "base/silence_watchdog.h"

namespace semantic_lidar_fusion {
namespace {

using std::chrono::seconds;

TEST(CallbackGateTest, ClosesWhenNothingIsInside) {
  CallbackGate gate;
  std::atomic<bool> inside{false}, may_leave{false}, closed{false};
  std::thread callback([&] {
    gate.pass([&] {
      inside = true;
      while (!may_leave) std::this_thread::yield();
      EXPECT_FALSE(closed);
    });
  });
  while (!inside) std::this_thread::yield();
  std::thread closing([&] {
    gate.close();
    closed = true;
  });
  may_leave = true;
  callback.join();
  closing.join();
  EXPECT_TRUE(closed);
  gate.pass([] { FAIL() << "the gate is closed"; });
}

TEST(SimulatedDeadlineClockTest, RunsWithSimulatedTimeAndNotWithItsJumps) {
  constexpr StampNs s = kNsPerSecond;
  SimulatedDeadlineClock clock;
  StampNs steady = 1000 * s;
  const StampNs start = clock.now(50000 * s, steady);  // a jump: nothing has passed
  EXPECT_EQ(clock.now(50000 * s + s / 2, ++steady) - start, s / 2);
  EXPECT_EQ(clock.now(50000 * s + 3 * s, ++steady) - start, 3 * s);
  EXPECT_EQ(clock.now(20000 * s, ++steady) - start, 3 * s);  // a bag starts anew
  EXPECT_EQ(clock.now(20001 * s, ++steady) - start, 4 * s);
  EXPECT_EQ(clock.now(20006 * s, ++steady) - start, 4 * s);  // 5 s at once are a jump
  EXPECT_EQ(clock.now(20011 * s - 1, ++steady) - start, 9 * s - 1);
}

TEST(SimulatedDeadlineClockTest, GoesOnWithWallTimeAfterAStall) {
  constexpr StampNs s = kNsPerSecond;
  SimulatedDeadlineClock clock;
  const StampNs start = clock.now(50 * s, 1000 * s);
  EXPECT_FALSE(clock.isStalled(50 * s, 1003 * s));
  EXPECT_EQ(clock.now(50 * s, 1003 * s), start);
  EXPECT_TRUE(clock.isStalled(50 * s, 1003 * s + 1));
  EXPECT_EQ(clock.now(50 * s, 1005 * s) - start, 2 * s);
  EXPECT_FALSE(clock.isStalled(50 * s + 1, 1005 * s));
}

TEST(ReportThrottleTest, LetsEachKeyThroughOncePerPeriod) {
  ReportThrottle throttle;
  const auto start = ReportThrottle::Clock::now();
  EXPECT_TRUE(throttle.mayReport("a", start));
  EXPECT_TRUE(throttle.mayReport("b", start));
  EXPECT_FALSE(throttle.mayReport("a", start + seconds(29)));
  EXPECT_TRUE(throttle.mayReport("a", start + seconds(30)));
  EXPECT_FALSE(throttle.mayReport("a", start + seconds(59)));
  EXPECT_TRUE(throttle.mayReport("a", start + seconds(59), seconds(1)));
}

TEST(SilentTopicTest, NamesTopicsThatMayBeMeant) {
  const std::vector<std::string> advertised = {"/gmsl/A0/image_raw", "/velodyne_point", "/odom"};
  EXPECT_EQ(describeSilentTopic("/odom", advertised), "no message on /odom, which is advertised");
  EXPECT_EQ(describeSilentTopic("/velodyne_points", advertised),
            "no message on /velodyne_points, which nobody advertises; advertised similar: "
            "/velodyne_point");
  EXPECT_EQ(describeSilentTopic("/B3/image_raw", advertised),
            "no message on /B3/image_raw, which nobody advertises; advertised similar: "
            "/gmsl/A0/image_raw");
  EXPECT_EQ(describeSilentTopic("/tf", advertised), "no message on /tf, which nobody advertises");
}

/// What a watchdog says, 6 s after its start, of a nodelet that waits for /points.
std::string said(const SilenceWatchdog::Surroundings& surroundings,
                 const std::vector<std::string>& advertised, bool published = false,
                 bool received = false) {
  Health health;
  health.expectInput("/points");
  const auto start = Health::Clock::now() - seconds(6);
  if (received) health.received("/points");
  if (published) health.published("/out");
  SilenceWatchdog watchdog(start);
  const auto early = watchdog.look(health, surroundings, start + seconds(4));
  EXPECT_FALSE(early.report || early.question);
  const auto look = watchdog.look(health, surroundings, start + seconds(6));
  EXPECT_FALSE(look.report && look.question);
  const auto again = watchdog.look(health, surroundings, start + seconds(7));
  EXPECT_FALSE(again.report || again.question);
  const auto report =
      look.question ? SilenceWatchdog::answer(*look.question, advertised) : look.report;
  return report ? report->text : "";
}

TEST(SilenceWatchdogTest, SaysWhyNothingIsPublished) {
  SilenceWatchdog::Surroundings surroundings;
  surroundings.explain_silence = [] { return std::string(); };
  const std::vector<std::string> similar = {"/pointz"}, exact = {"/points"};
  const std::string missing =
      "no message on /points, which nobody advertises; advertised similar: /pointz";
  EXPECT_EQ(said(surroundings, similar), "nothing published for 5 s: " + missing);
  EXPECT_EQ(said(surroundings, similar, true), missing);
  EXPECT_EQ(said(surroundings, similar, false, true), "");

  auto idle = surroundings;
  idle.explain_silence = [] { return std::string("nobody listens"); };
  EXPECT_EQ(said(idle, similar), "nothing published for 5 s: nobody listens");
  EXPECT_EQ(said(idle, similar, true), missing);

  auto ended = idle;  // what the bag never held is news, that nobody listens is none
  ended.clock_is_stalled = true;
  EXPECT_EQ(said(ended, similar), "nothing published for 5 s: " + missing);
  EXPECT_EQ(said(ended, exact), "");

  auto stopped = surroundings;
  stopped.clock_is_silent = true;
  EXPECT_EQ(said(stopped, similar), kSilentClock);
}

}  // namespace
}  // namespace semantic_lidar_fusion

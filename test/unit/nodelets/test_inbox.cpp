// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <ros/callback_queue.h>

#include <atomic>
#include <memory>
#include <thread>
#include <vector>

#include "base/inbox.h"

namespace semantic_lidar_fusion {
namespace {

using IntInbox = Inbox<int>;

TEST(Inbox, HandsOverInOrderOnTheQueuesTurn) {
  ros::CallbackQueue queue;
  std::vector<int> handled;
  const auto inbox = boost::make_shared<IntInbox>(
      &queue, 4, [&](int value) { handled.push_back(value); }, [] { FAIL(); },
      [](std::size_t) { FAIL(); });
  for (int i = 0; i < 4; ++i) inbox->add(i);
  EXPECT_TRUE(handled.empty());
  queue.callAvailable();
  EXPECT_EQ(handled, (std::vector<int>{0, 1, 2, 3}));
}

TEST(Inbox, WhatOverflowsIsTheOldestAndIsCountedExactly) {
  ros::CallbackQueue queue;
  std::vector<int> handled;
  int dropped = 0;
  const auto inbox = boost::make_shared<IntInbox>(
      &queue, 3, [&](int value) { handled.push_back(value); }, [&] { ++dropped; },
      [](std::size_t) { FAIL(); });
  for (int i = 0; i < 10; ++i) inbox->add(i);
  queue.callAvailable();
  EXPECT_EQ(handled, (std::vector<int>{7, 8, 9}));
  EXPECT_EQ(dropped, 7);
  inbox->add(10);  // nothing of the overflow is left behind
  queue.callAvailable();
  EXPECT_EQ(handled.back(), 10);
  EXPECT_EQ(handled.size() + static_cast<std::size_t>(dropped), 11u);
}

TEST(Inbox, OneAtATimeAndNoneLostOnSeveralThreads) {
  constexpr int kMessages = 2000;
  ros::CallbackQueue queue;
  std::atomic<int> inside{0}, most{0}, dropped{0};
  std::vector<int> handled;  // by one thread at a time
  const auto inbox = boost::make_shared<IntInbox>(
      &queue, 50,
      [&](int value) {
        most = std::max(most.load(), ++inside);
        handled.push_back(value);
        --inside;
      },
      [&] { ++dropped; }, [](std::size_t) { FAIL(); });
  std::atomic<bool> stop{false};
  std::vector<std::thread> threads;
  for (int t = 0; t < 3; ++t) {
    threads.emplace_back([&] {
      while (!stop) queue.callOne(ros::WallDuration(0.001));
    });
  }
  for (int i = 0; i < kMessages; ++i) inbox->add(i);
  const ros::WallTime deadline = ros::WallTime::now() + ros::WallDuration(60);
  while (!queue.isEmpty() && ros::WallTime::now() < deadline) ros::WallDuration(0.001).sleep();
  stop = true;
  for (std::thread& thread : threads) thread.join();
  queue.callAvailable();
  EXPECT_EQ(most, 1);
  EXPECT_EQ(static_cast<int>(handled.size()) + dropped, kMessages);
  EXPECT_TRUE(std::is_sorted(handled.begin(), handled.end()));
}

TEST(Inbox, WhatWaitsWhenTheSubscriptionEndsIsCounted) {
  ros::CallbackQueue queue;
  int handled = 0;
  std::size_t lost = 0;
  auto inbox = boost::make_shared<IntInbox>(
      &queue, 3, [&](int) { ++handled; }, [] {}, [&](std::size_t n) { lost += n; });
  inbox->add(1);
  inbox->add(2);
  inbox.reset();
  queue.callAvailable();
  EXPECT_EQ(handled, 0);
  EXPECT_EQ(lost, 2u);
}

}  // namespace
}  // namespace semantic_lidar_fusion

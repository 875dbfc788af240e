// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <atomic>
#include <condition_variable>
#include <mutex>
#include <set>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/thread_pool.h"

namespace semantic_lidar_fusion {
namespace {

TEST(ThreadPool, DoesEachItemOnceWhateverTheNumberOfThreads) {
  for (const int threads : {1, 2, 5}) {
    ThreadPool pool(threads);
    EXPECT_EQ(pool.threads(), threads);
    for (const int count : {0, 1, 2, 7, 100}) {
      for (int round = 0; round < 20; ++round) {
        std::vector<int> done(static_cast<std::size_t>(count), 0);  // each item its own place
        pool.forEach(count, [&](int item) { ++done[static_cast<std::size_t>(item)]; });
        EXPECT_EQ(done, std::vector<int>(static_cast<std::size_t>(count), 1));
      }
    }
  }
}

TEST(ThreadPool, WorksOnAsManyItemsAtOnceAsItHasThreads) {
  constexpr int kThreads = 3;
  ThreadPool pool(kThreads);
  std::mutex mutex;
  std::condition_variable arrived;
  std::set<std::thread::id> ids;
  // Each item waits for the two others: one thread alone would wait for ever.
  pool.forEach(kThreads, [&](int) {
    std::unique_lock<std::mutex> lock(mutex);
    ids.insert(std::this_thread::get_id());
    arrived.notify_all();
    arrived.wait(lock, [&] { return ids.size() == kThreads; });
  });
  EXPECT_EQ(ids.count(std::this_thread::get_id()), 1u);
}

TEST(ThreadPool, ThrowsTheExceptionOfTheLowestItemAndDoesTheOthers) {
  for (const int threads : {2, 5}) {
    ThreadPool pool(threads);
    for (int round = 0; round < 20; ++round) {
      std::atomic<int> done{0};
      try {
        pool.forEach(30, [&](int item) {
          ++done;
          if (item % 10 == 7) throw std::runtime_error(std::to_string(item));
        });
        FAIL();
      } catch (const std::runtime_error& error) {
        EXPECT_STREQ(error.what(), "7");
      }
      EXPECT_EQ(done, 30);
    }
    int again = 0;
    pool.forEach(1, [&](int) { ++again; });
    EXPECT_EQ(again, 1);
  }
}

TEST(ThreadPool, ServesSeveralCallersAndCallsFromWithin) {
  ThreadPool pool(3);
  std::atomic<int> done{0};
  const auto call = [&] {
    for (int round = 0; round < 50; ++round) {
      pool.forEach(4, [&](int) { pool.forEach(3, [&](int) { ++done; }); });
    }
  };
  std::vector<std::thread> callers;
  for (int i = 0; i < 3; ++i) callers.emplace_back(call);
  call();
  for (std::thread& caller : callers) caller.join();
  EXPECT_EQ(done, 4 * 50 * 4 * 3);
}

TEST(ThreadPool, RefusesSizesThatMakeNoSense) {
  EXPECT_THROW(ThreadPool(0), ConfigError);
  EXPECT_THROW(ThreadPool(-1), ConfigError);
  EXPECT_THROW(ThreadPool(ThreadPool::kMaxThreads + 1), ConfigError);
}

}  // namespace
}  // namespace semantic_lidar_fusion

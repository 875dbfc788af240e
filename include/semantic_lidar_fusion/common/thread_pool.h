// SPDX-License-Identifier: MIT
#pragma once

#include <condition_variable>
#include <cstdint>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace semantic_lidar_fusion {

/// A few threads that share the items of one job. They sleep between jobs: none spins.
class ThreadPool {
 public:
  /// `threads` >= 1 counts the thread that calls forEach, so that 1 starts none. Throws ConfigError
  /// outside 1..kMaxThreads.
  explicit ThreadPool(int threads);
  ~ThreadPool();
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  int threads() const { return static_cast<int>(workers_.size()) + 1; }

  /// Calls work(0), ..., work(count - 1), each once, in any order and thread, and returns when all
  /// have ended. If some throw, the exception of the lowest item is thrown. A call while another is
  /// under way (from another thread, or from within `work`) does its items alone.
  void forEach(int count, const std::function<void(int)>& work);

  static constexpr int kMaxThreads = 64;

 private:
  void run();
  /// Takes items until none is left. `lock` is held on entry and on return.
  void takeItems(std::unique_lock<std::mutex>* lock);

  std::mutex mutex_;  ///< guards what follows, except the items under work
  std::condition_variable job_given_, job_ended_;
  const std::function<void(int)>* work_ = nullptr;  ///< null: no job
  int next_ = 0, count_ = 0, unfinished_ = 0;
  int failed_item_ = 0;
  std::exception_ptr failure_;
  bool stop_ = false;
  std::vector<std::thread> workers_;
};

/// The same on the threads of `pool`, or in order on this one if there is none.
void forEach(ThreadPool* pool, int count, const std::function<void(int)>& work);

}  // namespace semantic_lidar_fusion

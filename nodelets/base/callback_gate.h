// SPDX-License-Identifier: MIT
#pragma once

#include <condition_variable>
#include <mutex>

namespace semantic_lidar_fusion {

/// Lets callbacks in until it is closed. Unloading disables a nodelet's queues, but does not wait
/// for a callback that runs on another thread.
class CallbackGate {
 public:
  /// Runs `work`, which must not throw, unless the gate is closed.
  template <class Work>
  void pass(const Work& work) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      if (closed_) return;
      ++inside_;
    }
    work();
    std::lock_guard<std::mutex> lock(mutex_);
    if (--inside_ == 0) empty_.notify_all();
  }
  /// Returns when nothing is inside any more.
  void close() {
    std::unique_lock<std::mutex> lock(mutex_);
    closed_ = true;
    empty_.wait(lock, [this] { return inside_ == 0; });
  }

 private:
  std::mutex mutex_;
  std::condition_variable empty_;
  int inside_ = 0;
  bool closed_ = false;
};

}  // namespace semantic_lidar_fusion

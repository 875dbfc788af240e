// SPDX-License-Identifier: MIT
#pragma once

#include <chrono>
#include <map>
#include <mutex>
#include <string>

namespace semantic_lidar_fusion {

/// Lets a report through at once, then at most once a period for the same key. Thread-safe.
class ReportThrottle {
 public:
  using Clock = std::chrono::steady_clock;
  static constexpr std::chrono::seconds kPeriod{30};

  bool mayReport(const std::string& key, Clock::time_point now = Clock::now(),
                 Clock::duration period = kPeriod) {
    std::lock_guard<std::mutex> lock(mutex_);
    if (reported_.size() >= kMaxKeys) reported_.clear();  // keys hold texts of messages
    const auto [entry, first] = reported_.emplace(key, now);
    if (!first && now - entry->second < period) return false;
    entry->second = now;
    return true;
  }

 private:
  static constexpr std::size_t kMaxKeys = 1000;

  std::mutex mutex_;
  std::map<std::string, Clock::time_point> reported_;
};

}  // namespace semantic_lidar_fusion

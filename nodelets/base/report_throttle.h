// SPDX-License-Identifier: MIT
#pragma once

#include <chrono>
#include <map>
#include <mutex>
#include <string>

namespace semantic_lidar_fusion {

/// Lets a report through at once, then at most every kPeriod for the same key. Thread-safe.
class ReportThrottle {
 public:
  using Clock = std::chrono::steady_clock;
  static constexpr std::chrono::seconds kPeriod{30};

  bool mayReport(const std::string& key, Clock::time_point now = Clock::now()) {
    std::lock_guard<std::mutex> lock(mutex_);
    const auto [entry, first] = reported_.emplace(key, now);
    if (!first && now - entry->second < kPeriod) return false;
    entry->second = now;
    return true;
  }

 private:
  std::mutex mutex_;
  std::map<std::string, Clock::time_point> reported_;
};

}  // namespace semantic_lidar_fusion

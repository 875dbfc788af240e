// SPDX-License-Identifier: MIT
#pragma once

#include <ros/publisher.h>

#include <chrono>
#include <map>
#include <mutex>
#include <string>
#include <vector>

namespace semantic_lidar_fusion {

/// Who listens to a nodelet's outputs. Thread-safe.
class Demand {
 public:
  using Clock = std::chrono::steady_clock;
  /// How long a nodelet works on after its last listener has left: one that comes back finds
  /// everything running.
  static constexpr std::chrono::milliseconds kLinger{2000};

  void add(const ros::Publisher& publisher) {
    std::lock_guard<std::mutex> lock(mutex_);
    advertised_.push_back(publisher);
  }
  /// A listener of `topic` has left.
  void left(const std::string& topic) {
    std::lock_guard<std::mutex> lock(mutex_);
    farewell_[topic] = Clock::now();
  }
  /// Whether somebody listens, or did until a moment ago.
  bool isWanted(const ros::Publisher& publisher) const {
    if (!publisher) return false;
    if (publisher.getNumSubscribers() > 0) return true;
    std::lock_guard<std::mutex> lock(mutex_);
    const auto farewell = farewell_.find(publisher.getTopic());
    return farewell != farewell_.end() && Clock::now() - farewell->second < kLinger;
  }
  /// Why nothing has to be published, in words; empty = something should be.
  std::string idleReason() const {
    std::vector<ros::Publisher> advertised;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      advertised = advertised_;
    }
    for (const ros::Publisher& publisher : advertised) {
      if (isWanted(publisher)) return {};
    }
    return advertised.empty() ? "" : "nobody listens to " + advertised.front().getTopic();
  }

 private:
  mutable std::mutex mutex_;
  std::vector<ros::Publisher> advertised_;
  std::map<std::string, Clock::time_point> farewell_;  ///< by topic
};

}  // namespace semantic_lidar_fusion

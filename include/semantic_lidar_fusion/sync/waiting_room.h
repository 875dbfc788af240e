// SPDX-License-Identifier: MIT
/// How many scans may wait at once: as many as come while one waits its longest, at the rate at
/// which they come. The rate is that of their stamps; below 20 Hz it counts as 20 Hz.
#pragma once

#include <cstddef>
#include <deque>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

/// Scans of one every `period_ns` that come within `longest_ns`, and one more; 4 to 4096.
std::size_t scansThatWait(StampNs longest_ns, StampNs period_ns = kNsPerSecond / 20);

class WaitingRoom {
 public:
  explicit WaitingRoom(StampNs longest_wait_ns) : longest_wait_ns_(longest_wait_ns) {}

  /// A scan has come; `stamp` is the time of its first point.
  void observe(StampNs stamp);
  std::size_t capacity() const { return scansThatWait(longest_wait_ns_, period_ns_); }

 private:
  StampNs longest_wait_ns_;
  StampNs last_ns_ = 0;
  std::deque<StampNs> gaps_ns_;  ///< between the last scans, in order of arrival
  StampNs period_ns_ = kNsPerSecond / 20;
};

}  // namespace semantic_lidar_fusion

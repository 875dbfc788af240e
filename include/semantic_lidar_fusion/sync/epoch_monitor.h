// SPDX-License-Identifier: MIT
/// Tells a jump of time (a bag that starts anew, a clock that was set) from stamps that are merely
/// late, and stragglers of the time before a jump from the time after it. No clock: stamps alone.
#pragma once

#include <map>
#include <string>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

enum class StampVerdict : std::uint8_t {
  kCurrent,
  kNewEpoch,  ///< forget what was buffered, then go on with this stamp
  kStale,     ///< from before the last jump: discard
};

class EpochMonitor {
 public:
  /// A stamp older than the newest by more than this, and older than its own source's newest, is a
  /// jump.
  static constexpr StampNs kBackwardNs = 1000000000;
  /// A stamp newer than the newest by more than this is a jump, not a gap to bridge.
  static constexpr StampNs kForwardNs = 5000000000;

  /// `source`: a name for messages that come in one order, e.g. the topic.
  StampVerdict observe(const std::string& source, StampNs stamp);

 private:
  struct Source {
    StampNs newest = 0;
    std::uint64_t epoch = 0;
  };

  std::map<std::string, Source> sources_;
  std::uint64_t epoch_ = 0;    ///< 0 = nothing seen yet
  StampNs newest_ = 0;         ///< of this epoch
  StampNs newest_before_ = 0;  ///< of the epoch before
};

}  // namespace semantic_lidar_fusion

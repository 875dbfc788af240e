// SPDX-License-Identifier: MIT
#pragma once

#include <mutex>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

/// The clock of deadlines while time is simulated, from an origin of its own. Jumps of the
/// simulated clock do not count. One that stands still goes on with wall time after kStallNs, so
/// that the last scans of a bag, which wait for what it does not hold, come out. Thread-safe.
class SimulatedDeadlineClock {
 public:
  /// A clock that stands still for longer is taken for the end of a bag.
  static constexpr StampNs kStallNs = 3 * kNsPerSecond;

  /// `simulated_ns` is read at `steady_ns` of a clock that never jumps.
  StampNs now(StampNs simulated_ns, StampNs steady_ns);
  /// Whether the simulated clock stands still for longer than kStallNs.
  bool isStalled(StampNs simulated_ns, StampNs steady_ns);

 private:
  /// With the mutex held: follows the simulated clock; returns how long it has stood still.
  StampNs follow(StampNs simulated_ns, StampNs steady_ns);

  std::mutex mutex_;
  StampNs simulated_ns_ = 0;  ///< its last time
  StampNs changed_ns_ = 0;    ///< when that came
  StampNs elapsed_ns_ = 0;    ///< how far it has gone without jumps
};

/// ROS time in simulation, else steady time.
class DeadlineClock {
 public:
  StampNs now();
  /// Whether simulated time stands still: a bag that is paused or has ended.
  bool isStalled();

 private:
  SimulatedDeadlineClock simulated_;
};

}  // namespace semantic_lidar_fusion

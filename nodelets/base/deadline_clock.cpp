// SPDX-License-Identifier: MIT
#include "base/deadline_clock.h"

#include <ros/time.h>

#include <algorithm>

#include "semantic_lidar_fusion/sync/epoch_monitor.h"

namespace semantic_lidar_fusion {

constexpr StampNs SimulatedDeadlineClock::kStallNs;

StampNs SimulatedDeadlineClock::now(StampNs simulated_ns, StampNs steady_ns) {
  std::lock_guard<std::mutex> lock(mutex_);
  const StampNs still_ns = follow(simulated_ns, steady_ns);
  return elapsed_ns_ + std::max<StampNs>(0, still_ns - kStallNs);
}

bool SimulatedDeadlineClock::isStalled(StampNs simulated_ns, StampNs steady_ns) {
  std::lock_guard<std::mutex> lock(mutex_);
  return follow(simulated_ns, steady_ns) > kStallNs;
}

StampNs SimulatedDeadlineClock::follow(StampNs simulated_ns, StampNs steady_ns) {
  if (simulated_ns != simulated_ns_) {
    // A jump is no time that passes: no deadline is due because of it.
    const StampNs step_ns = simulated_ns - simulated_ns_;
    if (step_ns > 0 && step_ns < EpochMonitor::kForwardNs) elapsed_ns_ += step_ns;
    simulated_ns_ = simulated_ns;
    changed_ns_ = steady_ns;
  }
  return steady_ns - changed_ns_;
}

namespace {

StampNs steadyNs() { return static_cast<StampNs>(ros::SteadyTime::now().toNSec()); }
StampNs simulatedNs() { return static_cast<StampNs>(ros::Time::now().toNSec()); }

}  // namespace

StampNs DeadlineClock::now() {
  return ros::Time::isSimTime() ? simulated_.now(simulatedNs(), steadyNs()) : steadyNs();
}

bool DeadlineClock::isStalled() {
  return ros::Time::isSimTime() && simulated_.isStalled(simulatedNs(), steadyNs());
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#pragma once

#include <cstddef>
#include <map>
#include <string>

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/lidar/time_decision.h"

namespace semantic_lidar_fusion {

/// A decoded scan with what was left out of it.
struct Scan {
  TimedCloud cloud;
  TimeDecision time;
  std::map<std::string, std::size_t> counters;
};

}  // namespace semantic_lidar_fusion

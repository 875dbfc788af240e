// SPDX-License-Identifier: MIT
#pragma once

#include <cmath>
#include <string>
#include <vector>

namespace semantic_lidar_fusion {

/// Appends what is wrong with the limits of the measured range (0 = no limit).
inline void checkRangeLimits(double min_range_m, double max_range_m,
                             std::vector<std::string>& problems) {
  const auto check = [&](const char* key, double value) {
    if (!std::isfinite(value) || value < 0.0) {
      problems.push_back(std::string("lidar.") + key + " is " + std::to_string(value) +
                         ", must be 0 (no limit) or more");
    }
  };
  check("min_range_m", min_range_m);
  check("max_range_m", max_range_m);
  if (max_range_m > 0.0 && min_range_m >= max_range_m) {
    problems.push_back("lidar.min_range_m is " + std::to_string(min_range_m) +
                       ", must be less than max_range_m, which is " + std::to_string(max_range_m));
  }
}

/// Whether a measured range lies outside the limits.
inline bool outOfRange(double range_m, double min_range_m, double max_range_m) {
  return range_m < min_range_m || (max_range_m > 0.0 && range_m > max_range_m);
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#pragma once

#include <limits>

namespace semantic_lidar_fusion {

constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

}  // namespace semantic_lidar_fusion

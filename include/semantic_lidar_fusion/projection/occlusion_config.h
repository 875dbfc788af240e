// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>

namespace semantic_lidar_fusion {

enum class OcclusionMode : std::uint8_t { kOff, kPaper, kAdaptive };

struct OcclusionConfig {
  OcclusionMode mode = OcclusionMode::kAdaptive;
  double vertical_step_deg = 0.0;    ///< between rings; 0 = from the data
  double horizontal_step_deg = 0.0;  ///< between firings; 0 = from the data
  double depth_margin_m = 0.3;       ///< adaptive only
  double depth_margin_ratio = 0.10;  ///< adaptive only
};

}  // namespace semantic_lidar_fusion

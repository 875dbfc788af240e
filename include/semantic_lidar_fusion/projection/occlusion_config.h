// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <vector>

namespace semantic_lidar_fusion {

class CameraModel;
struct BeamGrid;
struct MaskInput;

/// How hidden points are found: all that the package knows of a mode. `occlusionModes()` lists
/// them.
struct OcclusionMode {
  /// What a mode reads of the beam grid.
  enum class Needs : std::uint8_t { kNothing, kSteps, kLinks };

  const char* name;  ///< the value of the key `occlusion.mode`
  Needs needs;
  /// Pixels beyond the image within which points may cast into it.
  double (*cast_margin_px)(const CameraModel& camera, const BeamGrid& grid);
  /// 1 = visible, 0 = hidden, for each projected point. Meaningless for points outside the image.
  std::vector<std::uint8_t> (*visible)(const MaskInput& input);

  static const OcclusionMode kOff, kPaper, kAdaptive;
};

/// Every mode that a rig file can name.
const std::vector<const OcclusionMode*>& occlusionModes();

struct OcclusionConfig {
  const OcclusionMode* mode = &OcclusionMode::kAdaptive;  ///< never null
  double vertical_step_deg = 0.0;                         ///< between rings; 0 = from the data
  double horizontal_step_deg = 0.0;                       ///< between firings; 0 = from the data
  double depth_margin_m = 0.3;                            ///< adaptive only
  double depth_margin_ratio = 0.10;                       ///< adaptive only
};

}  // namespace semantic_lidar_fusion

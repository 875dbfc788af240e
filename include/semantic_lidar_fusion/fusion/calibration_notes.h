// SPDX-License-Identifier: MIT
#pragma once

#include <set>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/fusion/semantic_projector.h"

namespace semantic_lidar_fusion {

/// What is to be told of the cameras' calibrations, each sentence once: what was read against the
/// letter of a camera_info or lens file, and a lens file that tf contradicts.
class CalibrationNotes {
 public:
  /// The sentences on these views that were not given before.
  std::vector<std::string> news(const Rig& rig, const std::vector<CameraView>& views);

 private:
  std::set<std::string> given_;
};

}  // namespace semantic_lidar_fusion

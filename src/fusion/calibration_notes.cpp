// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/fusion/calibration_notes.h"

namespace semantic_lidar_fusion {

std::vector<std::string> CalibrationNotes::news(const Rig& rig,
                                                const std::vector<CameraView>& views) {
  std::vector<std::string> result;
  const auto tell = [&](const std::string& text) {
    if (given_.insert(text).second) result.push_back(text);
  };
  std::vector<MountedLens> mounted;
  for (const CameraView& view : views) {
    if (!view.model) continue;
    const CameraConfig& config = rig.cameras[static_cast<std::size_t>(view.rig_index)];
    for (const std::string& note : view.model->notes()) tell("camera " + view.name + ": " + note);
    mounted.push_back({view.name, config.lens.calibration, view.T_camera_lidar_static});
  }
  for (const std::string& contradiction : mountingContradictions(mounted)) tell(contradiction);
  return result;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/projection/occlusion_mask.h"

#include <algorithm>
#include <cmath>

#include "paper_mask.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/projection/surface_mask.h"

namespace semantic_lidar_fusion {
namespace {

double noMarginPx(const CameraModel&, const BeamGrid&) { return 0.0; }

std::vector<std::uint8_t> allVisible(const MaskInput& input) {
  return std::vector<std::uint8_t>(input.points.size(), 1);
}

std::vector<std::uint8_t> visibleByPaperMasks(const MaskInput& input) {
  const BeamGrid& grid = input.grid;
  return visibleByPaper(
      input.points, input.camera,
      paperMaskSize(input.camera, grid.horizontal_step_rad, grid.vertical_step_rad));
}

}  // namespace

const OcclusionMode OcclusionMode::kOff{"off", Needs::kNothing, noMarginPx, allVisible};
const OcclusionMode OcclusionMode::kPaper{"paper", Needs::kSteps, noMarginPx, visibleByPaperMasks};
const OcclusionMode OcclusionMode::kAdaptive{"adaptive", Needs::kLinks, surfaceMaskMarginPx,
                                             visibleBySurfaces};

const std::vector<const OcclusionMode*>& occlusionModes() {
  static const std::vector<const OcclusionMode*> modes = {
      &OcclusionMode::kOff, &OcclusionMode::kPaper, &OcclusionMode::kAdaptive};
  return modes;
}

MaskSize paperMaskSize(const CameraModel& camera, double horizontal_step_rad,
                       double vertical_step_rad) {
  const auto odd = [](double gap) {
    if (!(gap > 1.0)) return 1;
    const int up = static_cast<int>(std::ceil(std::min(gap, 1e6)));
    return std::max(1, std::min(up | 1, 2 * static_cast<int>(std::floor(std::min(gap, 1e6))) - 1));
  };
  return {odd(camera.axialFocalX() * std::tan(horizontal_step_rad)),
          odd(camera.axialFocalY() * std::tan(vertical_step_rad))};
}

double castMarginPx(const CameraModel& camera, const BeamGrid& grid,
                    const OcclusionConfig& config) {
  return config.mode->cast_margin_px(camera, grid);
}

std::vector<std::uint8_t> visiblePoints(const Cloud& cloud, const ProjectedPoints& points,
                                        const Transform& T_camera_lidar, const CameraModel& camera,
                                        const BeamGrid& grid, const OcclusionConfig& config,
                                        const Twist* motion) {
  if (config.mode->needs == OcclusionMode::Needs::kLinks && grid.links.size() != cloud.size()) {
    throw DataError("beam grid of " + std::to_string(grid.links.size()) + " points for " +
                    std::to_string(cloud.size()) + ": must be that of the same cloud");
  }
  return config.mode->visible({cloud, points, T_camera_lidar, camera, grid, config, motion});
}

}  // namespace semantic_lidar_fusion

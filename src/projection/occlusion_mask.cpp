// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/projection/occlusion_mask.h"

#include <algorithm>
#include <cmath>

#include "paper_mask.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/projection/surface_mask.h"

namespace semantic_lidar_fusion {

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
  if (config.mode != OcclusionMode::kAdaptive) return 0.0;
  double step = std::max(grid.horizontal_step_rad, grid.vertical_step_rad);
  for (const BeamGrid::Ring& ring : grid.rings) {
    step = std::max({step, 2.0 * ring.half_up_rad, 2.0 * ring.half_down_rad});
  }
  return std::max(camera.axialFocalX(), camera.axialFocalY()) * step;
}

std::vector<std::uint8_t> visiblePoints(const Cloud& cloud, const ProjectedPoints& points,
                                        const Transform& T_camera_lidar, const CameraModel& camera,
                                        const BeamGrid& grid, const OcclusionConfig& config) {
  switch (config.mode) {
    case OcclusionMode::kOff:
      break;
    case OcclusionMode::kPaper:
      return visibleByPaper(
          points, camera, paperMaskSize(camera, grid.horizontal_step_rad, grid.vertical_step_rad));
    case OcclusionMode::kAdaptive:
      if (grid.links.size() != cloud.size()) {
        throw DataError("beam grid of " + std::to_string(grid.links.size()) + " points for " +
                        std::to_string(cloud.size()) + ": must be that of the same cloud");
      }
      return visibleBySurfaces(cloud, points, T_camera_lidar, camera, grid, config);
  }
  return std::vector<std::uint8_t>(points.size(), 1);
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <vector>

#include "semantic_lidar_fusion/projection/occlusion_mask.h"

namespace semantic_lidar_fusion {

/// Mode `paper` of the occlusion masks: 1 = visible, 0 = hidden, for each of `points`; 0 outside
/// the image. `mask`: odd numbers of pixels.
std::vector<std::uint8_t> visibleByPaper(const ProjectedPoints& points, const CameraModel& camera,
                                         const MaskSize& mask);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Which neighbouring returns of a range image lie on one surface.
#pragma once

#include <vector>

#include "range_image.h"
#include "semantic_lidar_fusion/projection/beam_grid.h"

namespace semantic_lidar_fusion {

/// The neighbours of each return on its surface, by places of `image`. `grid` holds the measured
/// steps. The result does not depend on `pool`.
std::vector<BeamGrid::Links> linkSurfaces(const RangeImage& image, const OcclusionConfig& config,
                                          const BeamGrid& grid, ThreadPool* pool);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The ground around the lidar, from its lowest rings.
#pragma once

#include <optional>

#include "range_image.h"
#include "semantic_lidar_fusion/projection/beam_grid.h"

namespace semantic_lidar_fusion {

/// The plane on which most level returns within 5 deg of the lowest ring lie: returns from which
/// the surface goes on level to the ring above. None where fewer than 50 or a third of them agree
/// to 0.2 m, where it leans more than 15 deg, or where it is not below the lidar. `grid` holds the
/// elevations of the rows.
std::optional<BeamGrid::Ground> groundPlane(const RangeImage& image, const BeamGrid& grid);

}  // namespace semantic_lidar_fusion

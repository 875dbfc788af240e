// SPDX-License-Identifier: MIT
/// `adaptive`: the mask of a point is the piece of surface that its beam stands for, as the camera
/// sees it, and its depth follows the surface. Towards a neighbouring return (next ring up or down,
/// next firing left or right) on the same surface it reaches half-way, with inverse depth linear
/// in between. Towards a neighbour on another surface, or none, the surface ends somewhere between
/// the two beams: the mask reaches three quarters of the way, straight on from the neighbour on the
/// opposite side, or else at the point's range; half of the way up and down if it has a neighbour
/// on its surface neither above nor below, and to all sides if it has none at all. A return of the
/// lowest ring that stands above the ground reaches down to it: the lower bodies of cars, which no
/// beam meets. Two returns lie
/// on one surface if their ranges are close, or (ground at a grazing angle) if the surface goes on
/// straight; returns that are missing between them (glass, dark paint) are bridged. A point is
/// hidden iff d > d_near + max(depth_margin_m, depth_margin_ratio * d_near), d_near = the nearest
/// mask where it is in the image. So ground does not hide itself, however far the camera is from
/// the lidar. All points cast, also from outside the image.
#pragma once

#include <cstdint>
#include <vector>

#include "semantic_lidar_fusion/projection/occlusion_mask.h"

namespace semantic_lidar_fusion {

/// Mode `adaptive`: 1 = visible, 0 = hidden, for each point; 0 outside the image.
std::vector<std::uint8_t> visibleBySurfaces(const MaskInput& input);
/// What the widest beam cell of `grid` covers in the image, px.
double surfaceMaskMarginPx(const CameraModel& camera, const BeamGrid& grid);

}  // namespace semantic_lidar_fusion

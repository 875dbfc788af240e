// SPDX-License-Identifier: MIT
/// Which projected points the camera really sees (paper, eq. 12-14 and Fig. 5).
///
/// `paper`: points are visited nearest first (distance to the camera; ties: lower index). A point
/// whose pixel lies in the mask of a nearer visible point is hidden; a hidden point casts no mask.
/// The mask is a rectangle of constant full size, odd numbers of pixels, centred on the point's
/// pixel: |du| <= (w - 1) / 2, |dv| <= (h - 1) / 2. Only points inside the image cast; no depth
/// margin.
///
/// `adaptive`: see surface_mask.h.
#pragma once

#include <cstdint>
#include <vector>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/projection/beam_grid.h"
#include "semantic_lidar_fusion/projection/cloud_projector.h"
#include "semantic_lidar_fusion/projection/occlusion_config.h"

namespace semantic_lidar_fusion {

/// Full mask size in pixels of mode `paper` (eq. 14): gap = f tan(step),
/// max(1, min(smallest odd >= gap, 2 floor(gap) - 1)).
struct MaskSize {
  int width = 1;
  int height = 1;
};
MaskSize paperMaskSize(const CameraModel& camera, double horizontal_step_rad,
                       double vertical_step_rad);

/// What a mode of occlusion decides from: one camera's view of a cloud.
struct MaskInput {
  const Cloud& cloud;
  const ProjectedPoints& points;
  const Transform& T_camera_lidar;  ///< lidar at the cloud's stamp to camera at its image's time
  const CameraModel& camera;
  const BeamGrid& grid;  ///< of the same cloud
  const OcclusionConfig& config;
  const Twist* motion;  ///< of the camera, for a rolling shutter; null = none
};

/// Pixels beyond the image within which points may cast into it.
double castMarginPx(const CameraModel& camera, const BeamGrid& grid, const OcclusionConfig& config);

/// 1 = visible, 0 = hidden, for each of `points`. Meaningless for points outside the image. Throws
/// DataError if the mode needs links and `grid` is not that of `cloud`.
std::vector<std::uint8_t> visiblePoints(const Cloud& cloud, const ProjectedPoints& points,
                                        const Transform& T_camera_lidar, const CameraModel& camera,
                                        const BeamGrid& grid, const OcclusionConfig& config,
                                        const Twist* motion = nullptr);

}  // namespace semantic_lidar_fusion

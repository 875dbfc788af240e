// SPDX-License-Identifier: MIT
/// Which projected points the camera really sees (paper, eq. 12-14 and Fig. 5).
///
/// Points are visited nearest first (distance to the camera; ties: lower index). A point whose
/// pixel lies in the mask of a nearer visible point is hidden; a hidden point casts no mask.
///
/// `paper`: a rectangle of constant full size, odd numbers of pixels, centred on the point's pixel;
/// |du| <= (w - 1) / 2, |dv| <= (h - 1) / 2; only points inside the image cast; no depth margin.
/// `adaptive`: the box, rounded outwards, of the projections of the point's beam cell (same range,
/// azimuth +- half the median step of its ring, elevation half-way to the rings above and below);
/// hidden iff d > d_near + max(depth_margin_m, depth_margin_ratio * d_near); points outside the
/// image cast too where their box reaches it.
#pragma once

#include <cstdint>
#include <vector>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/projection/cloud_projector.h"

namespace semantic_lidar_fusion {

enum class OcclusionMode : std::uint8_t { kOff, kPaper, kAdaptive };

struct OcclusionConfig {
  OcclusionMode mode = OcclusionMode::kAdaptive;
  double vertical_step_deg = 0.0;    ///< between rings; 0 = from the data
  double horizontal_step_deg = 0.0;  ///< between firings; 0 = from the data
  double depth_margin_m = 0.3;       ///< adaptive only
  double depth_margin_ratio = 0.10;  ///< adaptive only
};

/// Angles between neighbouring beams, seen from the lidar.
struct BeamGrid {
  struct Ring {
    double elevation_rad = 0;  ///< median
    double half_up_rad = 0;    ///< half-way to the next ring up
    double half_down_rad = 0;
    double half_azimuth_rad = 0;  ///< half the median azimuth step
  };
  std::vector<Ring> rings;       ///< by ring number; of rings without points all zero
  double vertical_step_rad = 0;  ///< median over rings
  double horizontal_step_rad = 0;
};

/// Steps given in `config` override the data. Throws DataError when adaptive masks need a ring
/// field that the cloud lacks and vertical_step_deg is 0.
BeamGrid beamGrid(const Cloud& cloud, const OcclusionConfig& config);

/// Full mask size in pixels of mode `paper` (eq. 14): gap = f tan(step),
/// max(1, min(smallest odd >= gap, 2 floor(gap) - 1)).
struct MaskSize {
  int width = 1;
  int height = 1;
};
MaskSize paperMaskSize(const CameraModel& camera, double horizontal_step_rad,
                       double vertical_step_rad);

/// Pixels beyond the image within which points may cast into it.
double castMarginPx(const CameraModel& camera, const BeamGrid& grid, const OcclusionConfig& config);

/// 1 = visible, 0 = hidden, for each of `points`. Meaningless for points outside the image.
std::vector<std::uint8_t> visiblePoints(const Cloud& cloud, const ProjectedPoints& points,
                                        const Transform& T_camera_lidar, const CameraModel& camera,
                                        const BeamGrid& grid, const OcclusionConfig& config);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Which projected points the camera really sees (paper, eq. 12-14 and Fig. 5).
///
/// `paper`: points are visited nearest first (distance to the camera; ties: lower index). A point
/// whose pixel lies in the mask of a nearer visible point is hidden; a hidden point casts no mask.
/// The mask is a rectangle of constant full size, odd numbers of pixels, centred on the point's
/// pixel: |du| <= (w - 1) / 2, |dv| <= (h - 1) / 2. Only points inside the image cast; no depth
/// margin.
///
/// `adaptive`: the mask of a point is the piece of surface that its beam stands for, as the camera
/// sees it, and its depth follows the surface. Towards a neighbouring return (next ring up or down,
/// next firing left or right) on the same surface it reaches half-way, with inverse depth linear
/// in between. Towards a neighbour on another surface, or none, the surface ends somewhere between
/// the two beams: the mask reaches three quarters of the way, straight on from the neighbour on the
/// opposite side, or else at the point's range; half of the way up and down if it has a neighbour
/// on its surface neither above nor below, and to all sides if it has none at all. Two returns lie
/// on one surface if their ranges are close, or (ground at a grazing angle) if the surface goes on
/// straight. A point is hidden iff d > d_near + max(depth_margin_m, depth_margin_ratio * d_near),
/// d_near = the nearest mask on its pixel. So ground does not hide itself, however far the camera
/// is from the lidar. All points cast, also from outside the image; where masks are tall they are
/// sampled every few pixels along their height.
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

/// What the lidar's own range image says of each beam; independent of the camera.
struct BeamGrid {
  struct Ring {
    double elevation_rad = 0;  ///< median
    double half_up_rad = 0;    ///< half-way to the next ring up
    double half_down_rad = 0;
    double half_azimuth_rad = 0;  ///< half the median azimuth step
  };
  /// Cloud indices of the neighbouring returns on the same surface; kNoLink = the surface ends.
  struct Links {
    std::int32_t left, right, up, down;
  };
  static constexpr std::int32_t kNoLink = -1;

  std::vector<Ring> rings;       ///< by ring number; of rings without points all zero
  double vertical_step_rad = 0;  ///< median over rings
  double horizontal_step_rad = 0;
  /// Adaptive only, by cloud index: the ring (a made-up one if the cloud has none; kNoRing for
  /// points that cast no mask) and the links.
  std::vector<std::uint16_t> ring;
  std::vector<Links> links;
};

/// Steps given in `config` override the data. Throws DataError when the vertical step is needed and
/// neither the cloud (no ring field) nor `config` gives it.
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

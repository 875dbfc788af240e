// SPDX-License-Identifier: MIT
/// The rows of a camera's image that the points of the lidar can reach: `cameras[].lidar_rows`.
///
/// They follow from the elevations of the lidar's rings, the extrinsics and the lens, before any
/// point is measured, so that a vehicle and a bag have the same. Points nearer than kReachNearest_m
/// may lie anywhere, and so may those of a vehicle that pitches by more than kReachMarginRad
/// between t_ref and the image; the fusion counts what lies beyond.
#pragma once

#include <cstddef>
#include <optional>
#include <vector>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"

namespace semantic_lidar_fusion {

/// Directions and distances in which a lidar measures points.
struct LidarReach {
  double lowest_rad = 0.0;  ///< elevations of the outermost rings
  double highest_rad = 0.0;
  double nearest_m = 0.0;  ///< > 0
};

/// The reach of a lidar, with a margin: rings kReachMarginRad further out, and points from
/// kReachNearest_m or `min_range_m` on, whichever is more.
LidarReach reachOf(const LidarSpec& lidar, double min_range_m);
constexpr double kReachMarginRad = 0.05;  ///< 3 deg: bumps, slopes, turns within a scan
constexpr double kReachNearest_m = 3.0;

/// The rows in which the image of `camera` shows something of `reach`; the whole image if it shows
/// nothing of it. `T_camera_lidar`: extrinsics.
RowBand reachedRows(const CameraModel& camera, const Transform& T_camera_lidar,
                    const LidarReach& reach);

/// The rows of each camera of a rig, found again when a camera or its place changes. Not
/// thread-safe.
class LidarRows {
 public:
  /// Keeps the reference.
  explicit LidarRows(const Rig& rig) : rig_(rig), found_(rig.cameras.size()) {}

  /// Those that the rig names; with `auto` those that are found, the whole image while the place is
  /// not known.
  RowBand of(std::size_t camera, const CameraPlace& place);

 private:
  struct Found {
    CameraPlace place;
    RowBand rows;
  };

  const Rig& rig_;
  std::vector<std::optional<Found>> found_;  ///< by camera
};

}  // namespace semantic_lidar_fusion

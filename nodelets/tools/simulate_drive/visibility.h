// SPDX-License-Identifier: MIT
/// What a camera sees of a lidar scan, by rays, and what the scan itself tells of it.
///
/// A hidden point is *catchable* from the scan if its occluder was measured where it hides it. Let
/// Q be the place where the line of sight from the camera to the point first meets something, and O
/// the object met. Seen from the lidar at the instant, a return of O, itself closer to the camera
/// than the point, lies within one ring (2 deg) and one azimuth step (0.2 deg) of Q. Returns count
/// where they were measured, also those of objects that have moved on since. A mask hides only what
/// stands farther behind than its depth margin: such a point is *apart* from its occluder.
#pragma once

#include <Eigen/Geometry>
#include <vector>

#include "tools/simulate_drive/drive_path.h"
#include "tools/simulate_drive/lidar.h"
#include "tools/simulate_drive/world.h"

namespace semantic_lidar_fusion {
namespace simulator {

/// The returns of a scan around the lidar at one instant.
class ReturnsAround {
 public:
  /// `time_s`, the instant, and `start_ns`, the stamp of time 0, are those of the drive.
  ReturnsAround(const SimulatedScan& scan, const DrivePath& path, const Transform& T_base_lidar,
                StampNs start_ns, double time_s);

  /// Whether a return of `object`, closer to `eye` than `distance`, lies within one ring and one
  /// azimuth step of `p_world`.
  bool tellOf(int object, const Eigen::Vector3d& p_world, const Eigen::Vector3d& eye,
              double distance) const;

 private:
  struct Return {
    int object;
    float azimuth, elevation;  ///< rad, around the lidar
    Eigen::Vector3f p_world;
  };
  Eigen::Vector2f direction(const Eigen::Vector3d& p_world) const;

  Transform T_lidar_world_;
  std::vector<Return> returns_;  ///< by object, then azimuth
};

struct PointView {
  bool visible = false;
  bool catchable = false;  ///< hidden, and the scan tells by what
  bool apart = false;      ///< hidden, and farther behind what hides it than a rig's default margin
  bool silhouette =
      false;  ///< visible, within one ring and one azimuth step of something before it
};

/// How a camera at `eye` sees the point `p_world` of `object`, at the world's instant.
PointView viewPoint(const World& world, const ReturnsAround& returns, const Eigen::Vector3d& eye,
                    int object, const Eigen::Vector3d& p_world);

}  // namespace simulator
}  // namespace semantic_lidar_fusion

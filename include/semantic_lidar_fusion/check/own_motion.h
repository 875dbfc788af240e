// SPDX-License-Identifier: MIT
/// Where the lidar itself moves, roughly, against what odometry says: enough to tell odometry that
/// stands still, or runs backwards.
#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/motion/pose_buffer.h"

namespace semantic_lidar_fusion {

/// The range that each beam of a scan met, by ring and degree of azimuth.
class RangeGrid {
 public:
  explicit RangeGrid(const TimedCloud& scan);

  /// What the change of ranges between two scans tells.
  struct Change {
    std::size_t cells = 0;    ///< that both scans fill
    std::size_t changed = 0;  ///< by 0.1 to 1.5 m
    /// Horizontal motion in the lidar's frame, m, that explains the changes best: right in its
    /// direction, too short, for what the lidar passes alongside does not change its range.
    Eigen::Vector2d motion = Eigen::Vector2d::Zero();
    double agreeing = 0.0;  ///< share of the changed cells whose sign it explains
    /// Least share of them in a quarter of the horizon: a bus that passes fills two at most.
    double least_quarter = 0.0;
    /// Whether all this is the motion of the lidar.
    bool isClear() const;
  };
  Change to(const RangeGrid& later) const;

 private:
  std::vector<float> range_m_;  ///< NaN = none; ring-major
};

/// Votes over pairs of scans.
class OwnMotion {
 public:
  /// Scans in order of time; two of every `kEvery` are compared. Odometry may not cover them.
  void add(const TimedCloud& scan, const PoseBuffer& odometry, const Transform& T_vehicle_lidar);
  /// What looks wrong, once enough pairs say the same; empty before and if all is well.
  std::string doubt() const;

  static constexpr std::uint64_t kEvery = 4;

 private:
  std::uint64_t scans_ = 0;
  std::optional<RangeGrid> first_;
  std::optional<Transform> T_fixed_lidar_first_;
  StampNs first_ns_ = 0;
  int frozen_ = 0, backwards_ = 0, agreed_ = 0;
};

}  // namespace semantic_lidar_fusion

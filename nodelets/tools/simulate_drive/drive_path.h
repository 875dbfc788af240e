// SPDX-License-Identifier: MIT
/// The true motion of the vehicle, and the road below it.
///
/// Speed and heading are closed forms of time, in cycles of straight driving, braking, a bend (left
/// and right by turns) and speeding up; the position is their integral, tabulated every
/// millisecond and interpolated with its exact derivatives (error below 1 nm). World: x along the
/// first straight, z up, 0 on the road.
#pragma once

#include <vector>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {
namespace simulator {

struct PathPoint {
  double x = 0, y = 0, heading = 0, distance = 0;
};

class DrivePath {
 public:
  /// base_link above the road.
  static constexpr double kBaseHeight = 0.30;
  /// The path begins this long before time 0 and ends this long after `duration_s`.
  static constexpr double kMarginS = 0.5;

  DrivePath(double duration_s, double speed_mps);

  double speed(double time_s) const;         ///< m/s
  double acceleration(double time_s) const;  ///< m/s^2
  double yawRate(double time_s) const;       ///< rad/s
  double distance(double time_s) const { return at(time_s).distance; }
  /// T_world_base at a time within the margins; the body dips when braking and leans in bends.
  Transform pose(double time_s) const;
  /// The lane's middle at a distance from time 0's position; straight beyond both ends.
  PathPoint roadAt(double distance_m) const;
  double firstDistance() const { return table_.front().distance; }
  double lastDistance() const { return table_.back().distance; }

 private:
  double heading(double time_s) const;
  PathPoint at(double time_s) const;

  double duration_s_;
  double cycle_s_;
  double speed_mps_;
  double drop_mps_;
  double turn_rate_;
  std::vector<PathPoint> table_;
};

}  // namespace simulator
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#pragma once

#include <optional>
#include <string>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

/// Compares how far the poses and the twists of one stream of odometry go, second by second: a pose
/// that is frozen, inverted, of another unit or vehicle than the twist, or that turns the other
/// way.
class TwistWatch {
 public:
  /// `twist` in the axes of the moving body. What looks wrong; empty if nothing does, or if the
  /// messages have no twist (all 0).
  std::optional<std::string> add(StampNs stamp, const Transform& T_fixed_body, const Twist& twist);
  /// Forgets the second under way (a clock jump).
  void clear() { way_ = {}; }

 private:
  struct Way {
    StampNs begin = 0, end = 0;
    Transform from = Transform::Identity(), last = Transform::Identity();
    double by_twist_m = 0.0;     ///< length
    double along_twist_m = 0.0;  ///< of the poses' steps, along the twist's direction
    double turn_by_twist = 0.0, turn_by_pose = 0.0;  ///< rad, about the body's z
  };
  Way way_;
};

}  // namespace semantic_lidar_fusion

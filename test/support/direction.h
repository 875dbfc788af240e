// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <cmath>

namespace semantic_lidar_fusion {

/// The unit vector at the angle `theta` from the z axis, turned by `phi` about it from the x axis,
/// rad.
inline Eigen::Vector3d direction(double theta, double phi) {
  return {std::sin(theta) * std::cos(phi), std::sin(theta) * std::sin(phi), std::cos(theta)};
}

}  // namespace semantic_lidar_fusion

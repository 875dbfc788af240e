// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>

namespace semantic_lidar_fusion {

/// [v]x: crossMatrix(v) * w = v x w.
inline Eigen::Matrix3d crossMatrix(const Eigen::Vector3d& v) {
  Eigen::Matrix3d matrix;
  matrix << 0.0, -v.z(), v.y(), v.z(), 0.0, -v.x(), -v.y(), v.x(), 0.0;
  return matrix;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#pragma once

#include <Eigen/Core>
#include <Eigen/LU>
#include <limits>

namespace semantic_lidar_fusion {

/// How far `R` is from a rotation: the largest entry of |R R^T - 1|, infinite for a reflection, NaN
/// where an entry is.
inline double rotationError(const Eigen::Matrix3d& R) {
  if (R.determinant() < 0.0) return std::numeric_limits<double>::infinity();
  return (R * R.transpose() - Eigen::Matrix3d::Identity()).cwiseAbs().maxCoeff();
}

}  // namespace semantic_lidar_fusion

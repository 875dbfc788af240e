// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>

namespace semantic_lidar_fusion {

/// How the distributions of several cameras that see one point become one; key `overlap`.
enum class OverlapRule : std::uint8_t {
  kMean,           ///< arithmetic mean of the distributions
  kGeometricMean,  ///< normalised geometric mean
  kProduct,        ///< normalised product; independent evidence
  kNearestInTime,  ///< smallest |t_point - t_image|, ties averaged
  kMostCentral,    ///< smallest angle from the optical axis, ties averaged
};

}  // namespace semantic_lidar_fusion

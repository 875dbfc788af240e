// SPDX-License-Identifier: MIT
/// What the plain and the wide kernels share. Everything here is local to the file that includes
/// it, so that each compiles its own copy.
#pragma once

#include "map_kernels.h"

namespace semantic_lidar_fusion {
namespace {

// ln(1 + f) = f - f^2/2 + f^3 (k0 + f (k1 + ...)) on [sqrt(1/2) - 1, sqrt(2) - 1] (Cephes, logf).
constexpr float kLog[9] = {3.3333331174e-1f,  -2.4999993993e-1f, 2.0000714765e-1f,
                           -1.6668057665e-1f, 1.4249322787e-1f,  -1.2420140846e-1f,
                           1.1676998740e-1f,  -1.1514610310e-1f, 7.0376836292e-2f};
// The bits of sqrt(1/2), and those of a significand.
constexpr int kRootHalfBits = 0x3f3504f3;
constexpr int kSignificand = 0x007fffff;

// z shares 32 bits with the layer.
constexpr double kMaxIndex = 536870912.0;
constexpr double kPositionUnit = 1048576.0;

/// Written so that compilers make it wide.
inline __attribute__((always_inline)) void placeAll(const PlacementConstants& constants,
                                                    PlacedPoints* points) {
  constexpr int kCount = PlacedPoints::kMaxPoints;
  const double size = constants.voxel_size_m;
  double inside[kCount];
  for (int i = 0; i < kCount; ++i) inside[i] = 1.0;
  for (int axis = 0; axis < 3; ++axis) {
    const double a = constants.rows[axis][0], b = constants.rows[axis][1];
    const double c = constants.rows[axis][2], d = constants.rows[axis][3];
    std::int32_t* const index = points->index[axis];
    std::int32_t* const offset = points->offset[axis];
    for (int i = 0; i < kCount; ++i) {
      const double at = a * static_cast<double>(points->x[i]) +
                        b * static_cast<double>(points->y[i]) +
                        c * static_cast<double>(points->z[i]) + d;
      double cell = at / size;
      const bool far = !(cell < kMaxIndex) | !(cell > -kMaxIndex);
      inside[i] = far ? 0.0 : inside[i];
      cell = far ? 0.0 : cell;
      double whole = static_cast<double>(static_cast<std::int32_t>(cell));
      whole -= cell < whole ? 1.0 : 0.0;
      index[i] = static_cast<std::int32_t>(whole);
      // Not negative by more than a rounding error, so that the cast rounds down.
      double within = (at - whole * size) * kPositionUnit + 0.5;
      within = far ? 0.0 : within;
      offset[i] = static_cast<std::int32_t>(within);
    }
  }
  for (int i = 0; i < kCount; ++i) points->inside[i] = inside[i] > 0.0 ? 1 : 0;
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Smoothing of class distributions along the lidar's surfaces, after the cameras are merged.
///
/// Neighbouring returns on one surface mostly have one class; a network errs on some of them. With
/// the links of the beam grid (left, right, up, down on the same surface), over fused points only:
///
///     A_i = ln max(P_i, 1e-4)
///     `iterations` times, all points at once:
///       A_i <- (A_i + sum_j w_ij A_j) / (1 + sum_j w_ij)
///     w_ij = exp(-(|p_i - p_j| / distance_m)^2 - ((I_i - I_j) / intensity)^2)
///     P_i = softmax(A_i)
///
/// The mean of logarithms is a geometric mean: confident neighbours count for more than doubtful
/// ones, and a class that one of them excludes loses.
#pragma once

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/projection/beam_grid.h"

namespace semantic_lidar_fusion {

class ThreadPool;

struct SmoothingConfig {
  static constexpr int kMostIterations = 100;

  int iterations = 0;       ///< 0 = off
  double distance_m = 0.6;  ///< > 0
  double intensity = 20.0;  ///< on a scale of 0..255; 0 = the distance alone
};

/// Smooths `probabilities` of the points with status kFused and fills their label, confidence and
/// entropy anew; other points neither give nor take. `grid` is that of the cloud, with links.
/// Intensities that run from 0 to 1, or beyond 255, are brought to 0..255 (see
/// intensityFactor). Throws DataError if `grid` is not that of the cloud. The points are shared out
/// among the threads of `pool`, if there is one; the result does not depend on it.
void smoothAlongSurfaces(const BeamGrid& grid, const SmoothingConfig& config, SemanticCloud* cloud,
                         ThreadPool* pool = nullptr);

/// What brings intensities to 0..255. 1 where their 99th percentile lies in 1..255, or is 0; else
/// (reflectivity as a part of 1, raw signals of 16 bits) 255 / that percentile, and 255 for parts
/// of 1. A sample of at most 1024 points decides.
float intensityFactor(const std::vector<float>& intensity);

}  // namespace semantic_lidar_fusion

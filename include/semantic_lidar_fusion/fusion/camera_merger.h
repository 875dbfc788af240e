// SPDX-License-Identifier: MIT
/// Merges what several cameras say of the same point; the result does not depend on their order.
#pragma once

#include <cstdint>
#include <vector>

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/config/overlap_rule.h"

namespace semantic_lidar_fusion {

class ThreadPool;

/// One camera's distributions of its visible points.
struct CameraVotes {
  int rig_index = 0;
  std::vector<std::uint32_t> index;              ///< into the cloud, strictly ascending
  std::vector<double> probabilities;             ///< index.size() x class_count, row-major
  std::vector<std::int64_t> time_difference_ns;  ///< |t_point - t_image|; may be empty unless the
                                                 ///< rule is kNearestInTime
  std::vector<float> theta;                      ///< rad
};

/// Fills label, confidence, entropy, cameras and probabilities of the points that have votes, and
/// sets their status to kFused; the others keep their status and get the values of "none".
/// `cloud`: points and class_count are given, the other arrays are made here. `votes` are in order
/// of camera name: sums run in that order, in double.
///
/// A point with one vote keeps it as it is. `kProduct` and `kGeometricMean` are formed in log space
/// where the product of two could underflow, and of more; where the cameras contradict each other
/// fully (every class has a zero from some camera) they fall back to the mean.
/// The label is the most likely class as published (float), the lowest id on ties; confidence is
/// its probability, entropy H / ln(class_count) (0 for one class); `cameras` holds the bits of the
/// cameras whose votes were used. Throws DataError if arrays of `votes` do not fit each other or
/// the cloud. The points are shared out among the threads of `pool`, if there is one. Without
/// `with_entropy` the entropy stays 1, for smoothing to fill.
void mergeVotes(const std::vector<CameraVotes>& votes, OverlapRule rule, SemanticCloud* cloud,
                ThreadPool* pool = nullptr, bool with_entropy = true);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Bounded, time-ordered odometry readings with interpolation. Ask covers(t) before lookup(t).
#pragma once

#include <cstddef>
#include <deque>
#include <optional>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

struct StampedPose {
  StampNs stamp = 0;  ///< true time
  Transform T_fixed_vehicle = Transform::Identity();
};

/// Linear in translation, slerp in rotation; `fraction` 0 gives a, 1 gives b.
Transform interpolate(const Transform& a, const Transform& b, double fraction);

class PoseBuffer {
 public:
  /// Readings older than the newest by more than `history_ns` are forgotten; 0 keeps all.
  explicit PoseBuffer(StampNs history_ns = 0) : history_ns_(history_ns) {}

  /// Inserts in order of stamp; a second reading of one stamp replaces the first. Throws DataError
  /// if the pose is not finite or its rotation not orthonormal to 1e-3.
  void add(const StampedPose& reading);
  void clear() { readings_.clear(); }

  std::size_t size() const { return readings_.size(); }
  bool empty() const { return readings_.empty(); }
  const std::deque<StampedPose>& readings() const { return readings_; }

  /// Whether `t` lies between two readings, or on one.
  bool covers(StampNs t) const;
  /// Interpolated between the two readings around `t`; empty if not covered.
  std::optional<Transform> lookup(StampNs t) const;
  /// The reading nearest in time, the earlier of two; empty if `t` is not covered.
  std::optional<Transform> closest(StampNs t) const;

 private:
  StampNs history_ns_;
  std::deque<StampedPose> readings_;
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Bounded, time-ordered odometry readings with interpolation. Ask covers(t) before lookup(t).
///
/// A step between two readings that no vehicle makes is a jump: a localisation that found its place
/// again, or two sources of one pose. Nothing is interpolated within it, and the poses on its two
/// sides do not belong together.
#pragma once

#include <cstddef>
#include <deque>
#include <optional>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

struct StampedPose {
  StampNs stamp = 0;  ///< true time
  Transform T_fixed_vehicle = Transform::Identity();
};

/// How far the norm of a pose's quaternion may be off 1: by rounding, and by a filter that does not
/// normalise, which is worth a word. What is farther off is no rotation.
constexpr double kRoundedNorm = 0.01, kLooseNorm = 0.1;

/// A pose as messages tell it, its quaternion normalised. Throws DataError if a number is not
/// finite or the norm is off 1 by more than kLooseNorm.
Transform transformOf(const Eigen::Vector3d& translation, double w, double x, double y, double z);

/// Linear in translation, slerp in rotation; `fraction` 0 gives a, 1 gives b.
Transform interpolate(const Transform& a, const Transform& b, double fraction);

class PoseBuffer {
 public:
  /// Readings older than the newest by more than `history_ns` are forgotten; 0 keeps all. Steps
  /// faster than `fastest_mps` are jumps, and so are steps to and fro; 0: no step is one.
  explicit PoseBuffer(StampNs history_ns = 0, double fastest_mps = 0.0)
      : history_ns_(history_ns), fastest_mps_(fastest_mps) {}

  /// Inserts in order of stamp; a second reading of one stamp replaces the first. Throws DataError
  /// if the pose is not finite or its rotation not orthonormal to 1e-3.
  void add(const StampedPose& reading);
  /// Many, in any order, in less time than one by one.
  void add(const std::vector<StampedPose>& readings);
  void clear() {
    readings_.clear();
    jumps_.clear();
  }

  std::size_t size() const { return readings_.size(); }
  bool empty() const { return readings_.empty(); }
  const std::deque<StampedPose>& readings() const { return readings_; }

  /// Stamps of the readings behind a jump, in order.
  const std::vector<StampNs>& jumps() const { return jumps_; }
  /// The readings [begin, end) around `t` without a jump between them; around the nearest reading
  /// if `t` lies within a jump or outside. Empty without readings.
  struct Stretch {
    std::size_t begin = 0, end = 0;
    bool operator==(const Stretch& other) const { return begin == other.begin && end == other.end; }
  };
  Stretch stretchAround(StampNs t) const;

  /// Whether `t` lies between two readings without a jump, or on one.
  bool covers(StampNs t) const;
  /// Interpolated between the two readings around `t`; empty if not covered.
  std::optional<Transform> lookup(StampNs t) const;
  /// The vehicle's mean twist about `t`: between the reading at or after `t` and one at or before
  /// it, at least 10 ms apart if there is one, so that the noise of fast odometry does not become
  /// speed. Later readings do not change it. Empty if `t` is not covered, or by one reading only.
  std::optional<Twist> twist(StampNs t) const;
  /// The reading nearest in time, the earlier of two; empty if `t` is not covered.
  std::optional<Transform> closest(StampNs t) const;

 private:
  bool isJump(std::size_t to) const;
  void findJumps(std::size_t from, std::size_t to);
  void forgetOld();

  StampNs history_ns_;
  double fastest_mps_;
  std::deque<StampedPose> readings_;
  std::vector<StampNs> jumps_;
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Ego-motion compensation of a lidar scan (paper, eq. 5), in double precision through the fixed
/// frame, cast to float last:
///   T_lidar(t_ref)_lidar(t_i) = T_lidar_vehicle * T_vehicle_fixed(t_ref) * T_fixed_vehicle(t_i) *
///                               T_vehicle_lidar.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/motion/pose_buffer.h"

namespace semantic_lidar_fusion {

enum class MotionGranularity : std::uint8_t {
  kFiring,  ///< a pose for each firing, continuous within it
  kPacket,  ///< the pose at the packet's first firing, whether it returned anything or not (the
            ///< paper's)
};
enum class OdometryLookup : std::uint8_t {
  kInterpolate,
  kClosest,  ///< the reading closest to the point's time (the paper's); t_ref is always
             ///< interpolated
};
/// What happens to firings that odometry does not cover; kHold and kExtrapolate serve t_ref and the
/// images' times too.
enum class OnMissingOdometry : std::uint8_t {
  kMark,         ///< stay as measured, status kNoOdometry
  kDrop,         ///< do not come out
  kHold,         ///< the nearest reading's pose
  kExtrapolate,  ///< constant twist of the nearest two readings, up to max_extrapolation; marked
                 ///< beyond
};

struct CompensationConfig {
  bool enabled = true;  ///< false: points stay as measured, none is marked
  MotionGranularity granularity = MotionGranularity::kFiring;
  OdometryLookup lookup = OdometryLookup::kInterpolate;
  OnMissingOdometry on_missing = OnMissingOdometry::kMark;
  StampNs max_extrapolation_ns = 100000000;
};

struct CompensationCounters {
  std::size_t marked_points = 0;
  std::size_t dropped_points = 0;
  std::size_t held_points = 0;
  std::size_t extrapolated_points = 0;
  std::size_t uncovered_firings = 0;
  bool reference_covered = true;  ///< false: no pose at t_ref; every point is marked
};

struct CompensationResult {
  Cloud cloud;
  CompensationCounters counters;
};

/// All points of `scan` as seen from the lidar's pose at `reference_ns` (true time), in the same
/// order. The result takes over the scan's arrays: move the scan in unless it is still wanted. Only
/// readings without a jump between them and t_ref count; see PoseBuffer.
CompensationResult compensate(TimedCloud scan, StampNs reference_ns, const PoseBuffer& odometry,
                              const Transform& T_vehicle_lidar, const CompensationConfig& config);

/// Vehicle motion between two times, T_vehicle(to)_vehicle(from); empty if odometry does not cover
/// both (with what `on_missing` adds), or jumps between them.
std::optional<Transform> vehicleMotion(const PoseBuffer& odometry, StampNs from_ns, StampNs to_ns,
                                       const CompensationConfig& config = {});

}  // namespace semantic_lidar_fusion

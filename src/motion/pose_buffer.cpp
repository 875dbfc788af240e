// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/motion/pose_buffer.h"

#include <algorithm>
#include <string>

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

constexpr double kRotationTolerance = 1e-3;

bool isBefore(const StampedPose& reading, StampNs t) { return reading.stamp < t; }

/// First reading at or after `t`.
std::deque<StampedPose>::const_iterator atOrAfter(const std::deque<StampedPose>& readings,
                                                  StampNs t) {
  return std::lower_bound(readings.begin(), readings.end(), t, isBefore);
}

void check(const StampedPose& reading) {
  const std::string name = "odometry reading stamped " + std::to_string(reading.stamp) + " ns: ";
  if (!reading.T_fixed_vehicle.matrix().allFinite()) {
    throw DataError(name + "its pose has a NaN or infinite entry, every entry must be finite");
  }
  const Eigen::Matrix3d rotation = reading.T_fixed_vehicle.linear();
  const double deviation =
      (rotation.transpose() * rotation - Eigen::Matrix3d::Identity()).cwiseAbs().maxCoeff();
  if (deviation > kRotationTolerance || rotation.determinant() < 0.0) {
    throw DataError(name + "its rotation is not orthonormal (R^T R deviates from I by " +
                    std::to_string(deviation) + ", determinant " +
                    std::to_string(rotation.determinant()) + ", at most 0.001 and +1 are allowed)");
  }
}

}  // namespace

Transform interpolate(const Transform& a, const Transform& b, double fraction) {
  // Eigen's slerp takes the shorter way round, whatever the signs of the two quaternions.
  const Eigen::Quaterniond rotation_a = Eigen::Quaterniond(a.linear()).normalized();
  const Eigen::Quaterniond rotation_b = Eigen::Quaterniond(b.linear()).normalized();
  Transform result = Transform::Identity();
  result.linear() = rotation_a.slerp(fraction, rotation_b).normalized().toRotationMatrix();
  // The difference first: exact to the last bits of the large coordinates of a map frame.
  result.translation() = a.translation() + fraction * (b.translation() - a.translation());
  return result;
}

void PoseBuffer::add(const StampedPose& reading) {
  check(reading);
  const auto place = std::lower_bound(readings_.begin(), readings_.end(), reading.stamp, isBefore);
  if (place != readings_.end() && place->stamp == reading.stamp) {
    *place = reading;
  } else {
    readings_.insert(place, reading);
  }
  if (history_ns_ > 0) {
    const StampNs oldest = readings_.back().stamp - history_ns_;
    while (readings_.front().stamp < oldest) readings_.pop_front();
  }
}

bool PoseBuffer::covers(StampNs t) const {
  return !readings_.empty() && readings_.front().stamp <= t && t <= readings_.back().stamp;
}

std::optional<Transform> PoseBuffer::lookup(StampNs t) const {
  if (!covers(t)) return std::nullopt;
  const auto after = atOrAfter(readings_, t);
  if (after->stamp == t) return after->T_fixed_vehicle;
  const auto before = std::prev(after);
  const double fraction =
      static_cast<double>(t - before->stamp) / static_cast<double>(after->stamp - before->stamp);
  return interpolate(before->T_fixed_vehicle, after->T_fixed_vehicle, fraction);
}

std::optional<Transform> PoseBuffer::closest(StampNs t) const {
  if (!covers(t)) return std::nullopt;
  const auto after = atOrAfter(readings_, t);
  if (after == readings_.begin()) return after->T_fixed_vehicle;
  const auto before = std::prev(after);
  return (t - before->stamp <= after->stamp - t ? before : after)->T_fixed_vehicle;
}

}  // namespace semantic_lidar_fusion

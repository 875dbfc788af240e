// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/motion/pose_buffer.h"

#include <algorithm>
#include <string>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/rotation.h"

namespace semantic_lidar_fusion {
namespace {

constexpr double kPoseTolerance = 1e-3;
/// What noise and small corrections of an odometry add to a step, however short it is.
constexpr double kSlackM = 0.2, kSlackRad = 0.2;
constexpr double kFastestTurnRadS = 20.0;
/// A vehicle does not go to and fro by this way between three readings.
constexpr double kToAndFroM = 0.3;
constexpr StampNs kToAndFroNs = 500000000;
constexpr StampNs kLeastTwistSpan_ns = 10000000;

bool isEarlier(const StampedPose& reading, StampNs t) { return reading.stamp < t; }

/// First reading at or after `t`.
std::deque<StampedPose>::const_iterator atOrAfter(const std::deque<StampedPose>& readings,
                                                  StampNs t) {
  return std::lower_bound(readings.begin(), readings.end(), t, isEarlier);
}

void check(const StampedPose& reading) {
  const std::string name = "odometry reading stamped " + std::to_string(reading.stamp) + " ns: ";
  if (!reading.T_fixed_vehicle.matrix().allFinite()) {
    throw DataError(name + "its pose has a NaN or infinite entry, every entry must be finite");
  }
  const Eigen::Matrix3d rotation = reading.T_fixed_vehicle.linear();
  const double deviation = rotationError(rotation);
  if (deviation > kPoseTolerance) {
    throw DataError(name + "its rotation is not orthonormal (R R^T deviates from I by " +
                    std::to_string(deviation) + ", determinant " +
                    std::to_string(rotation.determinant()) + ", at most 0.001 and +1 are allowed)");
  }
}

}  // namespace

Transform transformOf(const Eigen::Vector3d& translation, double w, double x, double y, double z) {
  const Eigen::Quaterniond rotation(w, x, y, z);
  if (!translation.allFinite() || !rotation.coeffs().allFinite()) {
    throw DataError("transform has a number that is not finite");
  }
  if (std::abs(rotation.norm() - 1.0) > kLooseNorm) {
    throw DataError("transform has a quaternion of norm " + std::to_string(rotation.norm()) +
                    "; 1 is wanted");
  }
  Transform result = Transform::Identity();
  result.linear() = rotation.normalized().toRotationMatrix();
  result.translation() = translation;
  return result;
}

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
  const auto place = std::lower_bound(readings_.begin(), readings_.end(), reading.stamp, isEarlier);
  const auto index = static_cast<std::size_t>(place - readings_.begin());
  if (place != readings_.end() && place->stamp == reading.stamp) {
    *place = reading;
  } else {
    readings_.insert(place, reading);
  }
  // A reading has a part in the steps to it, from it, and over it.
  findJumps(index, index + 2);
  forgetOld();
}

void PoseBuffer::add(const std::vector<StampedPose>& readings) {
  for (const StampedPose& reading : readings) check(reading);
  const auto earlier = [](const StampedPose& a, const StampedPose& b) { return a.stamp < b.stamp; };
  readings_.insert(readings_.end(), readings.begin(), readings.end());
  std::stable_sort(readings_.begin(), readings_.end(), earlier);
  // Of one stamp the last one counts.
  std::size_t kept = 0;
  for (std::size_t i = 0; i < readings_.size(); ++i) {
    const bool replaced = i + 1 < readings_.size() && readings_[i + 1].stamp == readings_[i].stamp;
    if (!replaced) readings_[kept++] = readings_[i];
  }
  readings_.resize(kept);
  jumps_.clear();
  findJumps(0, readings_.size());
  forgetOld();
}

void PoseBuffer::forgetOld() {
  if (history_ns_ <= 0 || readings_.empty()) return;
  const StampNs oldest = readings_.back().stamp - history_ns_;
  while (readings_.front().stamp < oldest) readings_.pop_front();
  jumps_.erase(jumps_.begin(),
               std::upper_bound(jumps_.begin(), jumps_.end(), readings_.front().stamp));
}

/// Whether the step to reading `to` is a jump.
bool PoseBuffer::isJump(std::size_t to) const {
  if (fastest_mps_ <= 0.0 || to == 0 || to >= readings_.size()) return false;
  const StampedPose& a = readings_[to - 1];
  const StampedPose& b = readings_[to];
  const double dt_s = toSeconds(b.stamp - a.stamp);
  const double step_m = (b.T_fixed_vehicle.translation() - a.T_fixed_vehicle.translation()).norm();
  if (step_m > kSlackM + fastest_mps_ * dt_s) return true;
  const double turn_rad = Eigen::Quaterniond(a.T_fixed_vehicle.linear())
                              .angularDistance(Eigen::Quaterniond(b.T_fixed_vehicle.linear()));
  if (turn_rad > kSlackRad + kFastestTurnRadS * dt_s) return true;
  if (to < 2 || b.stamp - readings_[to - 2].stamp > kToAndFroNs) return false;
  // The way there and back again is longer than the straight one.
  const Eigen::Vector3d before = readings_[to - 2].T_fixed_vehicle.translation();
  const double previous_m = (a.T_fixed_vehicle.translation() - before).norm();
  const double straight_m = (b.T_fixed_vehicle.translation() - before).norm();
  return previous_m + step_m - straight_m > kToAndFroM;
}

/// Judges the steps to the readings from .. to, at most the last one.
void PoseBuffer::findJumps(std::size_t from, std::size_t to) {
  for (std::size_t i = from; i <= to && i < readings_.size(); ++i) {
    const StampNs stamp = readings_[i].stamp;
    const auto place = std::lower_bound(jumps_.begin(), jumps_.end(), stamp);
    const bool known = place != jumps_.end() && *place == stamp;
    if (isJump(i) && !known) {
      jumps_.insert(place, stamp);
    } else if (known && !isJump(i)) {
      jumps_.erase(place);
    }
  }
}

PoseBuffer::Stretch PoseBuffer::stretchAround(StampNs t) const {
  if (readings_.empty()) return {};
  const auto after = atOrAfter(readings_, t);
  auto nearest = after == readings_.end() ? std::prev(after) : after;
  if (nearest != readings_.begin() && nearest->stamp > t &&
      t - std::prev(nearest)->stamp <= nearest->stamp - t) {
    --nearest;
  }
  const auto next = std::upper_bound(jumps_.begin(), jumps_.end(), nearest->stamp);
  const auto indexOf = [&](StampNs stamp) {
    return static_cast<std::size_t>(atOrAfter(readings_, stamp) - readings_.begin());
  };
  Stretch stretch{0, readings_.size()};
  if (next != jumps_.begin()) stretch.begin = indexOf(*std::prev(next));
  if (next != jumps_.end()) stretch.end = indexOf(*next);
  return stretch;
}

bool PoseBuffer::covers(StampNs t) const {
  if (readings_.empty() || t < readings_.front().stamp || t > readings_.back().stamp) return false;
  const auto after = atOrAfter(readings_, t);
  return after->stamp == t || !std::binary_search(jumps_.begin(), jumps_.end(), after->stamp);
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

std::optional<Twist> PoseBuffer::twist(StampNs t) const {
  if (!covers(t)) return std::nullopt;
  const Stretch stretch = stretchAround(t);
  if (stretch.end - stretch.begin < 2) return std::nullopt;
  const std::deque<StampedPose>::const_iterator first =
      readings_.begin() + static_cast<std::ptrdiff_t>(stretch.begin);
  std::deque<StampedPose>::const_iterator after = atOrAfter(readings_, t);
  if (after == first) ++after;
  const StampNs latest = std::min(t, after->stamp - kLeastTwistSpan_ns);
  auto before = std::upper_bound(first, after, latest,
                                 [](StampNs time, const StampedPose& r) { return time < r.stamp; });
  if (before != first) --before;
  const double span_s = toSeconds(after->stamp - before->stamp);
  const Transform& a = before->T_fixed_vehicle;
  const Transform& b = after->T_fixed_vehicle;
  const Eigen::AngleAxisd turned(Eigen::Matrix3d(a.linear().transpose() * b.linear()));
  // A constant twist moves along a chord that points as the vehicle does half-way.
  const Transform middle = interpolate(a, b, 0.5);
  Twist result;
  result.turn = turned.axis() * (turned.angle() / span_s);
  result.velocity = middle.linear().transpose() * (b.translation() - a.translation()) / span_s;
  return result;
}

std::optional<Transform> PoseBuffer::closest(StampNs t) const {
  if (!covers(t)) return std::nullopt;
  const auto after = atOrAfter(readings_, t);
  if (after == readings_.begin()) return after->T_fixed_vehicle;
  const auto before = std::prev(after);
  return (t - before->stamp <= after->stamp - t ? before : after)->T_fixed_vehicle;
}

}  // namespace semantic_lidar_fusion

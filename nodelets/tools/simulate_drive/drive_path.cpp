// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/drive_path.h"

#include <algorithm>
#include <cmath>

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

constexpr double kStepS = 1e-3;
constexpr double kLongestCycleS = 10.0;
// Parts of a cycle.
constexpr double kBrakeBegin = 0.30, kBrakeEnd = 0.55, kRiseBegin = 0.80;
constexpr double kTurnBegin = 0.50, kTurnEnd = 0.98;
constexpr double kMostBraking = 3.5;    // m/s^2
constexpr double kMostLateral = 3.0;    // m/s^2
constexpr double kMostTurnRate = 0.45;  // rad/s
constexpr double kLeastRadiusM = 20.0;  // the houses of a bend's inside need room
constexpr double kMostTurn = 60.0 * kPi / 180.0;
// Angles per acceleration of a soft car, rad / (m/s^2).
constexpr double kPitchPerBraking = 0.35 * kPi / 180.0;
constexpr double kRollPerLateral = 0.30 * kPi / 180.0;

}  // namespace

DrivePath::DrivePath(double duration_s, double speed_mps)
    : duration_s_(duration_s), speed_mps_(speed_mps) {
  cycle_s_ = duration_s / std::ceil(duration_s / kLongestCycleS);
  const double brake_s = (kBrakeEnd - kBrakeBegin) * cycle_s_;
  // The steepest fall of a cosine step is pi / 2 times its mean.
  drop_mps_ = std::min(0.45 * speed_mps, kMostBraking * brake_s * 2.0 / kPi);
  const double turn_s = (kTurnEnd - kTurnBegin) * cycle_s_;
  const double slow_mps = speed_mps - drop_mps_;
  turn_rate_ = std::min(
      {kMostLateral / slow_mps, kMostTurnRate, slow_mps / kLeastRadiusM, 2.0 * kMostTurn / turn_s});
  const int steps = static_cast<int>(std::lround((duration_s + 2.0 * kMarginS) / kStepS));
  table_.resize(static_cast<std::size_t>(steps) + 1);
  PathPoint point;
  point.heading = heading(-kMarginS);
  table_[0] = point;
  for (int i = 0; i < steps; ++i) {
    const double t = -kMarginS + i * kStepS;
    // Simpson's rule.
    const double v[3] = {speed(t), speed(t + 0.5 * kStepS), speed(t + kStepS)};
    const double h[3] = {heading(t), heading(t + 0.5 * kStepS), heading(t + kStepS)};
    const double weight = kStepS / 6.0;
    point.x +=
        weight * (v[0] * std::cos(h[0]) + 4.0 * v[1] * std::cos(h[1]) + v[2] * std::cos(h[2]));
    point.y +=
        weight * (v[0] * std::sin(h[0]) + 4.0 * v[1] * std::sin(h[1]) + v[2] * std::sin(h[2]));
    point.distance += weight * (v[0] + 4.0 * v[1] + v[2]);
    point.heading = h[2];
    table_[static_cast<std::size_t>(i) + 1] = point;
  }
  const PathPoint origin = at(0.0);
  for (PathPoint& p : table_) {
    p.x -= origin.x;
    p.y -= origin.y;
    p.distance -= origin.distance;
  }
}

double DrivePath::speed(double time_s) const {
  if (time_s <= 0.0 || time_s >= duration_s_) return speed_mps_;
  const double u = std::fmod(time_s, cycle_s_) / cycle_s_;
  double low = 0.0;
  if (u >= kBrakeBegin && u < kBrakeEnd) {
    low = 0.5 - 0.5 * std::cos(kPi * (u - kBrakeBegin) / (kBrakeEnd - kBrakeBegin));
  } else if (u >= kBrakeEnd && u < kRiseBegin) {
    low = 1.0;
  } else if (u >= kRiseBegin) {
    low = 0.5 + 0.5 * std::cos(kPi * (u - kRiseBegin) / (1.0 - kRiseBegin));
  }
  return speed_mps_ - drop_mps_ * low;
}

double DrivePath::acceleration(double time_s) const {
  if (time_s <= 0.0 || time_s >= duration_s_) return 0.0;
  const double u = std::fmod(time_s, cycle_s_) / cycle_s_;
  if (u >= kBrakeBegin && u < kBrakeEnd) {
    const double width = kBrakeEnd - kBrakeBegin;
    return -drop_mps_ * 0.5 * kPi / (width * cycle_s_) * std::sin(kPi * (u - kBrakeBegin) / width);
  }
  if (u >= kRiseBegin) {
    const double width = 1.0 - kRiseBegin;
    return drop_mps_ * 0.5 * kPi / (width * cycle_s_) * std::sin(kPi * (u - kRiseBegin) / width);
  }
  return 0.0;
}

double DrivePath::yawRate(double time_s) const {
  if (time_s <= 0.0 || time_s >= duration_s_) return 0.0;
  const double cycle = std::floor(time_s / cycle_s_);
  const double u = time_s / cycle_s_ - cycle;
  if (u < kTurnBegin || u >= kTurnEnd) return 0.0;
  const double s = std::sin(kPi * (u - kTurnBegin) / (kTurnEnd - kTurnBegin));
  return (std::fmod(cycle, 2.0) == 0.0 ? turn_rate_ : -turn_rate_) * s * s;
}

double DrivePath::heading(double time_s) const {
  const double t = std::min(std::max(time_s, 0.0), duration_s_);
  const double turn_s = (kTurnEnd - kTurnBegin) * cycle_s_;
  const double cycle = std::floor(t / cycle_s_);
  // Bends to the left and to the right cancel in pairs.
  const bool odd = std::fmod(cycle, 2.0) != 0.0;
  const double whole = 0.5 * turn_rate_ * turn_s;
  const double w =
      std::min(std::max((t / cycle_s_ - cycle - kTurnBegin) / (kTurnEnd - kTurnBegin), 0.0), 1.0);
  const double part = turn_rate_ * turn_s * (0.5 * w - std::sin(2.0 * kPi * w) / (4.0 * kPi));
  return odd ? whole - part : part;
}

PathPoint DrivePath::at(double time_s) const {
  const double scaled = (time_s + kMarginS) / kStepS;
  const double most = static_cast<double>(table_.size()) - 2.0;
  const double index = std::min(std::max(std::floor(scaled), 0.0), most);
  const double w = scaled - index;
  const PathPoint& a = table_[static_cast<std::size_t>(index)];
  const PathPoint& b = table_[static_cast<std::size_t>(index) + 1];
  const double ta = -kMarginS + index * kStepS;
  const double va = speed(ta) * kStepS, vb = speed(ta + kStepS) * kStepS;
  // Cubic Hermite.
  const double h00 = (1.0 + 2.0 * w) * (1.0 - w) * (1.0 - w), h01 = w * w * (3.0 - 2.0 * w);
  const double h10 = w * (1.0 - w) * (1.0 - w), h11 = w * w * (w - 1.0);
  PathPoint result;
  result.x =
      h00 * a.x + h01 * b.x + h10 * va * std::cos(a.heading) + h11 * vb * std::cos(b.heading);
  result.y =
      h00 * a.y + h01 * b.y + h10 * va * std::sin(a.heading) + h11 * vb * std::sin(b.heading);
  result.distance = h00 * a.distance + h01 * b.distance + h10 * va + h11 * vb;
  result.heading = heading(time_s);
  return result;
}

Transform DrivePath::pose(double time_s) const {
  const PathPoint point = at(time_s);
  const double lateral = speed(time_s) * yawRate(time_s);
  // An uneven road: slow waves of some tenths of a degree, none of them in step with another.
  const double d = point.distance;
  const double wave_pitch = 0.0015 * std::sin(0.61 * d) + 0.0010 * std::sin(1.37 * d + 1.0);
  const double wave_roll = 0.0012 * std::sin(0.47 * d + 2.0) + 0.0008 * std::sin(1.13 * d);
  const double pitch = -kPitchPerBraking * acceleration(time_s) + wave_pitch;
  const double roll = kRollPerLateral * lateral + wave_roll;
  Transform result = Transform::Identity();
  result.translation() = Eigen::Vector3d(point.x, point.y, kBaseHeight);
  result.linear() = (Eigen::AngleAxisd(point.heading, Eigen::Vector3d::UnitZ()) *
                     Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()) *
                     Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitX()))
                        .toRotationMatrix();
  return result;
}

PathPoint DrivePath::roadAt(double distance_m) const {
  const PathPoint& first = table_.front();
  const PathPoint& last = table_.back();
  if (distance_m <= first.distance || distance_m >= last.distance) {
    PathPoint result = distance_m <= first.distance ? first : last;
    const double beyond = distance_m - result.distance;
    result.x += beyond * std::cos(result.heading);
    result.y += beyond * std::sin(result.heading);
    result.distance = distance_m;
    return result;
  }
  const auto next = std::upper_bound(
      table_.begin(), table_.end(), distance_m,
      [](double distance, const PathPoint& point) { return distance < point.distance; });
  const auto before = next - 1;
  const double w = (distance_m - before->distance) / (next->distance - before->distance);
  return at(-kMarginS + (static_cast<double>(before - table_.begin()) + w) * kStepS);
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

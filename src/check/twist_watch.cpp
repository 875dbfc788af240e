// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/check/twist_watch.h"

#include <cmath>
#include <cstdio>

namespace semantic_lidar_fusion {
namespace {

constexpr StampNs kWindowNs = kNsPerSecond, kLongestGapNs = kNsPerSecond / 2;
constexpr double kLeastWay_m = 1.0;
constexpr double kLeastTurn_rad = 0.1;

}  // namespace

std::optional<std::string> TwistWatch::add(StampNs stamp, const Transform& T_fixed_body,
                                           const Twist& twist) {
  Way& way = way_;
  const double speed = twist.velocity.norm();
  const bool joined = stamp > way.end && stamp - way.end < kLongestGapNs;
  if (!joined || !std::isfinite(speed) || !std::isfinite(twist.turn.z())) {
    way = Way();
    way.begin = way.end = stamp;
    way.from = way.last = T_fixed_body;
    return std::nullopt;
  }
  const double dt = toSeconds(stamp - way.end);
  const Transform step = way.last.inverse() * T_fixed_body;
  way.by_twist_m += speed * dt;
  if (speed > 0.0) way.along_twist_m += step.translation().dot(twist.velocity / speed);
  way.turn_by_twist += twist.turn.z() * dt;
  way.turn_by_pose += std::atan2(step.linear()(1, 0), step.linear()(0, 0));
  way.end = stamp;
  way.last = T_fixed_body;
  if (way.end - way.begin < kWindowNs) return std::nullopt;

  const Way past = way;
  way = Way();
  way.begin = way.end = stamp;
  way.from = way.last = T_fixed_body;
  const double by_pose_m = (T_fixed_body.translation() - past.from.translation()).norm();
  char text[240];
  // Drivers without a twist leave it 0.
  if (past.by_twist_m > kLeastWay_m &&
      (by_pose_m < 0.5 * past.by_twist_m || by_pose_m > 2.0 * past.by_twist_m)) {
    std::snprintf(
        text, sizeof(text),
        "odometry: within a second its pose moves by %.2f m and its twist says %.2f m: is "
        "the pose frozen, or of another unit?",
        by_pose_m, past.by_twist_m);
    return text;
  }
  if (past.by_twist_m > kLeastWay_m && past.along_twist_m < -0.5 * past.by_twist_m) {
    std::snprintf(text, sizeof(text),
                  "odometry: within a second its pose moves %.2f m against its twist: is the pose "
                  "inverted (parent and child frame exchanged)?",
                  -past.along_twist_m);
    return text;
  }
  if (std::abs(past.turn_by_twist) > kLeastTurn_rad &&
      past.turn_by_pose * past.turn_by_twist < -0.25 * past.turn_by_twist * past.turn_by_twist) {
    std::snprintf(text, sizeof(text),
                  "odometry: within a second its pose turns by %+.1f deg and its twist says %+.1f "
                  "deg: is the sign of yaw wrong (counter-clockwise is positive)?",
                  past.turn_by_pose * 180.0 / kPi, past.turn_by_twist * 180.0 / kPi);
    return text;
  }
  return std::nullopt;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/odometry.h"

#include <algorithm>
#include <cmath>

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

// A car's wheel encoders and gyroscope.
constexpr double kSpeedScaleSigma = 0.005, kSpeedSigma = 0.03;    // of the speed; m/s
constexpr double kYawBiasSigma = 8.7e-4, kYawRateSigma = 2.6e-3;  // rad/s
constexpr double kTiltSigma = 5e-4;                               // rad

}  // namespace

Odometry::Odometry(const DrivePath& path, const ErrorSizes& errors, std::uint64_t seed, bool exact)
    : path_(path), errors_(errors), random_(mixKeys(seed, 0x0D0)), exact_(exact) {
  scale_ = 1.0 + kSpeedScaleSigma * random_.normal();
  bias_ = kYawBiasSigma * random_.normal();
}

Transform Odometry::next(double time_s) {
  if (exact_) return path_.pose(time_s);
  return errors_.ofOdometry() ? nextOfTwist(time_s) : nextOfWheels(time_s);
}

Transform Odometry::nextOfWheels(double time_s) {
  const Transform truth = path_.pose(time_s);
  const PathPoint now = path_.roadAt(path_.distance(time_s));
  if (!started_) {
    x_ = now.x;
    y_ = now.y;
    heading_ = now.heading;
    started_ = true;
  } else {
    const double dt = time_s - last_s_;
    const double step =
        scale_ * (now.distance - last_.distance) + kSpeedSigma * random_.normal() * dt;
    const double turn =
        now.heading - last_.heading + (bias_ + kYawRateSigma * random_.normal()) * dt;
    x_ += step * std::cos(heading_ + 0.5 * turn);
    y_ += step * std::sin(heading_ + 0.5 * turn);
    heading_ += turn;
  }
  // Attitude errors last for some tenths of a second.
  tilt_x_ = 0.97 * tilt_x_ + 0.24 * kTiltSigma * random_.normal();
  tilt_y_ = 0.97 * tilt_y_ + 0.24 * kTiltSigma * random_.normal();
  last_ = now;
  last_s_ = time_s;
  Transform T = Transform::Identity();
  T.translation() = Eigen::Vector3d(x_, y_, truth.translation().z());
  const Eigen::Matrix3d tilt = (Eigen::AngleAxisd(tilt_y_, Eigen::Vector3d::UnitY()) *
                                Eigen::AngleAxisd(tilt_x_, Eigen::Vector3d::UnitX()))
                                   .toRotationMatrix();
  T.linear() =
      Eigen::AngleAxisd(heading_ - now.heading, Eigen::Vector3d::UnitZ()).toRotationMatrix() *
      truth.linear() * tilt;
  return T;
}

double Odometry::twistSigma(int axis) const {
  return axis < 3 ? errors_.velocity_mps : errors_.rate_dps * kRadPerDeg;
}

Eigen::Matrix<double, 6, 1> Odometry::firstTwistError() {
  for (int i = 0; i < 6; ++i) twist_error_[i] = twistSigma(i) * random_.normal();
  return Eigen::Matrix<double, 6, 1>::Zero();
}

Eigen::Matrix<double, 6, 1> Odometry::wayOfTwistError(double dt) {
  // Value and integral after dt are jointly normal given the value before. Of a process of unit
  // variance: variances of what is fresh in both, and their covariance.
  const double tau = errors_.correlation_s;
  const double kept = std::exp(-dt / tau);
  const double value_variance = 1.0 - kept * kept;
  const double way_variance = tau * tau * (2.0 * dt / tau - 3.0 + kept * (4.0 - kept));
  const double covariance = tau * (1.0 - kept) * (1.0 - kept);
  const double fresh = std::sqrt(value_variance), common = covariance / fresh;
  const double own = std::sqrt(std::max(way_variance - common * common, 0.0));
  Eigen::Matrix<double, 6, 1> way;
  for (int i = 0; i < 6; ++i) {
    const double draw = random_.normal(), other = random_.normal();
    way[i] = tau * (1.0 - kept) * twist_error_[i] + twistSigma(i) * (common * draw + own * other);
    twist_error_[i] = kept * twist_error_[i] + twistSigma(i) * fresh * draw;
  }
  return way;
}

Transform Odometry::nextOfTwist(double time_s) {
  const Transform truth = path_.pose(time_s);
  const double dt = time_s - last_s_;
  const Eigen::Matrix<double, 6, 1> error = started_ ? wayOfTwistError(dt) : firstTwistError();
  if (!started_) {
    believed_ = truth;
    started_ = true;
  } else {
    Transform step = last_true_.inverse() * truth;
    const Eigen::Vector3d turn = error.tail<3>();
    step.translation() += error.head<3>();
    if (!turn.isZero(0.0)) {
      step.linear() =
          step.linear() * Eigen::AngleAxisd(turn.norm(), turn.normalized()).toRotationMatrix();
    }
    believed_ = believed_ * step;
  }
  last_true_ = truth;
  last_s_ = time_s;
  return believed_;
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

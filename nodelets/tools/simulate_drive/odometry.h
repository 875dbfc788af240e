// SPDX-License-Identifier: MIT
/// Where the vehicle believes to be.
#pragma once

#include "tools/simulate_drive/drive_path.h"
#include "tools/simulate_drive/errors.h"
#include "tools/simulate_drive/noise.h"

namespace semantic_lidar_fusion {
namespace simulator {

/// Dead reckoning that begins at the true pose: from wheel speed and yaw rate, or, with errors of
/// odometry given, from the true motion of the body with a velocity and a rate added. Each of these
/// six is an Ornstein-Uhlenbeck process: normal, with autocorrelation exp(-|t| / correlation_s).
/// The readings integrate it exactly, so that what it adds up to over a time D has the variance
/// sigma^2 2 tau^2 (D / tau - 1 + exp(-D / tau)) for every correlation time tau.
class Odometry {
 public:
  Odometry(const DrivePath& path, const ErrorSizes& errors, std::uint64_t seed, bool exact);

  /// The next reading, T_odom_base; times must rise.
  Transform next(double time_s);

 private:
  Transform nextOfWheels(double time_s);
  Transform nextOfTwist(double time_s);
  double twistSigma(int axis) const;
  Eigen::Matrix<double, 6, 1> firstTwistError();
  /// Moves the error on by dt; its integral over that time, m and rad.
  Eigen::Matrix<double, 6, 1> wayOfTwistError(double dt);

  const DrivePath& path_;
  ErrorSizes errors_;
  Random random_;
  bool exact_;
  bool started_ = false;
  double last_s_ = 0.0;
  double scale_ = 1.0, bias_ = 0.0;
  double x_ = 0.0, y_ = 0.0, heading_ = 0.0, tilt_x_ = 0.0, tilt_y_ = 0.0;
  PathPoint last_;
  Transform believed_ = Transform::Identity(), last_true_ = Transform::Identity();
  Eigen::Matrix<double, 6, 1> twist_error_ = Eigen::Matrix<double, 6, 1>::Zero();
};

}  // namespace simulator
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// What is known of a rig's errors, as standard deviations; 0 = none. They become the covariance of
/// each point's pixel (see pixel_covariance.h).
#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

/// Small motions of a frame: metres along its axes x, y, z, then radians around them.
using Vector6d = Eigen::Matrix<double, 6, 1>;
using Matrix6d = Eigen::Matrix<double, 6, 6>;

struct LidarErrors {
  double range_m = 0.0;                                ///< of a measured range
  Eigen::Vector2d beam_deg = Eigen::Vector2d::Zero();  ///< full width of the beam: horizontal,
                                                       ///< vertical
};

/// Of the velocity and the rate that odometry gives, along and around the vehicle's axes. They are
/// correlated in time: exp(-|t| / correlation_s).
struct MotionErrors {
  Eigen::Vector3d velocity_mps = Eigen::Vector3d::Zero();
  Eigen::Vector3d rate_deg_s = Eigen::Vector3d::Zero();
  double correlation_s = 1.0;
  double scale = 0.0;  ///< of the speed, as a part of it (wheel radius)
};

/// Of the whole rig.
struct RigErrors {
  double lidar_stamp_s = 0.0;   ///< key stamps_s.lidar; common to the points of a scan
  double camera_stamp_s = 0.0;  ///< key stamps_s.camera; common to the pixels of an image
  LidarErrors lidar;
  MotionErrors motion;
};

/// Of one camera.
struct CameraErrors {
  /// Covariance of T_camera_lidar: small motions on the left, in the camera's axes (x right, y
  /// down, z forward). From six standard deviations, or from calibration runs.
  Matrix6d extrinsics = Matrix6d::Zero();
  double intrinsics_px = 0.0;  ///< of a pixel, along each axis: what the lens's calibration leaves
};

/// How a point reads its distribution from an image.
enum class TransferRule : std::uint8_t {
  kPixel,     ///< that of its pixel (the paper's)
  kExpected,  ///< its expectation over the ellipse of the pixel; where that is small, the pixel's
};

/// The covariance of T_camera_lidar from the runs of a calibration, and their mean.
struct CalibrationRuns {
  Transform T_camera_lidar = Transform::Identity();  ///< the mean
  Matrix6d covariance = Matrix6d::Zero();            ///< of small motions, as in CameraErrors
  std::size_t runs = 0;
};

/// Reads runs: one a line, roll pitch yaw (rad, fixed axes x y z) and x y z (m) of the camera in
/// the lidar's frame, with commas or blanks between them; lines that begin with # or a letter are
/// headers. The mean rotation is the chordal one, and a run's motion is log(T_k T_mean^-1). Throws
/// ConfigError naming file, line and rule: six finite numbers, at least seven runs.
CalibrationRuns readCalibrationRuns(const std::string& path);
/// The same from runs in memory, at least two.
CalibrationRuns calibrationOf(const std::vector<Vector6d>& runs);

/// Logarithm of a rigid motion: Exp([along; around]) = T.
Vector6d motionOf(const Transform& T);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// What is uncertain in one camera's view of one scan.
#pragma once

#include <Eigen/Core>
#include <optional>

#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/uncertainty/errors.h"

namespace semantic_lidar_fusion {

/// The errors of a view, brought to the camera: small motions [along; around] its axes at the
/// image's time, which move every point p to p + along + around x p.
struct ViewErrors {
  Matrix6d common = Matrix6d::Zero();  ///< of extrinsics and stamps: the same for every point
  /// Of odometry: times motionVariance(D) for a point measured D s after the image.
  Matrix6d odometry = Matrix6d::Zero();
  double correlation_s = 1.0;
  double image_after_reference_s = 0.0;  ///< the image's time minus t_ref
  Twist lidar;                           ///< how the lidar moves: where the beam of a point began
  double range_m = 0.0;                  ///< along the beam
  Eigen::Vector2d beam_rad = Eigen::Vector2d::Zero();  ///< across it: horizontal, vertical
  double intrinsics_px = 0.0;

  /// Whether any error is known.
  bool any() const;
};

/// The variance (s^2) that an error of velocity of variance 1 gives to the way made in `time_s`:
/// 2 tau^2 (|t| / tau - 1 + exp(-|t| / tau)), t^2 for short times.
double motionVariance(double time_s, double correlation_s);

/// What moves in a view. Without odometry the vehicle stands, and only extrinsics, lidar and lens
/// err.
struct ViewMotion {
  Transform T_camera_vehicle = Transform::Identity();  ///< extrinsics
  Transform T_vehicle_lidar = Transform::Identity();
  Twist vehicle;  ///< at the image's time
};

/// Whether the rig states any error of a camera's views. Those of stamps and odometry count only
/// where motion is known.
bool statesErrors(const RigErrors& rig, const CameraErrors& camera);

/// Of a camera whose image is taken `image_after_reference_s` after t_ref.
ViewErrors viewErrors(const RigErrors& rig, const CameraErrors& camera,
                      const std::optional<ViewMotion>& motion, double image_after_reference_s);

}  // namespace semantic_lidar_fusion

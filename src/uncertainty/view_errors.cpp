// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/uncertainty/view_errors.h"

#include <cmath>

#include "semantic_lidar_fusion/common/cross_matrix.h"

namespace semantic_lidar_fusion {
namespace {

/// What a small motion of frame b is in the axes of frame a.
Matrix6d adjoint(const Transform& T_a_b) {
  Matrix6d m = Matrix6d::Zero();
  m.topLeftCorner<3, 3>() = m.bottomRightCorner<3, 3>() = T_a_b.linear();
  m.topRightCorner<3, 3>() = crossMatrix(T_a_b.translation()) * T_a_b.linear();
  return m;
}

/// Of velocity and rate, per s.
Matrix6d twistCovariance(const MotionErrors& errors, const ViewMotion& motion) {
  Matrix6d result = Matrix6d::Zero();
  result.diagonal() << errors.velocity_mps.cwiseAbs2(),
      (kRadPerDeg * errors.rate_deg_s).cwiseAbs2();
  const double scaled = errors.scale * motion.vehicle.velocity.norm();
  result(0, 0) += scaled * scaled;
  return result;
}

}  // namespace

bool ViewErrors::any() const {
  return !common.isZero(0.0) || !odometry.isZero(0.0) || range_m > 0.0 || !beam_rad.isZero(0.0) ||
         intrinsics_px > 0.0;
}

double motionVariance(double time_s, double correlation_s) {
  const double x = std::abs(time_s) / correlation_s;
  // The series where the difference would cancel: 2 (x^2 / 2! - x^3 / 3! + ...), to 1e-9.
  const double doubled =
      x < 0.3 ? x * x *
                    (1.0 + x * (-1.0 / 3.0 +
                                x * (1.0 / 12.0 +
                                     x * (-1.0 / 60.0 +
                                          x * (1.0 / 360.0 + x * (-1.0 / 2520.0 + x / 20160.0))))))
              : 2.0 * (x - 1.0 + std::exp(-x));
  return correlation_s * correlation_s * doubled;
}

bool statesErrors(const RigErrors& rig, const CameraErrors& camera) {
  const MotionErrors& motion = rig.motion;
  return rig.lidar_stamp_s > 0.0 || rig.camera_stamp_s > 0.0 || rig.lidar.range_m > 0.0 ||
         !rig.lidar.beam_deg.isZero(0.0) || !motion.velocity_mps.isZero(0.0) ||
         !motion.rate_deg_s.isZero(0.0) || motion.scale > 0.0 || !camera.extrinsics.isZero(0.0) ||
         camera.intrinsics_px > 0.0;
}

ViewErrors viewErrors(const RigErrors& rig, const CameraErrors& camera,
                      const std::optional<ViewMotion>& motion, double image_after_reference_s) {
  ViewErrors errors;
  errors.image_after_reference_s = image_after_reference_s;
  errors.common = camera.extrinsics;
  errors.intrinsics_px = camera.intrinsics_px;
  errors.range_m = rig.lidar.range_m;
  errors.beam_rad = 0.25 * kRadPerDeg * rig.lidar.beam_deg;
  if (!motion) return errors;
  const Matrix6d to_camera = adjoint(motion->T_camera_vehicle);
  Vector6d twist;
  twist << motion->vehicle.velocity, motion->vehicle.turn;
  twist = to_camera * twist;
  const double stamps_s2 =
      rig.lidar_stamp_s * rig.lidar_stamp_s + rig.camera_stamp_s * rig.camera_stamp_s;
  errors.common += stamps_s2 * twist * twist.transpose();
  errors.odometry = to_camera * twistCovariance(rig.motion, *motion) * to_camera.transpose();
  errors.correlation_s = rig.motion.correlation_s;
  errors.lidar = twistOf(motion->T_vehicle_lidar.inverse(Eigen::Isometry), motion->vehicle);
  return errors;
}

}  // namespace semantic_lidar_fusion

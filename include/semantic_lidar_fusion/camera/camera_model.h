// SPDX-License-Identifier: MIT
/// Camera models of sensor_msgs/CameraInfo: pinhole, plumb_bob, rational_polynomial (Brown-Conrady
/// with OpenCV's coefficients) and equidistant (Kannala-Brandt, paper eq. 6-11, valid beyond 90
/// deg).
///
/// A point has a pixel only where the model is one-to-one: equidistant: theta = atan2(hypot(x, y),
/// z) on the rising branch of theta_d; the others: z > 0, radius below the fold-over of the radial
/// factor times r and (rational) below the first pole. Also theta <= max_theta_deg if given.
///
/// Raw images: pixel = K, D of R^T p (R rotates the raw camera's axes to the rectified ones, in
/// which the camera's frame is given), so that a point hits the same scene pixel raw and rectified.
/// Rectified images: pixel = P [p; 1]; P[3] and P[7] move the optical centre out of the frame's
/// origin. Binning and ROI follow image_geometry: cx - roi_x first, then everything in the row
/// divided by the binning (no half-pixel shift).
#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

/// The fields of sensor_msgs/CameraInfo that a model needs.
struct CameraInfo {
  std::string frame_id;
  ImageSize size;  ///< full resolution, before binning and ROI
  std::string distortion_model;
  std::vector<double> d;
  std::array<double, 9> k{};
  std::array<double, 9> r{};  ///< all zero = identity
  std::array<double, 12> p{};
  int binning_x = 0;  ///< 0 = 1
  int binning_y = 0;
  int roi_x = 0, roi_y = 0;           ///< in full-resolution pixels
  int roi_width = 0, roi_height = 0;  ///< 0 = full

  bool operator==(const CameraInfo& other) const;
};

struct CameraModelOptions {
  bool rectified = false;      ///< the image is rectified: P (with P[3], P[7]), no distortion
  double max_theta_deg = 0.0;  ///< largest angle from the optical axis; 0 = no limit
};

enum class DistortionModel : std::uint8_t { kPinhole, kBrownConrady, kEquidistant };

class CameraModel {
 public:
  /// Throws DataError naming field, value and rule: unknown model, wrong number of coefficients,
  /// non-finite or non-positive focal length, size 0, all-zero P when rectified, ROI outside, R not
  /// a rotation. plumb_bob has 0, 4 or 5 coefficients, rational_polynomial 8 (12 and 14 if the thin
  /// prism and tilt terms are zero), equidistant 4.
  CameraModel(const CameraInfo& info, const CameraModelOptions& options);

  /// Pixel of a point in the camera's frame; empty where the model has none. Pixels outside the
  /// image are returned too (see inImage).
  std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& p_camera) const;
  /// Unit ray of a pixel in the camera's frame, from opticalCentre(); empty where no ray maps to
  /// it.
  std::optional<Eigen::Vector3d> ray(const Eigen::Vector2d& pixel) const;
  /// Angle between a point, seen from opticalCentre(), and the optical axis of the image, rad.
  double theta(const Eigen::Vector3d& p_camera) const;
  /// No point at a larger angle has a pixel within `margin_px` of the image; at most maxThetaRad().
  double maxThetaWithin(double margin_px) const;
  /// Where the rays start, in the camera's frame, m: zero unless P has a fourth column.
  const Eigen::Vector3d& opticalCentre() const { return optical_centre_; }

  const ImageSize& imageSize() const { return size_; }  ///< after binning and ROI
  DistortionModel distortion() const { return distortion_; }
  bool rectified() const { return rectified_; }
  double fx() const { return fx_; }  ///< px, after binning
  double fy() const { return fy_; }
  double cx() const { return cx_; }  ///< px, after binning and ROI
  double cy() const { return cy_; }
  double skew() const { return skew_; }  ///< alpha = K[1] / fx; equidistant only
  /// Largest valid angle from the axis: fold-over, pole or max_theta_deg, whichever is least.
  double maxThetaRad() const { return max_theta_rad_; }
  /// Brown-Conrady: always 8 in OpenCV's order (k1 k2 p1 p2 k3 k4 k5 k6); equidistant: 4.
  const std::vector<double>& coefficients() const { return d_; }
  /// Rotation from the camera's frame to the axes in which K, D hold.
  const Eigen::Matrix3d& R_raw_camera() const { return R_raw_camera_; }
  /// Brown-Conrady and pinhole: largest valid hypot(x, y) / z, infinite if there is no limit.
  double maxRadius() const { return max_radius_; }

 private:
  std::optional<Eigen::Vector3d> rawRay(double x_distorted, double y_distorted) const;

  DistortionModel distortion_ = DistortionModel::kPinhole;
  bool rectified_ = false;
  ImageSize size_;
  double fx_ = 0, fy_ = 0, cx_ = 0, cy_ = 0, skew_ = 0;
  Eigen::Vector3d optical_centre_ = Eigen::Vector3d::Zero();
  Eigen::Matrix3d R_raw_camera_ = Eigen::Matrix3d::Identity();  ///< R^T (image_geometry's rule)
  std::vector<double> d_;
  double max_theta_rad_ = 0;
  double max_radius_ = 0;
};

}  // namespace semantic_lidar_fusion

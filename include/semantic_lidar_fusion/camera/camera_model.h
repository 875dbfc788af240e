// SPDX-License-Identifier: MIT
/// The camera of a sensor_msgs/CameraInfo: a lens (see lens.h) before a sensor. Its lenses are
/// pinhole, plumb_bob, rational_polynomial (Brown-Conrady with OpenCV's coefficients) and
/// equidistant (Kannala-Brandt, paper eq. 6-11, valid beyond 90 deg); a file (see lens_file.h) may
/// give these and others, in place of the message's.
///
/// A point has a pixel only where the model is one-to-one: equidistant, ocam, ftheta: theta =
/// atan2(hypot(x, y), z) on the rising branch of the radius; pinhole, plumb_bob,
/// rational_polynomial: z > 0, radius below the fold-over of the radial factor times r, or of the
/// tangential terms if sooner, and (rational) below the first pole; omni: the
/// same, and z > -w |p| with w = xi or 1 / xi, whichever is at most 1; double_sphere, eucm, ucm:
/// the domain of their papers. Also theta <= max_theta_deg if given.
///
/// Raw images: pixel = K, D of R^T p (R rotates the raw camera's axes to the rectified ones, in
/// which the camera's frame is given), so that a point hits the same scene pixel raw and rectified.
/// Rectified images: pixel = P [p; 1]; P[3] and P[7] move the optical centre out of the frame's
/// origin. Binning and ROI follow image_geometry: cx - roi_x first, then everything in the row
/// divided by the binning (no half-pixel shift).
#pragma once

#include <Eigen/Core>
#include <array>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "semantic_lidar_fusion/camera/lens.h"
#include "semantic_lidar_fusion/camera/lens_file.h"
#include "semantic_lidar_fusion/camera/shutter.h"
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
  /// From a file, in place of camera_info's model, K, D and R; null = none. `rectified` must be
  /// false. A camera_info of size 0 takes the file's.
  std::shared_ptr<const LensCalibration> lens;
  ShutterConfig shutter;
};

class CameraModel {
 public:
  /// Throws DataError naming field, value and rule: unknown model, wrong number of coefficients,
  /// non-finite or non-positive focal length, size 0, all-zero P when rectified, ROI outside, R not
  /// a rotation. plumb_bob has 0, 4 or 5 coefficients, rational_polynomial 8 (12 and 14 if the thin
  /// prism and tilt terms are zero), equidistant 4; further zeros are left out (see notes()).
  /// `lenses`: those that it may have.
  CameraModel(const CameraInfo& info, const CameraModelOptions& options,
              const std::vector<LensKind>& lenses = lensKinds());

  /// Pixel of a point in the camera's frame; empty where the model has none. Pixels outside the
  /// image are returned too (see inImage).
  std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& p_camera) const;
  /// Unit ray of a pixel in the camera's frame, from opticalCentre(); empty where no ray maps to
  /// it.
  std::optional<Eigen::Vector3d> ray(const Eigen::Vector2d& pixel) const;
  /// d (u, v) / d p_camera, px/m, where project() gives a pixel.
  Matrix23d jacobian(const Eigen::Vector3d& p_camera) const;
  /// Angle between a point, seen from opticalCentre(), and the optical axis of the image, rad.
  double theta(const Eigen::Vector3d& p_camera) const;
  /// No point at a larger angle has a pixel within `margin_px` of the image; at most maxThetaRad().
  double maxThetaWithin(double margin_px) const;
  /// Where the rays start, in the camera's frame, m: zero unless P has a fourth column.
  const Eigen::Vector3d& opticalCentre() const { return optical_centre_; }

  const ImageSize& imageSize() const { return size_; }  ///< after binning and ROI
  const Lens& lens() const { return *lens_; }
  bool rectified() const { return rectified_; }
  double fx() const { return fx_; }  ///< px, after binning
  double fy() const { return fy_; }
  double cx() const { return cx_; }  ///< px, after binning and ROI
  double cy() const { return cy_; }
  double skew() const { return skew_; }  ///< alpha = K[1] / fx; only of lenses that honour it
  /// px/rad on the optical axis: fx and fy of most lenses.
  double axialFocalX() const { return fx_ * lens_->axialScale(); }
  double axialFocalY() const { return fy_ * lens_->axialScale(); }
  /// Largest valid angle from the axis: fold-over, pole or max_theta_deg, whichever is least.
  double maxThetaRad() const { return lens_->maxThetaRad(); }
  bool rollingShutter() const { return shutter_.readout_s > 0.0; }
  const RowTimes& rowTimes() const { return row_times_; }
  /// What was read against the letter of the camera_info, one sentence each; for users.
  const std::vector<std::string>& notes() const { return notes_; }
  /// Rotation from the camera's frame to the axes in which K, D hold.
  const Eigen::Matrix3d& R_raw_camera() const { return R_raw_camera_; }

 private:
  bool rectified_ = false;
  ImageSize size_;
  double fx_ = 0, fy_ = 0, cx_ = 0, cy_ = 0, skew_ = 0;
  Eigen::Vector3d optical_centre_ = Eigen::Vector3d::Zero();
  Eigen::Matrix3d R_raw_camera_ = Eigen::Matrix3d::Identity();  ///< R^T (image_geometry's rule)
  ShutterConfig shutter_;
  RowTimes row_times_;
  std::vector<std::string> notes_;
  std::shared_ptr<const Lens> lens_;
};

}  // namespace semantic_lidar_fusion

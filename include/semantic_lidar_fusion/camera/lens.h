// SPDX-License-Identifier: MIT
/// What a lens does with directions, apart from the sensor behind it: points in the lens's axes
/// (x right, y down, z along the optical axis) to the image plane of focal length 1 and back. A
/// camera's pixel is u = fx (a.x + skew a.y) + cx, v = fy a.y + cy of the plane's point a.
///
/// A lens is one class, in one file of src/camera/, and one row of lensKinds().
#pragma once

#include <Eigen/Core>
#include <array>
#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace semantic_lidar_fusion {

using Matrix23d = Eigen::Matrix<double, 2, 3>;

/// A lens maps one-to-one what it maps at all: each point of the plane that project() gives belongs
/// to one direction, and ray() returns it.
class Lens {
 public:
  virtual ~Lens() = default;

  /// The plane's point of p (any length, m); empty outside the valid domain and for p = 0.
  virtual std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& p) const = 0;
  /// The unit direction that project() maps to `a`; empty where none is.
  virtual std::optional<Eigen::Vector3d> ray(const Eigen::Vector2d& a) const = 0;
  /// d project / d p, 1/m, where project() gives a point.
  virtual Matrix23d jacobian(const Eigen::Vector3d& p) const = 0;
  /// No direction at a larger angle from the axis is in the domain, rad.
  virtual double maxThetaRad() const = 0;
  /// No direction at a larger angle is mapped to within `radius` of the plane's origin; at most
  /// maxThetaRad(). May be larger than necessary.
  virtual double maxThetaWithin(double /*radius*/) const { return maxThetaRad(); }
  /// d |a| / d theta on the axis: 1 unless the model's focal length is no paraxial one.
  virtual double axialScale() const { return 1.0; }
  /// k1..k4 if the plane's radius is theta (1 + k1 theta^2 + ... + k4 theta^8), which projection
  /// kernels know (see projection/projection_kernels.h); else null.
  virtual const std::array<double, 4>* kannalaBrandt() const { return nullptr; }
};

/// A lens's model and numbers as a file or message gives them.
struct LensParameters {
  std::string source;  ///< begins messages: "camera_info of frame 'front'"
  std::string model;   ///< the name of a row of lensKinds()
  std::vector<double> coefficients;
};

/// A row of the table of lenses.
struct LensKind {
  std::string name;
  std::vector<std::string>
      in_camera_info;  ///< its names in sensor_msgs/CameraInfo; none: not there
  bool skewed;         ///< K[1] is honoured
  /// `max_theta_rad`: narrows the domain, at most pi. Adds to `notes` what was read against the
  /// letter of the parameters. Throws DataError naming source, field, value and rule.
  std::unique_ptr<const Lens> (*make)(const LensParameters& parameters, double max_theta_rad,
                                      std::vector<std::string>* notes);
};

/// The lenses of this package.
const std::vector<LensKind>& lensKinds();

}  // namespace semantic_lidar_fusion

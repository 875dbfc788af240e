// SPDX-License-Identifier: MIT
/// What the files of the lenses share.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <memory>
#include <sstream>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/camera/lens.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {

/// How far beyond the domain's edge a ray may come out by rounding, as a part.
constexpr double kEdgeSlack = 1e-12;

/// Throws DataError with source, field, value and rule in one sentence.
template <typename Value>
[[noreturn]] void refuse(const std::string& source, const std::string& field, const Value& value,
                         const std::string& rule) {
  std::ostringstream message;
  message.precision(12);
  message << source << ": " << field << " = " << value << ": " << rule;
  throw DataError(message.str());
}

/// Throws DataError for the first coefficient that is not finite.
void requireFiniteCoefficients(const LensParameters& parameters);

/// The coefficients, of which there must be one of `counts`. Zeros behind the highest count say
/// nothing and are left out, with a note. `rule` completes the refusal of another number. Throws
/// DataError, also for one that is not finite.
std::vector<double> checkedCoefficients(const LensParameters& parameters,
                                        std::initializer_list<std::size_t> counts,
                                        const std::string& rule, std::vector<std::string>* notes);

/// Jacobian of (x, y) / D(p), from D and its gradient.
inline Matrix23d quotientJacobian(const Eigen::Vector3d& p, double d,
                                  const Eigen::Vector3d& gradient) {
  Matrix23d j = -p.head<2>() * gradient.transpose() / (d * d);
  j(0, 0) += 1.0 / d;
  j(1, 1) += 1.0 / d;
  return j;
}

/// Angle of a direction from the optical axis, rad.
inline double angleFromAxis(const Eigen::Vector3d& p) {
  return std::atan2(std::hypot(p.x(), p.y()), p.z());
}

/// A lens whose plane's radius depends on the angle from the axis alone and rises with it, from
/// `begin` to `end` (rad).
class RadialLens : public Lens {
 public:
  RadialLens(double begin_rad, double end_rad) : begin_rad_(begin_rad), end_rad_(end_rad) {}

  std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& p) const override;
  std::optional<Eigen::Vector3d> ray(const Eigen::Vector2d& a) const override;
  Matrix23d jacobian(const Eigen::Vector3d& p) const override;
  double maxThetaRad() const override { return end_rad_; }
  double maxThetaWithin(double radius) const override;

 protected:
  virtual double radius(double theta) const = 0;
  /// d radius / d theta
  virtual double slope(double theta) const = 0;

 private:
  double begin_rad_, end_rad_;
};

}  // namespace semantic_lidar_fusion

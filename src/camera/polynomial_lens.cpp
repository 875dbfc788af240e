// SPDX-License-Identifier: MIT
// Lenses given by a polynomial of the angle from the axis in pixels, and an affine map of the
// sensor: ftheta (r(theta)) and ocam (D. Scaramuzza, A. Martinelli, R. Siegwart: "A Toolbox for
// Easily Calibrating Omnidirectional Cameras", IROS 2006; its inverse polynomial).
#include <Eigen/LU>
#include <cmath>

#include "lens_parts.h"
#include "polynomial.h"

namespace semantic_lidar_fusion {
namespace {

/// A polynomial r(theta + shift) on the branch where it is positive and rises.
struct Branch {
  Polynomial r, slope;
  double shift_rad, begin_rad, end_rad;
};

class PolynomialLens : public RadialLens {
 public:
  /// plane = sensor * (radial point)
  PolynomialLens(Branch branch, const Eigen::Matrix2d& sensor)
      : RadialLens(branch.begin_rad, branch.end_rad),
        branch_(std::move(branch)),
        sensor_(sensor),
        inverse_(sensor.inverse()) {}

  std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& p) const override {
    const auto a = RadialLens::project(p);
    if (!a) return std::nullopt;
    return sensor_ * *a;
  }
  std::optional<Eigen::Vector3d> ray(const Eigen::Vector2d& a) const override {
    return RadialLens::ray(inverse_ * a);
  }
  Matrix23d jacobian(const Eigen::Vector3d& p) const override {
    return sensor_ * RadialLens::jacobian(p);
  }
  double maxThetaWithin(double radius) const override {
    return RadialLens::maxThetaWithin(radius * inverse_.norm());  // at least the largest stretch
  }
  double axialScale() const override { return slope(0.0); }

 protected:
  double radius(double theta) const override {
    return evaluate(branch_.r, theta + branch_.shift_rad);
  }
  double slope(double theta) const override {
    return evaluate(branch_.slope, theta + branch_.shift_rad);
  }

 private:
  Branch branch_;
  Eigen::Matrix2d sensor_, inverse_;
};

/// More says that the polynomial is meant otherwise.
constexpr double kMostOnAxis_px = 2.0;

/// The branch that starts at the axis. Throws DataError if there is none.
Branch risingBranch(const LensParameters& parameters, const Polynomial& r, double shift_rad,
                    double max_theta_rad) {
  Branch branch{r, derivative(r), shift_rad, 0.0, 0.0};
  const double axis = shift_rad, behind = shift_rad + kPi;
  if (!(evaluate(branch.slope, axis) > 0.0)) {
    refuse(parameters.source, "d r / d theta on the axis", evaluate(branch.slope, axis),
           "must be above 0, px/rad");
  }
  const double fold = firstRoot(branch.slope, axis, behind);
  branch.end_rad = std::min({kPi, fold - shift_rad, max_theta_rad});
  if (!(std::abs(evaluate(r, axis)) <= kMostOnAxis_px)) {
    refuse(parameters.source, "r on the axis", evaluate(r, axis), "must be 0 px, to within 2 px");
  }
  // A fit may be some hundredths of a pixel below 0 on the axis.
  if (evaluate(r, axis) < 0.0) branch.begin_rad = firstRoot(r, axis, behind) - shift_rad;
  if (!(branch.begin_rad < branch.end_rad)) {
    refuse(parameters.source, "r on the axis", evaluate(r, axis),
           "must rise to above 0 px within the valid angle");
  }
  return branch;
}

/// [c d; e 1] in rows and columns of the image, as the toolbox writes it, in columns and rows.
Eigen::Matrix2d sensorOf(const LensParameters& parameters, double c, double d, double e) {
  Eigen::Matrix2d sensor;
  sensor << 1.0, e, d, c;
  if (!(sensor.determinant() >= 0.1 && sensor.norm() <= 10.0)) {
    refuse(parameters.source, "c - d e", sensor.determinant(),
           "must be about 1 (affine part c, d, e is 1, 0, 0 for square pixels)");
  }
  return sensor;
}

constexpr std::size_t kMostCoefficients = 40;

std::vector<double> polynomialCoefficients(const LensParameters& parameters, std::size_t least,
                                           const std::string& rule) {
  requireFiniteCoefficients(parameters);
  const std::size_t count = parameters.coefficients.size();
  if (count < least || count > kMostCoefficients) {
    refuse(parameters.source, "D.size", count, rule);
  }
  return parameters.coefficients;
}

}  // namespace

std::unique_ptr<const Lens> makeFtheta(const LensParameters& parameters, double max_theta_rad,
                                       std::vector<std::string>* /*notes*/) {
  const Polynomial r = polynomialCoefficients(
      parameters, 2, "must be 2 to 40 for ftheta (r = D[0] + D[1] theta + ..., px)");
  return std::make_unique<PolynomialLens>(risingBranch(parameters, r, 0.0, max_theta_rad),
                                          Eigen::Matrix2d::Identity());
}

std::unique_ptr<const Lens> makeOcam(const LensParameters& parameters, double max_theta_rad,
                                     std::vector<std::string>* /*notes*/) {
  const std::vector<double> d = polynomialCoefficients(
      parameters, 5, "must be 5 to 40 for ocam (c d e, then the inverse polynomial)");
  // The toolbox counts the angle from the plane of the sensor: -90 deg is the optical axis.
  return std::make_unique<PolynomialLens>(
      risingBranch(parameters, {d.begin() + 3, d.end()}, -0.5 * kPi, max_theta_rad),
      sensorOf(parameters, d[0], d[1], d[2]));
}

}  // namespace semantic_lidar_fusion

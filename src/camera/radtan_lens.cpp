// SPDX-License-Identifier: MIT
// Lenses that bend the plane of a central projection radially and tangentially: pinhole, plumb_bob
// and rational_polynomial (Brown-Conrady with OpenCV's coefficients), whose projection centre is
// the camera's.
#include <Eigen/Dense>
#include <cmath>

#include "lens_parts.h"
#include "polynomial.h"

namespace semantic_lidar_fusion {
namespace {

/// Squared radius up to which fold-over and pole are sought: 6e-7 deg short of 90 deg.
constexpr double kMaxSquaredRadius = 1e16;

/// a (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3) + tangential terms, s = |a|^2.
class Bending {
 public:
  /// k1 k2 p1 p2 k3 k4 k5 k6, OpenCV's order.
  explicit Bending(const std::array<double, 8>& d)
      : d_(d), none_(std::all_of(d.begin(), d.end(), [](double x) { return x == 0.0; })) {}

  bool none() const { return none_; }

  double radialFactor(double s) const {
    return (1.0 + s * (d_[0] + s * (d_[1] + s * d_[4]))) /
           (1.0 + s * (d_[5] + s * (d_[6] + s * d_[7])));
  }

  /// Largest radius on the rising branch of r N(r^2) / D(r^2), before D's first root.
  double foldOverRadius() const {
    const Polynomial n{1.0, d_[0], d_[1], d_[4]};
    const Polynomial q{1.0, d_[5], d_[6], d_[7]};
    // d/dr (r N / D) = 0  <=>  N D + 2 s (N' D - N D') = 0
    Polynomial slope = product(n, q);
    const Polynomial gain = product(derivative(n), q);
    const Polynomial loss = product(n, derivative(q));
    for (std::size_t i = 0; i < gain.size(); ++i) slope[i + 1] += 2.0 * (gain[i] - loss[i]);
    return std::sqrt(
        std::min(firstRoot(slope, 0.0, kMaxSquaredRadius), firstRoot(q, 0.0, kMaxSquaredRadius)));
  }

  Eigen::Vector2d apply(const Eigen::Vector2d& a) const {
    const double x = a.x(), y = a.y();
    const double s = a.squaredNorm();
    const double radial = radialFactor(s);
    return {x * radial + 2.0 * d_[2] * x * y + d_[3] * (s + 2.0 * x * x),
            y * radial + d_[2] * (s + 2.0 * y * y) + 2.0 * d_[3] * x * y};
  }

  Eigen::Matrix2d jacobian(const Eigen::Vector2d& a) const {
    const double x = a.x(), y = a.y();
    const double s = a.squaredNorm();
    const double bottom = 1.0 + s * (d_[5] + s * (d_[6] + s * d_[7]));
    const double radial = radialFactor(s);
    const double top_slope = d_[0] + s * (2.0 * d_[1] + s * 3.0 * d_[4]);
    const double bottom_slope = d_[5] + s * (2.0 * d_[6] + s * 3.0 * d_[7]);
    const double slope = (top_slope - radial * bottom_slope) / bottom;  // d radial / d s
    Eigen::Matrix2d j;
    j(0, 0) = radial + 2.0 * x * x * slope + 2.0 * d_[2] * y + 6.0 * d_[3] * x;
    j(0, 1) = 2.0 * x * y * slope + 2.0 * d_[2] * x + 2.0 * d_[3] * y;
    j(1, 0) = j(0, 1);
    j(1, 1) = radial + 2.0 * y * y * slope + 6.0 * d_[2] * y + 2.0 * d_[3] * x;
    return j;
  }

  /// The point that apply() maps to `target`, sought from the radial part's solution up to
  /// `max_radius`; empty if Newton's steps do not end there.
  std::optional<Eigen::Vector2d> invert(const Eigen::Vector2d& target, double max_radius) const {
    const double radius = std::hypot(target.x(), target.y());
    if (radius == 0.0) return target;
    // Start from the radial part alone, which is monotone up to max_radius, then Newton.
    const auto excess = [&](double r) { return r * radialFactor(r * r) - radius; };
    // The bracket ends short of the limit, which may be a pole. The tangential terms may carry a
    // valid pixel a little beyond it.
    const double bracket_end = std::min(max_radius * (1.0 - 1e-9), 1e8);
    double high = std::min(bracket_end, 2.0 * radius + 1.0);
    while (high < bracket_end && excess(high) < 0.0) high = std::min(bracket_end, 2.0 * high);
    const double start = excess(high) < 0.0 ? high : bisect(excess, 0.0, high);
    Eigen::Vector2d a = target * (start / radius);
    constexpr int kMaxIterations = 50;
    for (int i = 0; i < kMaxIterations; ++i) {
      const Eigen::Vector2d step = jacobian(a).fullPivLu().solve(target - apply(a));
      if (!step.allFinite()) return std::nullopt;
      a += step;
      if (step.norm() <= 1e-14 * (1.0 + a.norm())) break;
    }
    const double residual = (apply(a) - target).norm();
    if (!(residual <= 1e-9 * (1.0 + radius))) return std::nullopt;
    return a;
  }

 private:
  std::array<double, 8> d_;
  bool none_;
};

class RadtanLens : public Lens {
 public:
  RadtanLens(const std::array<double, 8>& d, double max_theta_rad) : bending_(d) {
    max_radius_ = bending_.none() ? kInfinity : bending_.foldOverRadius();
    if (max_theta_rad < 0.5 * kPi) max_radius_ = std::min(max_radius_, std::tan(max_theta_rad));
    max_theta_rad_ = std::atan(max_radius_);
  }

  std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& p) const override {
    if (!(p.z() > 0.0)) return std::nullopt;
    const Eigen::Vector2d a = p.head<2>() / p.z();
    if (!(a.norm() <= max_radius_)) return std::nullopt;
    return bending_.none() ? a : bending_.apply(a);
  }

  std::optional<Eigen::Vector3d> ray(const Eigen::Vector2d& target) const override {
    Eigen::Vector2d a = target;
    if (!bending_.none()) {
      const auto source = bending_.invert(target, max_radius_);
      if (!source) return std::nullopt;
      a = *source;
    }
    if (!(a.norm() <= max_radius_ * (1.0 + kEdgeSlack))) return std::nullopt;
    return Eigen::Vector3d(a.x(), a.y(), 1.0).stableNormalized();
  }

  Matrix23d jacobian(const Eigen::Vector3d& p) const override {
    const Matrix23d j = quotientJacobian(p, p.z(), Eigen::Vector3d::UnitZ());
    return bending_.none() ? j : Matrix23d(bending_.jacobian(p.head<2>() / p.z()) * j);
  }

  double maxThetaRad() const override { return max_theta_rad_; }
  double maxThetaWithin(double radius) const override {
    return bending_.none() ? std::min(std::atan(radius), max_theta_rad_) : max_theta_rad_;
  }

 private:
  Bending bending_;
  double max_radius_ = 0;  ///< of the plane before it is bent
  double max_theta_rad_ = 0;
};

std::unique_ptr<const Lens> makeRadtan(const std::vector<double>& d, double max_theta_rad) {
  std::array<double, 8> all{};
  std::copy(d.begin(), d.begin() + std::min<std::ptrdiff_t>(8, d.end() - d.begin()), all.begin());
  return std::make_unique<RadtanLens>(all, max_theta_rad);
}

}  // namespace

std::unique_ptr<const Lens> makePinhole(const LensParameters& parameters, double max_theta_rad,
                                        std::vector<std::string>* /*notes*/) {
  requireFiniteCoefficients(parameters);
  const std::vector<double>& d = parameters.coefficients;
  // Zeros without a model are what drivers publish.
  if (std::any_of(d.begin(), d.end(), [](double x) { return x != 0.0; })) {
    refuse(parameters.source, "distortion_model", "''",
           "names no model, yet D holds " + std::to_string(d.size()) +
               " coefficients that are not all 0");
  }
  return makeRadtan({}, max_theta_rad);
}

std::unique_ptr<const Lens> makePlumbBob(const LensParameters& parameters, double max_theta_rad,
                                         std::vector<std::string>* notes) {
  return makeRadtan(
      checkedCoefficients(parameters, {0, 4, 5},
                          "must be 5 for plumb_bob (k1 k2 p1 p2 k3), or 4 or 0", notes),
      max_theta_rad);
}

std::unique_ptr<const Lens> makeRationalPolynomial(const LensParameters& parameters,
                                                   double max_theta_rad,
                                                   std::vector<std::string>* notes) {
  const std::vector<double> d = checkedCoefficients(
      parameters, {8, 12, 14},
      "must be 8 for rational_polynomial (k1 k2 p1 p2 k3 k4 k5 k6), or 12 or 14", notes);
  if (std::any_of(d.begin() + 8, d.end(), [](double x) { return x != 0.0; })) {
    refuse(parameters.source, "D[8..]", "not all 0",
           "thin prism and tilt coefficients are not supported; calibrate with 8 coefficients");
  }
  return makeRadtan(d, max_theta_rad);
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
// Lenses with a closed inverse that divide by a mean of depth and distance: double_sphere
// (V. Usenko, N. Demmel, D. Cremers: "The Double Sphere Camera Model", 3DV 2018), eucm
// (B. Khomutenko, G. Garcia, P. Martinet: "An Enhanced Unified Camera Model", RA-L 2016) and ucm.
#include <cmath>

#include "lens_parts.h"
#include "polynomial.h"

namespace semantic_lidar_fusion {
namespace {

/// a = (x, y) / (alpha d2 + (1 - alpha) z2) with z2 = z + xi |p| and d2^2 = beta (x^2 + y^2) +
/// z2^2. One of xi = 0 and beta = 1 holds.
class SphereLens : public Lens {
 public:
  SphereLens(double xi, double alpha, double beta, double max_theta_rad)
      : xi_(xi),
        alpha_(alpha),
        beta_(beta),
        least_inner_(-(alpha <= 0.5 ? alpha / (1.0 - alpha) : (1.0 - alpha) / alpha)),
        least_outer_(leastOuter(xi, -least_inner_)) {
    // The direction at which z2 / d2 is least_inner_.
    const double across = std::sqrt((1.0 - least_inner_ * least_inner_) / beta);
    const double edge = xi == 0.0 ? std::atan2(across, least_inner_)
                                  : angleFromAxis(fromSecondSphere({across, 0.0, least_inner_}));
    max_theta_rad_ = std::min({edge, std::acos(least_outer_), max_theta_rad});
  }

  std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& p) const override {
    const Inner inner = innerOf(p);
    if (!std::isfinite(inner.d1 + inner.d2)) return std::nullopt;  // squares overflow
    if (!(inner.d1 > 0.0 && inner.z > least_inner_ * inner.d2 && p.z() > least_outer_ * inner.d1 &&
          angleFromAxis(p) <= max_theta_rad_)) {
      return std::nullopt;
    }
    return p.head<2>() / denominator(inner);
  }

  std::optional<Eigen::Vector3d> ray(const Eigen::Vector2d& a) const override {
    const double s = beta_ * a.squaredNorm();
    const double root = 1.0 - (2.0 * alpha_ - 1.0) * s;
    if (!(root >= -kEdgeSlack)) return std::nullopt;
    // z = (1 - alpha^2 s) / (alpha sqrt(root) + 1 - alpha), which is 0 / 0 at the edge of a lens of
    // alpha 1; with both multiplied by alpha sqrt(root) - (1 - alpha) it is not.
    const double rise = alpha_ * std::sqrt(std::max(0.0, root));
    const double z = alpha_ > 0.75 ? (rise - (1.0 - alpha_)) / (2.0 * alpha_ - 1.0)
                                   : (1.0 - alpha_ * alpha_ * s) / (rise + 1.0 - alpha_);
    if (!std::isfinite(z)) return std::nullopt;
    const Eigen::Vector3d p = fromSecondSphere(Eigen::Vector3d(a.x(), a.y(), z));
    if (!(angleFromAxis(p) <= max_theta_rad_ + kEdgeSlack)) return std::nullopt;
    return p;
  }

  Matrix23d jacobian(const Eigen::Vector3d& p) const override {
    const Inner inner = innerOf(p);
    const Eigen::Vector3d z_rise = Eigen::Vector3d::UnitZ() + p * (xi_ / inner.d1);
    const Eigen::Vector3d d2_rise =
        (Eigen::Vector3d(beta_ * p.x(), beta_ * p.y(), 0.0) + inner.z * z_rise) / inner.d2;
    return quotientJacobian(p, denominator(inner), alpha_ * d2_rise + (1.0 - alpha_) * z_rise);
  }

  double maxThetaRad() const override { return max_theta_rad_; }
  double maxThetaWithin(double radius) const override {
    const auto edge = ray({radius, 0.0});
    return edge ? std::min(angleFromAxis(*edge), max_theta_rad_) : max_theta_rad_;
  }
  double axialScale() const override { return 1.0 / (1.0 + xi_); }

 private:
  struct Inner {
    double d1, z, d2;
  };

  /// Usenko et al., eq. 44 and 45; never reached without a second sphere.
  static double leastOuter(double xi, double w1) {
    return xi == 0.0 ? -1.0 : -(w1 + xi) / std::sqrt(2.0 * w1 * xi + xi * xi + 1.0);
  }

  Inner innerOf(const Eigen::Vector3d& p) const {
    const double d1 = p.norm();
    const double z = p.z() + xi_ * d1;
    return {d1, z, std::sqrt(beta_ * p.head<2>().squaredNorm() + z * z)};
  }

  double denominator(const Inner& inner) const {
    return alpha_ * inner.d2 + (1.0 - alpha_) * inner.z;
  }

  /// The unit direction p with (x, y, z + xi) along q.
  Eigen::Vector3d fromSecondSphere(const Eigen::Vector3d& q) const {
    if (xi_ == 0.0) return q.stableNormalized();
    const Eigen::Vector3d unit = q.stableNormalized();
    const double along =
        xi_ * unit.z() + std::sqrt(xi_ * xi_ * unit.z() * unit.z() + 1.0 - xi_ * xi_);
    return (along * unit - Eigen::Vector3d(0.0, 0.0, xi_)).stableNormalized();
  }

  double xi_, alpha_, beta_;
  double least_inner_;  ///< z2 / d2 exceeds it: the divisor is positive and the radius rises
  double least_outer_;  ///< z / |p| exceeds it
  double max_theta_rad_ = 0;
};

void requireAlpha(const LensParameters& parameters, double alpha) {
  if (!(alpha >= 0.0 && alpha <= 1.0)) {
    refuse(parameters.source, "alpha", alpha, "must lie in 0..1 for " + parameters.model);
  }
}

std::unique_ptr<const Lens> makeUnified(const LensParameters& parameters, double alpha, double beta,
                                        double max_theta_rad) {
  requireAlpha(parameters, alpha);
  if (!(beta >= 1e-6 && beta <= 1e6)) {
    refuse(parameters.source, "beta", beta, "must lie in 1e-6..1e6 for " + parameters.model);
  }
  return std::make_unique<SphereLens>(0.0, alpha, beta, max_theta_rad);
}

}  // namespace

std::unique_ptr<const Lens> makeDoubleSphere(const LensParameters& parameters, double max_theta_rad,
                                             std::vector<std::string>* notes) {
  const std::vector<double> d =
      checkedCoefficients(parameters, {2}, "must be 2 for double_sphere (xi alpha)", notes);
  // With the second centre outside the first sphere two directions have one point.
  if (!(d[0] > -1.0 && d[0] <= 1.0)) {
    refuse(parameters.source, "xi", d[0], "must lie above -1 and not above 1 for double_sphere");
  }
  requireAlpha(parameters, d[1]);
  return std::make_unique<SphereLens>(d[0], d[1], 1.0, max_theta_rad);
}

std::unique_ptr<const Lens> makeEucm(const LensParameters& parameters, double max_theta_rad,
                                     std::vector<std::string>* notes) {
  const std::vector<double> d =
      checkedCoefficients(parameters, {2}, "must be 2 for eucm (alpha beta)", notes);
  return makeUnified(parameters, d[0], d[1], max_theta_rad);
}

std::unique_ptr<const Lens> makeUcm(const LensParameters& parameters, double max_theta_rad,
                                    std::vector<std::string>* notes) {
  const std::vector<double> d =
      checkedCoefficients(parameters, {1}, "must be 1 for ucm (alpha)", notes);
  return makeUnified(parameters, d[0], 1.0, max_theta_rad);
}

}  // namespace semantic_lidar_fusion

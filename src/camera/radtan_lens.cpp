// SPDX-License-Identifier: MIT
// Lenses that bend the plane of a central projection radially and tangentially. Pinhole, plumb_bob
// and rational_polynomial (Brown-Conrady with OpenCV's coefficients) project from the camera's
// centre. omni (C. Mei, P. Rives: "Single View Point Omnidirectional Camera Calibration from Planar
// Grids", ICRA 2007) projects the unit sphere from a point xi behind its centre.
#include <Eigen/Dense>
#include <cmath>

#include "lens_parts.h"
#include "polynomial.h"

namespace semantic_lidar_fusion {
namespace {

/// Squared radius up to which fold-over and pole are sought: 6e-7 deg short of 90 deg.
constexpr double kMaxSquaredRadius = 1e16;
/// A sphere seen from further away is a plane but for rounding.
constexpr double kMostXi = 100.0;

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

  /// Radius of the disk about the origin in which the plane is not folded: the radial part rises,
  /// has no pole, and the tangential terms, whatever the direction, weigh less than its rise. The
  /// symmetric Jacobian is positive definite there, so apply() is one-to-one.
  double foldOverRadius() const {
    const Polynomial n{1.0, d_[0], d_[1], d_[4]};
    const Polynomial q{1.0, d_[5], d_[6], d_[7]};
    // d/dr (r N / D) = 0  <=>  N D + 2 s (N' D - N D') = 0
    Polynomial slope = product(n, q);
    const Polynomial gain = product(derivative(n), q);
    const Polynomial loss = product(n, derivative(q));
    for (std::size_t i = 0; i < gain.size(); ++i) slope[i + 1] += 2.0 * (gain[i] - loss[i]);
    const double radius = std::sqrt(
        std::min(firstRoot(slope, 0.0, kMaxSquaredRadius), firstRoot(q, 0.0, kMaxSquaredRadius)));
    const double tangential = 6.0 * std::hypot(d_[2], d_[3]);  // of r, the least eigenvalue
    if (tangential == 0.0) return radius;
    const double limit = std::min(radius, std::sqrt(kMaxSquaredRadius));
    return std::min({radius, firstRoot(exceeding(slope, tangential, product(q, q)), 0.0, limit),
                     firstRoot(exceeding(n, tangential, q), 0.0, limit)});
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
    constexpr int kMaxIterations = 50, kMaxHalvings = 60;
    const double edge = max_radius * (1.0 + kEdgeSlack);
    double residual = (apply(a) - target).norm();
    for (int i = 0; i < kMaxIterations; ++i) {
      Eigen::Vector2d step = jacobian(a).fullPivLu().solve(target - apply(a));
      if (!step.allFinite()) return std::nullopt;
      if (step.norm() <= 1e-14 * (1.0 + a.norm())) break;
      // Shorter steps where the whole one leaves the disk or leads nowhere.
      double next = (apply(a + step) - target).norm();
      for (int k = 0; k < kMaxHalvings && !(next < residual && (a + step).norm() <= edge); ++k) {
        step *= 0.5;
        next = (apply(a + step) - target).norm();
      }
      if (!(next < residual)) break;
      a += step;
      residual = next;
    }
    if (!(residual <= 1e-9 * (1.0 + radius))) return std::nullopt;
    return a;
  }

 private:
  /// n(r^2) - factor r q(r^2) as a polynomial in r.
  static Polynomial exceeding(const Polynomial& n, double factor, const Polynomial& q) {
    Polynomial result(2 * std::max(n.size(), q.size()), 0.0);
    for (std::size_t i = 0; i < n.size(); ++i) result[2 * i] += n[i];
    for (std::size_t i = 0; i < q.size(); ++i) result[2 * i + 1] -= factor * q[i];
    return result;
  }

  std::array<double, 8> d_;
  bool none_;
};

class RadtanLens : public Lens {
 public:
  /// `xi` >= 0; 0 = the camera's centre.
  RadtanLens(double xi, const std::array<double, 8>& d, double max_theta_rad)
      : xi_(xi), least_cosine_(xi <= 1.0 ? -xi : -1.0 / xi), bending_(d) {
    max_radius_ = bending_.none() ? kInfinity : bending_.foldOverRadius();
    // Beyond least_cosine_ the radius of the plane falls again, or is on the other side of it.
    const double edge_rad = xi == 0.0 ? 0.5 * kPi : std::acos(least_cosine_);
    if (max_theta_rad < edge_rad) {
      max_radius_ = std::min(max_radius_,
                             xi == 0.0 ? std::tan(max_theta_rad)
                                       : std::sin(max_theta_rad) / (std::cos(max_theta_rad) + xi));
    }
    max_theta_rad_ = xi == 0.0 ? std::atan(max_radius_) : std::min(edge_rad, max_theta_rad);
    if (xi != 0.0 && max_radius_ < kInfinity) {
      const auto edge = lifted({max_radius_, 0.0});
      if (edge) max_theta_rad_ = std::min(max_theta_rad_, angleFromAxis(*edge));
    }
  }

  std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& p) const override {
    const double d1 = xi_ == 0.0 ? 0.0 : p.stableNorm();  // squares of large points overflow
    if (!(p.z() > least_cosine_ * d1)) return std::nullopt;
    const double depth = p.z() + xi_ * d1;
    const Eigen::Vector2d a = p.head<2>() / depth;
    if (!(depth < kInfinity && a.norm() <= max_radius_)) return std::nullopt;
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
    return lifted(a);
  }

  Matrix23d jacobian(const Eigen::Vector3d& p) const override {
    const double d1 = p.norm();
    const double d = p.z() + xi_ * d1;
    const Matrix23d j = quotientJacobian(p, d, Eigen::Vector3d::UnitZ() + p * (xi_ / d1));
    return bending_.none() ? j : Matrix23d(bending_.jacobian(p.head<2>() / d) * j);
  }

  double maxThetaRad() const override { return max_theta_rad_; }
  double maxThetaWithin(double radius) const override {
    if (!bending_.none()) return max_theta_rad_;
    const auto edge = lifted({radius, 0.0});
    return edge ? std::min(angleFromAxis(*edge), max_theta_rad_) : max_theta_rad_;
  }
  double axialScale() const override { return 1.0 / (1.0 + xi_); }

 private:
  /// The direction whose central projection is `a`; empty where there is none.
  std::optional<Eigen::Vector3d> lifted(const Eigen::Vector2d& a) const {
    if (xi_ == 0.0) return Eigen::Vector3d(a.x(), a.y(), 1.0).stableNormalized();
    const double s = a.squaredNorm();
    const double root = 1.0 + (1.0 - xi_ * xi_) * s;
    if (!(root >= -kEdgeSlack)) return std::nullopt;
    const double scale = (xi_ + std::sqrt(std::max(0.0, root))) / (1.0 + s);
    return Eigen::Vector3d(scale * a.x(), scale * a.y(), scale - xi_).stableNormalized();
  }

  double xi_, least_cosine_;
  Bending bending_;
  double max_radius_ = 0;  ///< of the plane before it is bent
  double max_theta_rad_ = 0;
};

std::unique_ptr<const Lens> makeRadtan(double xi, const std::vector<double>& d,
                                       double max_theta_rad) {
  std::array<double, 8> all{};
  std::copy_n(d.begin(), std::min(d.size(), all.size()), all.begin());
  return std::make_unique<RadtanLens>(xi, all, max_theta_rad);
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
  return makeRadtan(0.0, {}, max_theta_rad);
}

std::unique_ptr<const Lens> makePlumbBob(const LensParameters& parameters, double max_theta_rad,
                                         std::vector<std::string>* notes) {
  return makeRadtan(
      0.0,
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
  return makeRadtan(0.0, d, max_theta_rad);
}

std::unique_ptr<const Lens> makeOmni(const LensParameters& parameters, double max_theta_rad,
                                     std::vector<std::string>* notes) {
  const std::vector<double> d = checkedCoefficients(
      parameters, {1, 5, 6}, "must be 5 for omni (xi k1 k2 p1 p2), or 6 with k3, or 1", notes);
  if (!(d[0] >= 0.0 && d[0] <= kMostXi)) {
    refuse(parameters.source, "xi", d[0], "must lie in 0..100 for omni");
  }
  return makeRadtan(d[0], {d.begin() + 1, d.end()}, max_theta_rad);
}

}  // namespace semantic_lidar_fusion

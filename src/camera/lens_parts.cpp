// SPDX-License-Identifier: MIT
#include "lens_parts.h"

#include <cmath>

#include "polynomial.h"

namespace semantic_lidar_fusion {
namespace {

/// A direction nearer to the axis than this has no azimuth that doubles can hold, rad.
constexpr double kLeastAngle = 1e-150;

}  // namespace

void requireFiniteCoefficients(const LensParameters& parameters) {
  for (std::size_t i = 0; i < parameters.coefficients.size(); ++i) {
    const double value = parameters.coefficients[i];
    if (!std::isfinite(value)) {
      refuse(parameters.source, "D[" + std::to_string(i) + "]", value, "must be finite");
    }
  }
}

std::vector<double> checkedCoefficients(const LensParameters& parameters,
                                        std::initializer_list<std::size_t> counts,
                                        const std::string& rule, std::vector<std::string>* notes) {
  requireFiniteCoefficients(parameters);
  std::vector<double> d = parameters.coefficients;
  const std::size_t most = std::max(counts);
  std::size_t used = d.size();
  while (used > most && d[used - 1] == 0.0) --used;
  if (std::find(counts.begin(), counts.end(), used) == counts.end()) {
    refuse(parameters.source, "D.size", d.size(), rule);
  }
  if (used < d.size()) {
    notes->push_back(parameters.source + ": D holds " + std::to_string(d.size()) +
                     " coefficients where " + parameters.model + " has " + std::to_string(most) +
                     "; the zeros behind them are left out");
    d.resize(used);
  }
  return d;
}

std::optional<Eigen::Vector2d> RadialLens::project(const Eigen::Vector3d& p) const {
  const double r = std::hypot(p.x(), p.y());
  const double theta = std::atan2(r, p.z());
  if (!(theta <= end_rad_)) return std::nullopt;
  if (r == 0.0) {
    if (!(p.z() > 0.0)) return std::nullopt;  // the origin, or straight behind
    return Eigen::Vector2d::Zero();
  }
  if (theta < begin_rad_) return std::nullopt;
  return p.head<2>() * (radius(theta) / r);
}

std::optional<Eigen::Vector3d> RadialLens::ray(const Eigen::Vector2d& a) const {
  const double r = std::hypot(a.x(), a.y());
  if (r == 0.0) return Eigen::Vector3d::UnitZ();
  const double least = radius(begin_rad_), most = radius(end_rad_);
  if (r > most * (1.0 + kEdgeSlack) || r < least * (1.0 - kEdgeSlack)) return std::nullopt;
  const double solved = r > least
                            ? bisect([&](double t) { return radius(t) - r; }, begin_rad_, end_rad_)
                            : begin_rad_;
  // Around the axis of a lens whose radius is above 0 there lies a circle, not a point.
  const double theta = std::max(solved, kLeastAngle);
  const double s = std::sin(theta) / r;
  return Eigen::Vector3d(a.x() * s, a.y() * s, std::cos(theta));
}

Matrix23d RadialLens::jacobian(const Eigen::Vector3d& p) const {
  const double r = std::hypot(p.x(), p.y());
  const double squared = r * r + p.z() * p.z();
  const double theta = std::atan2(r, p.z());
  const double rise = slope(theta);
  Matrix23d j;
  if (r == 0.0) {
    j << rise / p.z(), 0.0, 0.0, 0.0, rise / p.z(), 0.0;
    return j;
  }
  const Eigen::Vector2d e = p.head<2>() / r;
  const Eigen::Vector2d t(-e.y(), e.x());
  j.leftCols<2>() =
      e * e.transpose() * (rise * p.z() / squared) + t * t.transpose() * (radius(theta) / r);
  j.col(2) = -e * (rise * r / squared);
  return j;
}

double RadialLens::maxThetaWithin(double r) const {
  if (r >= radius(end_rad_)) return end_rad_;
  if (r <= radius(begin_rad_)) return begin_rad_;
  return bisect([&](double t) { return radius(t) - r; }, begin_rad_, end_rad_);
}

}  // namespace semantic_lidar_fusion

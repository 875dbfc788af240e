// SPDX-License-Identifier: MIT
// Camera equations of "Semantic sensor fusion: from camera to sparse lidar information", eq. 6-11.
#include "semantic_lidar_fusion/camera/camera_model.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr int kMaxImageSide = 32767;
/// Squared radius up to which fold-over and pole are sought: 6e-7 deg short of 90 deg.
constexpr double kMaxSquaredRadius = 1e16;
/// Largest entry of R R^T - 1: rotations are often written with few digits.
constexpr double kRotationTolerance = 1e-2;

/// Polynomial, lowest power first.
using Polynomial = std::vector<double>;

double evaluate(const Polynomial& polynomial, double x) {
  double sum = 0.0;
  for (auto c = polynomial.rbegin(); c != polynomial.rend(); ++c) sum = sum * x + *c;
  return sum;
}

Polynomial derivative(const Polynomial& polynomial) {
  Polynomial result;
  for (std::size_t i = 1; i < polynomial.size(); ++i) {
    result.push_back(static_cast<double>(i) * polynomial[i]);
  }
  return result;
}

Polynomial product(const Polynomial& a, const Polynomial& b) {
  if (a.empty() || b.empty()) return {};
  Polynomial result(a.size() + b.size() - 1, 0.0);
  for (std::size_t i = 0; i < a.size(); ++i) {
    for (std::size_t j = 0; j < b.size(); ++j) result[i + j] += a[i] * b[j];
  }
  return result;
}

/// Root of `f` between lo and hi, where its signs differ.
template <typename Function>
double bisect(const Function& f, double lo, double hi) {
  const bool rising = f(lo) < 0.0;
  for (;;) {
    const double middle = 0.5 * (lo + hi);
    if (middle <= lo || middle >= hi) return middle;
    ((f(middle) < 0.0) == rising ? lo : hi) = middle;
  }
}

/// The sign changes of a polynomial in (lo, hi), ascending. Between two neighbouring extrema there
/// is at most one, so that none is missed however close they lie.
std::vector<double> signChanges(Polynomial polynomial, double lo, double hi) {
  while (!polynomial.empty() && polynomial.back() == 0.0) polynomial.pop_back();
  if (polynomial.size() < 2) return {};
  std::vector<double> borders = signChanges(derivative(polynomial), lo, hi);
  borders.push_back(hi);
  std::vector<double> result;
  double left = lo;
  for (const double right : borders) {
    const double at_left = evaluate(polynomial, left);
    const double at_right = evaluate(polynomial, right);
    if ((at_left < 0.0) != (at_right < 0.0)) {
      result.push_back(bisect([&](double x) { return evaluate(polynomial, x); }, left, right));
    }
    left = right;
  }
  return result;
}

/// First root in (0, limit); infinite if there is none.
double firstRoot(const Polynomial& polynomial, double limit) {
  const std::vector<double> roots = signChanges(polynomial, 0.0, limit);
  return roots.empty() ? kInfinity : roots.front();
}

/// theta_d of eq. 9.
double distortedTheta(const std::vector<double>& k, double theta) {
  const double s = theta * theta;
  return theta * (1.0 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))));
}

/// Radial factor of Brown-Conrady as numerator and denominator in s = r^2.
Polynomial numerator(const std::vector<double>& d) { return {1.0, d[0], d[1], d[4]}; }
Polynomial denominator(const std::vector<double>& d) { return {1.0, d[5], d[6], d[7]}; }

double radialFactor(const std::vector<double>& d, double s) {
  return (1.0 + s * (d[0] + s * (d[1] + s * d[4]))) / (1.0 + s * (d[5] + s * (d[6] + s * d[7])));
}

/// Largest radius on the rising branch of r N(r^2) / D(r^2), before D's first root.
double foldOverRadius(const std::vector<double>& d) {
  const Polynomial n = numerator(d);
  const Polynomial q = denominator(d);
  // d/dr (r N / D) = 0  <=>  N D + 2 s (N' D - N D') = 0
  Polynomial slope = product(n, q);
  const Polynomial gain = product(derivative(n), q);
  const Polynomial loss = product(n, derivative(q));
  for (std::size_t i = 0; i < gain.size(); ++i) slope[i + 1] += 2.0 * (gain[i] - loss[i]);
  return std::sqrt(std::min(firstRoot(slope, kMaxSquaredRadius), firstRoot(q, kMaxSquaredRadius)));
}

Eigen::Vector2d distort(const std::vector<double>& d, const Eigen::Vector2d& a) {
  const double x = a.x(), y = a.y();
  const double s = a.squaredNorm();
  const double radial = radialFactor(d, s);
  return {x * radial + 2.0 * d[2] * x * y + d[3] * (s + 2.0 * x * x),
          y * radial + d[2] * (s + 2.0 * y * y) + 2.0 * d[3] * x * y};
}

/// Derivative of distort().
Eigen::Matrix2d distortJacobian(const std::vector<double>& d, const Eigen::Vector2d& a) {
  const double x = a.x(), y = a.y();
  const double s = a.squaredNorm();
  const double bottom = 1.0 + s * (d[5] + s * (d[6] + s * d[7]));
  const double radial = radialFactor(d, s);
  const double top_slope = d[0] + s * (2.0 * d[1] + s * 3.0 * d[4]);
  const double bottom_slope = d[5] + s * (2.0 * d[6] + s * 3.0 * d[7]);
  const double slope = (top_slope - radial * bottom_slope) / bottom;  // d radial / d s
  Eigen::Matrix2d j;
  j(0, 0) = radial + 2.0 * x * x * slope + 2.0 * d[2] * y + 6.0 * d[3] * x;
  j(0, 1) = 2.0 * x * y * slope + 2.0 * d[2] * x + 2.0 * d[3] * y;
  j(1, 0) = j(0, 1);
  j(1, 1) = radial + 2.0 * y * y * slope + 6.0 * d[2] * y + 2.0 * d[3] * x;
  return j;
}

/// Collects field, value and rule into one sentence.
template <typename Value>
[[noreturn]] void refuse(const CameraInfo& info, const std::string& field, const Value& value,
                         const std::string& rule) {
  std::ostringstream message;
  message.precision(12);
  message << "camera_info of frame '" << info.frame_id << "': " << field << " = " << value << ": "
          << rule;
  throw DataError(message.str());
}

void requirePositive(const CameraInfo& info, const std::string& field, double value) {
  if (!(std::isfinite(value) && value > 0.0)) {
    refuse(info, field, value, "must be a finite number above 0 (0 = not calibrated)");
  }
}

void requireFinite(const CameraInfo& info, const std::string& field, double value) {
  if (!std::isfinite(value)) refuse(info, field, value, "must be finite");
}

struct Reduction {
  ImageSize size;
  int binning_x = 1, binning_y = 1;
};

/// Size after binning and ROI.
Reduction checkedReduction(const CameraInfo& info) {
  const auto checkSide = [&](const char* field, int value) {
    if (value < 1 || value > kMaxImageSide) {
      refuse(info, field, value, "must lie in 1.." + std::to_string(kMaxImageSide));
    }
  };
  checkSide("width", info.size.width);
  checkSide("height", info.size.height);

  Reduction result;
  const auto binning = [&](const char* field, int value) {
    if (value < 0) refuse(info, field, value, "must be 0 (= 1) or more");
    return std::max(1, value);
  };
  result.binning_x = binning("binning_x", info.binning_x);
  result.binning_y = binning("binning_y", info.binning_y);

  int width = info.size.width;
  int height = info.size.height;
  const bool has_roi = info.roi_x != 0 || info.roi_y != 0 || info.roi_width != 0 ||
                       info.roi_height != 0;  // all zero means the full image
  if (has_roi) {
    const auto inside = [&](const char* offset_field, int offset, const char* length_field,
                            int length, int side) {
      if (offset < 0 || offset >= side) {
        refuse(info, offset_field, offset,
               "must lie inside the image of " + std::to_string(side) + " px");
      }
      if (length < 1 || length > side - offset) {
        refuse(info, length_field, length,
               "must lie in 1.." + std::to_string(side - offset) +
                   ", the rest of the image (all roi fields 0 = the full image)");
      }
    };
    inside("roi.x_offset", info.roi_x, "roi.width", info.roi_width, info.size.width);
    inside("roi.y_offset", info.roi_y, "roi.height", info.roi_height, info.size.height);
    width = info.roi_width;
    height = info.roi_height;
  }
  result.size = {width / result.binning_x, height / result.binning_y};
  if (result.size.width < 1) {
    refuse(info, "binning_x", info.binning_x,
           "leaves no pixel of a width of " + std::to_string(width));
  }
  if (result.size.height < 1) {
    refuse(info, "binning_y", info.binning_y,
           "leaves no pixel of a height of " + std::to_string(height));
  }
  return result;
}

DistortionModel checkedModel(const CameraInfo& info) {
  if (info.distortion_model.empty()) return DistortionModel::kPinhole;
  if (info.distortion_model == "equidistant" || info.distortion_model == "fisheye") {
    return DistortionModel::kEquidistant;
  }
  if (info.distortion_model == "plumb_bob" || info.distortion_model == "rational_polynomial") {
    return DistortionModel::kBrownConrady;
  }
  refuse(info, "distortion_model", "'" + info.distortion_model + "'",
         "must be equidistant (alias fisheye), plumb_bob, rational_polynomial or empty (pinhole)");
}

/// Coefficients in the form that CameraModel::coefficients() promises.
std::vector<double> checkedCoefficients(const CameraInfo& info, DistortionModel model) {
  const std::size_t count = info.d.size();
  for (std::size_t i = 0; i < count; ++i) {
    requireFinite(info, "D[" + std::to_string(i) + "]", info.d[i]);
  }
  const auto allZeroFrom = [&](std::size_t first) {
    return std::all_of(info.d.begin() + static_cast<std::ptrdiff_t>(first), info.d.end(),
                       [](double d) { return d == 0.0; });
  };
  if (model == DistortionModel::kPinhole) {
    if (!allZeroFrom(0)) {
      refuse(info, "distortion_model", "''",
             "names no model, yet D holds " + std::to_string(count) +
                 " coefficients that are not all 0");
    }
    return {};
  }
  if (model == DistortionModel::kEquidistant) {
    if (count != 4) refuse(info, "D.size", count, "must be 4 for equidistant (k1..k4)");
    return info.d;
  }
  if (info.distortion_model == "plumb_bob") {
    if (count != 0 && count != 4 && count != 5) {
      refuse(info, "D.size", count, "must be 5 for plumb_bob (k1 k2 p1 p2 k3), or 4 or 0");
    }
  } else {
    if (count != 8 && count != 12 && count != 14) {
      refuse(info, "D.size", count,
             "must be 8 for rational_polynomial (k1 k2 p1 p2 k3 k4 k5 k6), or 12 or 14");
    }
    if (!allZeroFrom(8)) {
      refuse(info, "D[8..]", "not all 0",
             "thin prism and tilt coefficients are not supported; calibrate with 8 coefficients");
    }
  }
  std::vector<double> d = info.d;
  d.resize(8, 0.0);
  return d;
}

Eigen::Matrix3d checkedRotation(const CameraInfo& info) {
  if (std::all_of(info.r.begin(), info.r.end(), [](double r) { return r == 0.0; })) {
    return Eigen::Matrix3d::Identity();
  }
  for (std::size_t i = 0; i < info.r.size(); ++i) {
    requireFinite(info, "R[" + std::to_string(i) + "]", info.r[i]);
  }
  const Eigen::Matrix3d r =
      Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(info.r.data());
  const double error = (r * r.transpose() - Eigen::Matrix3d::Identity()).cwiseAbs().maxCoeff();
  if (error > kRotationTolerance || r.determinant() < 0.0) {
    refuse(info, "R", "[" + std::to_string(r(0, 0)) + ", " + std::to_string(r(0, 1)) + ", ...]",
           "must be a rotation matrix, or all 0 for none");
  }
  return r;
}

}  // namespace

bool CameraInfo::operator==(const CameraInfo& other) const {
  return frame_id == other.frame_id && size == other.size &&
         distortion_model == other.distortion_model && d == other.d && k == other.k &&
         r == other.r && p == other.p && binning_x == other.binning_x &&
         binning_y == other.binning_y && roi_x == other.roi_x && roi_y == other.roi_y &&
         roi_width == other.roi_width && roi_height == other.roi_height;
}

CameraModel::CameraModel(const CameraInfo& info, const CameraModelOptions& options)
    : rectified_(options.rectified) {
  const Reduction reduction = checkedReduction(info);
  size_ = reduction.size;
  const DistortionModel model = checkedModel(info);
  const double max_theta_deg = options.max_theta_deg;
  if (!(max_theta_deg >= 0.0 && max_theta_deg <= 180.0)) {
    refuse(info, "max_theta_deg", max_theta_deg, "must lie in 0..180 (0 = no limit)");
  }

  if (rectified_) {
    requirePositive(info, "P[0]", info.p[0]);
    requirePositive(info, "P[5]", info.p[5]);
    for (const std::size_t i : {2, 3, 6, 7}) {
      requireFinite(info, "P[" + std::to_string(i) + "]", info.p[i]);
    }
    fx_ = info.p[0] / reduction.binning_x;
    fy_ = info.p[5] / reduction.binning_y;
    cx_ = (info.p[2] - info.roi_x) / reduction.binning_x;
    cy_ = (info.p[6] - info.roi_y) / reduction.binning_y;
    optical_centre_ = {-info.p[3] / info.p[0], -info.p[7] / info.p[5], 0.0};
  } else {
    requirePositive(info, "K[0]", info.k[0]);
    requirePositive(info, "K[4]", info.k[4]);
    for (const std::size_t i : {1, 2, 5}) {
      requireFinite(info, "K[" + std::to_string(i) + "]", info.k[i]);
    }
    distortion_ = model;
    d_ = checkedCoefficients(info, model);
    if (distortion_ == DistortionModel::kBrownConrady &&
        std::all_of(d_.begin(), d_.end(), [](double d) { return d == 0.0; })) {
      distortion_ = DistortionModel::kPinhole;
      d_.clear();
    }
    R_raw_camera_ = checkedRotation(info).transpose();
    fx_ = info.k[0] / reduction.binning_x;
    fy_ = info.k[4] / reduction.binning_y;
    cx_ = (info.k[2] - info.roi_x) / reduction.binning_x;
    cy_ = (info.k[5] - info.roi_y) / reduction.binning_y;
    if (distortion_ == DistortionModel::kEquidistant) skew_ = info.k[1] / info.k[0];
    if (!std::isfinite(skew_)) refuse(info, "K[1]", info.k[1], "must be finite as K[1] / K[0]");
  }

  const double limit = max_theta_deg > 0.0 ? max_theta_deg * kPi / 180.0 : kPi;
  if (distortion_ == DistortionModel::kEquidistant) {
    // d theta_d / d theta as a polynomial in theta^2
    const double fold_over =
        std::sqrt(firstRoot({1.0, 3.0 * d_[0], 5.0 * d_[1], 7.0 * d_[2], 9.0 * d_[3]}, kPi * kPi));
    max_theta_rad_ = std::min(fold_over, limit);
    max_radius_ = kInfinity;
  } else {
    max_radius_ = distortion_ == DistortionModel::kBrownConrady ? foldOverRadius(d_) : kInfinity;
    if (limit < 0.5 * kPi) max_radius_ = std::min(max_radius_, std::tan(limit));
    max_theta_rad_ = std::atan(max_radius_);
  }
}

double CameraModel::theta(const Eigen::Vector3d& p_camera) const {
  const Eigen::Vector3d p = R_raw_camera_ * (p_camera - optical_centre_);
  return std::atan2(std::hypot(p.x(), p.y()), p.z());
}

double CameraModel::maxThetaWithin(double margin_px) const {
  if (distortion_ == DistortionModel::kBrownConrady) return max_theta_rad_;
  // The distorted radius is largest in a corner, and it grows with the angle.
  double radius = 0.0;
  for (const double u : {-0.5 - margin_px, size_.width - 0.5 + margin_px}) {
    for (const double v : {-0.5 - margin_px, size_.height - 0.5 + margin_px}) {
      const double y = (v - cy_) / fy_;
      radius = std::max(radius, std::hypot((u - cx_) / fx_ - skew_ * y, y));
    }
  }
  if (distortion_ == DistortionModel::kPinhole) return std::min(std::atan(radius), max_theta_rad_);
  if (radius >= distortedTheta(d_, max_theta_rad_)) return max_theta_rad_;
  return bisect([&](double t) { return distortedTheta(d_, t) - radius; }, 0.0, max_theta_rad_);
}

std::optional<Eigen::Vector2d> CameraModel::project(const Eigen::Vector3d& p_camera) const {
  const Eigen::Vector3d p = R_raw_camera_ * (p_camera - optical_centre_);
  Eigen::Vector2d a;  // x', y' of eq. 10
  if (distortion_ == DistortionModel::kEquidistant) {
    const double r = std::hypot(p.x(), p.y());
    const double theta = std::atan2(r, p.z());
    if (!(theta <= max_theta_rad_)) return std::nullopt;
    if (r == 0.0) {
      if (!(p.z() > 0.0)) return std::nullopt;  // the origin, or straight behind
      a.setZero();
    } else {
      a = p.head<2>() * (distortedTheta(d_, theta) / r);
    }
  } else {
    if (!(p.z() > 0.0)) return std::nullopt;
    a = p.head<2>() / p.z();
    if (!(a.norm() <= max_radius_)) return std::nullopt;
    if (distortion_ == DistortionModel::kBrownConrady) a = distort(d_, a);
  }
  const Eigen::Vector2d pixel(fx_ * (a.x() + skew_ * a.y()) + cx_, fy_ * a.y() + cy_);
  if (!pixel.allFinite()) return std::nullopt;
  return pixel;
}

std::optional<Eigen::Vector3d> CameraModel::ray(const Eigen::Vector2d& pixel) const {
  if (!pixel.allFinite()) return std::nullopt;
  const double y = (pixel.y() - cy_) / fy_;
  const double x = (pixel.x() - cx_) / fx_ - skew_ * y;
  // A focal length next to zero overflows: such pixels have no ray.
  if (!std::isfinite(x) || !std::isfinite(y)) return std::nullopt;
  const auto raw = rawRay(x, y);
  if (!raw || !raw->allFinite()) return std::nullopt;
  return (R_raw_camera_.transpose() * *raw).stableNormalized();
}

std::optional<Eigen::Vector3d> CameraModel::rawRay(double x, double y) const {
  const double radius = std::hypot(x, y);
  if (distortion_ == DistortionModel::kEquidistant) {
    if (radius == 0.0) return Eigen::Vector3d::UnitZ();
    if (radius > distortedTheta(d_, max_theta_rad_)) return std::nullopt;
    const double theta =
        bisect([&](double t) { return distortedTheta(d_, t) - radius; }, 0.0, max_theta_rad_);
    const double s = std::sin(theta) / radius;
    return Eigen::Vector3d(x * s, y * s, std::cos(theta));
  }
  Eigen::Vector2d a(x, y);
  if (distortion_ == DistortionModel::kBrownConrady && radius > 0.0) {
    // Start from the radial part alone, which is monotone up to max_radius_, then Newton.
    const auto excess = [&](double r) { return r * radialFactor(d_, r * r) - radius; };
    // The bracket ends short of the limit, which may be a pole. The tangential terms may carry a
    // valid pixel a little beyond it.
    const double bracket_end = std::min(max_radius_ * (1.0 - 1e-9), 1e8);
    double high = std::min(bracket_end, 2.0 * radius + 1.0);
    while (high < bracket_end && excess(high) < 0.0) high = std::min(bracket_end, 2.0 * high);
    const double start = excess(high) < 0.0 ? high : bisect(excess, 0.0, high);
    const Eigen::Vector2d target(x, y);
    a = target * (start / radius);
    constexpr int kMaxIterations = 50;
    for (int i = 0; i < kMaxIterations; ++i) {
      const Eigen::Vector2d step =
          distortJacobian(d_, a).fullPivLu().solve(target - distort(d_, a));
      if (!step.allFinite()) return std::nullopt;
      a += step;
      if (step.norm() <= 1e-14 * (1.0 + a.norm())) break;
    }
    const double residual = (distort(d_, a) - target).norm();
    if (!(residual <= 1e-9 * (1.0 + radius))) return std::nullopt;
  }
  if (!(a.norm() <= max_radius_)) return std::nullopt;
  return Eigen::Vector3d(a.x(), a.y(), 1.0).stableNormalized();
}

}  // namespace semantic_lidar_fusion

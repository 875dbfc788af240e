// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/camera/camera_model.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>

#include "lens_parts.h"
#include "polynomial.h"
#include "semantic_lidar_fusion/common/rotation.h"

namespace semantic_lidar_fusion {
namespace {

/// Rectifications are often written with few digits.
constexpr double kRectificationTolerance = 1e-2;

std::string sourceOf(const CameraInfo& info) {
  return "camera_info of frame '" + info.frame_id + "'";
}

using semantic_lidar_fusion::refuse;
template <typename Value>
[[noreturn]] void refuse(const CameraInfo& info, const std::string& field, const Value& value,
                         const std::string& rule) {
  refuse(sourceOf(info), field, value, rule);
}

/// The focal length of the image after binning, px.
double checkedFocalLength(const CameraInfo& info, const std::string& field, double value,
                          int binning) {
  // The quotient of the smallest numbers is 0.
  if (!(std::isfinite(value) && value / binning > 0.0)) {
    refuse(info, field, value, "must be a finite number above 0 (0 = not calibrated)");
  }
  return value / binning;
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

const LensKind& checkedKind(const CameraInfo& info, const std::vector<LensKind>& lenses) {
  for (const LensKind& kind : lenses) {
    const auto& names = kind.in_camera_info;
    if (std::find(names.begin(), names.end(), info.distortion_model) != names.end()) return kind;
  }
  refuse(info, "distortion_model", "'" + info.distortion_model + "'",
         "must be equidistant (alias fisheye), plumb_bob, rational_polynomial or empty (pinhole)");
}

const LensKind& kindNamed(const LensParameters& lens, const std::vector<LensKind>& kinds) {
  for (const LensKind& kind : kinds) {
    if (kind.name == lens.model) return kind;
  }
  refuse(lens.source, "model", "'" + lens.model + "'", "must be the name of a lens");
}

/// A camera_info whose lens and focal lengths a file gives.
CameraInfo withLens(CameraInfo info, const LensCalibration* lens) {
  if (lens == nullptr) return info;
  if (info.size == ImageSize()) info.size = lens->size;
  if (info.size != lens->size) {
    const auto text = [](const ImageSize& size) {
      return std::to_string(size.width) + "x" + std::to_string(size.height);
    };
    refuse(info, "width x height", text(info.size),
           "must be the resolution " + text(lens->size) + " of the " + lens->lens.source);
  }
  info.k = {lens->fx, lens->fx * lens->skew, lens->cx, 0.0, lens->fy, lens->cy, 0.0, 0.0, 1.0};
  info.r.fill(0.0);
  return info;
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
  if (rotationError(r) > kRectificationTolerance) {
    refuse(info, "R", "[" + std::to_string(r(0, 0)) + ", " + std::to_string(r(0, 1)) + ", ...]",
           "must be a rotation matrix, or all 0 for none");
  }
  return r;
}

RowTimes timesOfRows(const ShutterConfig& shutter, const CameraInfo& info,
                     const Reduction& reduction) {
  using Direction = ShutterDirection;
  const Direction direction = shutter.direction;
  RowTimes result;
  result.down = direction == Direction::kDown || direction == Direction::kUp;
  const bool backwards = direction == Direction::kUp || direction == Direction::kLeft;
  const double rows = result.down ? info.size.height : info.size.width;
  const double stamped = shutter.stamp_row == StampRow::kFirst    ? 0.0
                         : shutter.stamp_row == StampRow::kMiddle ? 0.5 * (rows - 1.0)
                                                                  : rows - 1.0;
  // Row of the sensor = first + binning * pixel (image_geometry's rule).
  const double first = result.down ? info.roi_y : info.roi_x;
  const double binning = result.down ? reduction.binning_y : reduction.binning_x;
  const double row_s = shutter.readout_s / rows;
  result.at_zero_s = ((backwards ? rows - 1.0 - first : first) - stamped) * row_s;
  result.per_px_s = (backwards ? -1.0 : 1.0) * binning * row_s;
  return result;
}

}  // namespace

bool CameraInfo::operator==(const CameraInfo& other) const {
  return frame_id == other.frame_id && size == other.size &&
         distortion_model == other.distortion_model && d == other.d && k == other.k &&
         r == other.r && p == other.p && binning_x == other.binning_x &&
         binning_y == other.binning_y && roi_x == other.roi_x && roi_y == other.roi_y &&
         roi_width == other.roi_width && roi_height == other.roi_height;
}

CameraModel::CameraModel(const CameraInfo& given, const CameraModelOptions& options,
                         const std::vector<LensKind>& lenses)
    : rectified_(options.rectified), shutter_(options.shutter) {
  const CameraInfo info = withLens(given, options.lens.get());
  const Reduction reduction = checkedReduction(info);
  size_ = reduction.size;
  const LensKind& kind =
      options.lens ? kindNamed(options.lens->lens, lenses) : checkedKind(info, lenses);
  const double max_theta_deg = options.max_theta_deg;
  if (!(max_theta_deg >= 0.0 && max_theta_deg <= 180.0)) {
    refuse(info, "max_theta_deg", max_theta_deg, "must lie in 0..180 (0 = no limit)");
  }
  row_times_ = timesOfRows(shutter_, info, reduction);
  const double max_theta_rad = max_theta_deg > 0.0 ? max_theta_deg * kPi / 180.0 : kPi;

  if (rectified_) {
    fx_ = checkedFocalLength(info, "P[0]", info.p[0], reduction.binning_x);
    fy_ = checkedFocalLength(info, "P[5]", info.p[5], reduction.binning_y);
    for (const std::size_t i : {2, 3, 6, 7}) {
      requireFinite(info, "P[" + std::to_string(i) + "]", info.p[i]);
    }
    cx_ = (info.p[2] - info.roi_x) / reduction.binning_x;
    cy_ = (info.p[6] - info.roi_y) / reduction.binning_y;
    optical_centre_ = {-info.p[3] / info.p[0], -info.p[7] / info.p[5], 0.0};
    const LensParameters plain{sourceOf(info), "pinhole", {}};
    lens_ = kindNamed(plain, lenses).make(plain, max_theta_rad, &notes_);
  } else {
    fx_ = checkedFocalLength(info, "K[0]", info.k[0], reduction.binning_x);
    fy_ = checkedFocalLength(info, "K[4]", info.k[4], reduction.binning_y);
    for (const std::size_t i : {1, 2, 5}) {
      requireFinite(info, "K[" + std::to_string(i) + "]", info.k[i]);
    }
    const LensParameters parameters{sourceOf(info), kind.name, info.d};
    lens_ = kind.make(options.lens ? options.lens->lens : parameters, max_theta_rad, &notes_);
    R_raw_camera_ = checkedRotation(info).transpose();
    cx_ = (info.k[2] - info.roi_x) / reduction.binning_x;
    cy_ = (info.k[5] - info.roi_y) / reduction.binning_y;
    if (kind.skewed) skew_ = info.k[1] / info.k[0];
    if (!std::isfinite(skew_)) refuse(info, "K[1]", info.k[1], "must be finite as K[1] / K[0]");
  }
}

double CameraModel::theta(const Eigen::Vector3d& p_camera) const {
  const Eigen::Vector3d p = R_raw_camera_ * (p_camera - optical_centre_);
  return std::atan2(std::hypot(p.x(), p.y()), p.z());
}

double CameraModel::maxThetaWithin(double margin_px) const {
  // The distance from the plane's origin is largest in a corner.
  double radius = 0.0;
  for (const double u : {-0.5 - margin_px, size_.width - 0.5 + margin_px}) {
    for (const double v : {-0.5 - margin_px, size_.height - 0.5 + margin_px}) {
      const double y = (v - cy_) / fy_;
      radius = std::max(radius, std::hypot((u - cx_) / fx_ - skew_ * y, y));
    }
  }
  return lens_->maxThetaWithin(radius);
}

std::optional<Eigen::Vector2d> CameraModel::project(const Eigen::Vector3d& p_camera) const {
  const auto a = lens_->project(R_raw_camera_ * (p_camera - optical_centre_));
  if (!a) return std::nullopt;
  const Eigen::Vector2d pixel(fx_ * (a->x() + skew_ * a->y()) + cx_, fy_ * a->y() + cy_);
  if (!pixel.allFinite()) return std::nullopt;
  return pixel;
}

Matrix23d CameraModel::jacobian(const Eigen::Vector3d& p_camera) const {
  Eigen::Matrix2d sensor;
  sensor << fx_, fx_ * skew_, 0.0, fy_;
  return sensor * lens_->jacobian(R_raw_camera_ * (p_camera - optical_centre_)) * R_raw_camera_;
}

std::optional<Eigen::Vector3d> CameraModel::ray(const Eigen::Vector2d& pixel) const {
  if (!pixel.allFinite()) return std::nullopt;
  const double y = (pixel.y() - cy_) / fy_;
  const double x = (pixel.x() - cx_) / fx_ - skew_ * y;
  // A focal length next to zero overflows: such pixels have no ray.
  if (!std::isfinite(x) || !std::isfinite(y)) return std::nullopt;
  const auto raw = lens_->ray({x, y});
  if (!raw || !raw->allFinite()) return std::nullopt;
  return (R_raw_camera_.transpose() * *raw).stableNormalized();
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/uncertainty/pixel_covariance.h"

#include <Eigen/Dense>
#include <algorithm>
#include <array>
#include <cmath>

#include "covariance_kernels.h"
#include "semantic_lidar_fusion/common/cross_matrix.h"
#include "semantic_lidar_fusion/projection/rolling_shutter.h"

namespace semantic_lidar_fusion {
namespace {

const CovarianceKernels& covarianceKernels() {
  static const CovarianceKernelList list = usableCovarianceKernels();
  return *list.kernels[list.count - 1];
}

/// `motions` in the axes and about the centre of the image, as the upper triangle.
void toImageAxes(const Matrix6d& motions, const CameraModel& camera, float* out) {
  const Eigen::Matrix3d& R = camera.R_raw_camera();
  // A point R (p - c) moves by R (along + around x p).
  Matrix6d to_image = Matrix6d::Zero();
  to_image.topLeftCorner<3, 3>() = to_image.bottomRightCorner<3, 3>() = R;
  to_image.topRightCorner<3, 3>() = -R * crossMatrix(camera.opticalCentre());
  const Matrix6d moved = to_image * motions * to_image.transpose();
  for (int row = 0, k = 0; row < 6; ++row) {
    for (int column = row; column < 6; ++column) out[k++] = static_cast<float>(moved(row, column));
  }
}

/// One view's points, block by block.
class Covariances {
 public:
  Covariances(const Cloud& cloud, const ProjectedPoints& points, const Transform& T_camera_lidar,
              const CameraModel& camera, const Twist* motion, const ViewErrors& errors,
              const Eigen::Vector2d& cell_px)
      : cloud_(cloud),
        points_(points),
        T_camera_lidar_(T_camera_lidar),
        camera_(camera),
        motion_(camera.rollingShutter() ? motion : nullptr),
        errors_(errors),
        lidar_turned_(0.5 * errors.lidar.turn.cross(errors.lidar.velocity)),
        has_odometry_(!errors.odometry.isZero(0.0)),
        has_beam_(errors.range_m > 0.0 || !errors.beam_rad.isZero(0.0)),
        image_from_lidar_(camera.R_raw_camera() * T_camera_lidar.linear()),
        shift_(camera.R_raw_camera() * (T_camera_lidar.translation() - camera.opticalCentre())) {
    toImageAxes(errors.common, camera, constants_.common);
    toImageAxes(errors.odometry, camera, constants_.odometry);
    for (int k = 0; k < 9; ++k) {
      constants_.rotation[k] = static_cast<float>(image_from_lidar_(k / 3, k % 3));
    }
    constants_.range_m2 = static_cast<float>(errors.range_m * errors.range_m);
    constants_.side_rad2 = static_cast<float>(errors.beam_rad.x() * errors.beam_rad.x());
    constants_.up_rad2 = static_cast<float>(errors.beam_rad.y() * errors.beam_rad.y());
    const double lens_px2 = errors.intrinsics_px * errors.intrinsics_px;
    constants_.own_uu = static_cast<float>(lens_px2 + cell_px.x() * cell_px.x() / 12.0);
    constants_.own_vv = static_cast<float>(lens_px2 + cell_px.y() * cell_px.y() / 12.0);
    const std::array<double, 4>* k = camera.lens().kannalaBrandt();
    fast_ = k != nullptr;
    if (fast_) {
      fit_.focal_x = static_cast<float>(camera.fx());
      fit_.focal_y = static_cast<float>(camera.fy());
      fit_.skew = static_cast<float>(camera.skew());
      for (std::size_t i = 0; i < 4; ++i) fit_.k[i] = static_cast<float>((*k)[i]);
    }
  }

  void of(const std::uint32_t* places, int count, float* uu, float* uv, float* vv) {
    for (int i = 0; i < count; ++i) place(i, places[i]);
    if (fast_) {
      covarianceKernels().equidistant(fit_, count, &block_);
    } else {
      for (int i = 0; i < count; ++i) takeJacobian(i);
    }
    if (motion_ != nullptr) {
      for (int i = 0; i < count; ++i) meetAnotherRow(i);
    }
    covarianceKernels().covariances(constants_, has_odometry_, has_beam_, count, &block_);
    std::copy_n(block_.uu, count, uu);
    std::copy_n(block_.uv, count, uv);
    std::copy_n(block_.vv, count, vv);
  }

 private:
  void place(int i, std::uint32_t k) {
    const std::uint32_t index = points_.index[k];
    const Eigen::Vector3d p_lidar(cloud_.x[index], cloud_.y[index], cloud_.z[index]);
    Eigen::Vector3d p = image_from_lidar_ * p_lidar + shift_;
    const double dt = cloud_.dt.empty() ? 0.0 : cloud_.dt[index];
    double after_image_s = dt - errors_.image_after_reference_s;
    if (motion_ != nullptr) {
      const double row_s = clampedRowTime(camera_, points_.u[k], points_.v[k]);
      still_[i] = p.cast<float>();
      row_s_[i] = row_s;
      const Eigen::Vector3d seen = seenLater(T_camera_lidar_ * p_lidar, *motion_, row_s);
      p = camera_.R_raw_camera() * (seen - camera_.opticalCentre());
      after_image_s -= row_s;
    }
    block_.x[i] = static_cast<float>(p.x());
    block_.y[i] = static_cast<float>(p.y());
    block_.z[i] = static_cast<float>(p.z());
    block_.theta[i] = points_.theta[k];
    if (has_odometry_) {
      block_.motion_s2[i] =
          static_cast<float>(motionVariance(after_image_s, errors_.correlation_s));
    }
    if (!has_beam_) return;
    // From the lidar's origin at the point's time, in the axes at t_ref.
    const Eigen::Vector3d beam = p_lidar - dt * (errors_.lidar.velocity + dt * lidar_turned_);
    const double flat = std::max(1e-6, std::hypot(beam.x(), beam.y()));
    block_.beam_x[i] = static_cast<float>(beam.x());
    block_.beam_y[i] = static_cast<float>(beam.y());
    block_.beam_z[i] = static_cast<float>(beam.z());
    block_.flat_range[i] = static_cast<float>(flat);
    block_.range[i] = static_cast<float>(std::hypot(flat, beam.z()));
  }

  void takeJacobian(int i) {
    const Matrix23d plane = camera_.lens().jacobian({block_.x[i], block_.y[i], block_.z[i]});
    for (int axis = 0; axis < 3; ++axis) {
      block_.ju[axis][i] =
          static_cast<float>(camera_.fx() * (plane(0, axis) + camera_.skew() * plane(1, axis)));
      block_.jv[axis][i] = static_cast<float>(camera_.fy() * plane(1, axis));
    }
  }

  /// A displaced point turns with the view until its row is exposed, and meets another row:
  /// du = J (dp_row + dp/dt t'(u) du) gives (I - J dp/dt t') du = J dp_row.
  void meetAnotherRow(int i) {
    const Eigen::Vector3d p(block_.x[i], block_.y[i], block_.z[i]);
    const Eigen::Vector3d p_camera =
        camera_.R_raw_camera().transpose() * p + camera_.opticalCentre();
    const Eigen::Vector3d flow =
        -(camera_.R_raw_camera() * (motion_->velocity + motion_->turn.cross(p_camera)));
    Matrix23d J;
    for (int axis = 0; axis < 3; ++axis) J.col(axis) << block_.ju[axis][i], block_.jv[axis][i];
    const RowTimes& rows = camera_.rowTimes();
    Eigen::Matrix2d left = Eigen::Matrix2d::Identity();
    left.col(rows.down ? 1 : 0) -= rows.per_px_s * J * flow;
    // Not of rows that run as fast as the point.
    if (std::abs(left.determinant()) > 1e-3) J = left.inverse() * J;
    const Eigen::Vector3d turn = row_s_[i] * (camera_.R_raw_camera() * motion_->turn);
    for (int row = 0; row < 2; ++row) {
      const Eigen::Vector3d j = J.row(row);
      J.row(row) = j - j.cross(turn) + 0.5 * j.cross(turn).cross(turn);
    }
    block_.x[i] = still_[i].x(), block_.y[i] = still_[i].y(), block_.z[i] = still_[i].z();
    for (int axis = 0; axis < 3; ++axis) {
      block_.ju[axis][i] = static_cast<float>(J(0, axis));
      block_.jv[axis][i] = static_cast<float>(J(1, axis));
    }
  }

  const Cloud& cloud_;
  const ProjectedPoints& points_;
  const Transform& T_camera_lidar_;
  const CameraModel& camera_;
  const Twist* motion_;  ///< null unless the shutter rolls
  const ViewErrors& errors_;
  Eigen::Vector3d lidar_turned_;  ///< half its acceleration, m/s^2
  bool has_odometry_, has_beam_, fast_ = false;
  Eigen::Matrix3d image_from_lidar_;
  Eigen::Vector3d shift_;
  CovarianceConstants constants_;
  RadialFit fit_;
  CovarianceBlock block_;
  Eigen::Vector3f still_[kCovarianceBlock];  ///< of a rolling shutter: at the image's time
  double row_s_[kCovarianceBlock];           ///< when the row is exposed
};

}  // namespace

void PixelCovariances::resize(std::size_t count) {
  uu.resize(count);
  uv.resize(count);
  vv.resize(count);
}

PixelCovariances pixelCovariances(const Cloud& cloud, const ProjectedPoints& points,
                                  const std::vector<std::uint32_t>& places,
                                  const Transform& T_camera_lidar, const CameraModel& camera,
                                  const Twist* motion, const ViewErrors& errors,
                                  const Eigen::Vector2d& cell_px) {
  PixelCovariances result;
  result.resize(places.size());
  Covariances covariances(cloud, points, T_camera_lidar, camera, motion, errors, cell_px);
  for (std::size_t begin = 0; begin < places.size(); begin += kCovarianceBlock) {
    const auto count =
        static_cast<int>(std::min<std::size_t>(kCovarianceBlock, places.size() - begin));
    covariances.of(&places[begin], count, &result.uu[begin], &result.uv[begin], &result.vv[begin]);
  }
  return result;
}

SigmaPoints sigmaPoints(float uu, float uv, float vv, float negligible) {
  // Eigenvalues of the symmetric matrix: half the trace, plus and minus `spread`.
  const float half_trace = 0.5f * (uu + vv), difference = 0.5f * (uu - vv);
  const float spread = std::sqrt(difference * difference + uv * uv);
  const float major2 = half_trace + spread, minor2 = std::max(0.0f, half_trace - spread);
  SigmaPoints points;
  points.count = 1;
  points.du[0] = points.dv[0] = 0.0f;
  points.weight[0] = 1.0f;
  const float negligible2 = negligible * negligible;
  // Not so for what is no number.
  if (!(major2 > negligible2) || !std::isfinite(major2)) return points;
  // (difference, uv) is spread times (cos 2a, sin 2a), a being the angle of the major axis.
  const float cos_2a = spread > 0.0f ? difference / spread : 1.0f;
  float cos_a = std::sqrt(std::max(0.0f, 0.5f * (1.0f + cos_2a)));
  float sin_a = std::sqrt(std::max(0.0f, 0.5f * (1.0f - cos_2a)));
  if (uv < 0.0f) sin_a = -sin_a;
  const float reach = std::sqrt(3.0f * major2);
  const bool flat = !(minor2 > negligible2);
  const float side = flat ? 0.0f : std::sqrt(3.0f * minor2);
  constexpr float kCentre = 2.0f / 3.0f, kEnd = 1.0f / 6.0f;
  points.count = 0;
  const auto add = [&](float along, float across, float weight) {
    points.du[points.count] = along * reach * cos_a - across * side * sin_a;
    points.dv[points.count] = along * reach * sin_a + across * side * cos_a;
    points.weight[points.count++] = weight;
  };
  const float middle = flat ? 1.0f : kCentre;
  add(0.0f, 0.0f, kCentre * middle);
  add(1.0f, 0.0f, kEnd * middle);
  add(-1.0f, 0.0f, kEnd * middle);
  if (flat) return points;
  for (const float across : {1.0f, -1.0f}) {
    add(0.0f, across, kCentre * kEnd);
    add(1.0f, across, kEnd * kEnd);
    add(-1.0f, across, kEnd * kEnd);
  }
  return points;
}

}  // namespace semantic_lidar_fusion

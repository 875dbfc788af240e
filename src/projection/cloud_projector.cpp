// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/projection/cloud_projector.h"

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "projection_kernels.h"
#include "semantic_lidar_fusion/projection/rolling_shutter.h"

namespace semantic_lidar_fusion {
namespace {

/// Slack of the cone for single precision, as a part of lengths: 20 times the largest error.
constexpr double kConeSlack = 1e-5;
/// Angles this close to the limit are judged in double precision.
constexpr double kThetaSlack_rad = 2e-6;
/// The same where the transform is in single precision too, for points from this part of the
/// translation's length on.
constexpr double kRollingThetaSlack_rad = 1e-3;
constexpr double kLeastOfTranslation = 1e-3;
/// Longest distance from the image's corner, as the lens' equation counts, that single precision
/// gives to 0.02 px.
constexpr double kMostSinglePrecision_px = 10000.0;

const ProjectionKernels& projectionKernels() {
  static const ProjectionKernelList list = usableProjectionKernels();
  return *list.kernels[list.count - 1];
}

/// Bounds of the pixels that are kept. Compared with floats, so that a kept point with margin 0 is
/// inside the image for its users.
struct Bounds {
  double begin, u_end, v_end;
  bool hold(float u, float v) const { return u >= begin && u < u_end && v >= begin && v < v_end; }
};

Eigen::Matrix<double, 3, 4, Eigen::RowMajor> imageFromLidar(const Transform& T_camera_lidar,
                                                            const CameraModel& camera) {
  Eigen::Matrix<double, 3, 4, Eigen::RowMajor> matrix;
  matrix.leftCols<3>() = camera.R_raw_camera() * T_camera_lidar.linear();
  matrix.col(3) = camera.R_raw_camera() * (T_camera_lidar.translation() - camera.opticalCentre());
  return matrix;
}

void append(const Eigen::Vector3d& p_camera, const CameraModel& camera, const Twist* motion,
            std::uint32_t index, const Bounds& bounds, ProjectedPoints* points) {
  const auto seen = seePoint(camera, motion, p_camera);
  if (!seen) return;
  const auto u = static_cast<float>(seen->pixel.x());
  const auto v = static_cast<float>(seen->pixel.y());
  if (!bounds.hold(u, v)) return;
  points->index.push_back(index);
  points->u.push_back(u);
  points->v.push_back(v);
  points->distance.push_back(static_cast<float>((seen->p_camera - camera.opticalCentre()).norm()));
  points->theta.push_back(static_cast<float>(camera.theta(seen->p_camera)));
}

Flow flowOf(const Twist& twist) {
  Flow flow{};
  for (int axis = 0; axis < 3; ++axis) {
    flow.velocity[axis] = static_cast<float>(twist.velocity[axis]);
    flow.turn[axis] = static_cast<float>(twist.turn[axis]);
  }
  return flow;
}

/// seePoint() in single precision. `motion`: the camera's.
RollingRows rollingRows(const Eigen::Matrix<double, 3, 4, Eigen::RowMajor>& image_from_lidar,
                        const Transform& T_camera_lidar, const CameraModel& camera,
                        const std::array<double, 4>& k, const Twist& motion) {
  Transform T_image_camera = Transform::Identity();
  T_image_camera.linear() = camera.R_raw_camera();
  T_image_camera.translation() = -(camera.R_raw_camera() * camera.opticalCentre());
  const RowTimes& times = camera.rowTimes();
  const double side = times.down ? camera.imageSize().height : camera.imageSize().width;
  RollingRows rows{};
  for (int i = 0; i < 12; ++i) rows.matrix[i] = static_cast<float>(image_from_lidar.data()[i]);
  rows.k[0] = 1.0f;
  for (std::size_t i = 0; i < 4; ++i) rows.k[i + 1] = static_cast<float>(k[i]);
  rows.per_right = static_cast<float>(times.down ? 0.0 : camera.fx());
  rows.per_down = static_cast<float>(times.down ? camera.fy() : camera.fx() * camera.skew());
  rows.at_centre = static_cast<float>(times.down ? camera.cy() : camera.cx());
  rows.begin = static_cast<float>(-side);
  rows.end = static_cast<float>(2.0 * side);
  rows.at_zero_s = static_cast<float>(times.at_zero_s);
  rows.per_px_s = static_cast<float>(times.per_px_s);
  rows.theta_sure = static_cast<float>(camera.maxThetaRad() - kRollingThetaSlack_rad);
  rows.theta_never = static_cast<float>(camera.maxThetaRad() + kRollingThetaSlack_rad);
  rows.least_squared_m2 = static_cast<float>(
      std::max(kLeastSquaredDistance,
               kLeastOfTranslation * kLeastOfTranslation * image_from_lidar.col(3).squaredNorm()));
  rows.in_image = flowOf(twistOf(T_image_camera, motion));
  rows.in_lidar = flowOf(twistOf(T_camera_lidar.inverse(Eigen::Isometry), motion));
  return rows;
}

/// The equidistant model in single precision, from the transformed point on.
class FastEquidistant {
 public:
  /// `motion`: the camera's where its shutter rolls, else null.
  FastEquidistant(const Eigen::Matrix<double, 3, 4, Eigen::RowMajor>& image_from_lidar,
                  const Transform& T_camera_lidar, const CameraModel& camera,
                  const std::array<double, 4>& k, const Twist* motion, const Bounds& bounds) {
    std::copy_n(image_from_lidar.data(), 12, lens_.matrix);
    lens_.focal_x = static_cast<float>(camera.fx());
    lens_.focal_y = static_cast<float>(camera.fy());
    lens_.skew = static_cast<float>(camera.skew());
    lens_.centre_x = static_cast<float>(camera.cx());
    lens_.centre_y = static_cast<float>(camera.cy());
    for (std::size_t i = 0; i < 4; ++i) lens_.k[i] = static_cast<float>(k[i]);
    lens_.theta_sure = static_cast<float>(camera.maxThetaRad() - kThetaSlack_rad);
    lens_.theta_never = static_cast<float>(camera.maxThetaRad() + kThetaSlack_rad);
    lens_.u_begin = lens_.v_begin = static_cast<float>(bounds.begin);
    lens_.u_end = static_cast<float>(bounds.u_end);
    lens_.v_end = static_cast<float>(bounds.v_end);
    if (motion != nullptr) {
      rows_ = rollingRows(image_from_lidar, T_camera_lidar, camera, k, *motion);
    }
  }

  void project(const SelectedPoints& selected, int count, std::uint32_t first,
               const Transform& T_camera_lidar, const CameraModel& camera, const Twist* motion,
               const Bounds& bounds, const Cloud& cloud, ProjectedPoints* points) {
    const SelectedPoints* seen = &selected;
    if (rows_) {
      count = projectionKernels().roll(*rows_, selected, count, &moved_);
      seen = &moved_;
    }
    const int kept = projectionKernels().equidistant(lens_, *seen, count, &block_);
    int begin = 0;
    for (int k = 0; k < block_.doubtful_count; ++k) {
      const int doubtful = static_cast<int>(block_.doubtful[k]);
      appendBlock(begin, doubtful, first, points);
      const std::uint32_t i = first + block_.place[doubtful];
      append(T_camera_lidar * Eigen::Vector3d(cloud.x[i], cloud.y[i], cloud.z[i]), camera, motion,
             i, bounds, points);
      begin = doubtful + 1;
    }
    appendBlock(begin, kept, first, points);
  }

 private:
  void appendBlock(int begin, int end, std::uint32_t first, ProjectedPoints* points) {
    for (int k = begin; k < end; ++k) block_.place[k] += first;
    points->index.insert(points->index.end(), block_.place + begin, block_.place + end);
    points->u.insert(points->u.end(), block_.u + begin, block_.u + end);
    points->v.insert(points->v.end(), block_.v + begin, block_.v + end);
    points->distance.insert(points->distance.end(), block_.distance + begin, block_.distance + end);
    points->theta.insert(points->theta.end(), block_.theta + begin, block_.theta + end);
  }

  EquidistantLens lens_;
  std::optional<RollingRows> rows_;
  SelectedPoints moved_;
  PixelBlock block_;
};

bool singlePrecisionSuffices(const CameraModel& camera, const Bounds& bounds) {
  const double reach =
      std::max({std::abs(bounds.begin - camera.cx()), std::abs(bounds.u_end - camera.cx()),
                std::abs(bounds.begin - camera.cy()), std::abs(bounds.v_end - camera.cy()),
                std::abs(camera.cx()), std::abs(camera.cy())});
  return reach * (1.0 + std::abs(camera.skew())) <= kMostSinglePrecision_px;
}

/// `motion`: also what comes into view while the rows are exposed; null = nothing does.
SightCone sightCone(const Eigen::Matrix<double, 3, 4, Eigen::RowMajor>& image_from_lidar,
                    double margin_px, const CameraModel& camera, const Twist* motion) {
  double theta_rad = camera.maxThetaWithin(margin_px);
  double moved_m = 0.0;
  if (motion != nullptr) {
    // A pixel that is kept has its row within the margin, so that its time is known to a quarter
    // of the readout even where two rounds are far from the end.
    const RowTimes& rows = camera.rowTimes();
    const double side = rows.down ? camera.imageSize().height : camera.imageSize().width;
    const double beyond = std::min(side, margin_px + 0.25 * side);
    const double longest_s = std::max(std::abs(rows.at_zero_s - rows.per_px_s * beyond),
                                      std::abs(rows.at_zero_s + rows.per_px_s * (side + beyond)));
    theta_rad = std::min(kPi, theta_rad + longest_s * motion->turn.norm());
    moved_m = longest_s * motion->velocity.norm();
  }
  SightCone cone;
  for (int i = 0; i < 12; ++i) cone.matrix[i] = static_cast<float>(image_from_lidar.data()[i]);
  cone.cosine = static_cast<float>(std::cos(theta_rad) - kConeSlack);
  cone.reach_m =
      static_cast<float>(2.0 * kConeSlack * image_from_lidar.col(3).norm() + 2.0 * moved_m + 1e-30);
  return cone;
}

}  // namespace

ProjectedPoints projectCloud(const Cloud& cloud, const Transform& T_camera_lidar,
                             const CameraModel& camera, double margin_px, const Twist* motion) {
  if (!camera.rollingShutter()) motion = nullptr;
  const Bounds bounds{-0.5 - margin_px, camera.imageSize().width - 0.5 + margin_px,
                      camera.imageSize().height - 0.5 + margin_px};
  const auto image_from_lidar = imageFromLidar(T_camera_lidar, camera);
  const SightCone cone = sightCone(image_from_lidar, margin_px, camera, motion);
  const std::array<double, 4>* coefficients = camera.lens().kannalaBrandt();
  const bool fast = coefficients != nullptr && singlePrecisionSuffices(camera, bounds);
  std::optional<FastEquidistant> equidistant;
  if (fast) {
    equidistant.emplace(image_from_lidar, T_camera_lidar, camera, *coefficients, motion, bounds);
  }

  ProjectedPoints points;
  const std::size_t expected = cloud.size() / 3;
  points.index.reserve(expected);
  points.u.reserve(expected);
  points.v.reserve(expected);
  points.distance.reserve(expected);
  points.theta.reserve(expected);
  SelectedPoints selected;
  for (std::size_t first = 0; first < cloud.size(); first += kProjectionBlock) {
    const int block =
        static_cast<int>(std::min<std::size_t>(kProjectionBlock, cloud.size() - first));
    const int count = projectionKernels().select(
        cone, cloud.x.data() + first, cloud.y.data() + first, cloud.z.data() + first,
        cloud.status.data() + first, static_cast<std::uint8_t>(PointStatus::kNoOdometry), block,
        &selected);
    const auto base = static_cast<std::uint32_t>(first);
    if (fast) {
      equidistant->project(selected, count, base, T_camera_lidar, camera, motion, bounds, cloud,
                           &points);
      continue;
    }
    for (int k = 0; k < count; ++k) {
      append(T_camera_lidar * Eigen::Vector3d(selected.x[k], selected.y[k], selected.z[k]), camera,
             motion, base + selected.place[k], bounds, &points);
    }
  }
  return points;
}

}  // namespace semantic_lidar_fusion

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

/// clampedRowTime() in single precision.
class RollingRows {
 public:
  explicit RollingRows(const CameraModel& camera)
      : down_(camera.rowTimes().down),
        at_zero_s_(static_cast<float>(camera.rowTimes().at_zero_s)),
        per_px_s_(static_cast<float>(camera.rowTimes().per_px_s)),
        side_(static_cast<float>(down_ ? camera.imageSize().height : camera.imageSize().width)) {}

  void times(const PixelBlock& block, int count, float* times_s) const {
    const float* pixel = down_ ? block.v : block.u;
    for (int k = 0; k < count; ++k) {
      const float row = std::max(-side_, std::min(pixel[k], 2.0f * side_));
      times_s[k] = at_zero_s_ + per_px_s_ * row;
    }
  }

 private:
  bool down_;
  float at_zero_s_, per_px_s_, side_;
};

/// seenLater() in single precision: p + t (first p + ...) + t^2 (second p + ...).
class Flow {
 public:
  explicit Flow(const Twist& twist) {
    for (int axis = 0; axis < 4; ++axis) {
      const Eigen::Vector3d flow =
          axis < 3 ? twist.turn.cross(Eigen::Vector3d::Unit(axis)) : twist.velocity;
      const Eigen::Vector3d turned = 0.5 * twist.turn.cross(flow);
      for (int row = 0; row < 3; ++row) {
        first_[row][axis] = static_cast<float>(-flow[row]);
        second_[row][axis] = static_cast<float>(turned[row]);
      }
    }
  }

  void apply(const float* times_s, int count, SelectedPoints* points) const {
    for (int k = 0; k < count; ++k) {
      const float t = times_s[k], x = points->x[k], y = points->y[k], z = points->z[k];
      points->x[k] = x + t * (along(first_[0], x, y, z) + t * along(second_[0], x, y, z));
      points->y[k] = y + t * (along(first_[1], x, y, z) + t * along(second_[1], x, y, z));
      points->z[k] = z + t * (along(first_[2], x, y, z) + t * along(second_[2], x, y, z));
    }
  }

 private:
  static float along(const float* row, float x, float y, float z) {
    return (row[0] * x + row[1] * y) + (row[2] * z + row[3]);
  }
  float first_[3][4], second_[3][4];
};

/// The equidistant model in single precision, from the transformed point on.
class FastEquidistant {
 public:
  FastEquidistant(const Eigen::Matrix<double, 3, 4, Eigen::RowMajor>& image_from_lidar,
                  const CameraModel& camera, const std::array<double, 4>& k, const Bounds& bounds) {
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
  }

  void project(const SelectedPoints& selected, int count, std::uint32_t first,
               const Transform& T_camera_lidar, const CameraModel& camera, const Twist* motion,
               const Bounds& bounds, const Cloud& cloud, ProjectedPoints* points) {
    const int kept = motion != nullptr
                         ? rolled(selected, count, first, T_camera_lidar, camera, *motion, cloud)
                         : projectionKernels().equidistant(lens_, selected, count, &block_);
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

  /// The two rounds of seePoint() for a block, with the lidar's motion instead of the camera's.
  /// What is doubtful in a round stays where it is, and so is doubtful in the last one.
  int rolled(const SelectedPoints& selected, int count, std::uint32_t first,
             const Transform& T_camera_lidar, const CameraModel& camera, const Twist& motion,
             const Cloud& cloud) {
    EquidistantLens anywhere = lens_;
    anywhere.u_begin = anywhere.v_begin = -std::numeric_limits<float>::max();
    anywhere.u_end = anywhere.v_end = std::numeric_limits<float>::max();
    const RollingRows rows(camera);
    const Flow flow(twistOf(T_camera_lidar.inverse(Eigen::Isometry), motion));
    const auto move = [&](int kept) {
      for (int k = 0; k < kept; ++k) {
        const std::size_t i = first + moved_.place[k];
        moved_.x[k] = cloud.x[i], moved_.y[k] = cloud.y[i], moved_.z[k] = cloud.z[i];
      }
      flow.apply(time_, kept, &moved_);
    };

    int kept = projectionKernels().equidistant(anywhere, selected, count, &block_);
    rows.times(block_, kept, time_);
    for (int k = 0; k < block_.doubtful_count; ++k) time_[block_.doubtful[k]] = 0.0f;
    std::copy_n(block_.place, kept, moved_.place);
    move(kept);

    // The kernel's `place` is this round's order, so that the times of the first are found.
    float earlier[kProjectionRoom];
    std::uint32_t place[kProjectionRoom];
    std::copy_n(time_, kept, earlier);
    std::copy_n(moved_.place, kept, place);
    for (int k = 0; k < kept; ++k) moved_.place[k] = static_cast<std::uint32_t>(k);
    kept = projectionKernels().equidistant(anywhere, moved_, kept, &block_);
    rows.times(block_, kept, time_);
    for (int k = 0; k < block_.doubtful_count; ++k) {
      time_[block_.doubtful[k]] = earlier[block_.place[block_.doubtful[k]]];
    }
    for (int k = 0; k < kept; ++k) {
      const std::uint32_t before = block_.place[k];
      time_[k] = secantTime(earlier[before], time_[k]);
      moved_.place[k] = place[before];
    }
    move(kept);
    return projectionKernels().equidistant(lens_, moved_, kept, &block_);
  }

  EquidistantLens lens_;
  PixelBlock block_;
  SelectedPoints moved_;
  float time_[kProjectionRoom];  ///< s, of the rows of the points in moved_
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
                    double theta_rad, const CameraModel& camera, const Twist* motion) {
  double moved_m = 0.0;
  if (motion != nullptr) {
    const RowTimes& rows = camera.rowTimes();
    const double side = rows.down ? camera.imageSize().height : camera.imageSize().width;
    const double longest_s = std::max(std::abs(rows.at_zero_s - rows.per_px_s * side),
                                      std::abs(rows.at_zero_s + 2.0 * rows.per_px_s * side));
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
  const SightCone cone =
      sightCone(image_from_lidar, camera.maxThetaWithin(margin_px), camera, motion);
  const std::array<double, 4>* coefficients = camera.lens().kannalaBrandt();
  const bool fast = coefficients != nullptr && singlePrecisionSuffices(camera, bounds);
  std::optional<FastEquidistant> equidistant;
  if (fast) equidistant.emplace(image_from_lidar, camera, *coefficients, bounds);

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

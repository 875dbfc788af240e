// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/projection/cloud_projector.h"

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "projection_kernels.h"

namespace semantic_lidar_fusion {
namespace {

/// Slack of the cone for single precision, as a part of lengths: 20 times the largest error.
constexpr double kConeSlack = 1e-5;
/// Angles this close to the limit are judged in double precision.
constexpr double kThetaSlack_rad = 2e-6;
/// Longest distance from the image's corner, as the lens' equation counts, that single precision
/// gives to 0.02 px.
constexpr double kMostSinglePrecision_px = 10000.0;

const ProjectionKernels& kernels() {
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

void append(const Eigen::Vector3d& p_camera, const CameraModel& camera, std::uint32_t index,
            const Bounds& bounds, ProjectedPoints* points) {
  const auto pixel = camera.project(p_camera);
  if (!pixel) return;
  const auto u = static_cast<float>(pixel->x());
  const auto v = static_cast<float>(pixel->y());
  if (!bounds.hold(u, v)) return;
  points->index.push_back(index);
  points->u.push_back(u);
  points->v.push_back(v);
  points->distance.push_back(static_cast<float>((p_camera - camera.opticalCentre()).norm()));
  points->theta.push_back(static_cast<float>(camera.theta(p_camera)));
}

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
               const Transform& T_camera_lidar, const CameraModel& camera, const Bounds& bounds,
               const Cloud& cloud, ProjectedPoints* points) {
    const int kept = kernels().equidistant(lens_, selected, count, &block_);
    int begin = 0;
    for (int k = 0; k < block_.doubtful_count; ++k) {
      const int doubtful = static_cast<int>(block_.doubtful[k]);
      appendBlock(begin, doubtful, first, points);
      const std::uint32_t i = first + block_.place[doubtful];
      append(T_camera_lidar * Eigen::Vector3d(cloud.x[i], cloud.y[i], cloud.z[i]), camera, i,
             bounds, points);
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
  PixelBlock block_;
};

bool singlePrecisionSuffices(const CameraModel& camera, const Bounds& bounds) {
  const double reach =
      std::max({std::abs(bounds.begin - camera.cx()), std::abs(bounds.u_end - camera.cx()),
                std::abs(bounds.begin - camera.cy()), std::abs(bounds.v_end - camera.cy()),
                std::abs(camera.cx()), std::abs(camera.cy())});
  return reach * (1.0 + std::abs(camera.skew())) <= kMostSinglePrecision_px;
}

SightCone sightCone(const Eigen::Matrix<double, 3, 4, Eigen::RowMajor>& image_from_lidar,
                    double theta_rad) {
  SightCone cone;
  for (int i = 0; i < 12; ++i) cone.matrix[i] = static_cast<float>(image_from_lidar.data()[i]);
  cone.cosine = static_cast<float>(std::cos(theta_rad) - kConeSlack);
  cone.reach_m = static_cast<float>(2.0 * kConeSlack * image_from_lidar.col(3).norm() + 1e-30);
  return cone;
}

}  // namespace

ProjectedPoints projectCloud(const Cloud& cloud, const Transform& T_camera_lidar,
                             const CameraModel& camera, double margin_px) {
  const Bounds bounds{-0.5 - margin_px, camera.imageSize().width - 0.5 + margin_px,
                      camera.imageSize().height - 0.5 + margin_px};
  const auto image_from_lidar = imageFromLidar(T_camera_lidar, camera);
  const SightCone cone = sightCone(image_from_lidar, camera.maxThetaWithin(margin_px));
  const std::array<double, 4>* k = camera.lens().kannalaBrandt();
  const bool fast = k != nullptr && singlePrecisionSuffices(camera, bounds);
  std::optional<FastEquidistant> equidistant;
  if (fast) equidistant.emplace(image_from_lidar, camera, *k, bounds);

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
    const int count =
        kernels().select(cone, cloud.x.data() + first, cloud.y.data() + first,
                         cloud.z.data() + first, cloud.status.data() + first,
                         static_cast<std::uint8_t>(PointStatus::kNoOdometry), block, &selected);
    const auto base = static_cast<std::uint32_t>(first);
    if (fast) {
      equidistant->project(selected, count, base, T_camera_lidar, camera, bounds, cloud, &points);
      continue;
    }
    for (int k = 0; k < count; ++k) {
      append(T_camera_lidar * Eigen::Vector3d(selected.x[k], selected.y[k], selected.z[k]), camera,
             base + selected.place[k], bounds, &points);
    }
  }
  return points;
}

}  // namespace semantic_lidar_fusion

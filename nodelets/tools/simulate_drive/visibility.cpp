// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/visibility.h"

#include <algorithm>
#include <cmath>

#include "semantic_lidar_fusion/lidar/lidar_spec.h"
#include "semantic_lidar_fusion/projection/occlusion_config.h"

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

constexpr float kRingRad = 2.0F * kPiF / 180.0F;
/// A camera sees a point if its ray meets nothing this much before it: share of the range, and m.
constexpr double kSeenShare = 1e-4, kSeenM = 2e-3;
/// A silhouette is a step in depth of at least this, m.
constexpr double kSilhouetteM = 0.3;

float azimuthStepRad() {
  return static_cast<float>(2.0 * kPiF * kLidarTurnsPerS *
                            toSeconds(findLidarSpec("VLP16")->firing_ns));
}

/// Whether something else lies before the point on a line of sight up to one beam beside its own.
bool besideSilhouette(const World& world, const Eigen::Vector3d& eye, int object,
                      const Eigen::Vector3d& line) {
  const double distance = line.norm(), flat = std::hypot(line.x(), line.y());
  const double azimuth = std::atan2(line.y(), line.x()), elevation = std::atan2(line.z(), flat);
  for (int up = -4; up <= 4; ++up) {
    for (int left = -1; left <= 1; ++left) {
      const double a = azimuth + left * azimuthStepRad(), e = elevation + 0.25 * up * kRingRad;
      const Eigen::Vector3f way(static_cast<float>(std::cos(e) * std::cos(a)),
                                static_cast<float>(std::cos(e) * std::sin(a)),
                                static_cast<float>(std::sin(e)));
      const Hit hit = world.see(eye.cast<float>(), way);
      if (hit.range > 0.0F && hit.object != object && hit.range < distance - kSilhouetteM) {
        return true;
      }
    }
  }
  return false;
}

}  // namespace

ReturnsAround::ReturnsAround(const SimulatedScan& scan, const DrivePath& path,
                             const Transform& T_base_lidar, StampNs start_ns, double time_s)
    : T_lidar_world_((path.pose(time_s) * T_base_lidar).inverse()) {
  returns_.reserve(scan.echoes.size());
  for (const Echo& echo : scan.echoes) {
    const Eigen::Vector3d p_world =
        path.pose(toSeconds(echo.time_ns - start_ns)) * T_base_lidar * echo.p_lidar;
    const Eigen::Vector2f way = direction(p_world);
    returns_.push_back({echo.object, way.x(), way.y(), p_world.cast<float>()});
  }
  std::sort(returns_.begin(), returns_.end(), [](const Return& a, const Return& b) {
    return a.object != b.object ? a.object < b.object : a.azimuth < b.azimuth;
  });
}

Eigen::Vector2f ReturnsAround::direction(const Eigen::Vector3d& p_world) const {
  const Eigen::Vector3d p = T_lidar_world_ * p_world;
  return {static_cast<float>(std::atan2(p.y(), p.x())),
          static_cast<float>(std::atan2(p.z(), std::hypot(p.x(), p.y())))};
}

bool ReturnsAround::tellOf(int object, const Eigen::Vector3d& p_world, const Eigen::Vector3d& eye,
                           double distance) const {
  const Eigen::Vector2f way = direction(p_world);
  const float step = azimuthStepRad();
  for (const float turn : {0.0F, -2.0F * kPiF, 2.0F * kPiF}) {
    const float first = way.x() + turn - step, last = way.x() + turn + step;
    auto found = std::lower_bound(
        returns_.begin(), returns_.end(), first, [&](const Return& r, float azimuth) {
          return r.object != object ? r.object < object : r.azimuth < azimuth;
        });
    for (; found != returns_.end() && found->object == object && found->azimuth <= last; ++found) {
      if (std::abs(found->elevation - way.y()) <= kRingRad &&
          (found->p_world.cast<double>() - eye).norm() < distance) {
        return true;
      }
    }
  }
  return false;
}

PointView viewPoint(const World& world, const ReturnsAround& returns, const Eigen::Vector3d& eye,
                    int object, const Eigen::Vector3d& p_world) {
  const Eigen::Vector3d line = p_world - eye;
  const double distance = line.norm();
  const Hit hit = world.see(eye.cast<float>(), line.normalized().cast<float>());
  PointView view;
  view.visible = !(hit.range > 0.0F && hit.range < distance * (1.0 - kSeenShare) - kSeenM);
  if (view.visible) {
    view.silhouette = besideSilhouette(world, eye, object, line);
  } else {
    const Eigen::Vector3d met = eye + static_cast<double>(hit.range) * line / distance;
    view.catchable = returns.tellOf(hit.object, met, eye, distance);
    const OcclusionConfig mask;
    view.apart =
        distance > hit.range + std::max(mask.depth_margin_m, mask.depth_margin_ratio * hit.range);
  }
  return view;
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

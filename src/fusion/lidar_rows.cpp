// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/fusion/lidar_rows.h"

#include <Eigen/Core>
#include <algorithm>
#include <cmath>

namespace semantic_lidar_fusion {
namespace {

// Directions are sampled so densely that what lies between them is within kMarginOfHeight.
constexpr int kElevations = 8;  ///< steps from the lowest to the highest
constexpr int kAzimuths = 720;
/// Beyond it the place of the lidar in the vehicle does not matter.
constexpr double kFarthest_m = 10000.0;
constexpr double kMarginOfHeight = 0.01;

}  // namespace

LidarReach reachOf(const LidarSpec& lidar, double min_range_m) {
  const auto [lowest, highest] = std::minmax_element(
      lidar.lasers.begin(), lidar.lasers.end(),
      [](const Laser& a, const Laser& b) { return a.elevation_rad < b.elevation_rad; });
  return {lowest->elevation_rad - kReachMarginRad, highest->elevation_rad + kReachMarginRad,
          std::max(kReachNearest_m, min_range_m)};
}

RowBand reachedRows(const CameraModel& camera, const Transform& T_camera_lidar,
                    const LidarReach& reach) {
  const ImageSize& size = camera.imageSize();
  double top = size.height, bottom = 0.0;
  for (int i = 0; i <= kElevations; ++i) {
    const double elevation =
        reach.lowest_rad + (reach.highest_rad - reach.lowest_rad) * i / kElevations;
    for (int k = 0; k < kAzimuths; ++k) {
      const double azimuth = 2.0 * kPi * k / kAzimuths;
      const Eigen::Vector3d beam(std::cos(elevation) * std::cos(azimuth),
                                 std::cos(elevation) * std::sin(azimuth), std::sin(elevation));
      for (double range = reach.nearest_m; range < kFarthest_m; range *= 1.5) {
        const auto pixel = camera.project(T_camera_lidar * (range * beam));
        if (!pixel || !inImage(pixel->x(), pixel->y(), size)) continue;
        top = std::min(top, pixel->y());
        bottom = std::max(bottom, pixel->y());
      }
    }
  }
  if (top > bottom) return {};
  return {std::max(0.0, top / size.height - kMarginOfHeight),
          std::min(1.0, (bottom + 1.0) / size.height + kMarginOfHeight)};
}

RowBand LidarRows::of(std::size_t camera, const CameraPlace& place) {
  const CameraConfig& config = rig_.cameras.at(camera);
  if (!config.finds_lidar_rows) return config.lidar_rows;
  if (!place.model) return {};
  std::optional<Found>& found = found_[camera];
  const bool is_known = found && found->place.model == place.model &&
                        found->place.T_camera_lidar.matrix() == place.T_camera_lidar.matrix();
  if (!is_known) {
    const LidarReach reach = reachOf(*rig_.lidar.model, rig_.lidar.min_range_m);
    found = Found{place, reachedRows(*place.model, place.T_camera_lidar, reach)};
  }
  return found->rows;
}

}  // namespace semantic_lidar_fusion

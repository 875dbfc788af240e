// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/projection/rolling_shutter.h"

#include <algorithm>

namespace semantic_lidar_fusion {

double clampedRowTime(const CameraModel& camera, double u, double v) {
  const RowTimes& rows = camera.rowTimes();
  const double side = rows.down ? camera.imageSize().height : camera.imageSize().width;
  const double row = std::max(-side, std::min(rows.down ? v : u, 2.0 * side));
  return rows.at_zero_s + rows.per_px_s * row;
}

std::optional<SeenPoint> seePoint(const CameraModel& camera, const Twist* motion,
                                  const Eigen::Vector3d& p_camera) {
  const auto pixelAt = [&](const Eigen::Vector3d& p) -> std::optional<SeenPoint> {
    const auto pixel = camera.project(p);
    if (!pixel) return std::nullopt;
    return SeenPoint{*pixel, p};
  };
  const auto rowTime = [&](const SeenPoint& seen) {
    return clampedRowTime(camera, seen.pixel.x(), seen.pixel.y());
  };
  auto seen = pixelAt(p_camera);
  if (!seen || motion == nullptr || !camera.rollingShutter()) return seen;
  const double first = rowTime(*seen);
  seen = pixelAt(seenLater(p_camera, *motion, first));
  if (!seen) return seen;
  return pixelAt(seenLater(p_camera, *motion, secantTime(first, rowTime(*seen))));
}

}  // namespace semantic_lidar_fusion

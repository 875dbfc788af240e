// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/projection/occlusion_mask.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/projection/surface_mask.h"

namespace semantic_lidar_fusion {

namespace {

/// Points in the order of visiting: nearest first, ties by lower index.
std::vector<std::uint32_t> nearestFirst(const ProjectedPoints& points) {
  std::vector<std::uint32_t> order(points.size());
  std::iota(order.begin(), order.end(), 0u);
  std::sort(order.begin(), order.end(), [&](std::uint32_t a, std::uint32_t b) {
    return points.distance[a] != points.distance[b] ? points.distance[a] < points.distance[b]
                                                    : points.index[a] < points.index[b];
  });
  return order;
}

std::vector<std::uint8_t> visibleByPaper(const ProjectedPoints& points, const CameraModel& camera,
                                         const MaskSize& mask) {
  const int width = camera.imageSize().width, height = camera.imageSize().height;
  const int half_width = (mask.width - 1) / 2, half_height = (mask.height - 1) / 2;
  // One bit a pixel, columns contiguous: masks are tall.
  const std::size_t words = (static_cast<std::size_t>(height) + 63) / 64;
  std::vector<std::uint64_t> masked(words * static_cast<std::size_t>(width), 0);
  std::vector<std::uint8_t> visible(points.size(), 0);
  for (const std::uint32_t i : nearestFirst(points)) {
    if (!inImage(points.u[i], points.v[i], camera.imageSize())) continue;
    const int u = pixelIndex(points.u[i]), v = pixelIndex(points.v[i]);
    const std::uint64_t* own = masked.data() + words * static_cast<std::size_t>(u);
    if (own[v / 64] >> (v % 64) & 1u) continue;
    visible[i] = 1;
    const int top = std::max(0, v - half_height), bottom = std::min(height - 1, v + half_height);
    for (int x = std::max(0, u - half_width); x <= std::min(width - 1, u + half_width); ++x) {
      std::uint64_t* column = masked.data() + words * static_cast<std::size_t>(x);
      for (int word = top / 64; word <= bottom / 64; ++word) {
        const int from = std::max(top - 64 * word, 0), to = std::min(bottom - 64 * word, 63);
        column[word] |= (~std::uint64_t{0} >> (63 - to + from)) << from;
      }
    }
  }
  return visible;
}

}  // namespace

MaskSize paperMaskSize(const CameraModel& camera, double horizontal_step_rad,
                       double vertical_step_rad) {
  const auto odd = [](double gap) {
    if (!(gap > 1.0)) return 1;
    const int up = static_cast<int>(std::ceil(std::min(gap, 1e6)));
    return std::max(1, std::min(up | 1, 2 * static_cast<int>(std::floor(std::min(gap, 1e6))) - 1));
  };
  return {odd(camera.fx() * std::tan(horizontal_step_rad)),
          odd(camera.fy() * std::tan(vertical_step_rad))};
}

double castMarginPx(const CameraModel& camera, const BeamGrid& grid,
                    const OcclusionConfig& config) {
  if (config.mode != OcclusionMode::kAdaptive) return 0.0;
  double step = std::max(grid.horizontal_step_rad, grid.vertical_step_rad);
  for (const BeamGrid::Ring& ring : grid.rings) {
    step = std::max({step, 2.0 * ring.half_up_rad, 2.0 * ring.half_down_rad});
  }
  return std::max(camera.fx(), camera.fy()) * step;
}

std::vector<std::uint8_t> visiblePoints(const Cloud& cloud, const ProjectedPoints& points,
                                        const Transform& T_camera_lidar, const CameraModel& camera,
                                        const BeamGrid& grid, const OcclusionConfig& config) {
  switch (config.mode) {
    case OcclusionMode::kOff:
      break;
    case OcclusionMode::kPaper:
      return visibleByPaper(
          points, camera, paperMaskSize(camera, grid.horizontal_step_rad, grid.vertical_step_rad));
    case OcclusionMode::kAdaptive:
      if (grid.links.size() != cloud.size()) {
        throw DataError("beam grid of " + std::to_string(grid.links.size()) + " points for " +
                        std::to_string(cloud.size()) + ": must be that of the same cloud");
      }
      return visibleBySurfaces(cloud, points, T_camera_lidar, camera, grid, config);
  }
  return std::vector<std::uint8_t>(points.size(), 1);
}

}  // namespace semantic_lidar_fusion

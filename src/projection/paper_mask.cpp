// SPDX-License-Identifier: MIT
#include "paper_mask.h"

#include <algorithm>
#include <cstddef>
#include <numeric>

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

}  // namespace

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

}  // namespace semantic_lidar_fusion

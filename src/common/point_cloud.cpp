// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/common/point_cloud.h"

#include <algorithm>

namespace semantic_lidar_fusion {

void TimedCloud::reserve(std::size_t points) {
  x.reserve(points);
  y.reserve(points);
  z.reserve(points);
  intensity.reserve(points);
  ring.reserve(points);
  time_ns.reserve(points);
  firing.reserve(points);
}

ScanInterval scanInterval(const TimedCloud& cloud) {
  if (cloud.time_ns.empty()) return {cloud.header_stamp, cloud.header_stamp};
  const auto range = std::minmax_element(cloud.time_ns.begin(), cloud.time_ns.end());
  return {*range.first, *range.second};
}

void Cloud::resize(std::size_t points) {
  x.resize(points);
  y.resize(points);
  z.resize(points);
  intensity.resize(points);
  ring.resize(points, kNoRing);
  dt.resize(points);
  status.resize(points);
}

}  // namespace semantic_lidar_fusion

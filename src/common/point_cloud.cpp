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
  ScanInterval interval = {cloud.time_ns.front(), cloud.time_ns.front()};
  for (const StampNs time : cloud.time_ns) {  // minmax_element takes five times as long
    interval.first_ns = std::min(interval.first_ns, time);
    interval.last_ns = std::max(interval.last_ns, time);
  }
  return interval;
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

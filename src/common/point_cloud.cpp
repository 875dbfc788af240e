// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/common/point_cloud.h"

#include <algorithm>

#include "time_kernels.h"

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
  static const TimeKernelList list = usableTimeKernels();
  ScanInterval interval;
  list.kernels[list.count - 1]->span(cloud.time_ns.data(), static_cast<int>(cloud.time_ns.size()),
                                     &interval.first_ns, &interval.last_ns);
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

std::array<std::uint64_t, kPointStatusNames.size()> countByStatus(const Cloud& cloud) {
  std::array<std::uint64_t, kPointStatusNames.size()> counts{};
  for (const std::uint8_t status : cloud.status) {
    ++counts[std::min<std::size_t>(status, counts.size() - 1)];
  }
  return counts;
}

}  // namespace semantic_lidar_fusion

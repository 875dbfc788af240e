// SPDX-License-Identifier: MIT
// Uses headers and the library as a C++ user does: compensates a scan of a vehicle that stands.
#include <cstdio>

#include "semantic_lidar_fusion/fusion/scan_pipeline.h"

using namespace semantic_lidar_fusion;

int main() {
  TimedCloud scan;
  scan.frame_id = "lidar";
  for (int i = 0; i < 2; ++i) {
    const StampNs time = kNsPerSecond + i * 100000000;
    scan.x.push_back(5.0f);
    scan.y.push_back(0.0f);
    scan.z.push_back(0.0f);
    scan.intensity.push_back(0.0f);
    scan.ring.push_back(0);
    scan.time_ns.push_back(time);
    scan.firing.push_back(static_cast<std::uint32_t>(i));
    scan.firings.push_back({time, time, static_cast<std::uint32_t>(i)});
  }
  PoseBuffer odometry;
  odometry.add({0, Transform::Identity()});
  odometry.add({2 * kNsPerSecond, Transform::Identity()});
  const ScanPipeline pipeline(Rig(), {PipelineStep::kCompensate});
  const CompensationResult result =
      pipeline.compensate(scan, scanInterval(scan).middleNs(), odometry, Transform::Identity());
  std::printf("%zu points, t_ref %.2f s\n", result.cloud.size(), toSeconds(result.cloud.stamp));
  return result.counters.marked_points == 0 ? 0 : 1;
}

// SPDX-License-Identifier: MIT
/// What a simulated bag knows of its scans: which cameras really see each point.
#pragma once

#include <rosbag/view.h>
#include <sensor_msgs/PointCloud2.h>

#include <cstdint>
#include <map>
#include <memory>
#include <vector>

#include "semantic_lidar_fusion/fusion/semantic_projector.h"
#include "tools/common/bag_input.h"

namespace semantic_lidar_fusion {

/// The field `visible` (u16, bit i: the i-th camera of the rig sees the point) of a PointCloud2,
/// one value a point. Throws DataError if the cloud has no such field or is malformed.
std::vector<std::uint16_t> visibleFlags(const sensor_msgs::PointCloud2& message);

class VisibilityTruth {
 public:
  /// Finds the messages of /points_truth. `offset_ns`: lidar.time_offset. Throws Error without
  /// them.
  VisibilityTruth(const BagInput& input, StampNs offset_ns);

  /// Gives each view what its camera sees of a scan of `points` points whose first one was measured
  /// at `first_ns` (true time). Throws DataError if the truth has no such scan.
  void apply(StampNs first_ns, std::size_t points, std::vector<CameraView>* views) const;

 private:
  std::unique_ptr<rosbag::View> view_;
  std::map<StampNs, rosbag::MessageInstance> scans_;  ///< by true time
};

}  // namespace semantic_lidar_fusion

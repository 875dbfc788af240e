// SPDX-License-Identifier: MIT
#pragma once
#include <rosbag/message_instance.h>
#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/config/rig.h"
namespace semantic_lidar_fusion {
class LidarInputDecoder {
 public:
  explicit LidarInputDecoder(const LidarConfig& config) : config_(config) {}
  TimedCloud decode(const rosbag::MessageInstance& message) const;
 private:
  LidarConfig config_;
};
}  // namespace semantic_lidar_fusion

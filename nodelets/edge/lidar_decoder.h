// SPDX-License-Identifier: MIT
/// The lidar's messages to points, as the rig file says; for nodelets and the offline tool alike.
#pragma once

#include <sensor_msgs/PointCloud2.h>

#include <functional>
#include <string>

#include "edge/velodyne_messages.h"
#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/lidar/packet_decoder.h"
#include "semantic_lidar_fusion/lidar/point_cloud_reader.h"

namespace semantic_lidar_fusion {

class LidarDecoder {
 public:
  /// Told of what was discarded: reason and number (0 too).
  using CountDrops = std::function<void(const std::string& reason, std::uint64_t count)>;

  /// `count_left_out` is told of what is discarded as intended (range limits, points without a
  /// value, second returns equal to the first); without it `count_drops` is. Throws ConfigError.
  LidarDecoder(const LidarConfig& config, CountDrops count_drops, CountDrops count_left_out = {});

  /// Finite points within the range limits; the frame is `lidar.frame` or the message's. Throws
  /// DataError (no frame, malformed layout).
  TimedCloud decode(const VelodyneScan& message);
  TimedCloud decode(const sensor_msgs::PointCloud2& message);

  /// How the times of the last PointCloud2 were understood, in one line; empty for packets.
  const std::string& timeDecision() const { return time_decision_; }
  /// Whether that understanding is a guess that a user should know of.
  bool timeDecisionIsDoubtful() const { return time_decision_is_doubtful_; }

 private:
  std::string frame(const std::string& message_frame) const;

  LidarConfig config_;
  CountDrops count_drops_, count_left_out_;
  PacketDecoder packets_;
  PointCloudReader clouds_;
  std::string time_decision_;
  bool time_decision_is_doubtful_ = false;
};

}  // namespace semantic_lidar_fusion

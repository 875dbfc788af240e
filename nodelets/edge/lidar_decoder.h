// SPDX-License-Identifier: MIT
/// The lidar's messages to points, as the rig file says; for nodelets and the offline tool alike.
#pragma once

#include <sensor_msgs/PointCloud2.h>

#include <functional>
#include <optional>
#include <set>
#include <string>
#include <vector>

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

  /// How the times of the last scan with points were understood, in one line.
  const std::string& timeDecision() const { return time_decision_; }

  /// How the input is understood, as far as it was not told before: each line comes once.
  struct Note {
    std::string text;
    bool warning = false;  ///< a guess, or wrong
  };
  std::vector<Note> takeNotes();

 private:
  std::string frame(const std::string& message_frame) const;
  void note(const std::string& text, bool warning);
  void noteTimes(const TimeDecision& decision);

  LidarConfig config_;
  CountDrops count_drops_, count_left_out_;
  PacketDecoder packets_;
  PointCloudReader clouds_;
  std::string time_decision_;
  std::optional<TimeDecision> last_times_;
  std::set<std::string> noted_;
  std::vector<Note> notes_;  ///< that were not taken
};

}  // namespace semantic_lidar_fusion

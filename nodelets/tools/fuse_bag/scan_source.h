// SPDX-License-Identifier: MIT
/// The scans of a bag, and the decisions about each. Decisions come from the core's ScanSelector
/// and depend on stamps alone.
#pragma once

#include <cstddef>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "edge/lidar_decoder.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "semantic_lidar_fusion/sync/scan_selector.h"
#include "tools/fuse_bag/drive_index.h"
#include "tools/fuse_bag/drop_log.h"

namespace semantic_lidar_fusion {

/// One scan of the bag.
struct BagScan {
  const rosbag::MessageInstance* message = nullptr;
  SelectorScan times;
  bool usable = false;
  bool empty = false;
  StampNs reference_ns = 0;
  std::vector<std::optional<StampNs>> image_stamps;  ///< raw, per camera
};

class ScanSource {
 public:
  /// Where a camera stands at the time of a message, in the frame of a lidar.
  using Place = std::function<CameraPlace(std::size_t camera, const ros::Time& time,
                                          const std::string& lidar_frame)>;
  /// Of each camera the raw stamps of the images that can be chosen, by true time.
  using Candidates = std::vector<std::map<StampNs, StampNs>>;

  /// Keeps the references.
  ScanSource(const Rig& rig, DropLog* drops);

  /// Throws DataError.
  TimedCloud decode(const rosbag::MessageInstance& message);
  /// Decodes each scan for its times; its points are decoded again when it is fused, which costs
  /// less than keeping them. `advanced` is called after each.
  void measure(const std::vector<rosbag::MessageInstance>& messages, const Place& place,
               const std::function<void()>& advanced);
  /// Each scan is decided with all stamps that may matter to it, as if nothing more would come: the
  /// selector's bounds on memory and its timeouts, made for a live stream, do not touch the result.
  void select(const Candidates& candidates);

  const std::vector<BagScan>& scans() const { return scans_; }
  /// How the times of points are understood; empty for packets.
  const std::string& timeDecision() const { return lidar_.timeDecision(); }

 private:
  void decide(const SelectorConfig& config, const Candidates& candidates, BagScan* scan) const;

  const Rig& rig_;
  DropLog& drops_;
  bool counts_points_ = true;  ///< scans are decoded twice, their points are counted once
  LidarDecoder lidar_;
  std::vector<BagScan> scans_;
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The scans of a bag, and the decisions about each. Decisions come from the core's ScanSelector
/// and depend on stamps alone.
#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "edge/lidar_decoder.h"
#include "semantic_lidar_fusion/check/rig_watch.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/sync/scan_selector.h"
#include "tools/fuse_bag/camera_places.h"
#include "tools/fuse_bag/drive_reader.h"
#include "tools/fuse_bag/drop_log.h"
#include "tools/fuse_bag/image_source.h"

namespace semantic_lidar_fusion {

/// One scan of the bag.
struct BagScan {
  explicit BagScan(rosbag::MessageInstance place) : message(std::move(place)) {}

  rosbag::MessageInstance message;
  std::size_t number = 0;  ///< in the bag
  SelectorScan times;
  bool empty = false;
  std::optional<TimedCloud> points;  ///< as long as few scans wait; else they are decoded again
  StampNs reference_ns = 0;
  std::vector<std::optional<StampNs>> image_stamps;  ///< raw, by camera
};

class ScanSource {
 public:
  /// Keeps the references. `watch` is shown each scan once.
  ScanSource(const Rig& rig, const DriveIndex& index, const ImageSource& images,
             CameraPlaces* places, DropLog* drops, RigWatch* watch);

  /// The next scan of the bag: decoded for its times. One that cannot be used is counted.
  void take(const rosbag::MessageInstance& message);
  /// The oldest scan that was taken and not decided; null if there is none.
  const BagScan* waiting() const { return waiting_.empty() ? nullptr : &waiting_.front(); }
  /// Decides it with all stamps that are known, as if nothing more would come: the selector's
  /// bounds on memory and its timeouts, made for a live stream, do not touch the result.
  BagScan decide();
  /// The points of a scan, which it gives away. Throws DataError.
  TimedCloud points(BagScan* scan);
  /// Whether the images of a scan that was decided are still those that it would get.
  bool holds(const BagScan& scan) const;

  std::size_t taken() const { return taken_; }
  /// How the times of points are understood; empty for packets.
  const std::string& timeDecision() const { return lidar_.timeDecision(); }
  /// What a user should know of the lidar's messages.
  void tellNotes();

 private:
  TimedCloud decode(const rosbag::MessageInstance& message);
  void select(BagScan* scan) const;

  const Rig& rig_;
  const DriveIndex& index_;
  const ImageSource& images_;
  CameraPlaces& places_;
  DropLog& drops_;
  RigWatch& watch_;
  bool counts_points_ = true;  ///< scans may be decoded twice, their points are counted once
  LidarDecoder lidar_;
  SelectorConfig selection_;
  std::size_t taken_ = 0;
  std::set<StampNs> seen_;  ///< first points
  std::deque<BagScan> waiting_;
};

}  // namespace semantic_lidar_fusion

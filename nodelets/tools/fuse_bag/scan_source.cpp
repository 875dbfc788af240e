// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/scan_source.h"

#include <sensor_msgs/PointCloud2.h>

#include <algorithm>
#include <limits>
#include <set>
#include <utility>

#include "edge/velodyne_messages.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {

ScanSource::ScanSource(const Rig& rig, DropLog* drops)
    : rig_(rig),
      drops_(*drops),
      lidar_(rig.lidar, [this](const std::string& reason, std::uint64_t n) {
        if (counts_points_) drops_.add("lidar: " + reason, n);
      }) {}

TimedCloud ScanSource::decode(const rosbag::MessageInstance& message) {
  if (rig_.lidar.input == LidarInput::kPackets) {
    const auto scan = message.instantiate<VelodyneScan>();
    if (!scan) throw DataError("has another definition of velodyne_msgs/VelodyneScan");
    return lidar_.decode(*scan);
  }
  const auto cloud = message.instantiate<sensor_msgs::PointCloud2>();
  if (!cloud) throw DataError("has another definition of sensor_msgs/PointCloud2");
  return lidar_.decode(*cloud);
}

void ScanSource::measure(const std::vector<rosbag::MessageInstance>& messages, const Place& place,
                         const std::function<void()>& advanced) {
  const bool sweeps = rig_.image_choice == ImageChoice::kClosestToSweep;
  for (const rosbag::MessageInstance& message : messages) {
    BagScan scan;
    scan.message = &message;
    scan.image_stamps.resize(rig_.cameras.size());
    try {
      const TimedCloud cloud = decode(message);
      scan.times.interval = scanInterval(cloud);
      scan.empty = cloud.empty();
      scan.usable = true;
      if (scan.times.interval.first_ns <= 0) throw DataError("has stamp 0");
      if (cloud.frame_id.empty()) throw DataError("has an empty frame_id");
      for (std::size_t c = 0; sweeps && c < rig_.cameras.size(); ++c) {
        const CameraPlace at = place(c, message.getTime(), cloud.frame_id);
        scan.times.sweep_ns.push_back(sweepTime(cloud, at));
      }
    } catch (const DataError& e) {
      scan.usable = false;
      drops_.count("scans: unusable", message.getTopic() + ": scan " +
                                          std::to_string(scans_.size()) +
                                          " is dropped: " + e.what());
    }
    scans_.push_back(std::move(scan));
    advanced();
  }
  counts_points_ = false;
  for (const LidarDecoder::Note& note : lidar_.takeNotes()) {
    if (note.warning) {
      DropLog::warn("lidar: " + note.text);
    } else if (note.text != lidar_.timeDecision()) {  // which the summary tells
      DropLog::note("lidar: " + note.text);
    }
  }
}

void ScanSource::select(const Candidates& candidates) {
  SelectorConfig config = rig_.selectorConfig();
  config.image_history_ns = std::numeric_limits<StampNs>::max() / 4;
  std::set<StampNs> seen;
  for (BagScan& scan : scans_) {
    if (!scan.usable) continue;
    const StampNs first_ns = scan.times.interval.first_ns;
    if (!seen.insert(first_ns).second) {
      scan.usable = false;
      drops_.count(
          "scans: first point seen twice",
          "second scan with its first point at " + std::to_string(first_ns) + " ns is dropped");
    } else if (scan.empty) {  // no time to choose by: stamped with its header
      scan.reference_ns = first_ns;
    } else {
      decide(config, candidates, &scan);
    }
  }
}

void ScanSource::decide(const SelectorConfig& config, const Candidates& candidates,
                        BagScan* scan) const {
  StampNs reach_ns = config.reference_timeout_ns;
  for (const SelectorCamera& camera : config.cameras) {
    reach_ns = std::max(reach_ns, camera.max_time_difference_ns);
  }
  const ScanInterval& interval = scan->times.interval;
  ScanSelector selector(config);
  selector.addScan(scan->times, 0);
  // t_ref is at most `reach_ns` off the scan, an image at most that off t_ref.
  for (std::size_t c = 0; c < candidates.size(); ++c) {
    for (auto image = candidates[c].lower_bound(interval.first_ns - 2 * reach_ns);
         image != candidates[c].end() && image->first <= interval.last_ns + 2 * reach_ns; ++image) {
      selector.addImage(static_cast<int>(c), image->second);
    }
  }
  const SelectorDecisions decisions = selector.finish();
  for (const ReferenceDecision& decision : decisions.references) {
    scan->reference_ns = decision.reference_ns;
  }
  for (const SelectionDecision& decision : decisions.selections) {
    scan->image_stamps[static_cast<std::size_t>(decision.camera)] = decision.image_stamp;
  }
}

}  // namespace semantic_lidar_fusion

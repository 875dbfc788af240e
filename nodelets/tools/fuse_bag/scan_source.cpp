// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/scan_source.h"

#include <sensor_msgs/PointCloud2.h>

#include <algorithm>
#include <limits>
#include <utility>

#include "edge/conversions.h"
#include "edge/velodyne_messages.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

/// Of scans that wait for their decision, so many keep their points.
constexpr std::size_t kMostWithPoints = 64;

}  // namespace

ScanSource::ScanSource(const Rig& rig, const DriveIndex& index, const ImageSource& images,
                       CameraPlaces* places, DropLog* drops, RigWatch* watch)
    : rig_(rig),
      index_(index),
      images_(images),
      places_(*places),
      drops_(*drops),
      watch_(*watch),
      lidar_(rig.lidar,
             [this](const std::string& reason, std::uint64_t n) {
               if (counts_points_) drops_.add("lidar: " + reason, n);
             }),
      selection_(rig.selectorConfig()) {
  selection_.image_history_ns = std::numeric_limits<StampNs>::max() / 4;
}

TimedCloud ScanSource::decode(const rosbag::MessageInstance& message) {
  if (rig_.lidar.input == LidarInput::kPackets) {
    const auto scan = messageOf<VelodyneScan>(message);
    if (!scan) throw DataError("has another definition of velodyne_msgs/VelodyneScan");
    return lidar_.decode(*scan);
  }
  const auto cloud = messageOf<sensor_msgs::PointCloud2>(message);
  if (!cloud) throw DataError("has another definition of sensor_msgs/PointCloud2");
  return lidar_.decode(*cloud);
}

void ScanSource::take(const rosbag::MessageInstance& message) {
  BagScan scan(message);
  scan.number = taken_++;
  scan.image_stamps.resize(rig_.cameras.size());
  try {
    TimedCloud cloud = decode(message);
    watch_.lookAtArrival(message.getTopic(), cloud.header_stamp, stampNs(message.getTime()));
    watch_.lookAtScan(cloud);
    scan.times.interval = scanInterval(cloud);
    scan.empty = cloud.empty();
    if (scan.times.interval.first_ns <= 0) throw DataError("has stamp 0");
    if (cloud.frame_id.empty()) throw DataError("has an empty frame_id");
    if (waiting_.size() < kMostWithPoints) scan.points = std::move(cloud);
  } catch (const DataError& e) {
    drops_.count("scans: unusable", message.getTopic() + ": scan " + std::to_string(scan.number) +
                                        " is dropped: " + e.what());
    return;
  }
  const StampNs first_ns = scan.times.interval.first_ns;
  if (!seen_.insert(first_ns).second) {
    drops_.count("scans: first point seen twice", "second scan with its first point at " +
                                                      std::to_string(first_ns) + " ns is dropped");
    return;
  }
  waiting_.push_back(std::move(scan));
}

TimedCloud ScanSource::points(BagScan* scan) {
  if (scan->points) {
    TimedCloud points = std::move(*scan->points);
    scan->points.reset();
    return points;
  }
  counts_points_ = false;
  TimedCloud points = decode(scan->message);
  counts_points_ = true;
  return points;
}

BagScan ScanSource::decide() {
  BagScan scan = std::move(waiting_.front());
  waiting_.pop_front();
  if (scan.empty) {  // no time to choose by: stamped with its header
    scan.reference_ns = scan.times.interval.first_ns;
    return scan;
  }
  if (rig_.image_choice == ImageChoice::kClosestToSweep) {
    const TimedCloud points = this->points(&scan);
    for (std::size_t c = 0; c < rig_.cameras.size(); ++c) {
      const CameraPlace at = places_.at(c, scan.message.getTime(), points.frame_id);
      scan.times.sweep_ns.push_back(sweepTime(points, at));
    }
    scan.points = points;
  }
  select(&scan);
  return scan;
}

void ScanSource::select(BagScan* scan) const {
  StampNs reach_ns = selection_.reference_timeout_ns;
  for (const SelectorCamera& camera : selection_.cameras) {
    reach_ns = std::max(reach_ns, camera.max_time_difference_ns);
  }
  const ScanInterval& interval = scan->times.interval;
  ScanSelector selector(selection_);
  selector.addScan(scan->times, 0);
  // t_ref is at most `reach_ns` off the scan, an image at most that off t_ref.
  for (std::size_t c = 0; c < index_.cameras.size(); ++c) {
    const StampNs begin = interval.first_ns - 2 * reach_ns - images_.pipeline().imageTime(c, 0);
    const StampNs end = interval.last_ns + 2 * reach_ns - images_.pipeline().imageTime(c, 0);
    std::set<StampNs> stamps;
    for (const ImagesByStamp* images : {&index_.cameras[c].images, &index_.cameras[c].semantics}) {
      for (auto i = images->lower_bound(begin); i != images->end() && i->first <= end; ++i) {
        if (images_.isCandidate(c, i->first)) stamps.insert(i->first);
      }
    }
    for (const StampNs stamp : stamps) selector.addImage(static_cast<int>(c), stamp);
  }
  const SelectorDecisions decisions = selector.finish();
  for (const ReferenceDecision& decision : decisions.references) {
    scan->reference_ns = decision.reference_ns;
  }
  for (const SelectionDecision& decision : decisions.selections) {
    scan->image_stamps[static_cast<std::size_t>(decision.camera)] = decision.image_stamp;
  }
}

bool ScanSource::holds(const BagScan& scan) const {
  if (scan.empty) return true;
  BagScan again = scan;
  select(&again);
  return again.reference_ns == scan.reference_ns && again.image_stamps == scan.image_stamps;
}

void ScanSource::tellNotes() {
  for (const LidarDecoder::Note& note : lidar_.takeNotes()) {
    if (note.warning) {
      DropLog::warn("lidar: " + note.text);
    } else if (note.text != lidar_.timeDecision()) {  // which the summary tells
      DropLog::note("lidar: " + note.text);
    }
  }
}

}  // namespace semantic_lidar_fusion

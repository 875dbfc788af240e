// SPDX-License-Identifier: MIT
/// Chooses the reference time t_ref of each scan and one image per camera, from stamps alone.
///
/// t_ref is the true time of the reference camera's image closest to the middle of the scan
/// ("closest camera image timestamp" of the paper); each camera then contributes its image closest
/// to its own target. The class has no clock: `advance` passes the current time in, and the
/// decisions do not depend on the order of arrival as long as no timeout passes.
///
/// A decision is settled as soon as a stamp at or after its target is known (stamps of one camera
/// may arrive late or twice, but are bounded by the timeout), else when the timeout has passed
/// since the scan was added. Of two equally close images the earlier wins. t_ref never waits for
/// other cameras.
#pragma once

#include <cstdint>
#include <deque>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

enum class ReferenceChoice : std::uint8_t { kClosestImage, kScanStart, kScanMiddle, kScanEnd };
enum class ImageChoice : std::uint8_t { kClosestToReference, kClosestToSweep };

struct SelectorCamera {
  StampNs time_offset_ns = 0;                 ///< true time = raw stamp + this
  StampNs max_time_difference_ns = 50000000;  ///< an image further from the target is none
  StampNs timeout_ns = 200000000;  ///< wait for this camera's images, from the scan's arrival
};

struct SelectorConfig {
  std::vector<SelectorCamera> cameras;  ///< in the rig file's order
  ReferenceChoice choose = ReferenceChoice::kClosestImage;
  int reference_camera = 0;  ///< index into `cameras`
  StampNs reference_timeout_ns = 200000000;
  ImageChoice image_choice = ImageChoice::kClosestToReference;
  std::size_t max_pending_scans = 4;      ///< the oldest is dropped and counted
  StampNs image_history_ns = 2000000000;  ///< stamps older than the newest by more are forgotten
};

/// What the selector needs to know of a scan.
struct SelectorScan {
  ScanInterval interval;
  /// kClosestToSweep: mean true time of the points in each camera's view, rounded down; empty
  /// optional = no point in view, the target is then t_ref. May be empty otherwise.
  std::vector<std::optional<StampNs>> sweep_ns;
};

/// t_ref of a scan is settled.
struct ReferenceDecision {
  StampNs scan_ns = 0;       ///< first point of the scan, its key
  StampNs reference_ns = 0;  ///< t_ref, true time
  bool timed_out = false;    ///< no image in time: t_ref is the middle of the scan
};

/// The image of one camera for one scan is settled.
struct SelectionDecision {
  StampNs scan_ns = 0;
  int camera = 0;
  std::optional<StampNs> image_stamp;  ///< raw stamp; empty = none
  bool timed_out = false;              ///< decided without an image at or after the target
};

struct SelectorDecisions {
  std::vector<ReferenceDecision> references;
  std::vector<SelectionDecision> selections;  ///< scan by scan, then by camera index
};

struct SelectorCounters {
  std::uint64_t scans = 0;
  std::uint64_t scans_dropped_pending = 0;  ///< the queue of pending scans was full
  std::uint64_t scans_duplicate = 0;        ///< a scan with this first stamp is known
  std::uint64_t reference_timeouts = 0;
  std::uint64_t images = 0;
  std::uint64_t images_duplicate = 0;
  std::uint64_t epochs = 0;                    ///< resets by a backward or large forward jump
  std::vector<std::uint64_t> camera_timeouts;  ///< per camera
  std::vector<std::uint64_t> camera_none;      ///< per camera: no image within the limit
};

class ScanSelector {
 public:
  /// Throws ConfigError.
  explicit ScanSelector(SelectorConfig config);

  /// `now_ns`: time of arrival on the clock that `advance` uses.
  void addScan(const SelectorScan& scan, StampNs now_ns);
  /// `stamp`: raw stamp of an image of camera `camera`.
  void addImage(int camera, StampNs stamp);
  /// Settles what can be settled at `now_ns`; decisions come once, oldest scan first.
  SelectorDecisions advance(StampNs now_ns);
  /// No more stamps will come: settles everything.
  SelectorDecisions finish();
  /// Forgets scans and images, keeps counters (a clock jump, a bag that starts anew).
  void reset();

  std::size_t pendingScans() const { return pending_.size(); }
  const SelectorCounters& counters() const { return counters_; }

 private:
  struct PendingScan {
    SelectorScan scan;
    StampNs added_ns = 0;
    std::optional<StampNs> reference_ns;
    std::vector<bool> settled;  ///< per camera
  };

  SelectorDecisions settle(StampNs now_ns, bool final);

  SelectorConfig config_;
  std::vector<std::set<StampNs>> images_;  ///< raw stamps per camera
  std::deque<PendingScan> pending_;
  SelectorCounters counters_;
};

}  // namespace semantic_lidar_fusion

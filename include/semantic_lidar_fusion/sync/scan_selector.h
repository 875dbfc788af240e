// SPDX-License-Identifier: MIT
/// Chooses the reference time t_ref of each scan and one image per camera, from stamps alone.
///
/// t_ref is the true time of the reference camera's image closest to the middle of the scan
/// ("closest camera image timestamp" of the paper); each camera then contributes its image closest
/// to its own target. Of two equally close images the earlier wins. t_ref never waits for other
/// cameras. The class has no clock: `advance` passes the current time in.
///
/// Settling. A decision is settled as soon as a stamp at or after its target is known, else when
/// the timeout has passed since the scan was added, or when no more stamps will come (`finish`):
/// the closest image that is known is then taken. t_ref is the middle of the scan where no image is
/// known that is within the reference timeout of it. Decisions therefore depend on stamps alone,
/// however scans, cameras and duplicates interleave, as long as no timeout passes and the images of
/// each camera arrive in the order of their stamps (one connection delivers them so) or at most
/// `reorder_window_ns` out of it. An image that comes too late to be chosen changes nothing and is
/// counted.
///
/// Epochs. Jumps of time are the caller's to see (EpochMonitor) and to `reset`. Stamps that jump
/// without it cost their own camera its images, and nothing else.
#pragma once

#include <cstdint>
#include <deque>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/sync/waiting_room.h"

namespace semantic_lidar_fusion {

enum class ReferenceChoice : std::uint8_t { kClosestImage, kScanStart, kScanMiddle, kScanEnd };
enum class ImageChoice : std::uint8_t { kClosestToReference, kClosestToSweep };

struct SelectorCamera {
  StampNs time_offset_ns = 0;                 ///< true time = raw stamp + this
  StampNs max_time_difference_ns = 50000000;  ///< an image further from the target is none
  StampNs timeout_ns = 200000000;  ///< wait for this camera's images, from the scan's arrival
  /// How far images may overtake each other: a decision waits for a stamp this far beyond the
  /// image that settles it. 0 for images that arrive in the order of their stamps.
  StampNs reorder_window_ns = 0;
};

struct SelectorConfig {
  std::vector<SelectorCamera> cameras;  ///< in the rig file's order
  ReferenceChoice choose = ReferenceChoice::kClosestImage;
  int reference_camera = 0;  ///< index into `cameras`
  StampNs reference_timeout_ns = 200000000;
  ImageChoice image_choice = ImageChoice::kClosestToReference;
  /// More scans may wait where they come faster (WaitingRoom); the oldest is dropped and counted.
  std::size_t max_pending_scans = 4;
  /// Images older than the newest scan, or than their camera's newest image if that is older, by
  /// more are forgotten; at least kLeastHistoryNs.
  StampNs image_history_ns = 2000000000;
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

/// The image of one camera for one scan is settled; its t_ref always is, earlier or at once.
struct SelectionDecision {
  StampNs scan_ns = 0;
  int camera = 0;
  std::optional<StampNs> image_stamp;  ///< raw stamp; empty = none
  bool timed_out = false;              ///< decided without an image at or after the target
};

enum class DropReason : std::uint8_t {
  kQueueFull,  ///< too many waited for t_ref
  kNewEpoch,   ///< `reset`
  kTooOld,     ///< as old as scans that are no longer remembered: it may be a duplicate
};

/// A scan that gets no further decision.
struct DroppedScan {
  StampNs scan_ns = 0;
  DropReason reason = DropReason::kQueueFull;
};

struct SelectorDecisions {
  std::vector<ReferenceDecision> references;  ///< oldest scan first
  std::vector<SelectionDecision> selections;  ///< oldest scan first, then by camera index
  std::vector<DroppedScan> dropped;           ///< in the order of their drops
};

struct SelectorCounters {
  std::uint64_t scans = 0;
  std::uint64_t scans_dropped_pending = 0;  ///< DropReason::kQueueFull
  std::uint64_t scans_dropped_epoch = 0;    ///< DropReason::kNewEpoch
  std::uint64_t scans_dropped_old = 0;      ///< DropReason::kTooOld
  std::uint64_t scans_duplicate = 0;        ///< a scan with this first stamp is known
  std::uint64_t reference_timeouts = 0;
  std::uint64_t images = 0;
  std::uint64_t images_duplicate = 0;
  std::uint64_t images_late = 0;  ///< would have been chosen, had they come before the decision
  std::vector<std::uint64_t> camera_timeouts;  ///< per camera
  std::vector<std::uint64_t> camera_none;      ///< per camera: no image within the limit
};

class ScanSelector {
 public:
  static constexpr StampNs kLeastHistoryNs = kNsPerSecond;
  /// Largest magnitude of a stamp, so that differences fit; ROS stamps reach 4.3e18.
  static constexpr StampNs kMaxStampNs = (StampNs{1} << 62) - 1;

  /// Throws ConfigError.
  explicit ScanSelector(SelectorConfig config);

  /// `now_ns`: time of arrival on the clock that `advance` uses. A full queue gives up its oldest
  /// scan: with the images known so far if its t_ref is settled, else it is dropped. Throws
  /// DataError on an interval or sweep times that make no sense.
  void addScan(const SelectorScan& scan, StampNs now_ns);
  /// `stamp`: raw stamp of an image of camera `camera`. Stamps come in roughly the order of the
  /// scans: `image_history_ns` is all that is kept. Throws DataError on an unknown camera or a
  /// stamp beyond kMaxStampNs.
  void addImage(int camera, StampNs stamp);
  /// Another offset of a camera's clock from here on, also for the images that are known. Throws
  /// DataError on an unknown camera or an offset that the constructor refuses.
  void setTimeOffset(int camera, StampNs offset_ns);
  /// Settles what can be settled at `now_ns`; each decision comes once. To be called after every
  /// addition, and when a timeout may have passed.
  SelectorDecisions advance(StampNs now_ns);
  /// No more stamps will come: settles everything.
  SelectorDecisions finish();
  /// Forgets scans and images, keeps counters (a clock jump, a bag that starts anew); the next
  /// `advance` names the scans that were pending.
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
  /// A decision made; an image nearer to the target than `difference_ns` would have changed it.
  struct Settled {
    StampNs target_ns = 0;
    StampNs difference_ns = 0;
  };
  struct CameraState {
    std::set<StampNs> images;     ///< true times
    std::deque<Settled> settled;  ///< the last few
  };
  enum class Waiting : std::uint8_t { kAsConfigured, kNoLonger };

  void makeRoom();
  void forgetOldImages(std::set<StampNs>* images) const;
  /// Settles what it can of the scan; true if nothing is left.
  bool settleScan(PendingScan* pending, StampNs now_ns, Waiting waiting);
  void settleReference(PendingScan* pending, StampNs waited_ns, Waiting waiting);
  void settleCamera(PendingScan* pending, int camera, StampNs waited_ns, Waiting waiting);
  void settleAll(StampNs now_ns, Waiting waiting);
  void remember(int camera, StampNs target_ns, StampNs difference_ns);
  SelectorDecisions takeDecisions();

  SelectorConfig config_;
  std::vector<CameraState> cameras_;
  std::deque<PendingScan> pending_;      ///< oldest first
  std::set<StampNs> scans_;              ///< first stamps of the last scans
  std::optional<StampNs> forgotten_ns_;  ///< the newest that is no longer among them
  WaitingRoom room_;
  SelectorDecisions decisions_;  ///< made and not yet returned
  SelectorCounters counters_;
};

}  // namespace semantic_lidar_fusion

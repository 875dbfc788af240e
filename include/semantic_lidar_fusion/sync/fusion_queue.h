// SPDX-License-Identifier: MIT
/// Holds compensated scans until every camera has said what it brings, or its deadline has passed.
///
/// Scans leave in the order in which they came. A scan is known by its key, the true time of its
/// first point; two scans may share a t_ref. Each camera of a scan is expected, none, ready or
/// failed; a scan completes when nothing is expected any more. One image may serve several scans.
/// A cloud without points has neither key nor images: it waits only for the scans before it.
///
/// Deadlines. Whoever chooses the images has a deadline of its own: the selection of a camera is
/// waited for from the arrival of the cloud for the camera's timeout and a grace, and the semantics
/// of the chosen image for the timeout from the later of the selection and the cloud.
#pragma once

#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <vector>

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/sync/stamped_store.h"
#include "semantic_lidar_fusion/sync/waiting_room.h"

namespace semantic_lidar_fusion {

enum class ViewState : std::uint8_t {
  kExpected,
  kNone,    ///< no image in time was selected
  kReady,   ///< the semantics of the selected image are at hand
  kFailed,  ///< the semantics did not come, or were reported missing
};

struct FusionQueueConfig {
  std::vector<StampNs> timeout_ns;         ///< per camera
  StampNs selection_grace_ns = 500000000;  ///< for a selection that was due
  /// More scans may wait where they come faster (WaitingRoom), but never more points than
  /// `max_pending_points`; the oldest is dropped and counted.
  std::size_t max_pending = 4;
  std::size_t max_pending_points = 8000000;
  std::size_t known_images = 64;  ///< semantics remembered per camera
};

struct CompletedScan {
  struct View {
    ViewState state = ViewState::kExpected;
    StampNs image_stamp = 0;  ///< raw stamp of the selected image, if one was selected
    bool timed_out = false;   ///< the deadline decided
  };
  std::shared_ptr<const Cloud> cloud;
  std::vector<View> views;  ///< per camera
};

struct FusionQueueCounters {
  std::uint64_t overflow = 0;       ///< scans dropped: too many waited
  std::uint64_t out_of_order = 0;   ///< scans dropped: known already, or before the last one
  std::uint64_t old_decisions = 0;  ///< ignored: older than all that are remembered
};

class FusionQueue {
 public:
  explicit FusionQueue(FusionQueueConfig config);

  /// `key_ns`: first point of the scan; `reference_ns`: its t_ref.
  void addReference(StampNs key_ns, StampNs reference_ns);
  void addSelection(StampNs key_ns, int camera, std::optional<StampNs> image_stamp, StampNs now_ns);
  /// The semantics of an image are at hand (or will never be).
  void setSemantics(int camera, StampNs image_stamp, bool ready);
  /// Clouds come in the order of their scans; one that does not is dropped and counted. The stamp
  /// of a cloud without points is its header's and tells no order.
  void addCloud(std::shared_ptr<const Cloud> cloud, StampNs now_ns);

  /// Scans that are complete at `now_ns`, in order.
  std::vector<CompletedScan> advance(StampNs now_ns);
  /// Forgets everything but counters.
  void reset();

  std::size_t pending() const { return pending_.size(); }
  const FusionQueueCounters& counters() const { return counters_; }

 private:
  struct Selection {
    std::optional<StampNs> image;
    StampNs arrived_ns = 0;
  };
  struct Decision {
    std::optional<StampNs> reference_ns;
    std::vector<std::optional<Selection>> selections;  ///< per camera
  };
  struct Pending {
    std::shared_ptr<const Cloud> cloud;
    StampNs arrived_ns = 0;
    std::optional<StampNs> key_ns;
  };

  /// Null where the scan is older than all that are remembered.
  Decision* decision(StampNs key_ns);
  bool follows(const Cloud& cloud) const;
  void makeRoom();
  /// Finds the key of a pending cloud: same t_ref, the latest first point that is not after its
  /// own.
  void matchKey(Pending* pending);
  CompletedScan::View view(const Pending& pending, std::size_t camera, StampNs now_ns) const;

  FusionQueueConfig config_;
  WaitingRoom room_;
  StampedStore<Decision> decisions_;
  std::vector<StampedStore<bool>> semantics_;
  std::deque<Pending> pending_;
  std::size_t pending_points_ = 0;
  std::optional<StampNs> last_first_point_ns_, last_stamp_ns_;  ///< of the last scan with points
  FusionQueueCounters counters_;
};

}  // namespace semantic_lidar_fusion

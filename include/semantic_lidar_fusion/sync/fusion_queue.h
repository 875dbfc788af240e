// SPDX-License-Identifier: MIT
/// Holds compensated scans until every camera has said what it brings, or its deadline has passed.
///
/// Scans leave in the order in which they came. A scan is known by its key, the true time of its
/// first point; two scans may share a t_ref. Each camera of a scan is expected, none, ready or
/// failed; a scan completes when nothing is expected any more. One image may serve several scans.
#pragma once

#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <optional>
#include <vector>

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/sync/stamped_store.h"

namespace semantic_lidar_fusion {

enum class ViewState : std::uint8_t {
  kExpected,
  kNone,    ///< no image in time was selected
  kReady,   ///< the semantics of the selected image are at hand
  kFailed,  ///< the semantics did not come, or were reported missing
};

struct FusionQueueConfig {
  std::vector<StampNs> timeout_ns;  ///< per camera: longest wait from the arrival of the cloud
  std::size_t max_pending = 4;      ///< the oldest scan is dropped and counted
  std::size_t known_images = 32;    ///< semantics remembered per camera
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

class FusionQueue {
 public:
  explicit FusionQueue(FusionQueueConfig config);

  /// `key_ns`: first point of the scan; `reference_ns`: its t_ref.
  void addReference(StampNs key_ns, StampNs reference_ns);
  void addSelection(StampNs key_ns, int camera, std::optional<StampNs> image_stamp);
  /// The semantics of an image are at hand (or will never be).
  void setSemantics(int camera, StampNs image_stamp, bool ready);
  void addCloud(std::shared_ptr<const Cloud> cloud, StampNs now_ns);

  /// Scans that are complete at `now_ns`, in order.
  std::vector<CompletedScan> advance(StampNs now_ns);
  /// Forgets everything.
  void reset();

  std::size_t pending() const { return pending_.size(); }
  std::uint64_t droppedPending() const { return dropped_pending_; }

 private:
  struct Decision {
    StampNs reference_ns = 0;
    bool has_reference = false;
    std::vector<std::optional<std::optional<StampNs>>>
        images;  ///< per camera: unknown, none, stamp
  };
  struct Pending {
    std::shared_ptr<const Cloud> cloud;
    StampNs arrived_ns = 0;
    std::optional<StampNs> key_ns;
  };

  Decision& decision(StampNs key_ns);
  /// Finds the key of a pending cloud: same t_ref, the latest first point that is not after its
  /// own.
  void matchKey(Pending* pending);

  FusionQueueConfig config_;
  StampedStore<Decision> decisions_;
  std::vector<StampedStore<bool>> semantics_;
  std::deque<Pending> pending_;
  std::uint64_t dropped_pending_ = 0;
};

}  // namespace semantic_lidar_fusion

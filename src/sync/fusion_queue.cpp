// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/sync/fusion_queue.h"

#include <algorithm>
#include <utility>

namespace semantic_lidar_fusion {
namespace {

/// Decisions remembered at least; scans whose cloud never comes fall out at the old end.
constexpr std::size_t kKnownDecisions = 32;
/// A cloud's first point is told by a float `dt` relative to t_ref: off by some nanoseconds.
constexpr StampNs kKeyToleranceNs = 1000;

}  // namespace

FusionQueue::FusionQueue(FusionQueueConfig config)
    : config_(std::move(config)),
      decisions_(std::max(kKnownDecisions, 2 * config_.max_pending)),
      semantics_(config_.timeout_ns.size(), StampedStore<bool>(config_.known_images)) {}

FusionQueue::Decision& FusionQueue::decision(StampNs key_ns) {
  if (decisions_.find(key_ns) == nullptr) {
    Decision empty;
    empty.images.resize(config_.timeout_ns.size());
    decisions_.put(key_ns, std::move(empty));
  }
  return *decisions_.find(key_ns);
}

void FusionQueue::addReference(StampNs key_ns, StampNs reference_ns) {
  Decision& known = decision(key_ns);
  known.reference_ns = reference_ns;
  known.has_reference = true;
}

void FusionQueue::addSelection(StampNs key_ns, int camera, std::optional<StampNs> image_stamp) {
  decision(key_ns).images.at(static_cast<std::size_t>(camera)) = image_stamp;
}

void FusionQueue::setSemantics(int camera, StampNs image_stamp, bool ready) {
  semantics_.at(static_cast<std::size_t>(camera)).put(image_stamp, ready);
}

void FusionQueue::addCloud(std::shared_ptr<const Cloud> cloud, StampNs now_ns) {
  pending_.push_back({std::move(cloud), now_ns, {}});
  while (pending_.size() > config_.max_pending) {
    pending_.pop_front();
    ++dropped_pending_;
  }
}

void FusionQueue::matchKey(Pending* pending) {
  for (auto known = decisions_.values().rbegin(); known != decisions_.values().rend(); ++known) {
    const auto& [key_ns, decision] = *known;
    if (!decision.has_reference || decision.reference_ns != pending->cloud->stamp) continue;
    if (key_ns > pending->cloud->first_point_ns + kKeyToleranceNs) continue;
    bool taken = false;
    for (const Pending& other : pending_) taken = taken || other.key_ns == key_ns;
    if (!taken) pending->key_ns = key_ns;
    return;
  }
}

std::vector<CompletedScan> FusionQueue::advance(StampNs now_ns) {
  for (Pending& pending : pending_) {
    if (!pending.key_ns) matchKey(&pending);
  }
  std::vector<CompletedScan> completed;
  while (!pending_.empty()) {
    const Pending& pending = pending_.front();
    CompletedScan scan;
    scan.cloud = pending.cloud;
    scan.views.resize(config_.timeout_ns.size());
    const Decision* decided = pending.key_ns ? decisions_.find(*pending.key_ns) : nullptr;
    bool complete = true;
    for (std::size_t camera = 0; camera < scan.views.size(); ++camera) {
      CompletedScan::View& view = scan.views[camera];
      const bool late = now_ns - pending.arrived_ns >= config_.timeout_ns[camera];
      if (decided != nullptr && decided->images[camera]) {
        const std::optional<StampNs>& image = *decided->images[camera];
        if (!image) {
          view.state = ViewState::kNone;
          continue;
        }
        view.image_stamp = *image;
        if (const bool* ready = semantics_[camera].find(*image)) {
          view.state = *ready ? ViewState::kReady : ViewState::kFailed;
          continue;
        }
      }
      if (late) {
        view.state = ViewState::kFailed;
        view.timed_out = true;
      } else {
        complete = false;
      }
    }
    if (!complete) break;
    completed.push_back(std::move(scan));
    if (pending.key_ns) decisions_.erase(*pending.key_ns);
    pending_.pop_front();
  }
  return completed;
}

void FusionQueue::reset() {
  decisions_.clear();
  for (auto& known : semantics_) known.clear();
  pending_.clear();
}

}  // namespace semantic_lidar_fusion

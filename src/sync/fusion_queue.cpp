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

/// From the arrival of a cloud to the last deadline that it may wait for.
StampNs longestWait(const FusionQueueConfig& config) {
  StampNs longest_ns = 0;
  for (const StampNs timeout_ns : config.timeout_ns) longest_ns = std::max(longest_ns, timeout_ns);
  return 2 * longest_ns + config.selection_grace_ns;
}

}  // namespace

FusionQueue::FusionQueue(FusionQueueConfig config)
    : config_(std::move(config)),
      room_(longestWait(config_)),
      decisions_(kKnownDecisions),
      semantics_(config_.timeout_ns.size(), StampedStore<bool>(config_.known_images)) {}

FusionQueue::Decision* FusionQueue::decision(StampNs key_ns) {
  if (decisions_.find(key_ns) == nullptr) {
    Decision empty;
    empty.selections.resize(config_.timeout_ns.size());
    decisions_.put(key_ns, std::move(empty));
  }
  Decision* const known = decisions_.find(key_ns);
  if (known == nullptr) ++counters_.old_decisions;
  return known;
}

void FusionQueue::addReference(StampNs key_ns, StampNs reference_ns) {
  if (Decision* known = decision(key_ns)) known->reference_ns = reference_ns;
}

void FusionQueue::addSelection(StampNs key_ns, int camera, std::optional<StampNs> image_stamp,
                               StampNs now_ns) {
  if (Decision* known = decision(key_ns)) {
    known->selections.at(static_cast<std::size_t>(camera)) = Selection{image_stamp, now_ns};
  }
}

void FusionQueue::setSemantics(int camera, StampNs image_stamp, bool ready) {
  semantics_.at(static_cast<std::size_t>(camera)).put(image_stamp, ready);
}

bool FusionQueue::follows(const Cloud& cloud) const {
  if (cloud.empty() || !last_stamp_ns_) return true;
  return cloud.stamp >= *last_stamp_ns_ && cloud.first_point_ns > *last_first_point_ns_;
}

void FusionQueue::addCloud(std::shared_ptr<const Cloud> cloud, StampNs now_ns) {
  if (!follows(*cloud)) {
    ++counters_.out_of_order;
    return;
  }
  if (cloud->size() > 0) {
    room_.observe(cloud->first_point_ns);
    last_first_point_ns_ = cloud->first_point_ns;
    last_stamp_ns_ = cloud->stamp;
  }
  pending_points_ += cloud->size();
  pending_.push_back({std::move(cloud), now_ns, {}});
  makeRoom();
}

void FusionQueue::makeRoom() {
  const std::size_t most = std::max(config_.max_pending, room_.capacity());
  decisions_.grow(2 * most);
  while (pending_.size() > most ||
         (pending_.size() > 1 && pending_points_ > config_.max_pending_points)) {
    pending_points_ -= pending_.front().cloud->size();
    pending_.pop_front();
    ++counters_.overflow;
  }
}

void FusionQueue::matchKey(Pending* pending) {
  for (auto known = decisions_.values().rbegin(); known != decisions_.values().rend(); ++known) {
    const auto& [key_ns, decision] = *known;
    if (decision.reference_ns != pending->cloud->stamp) continue;
    if (key_ns > pending->cloud->first_point_ns + kKeyToleranceNs) continue;
    bool taken = false;
    for (const Pending& other : pending_) taken = taken || other.key_ns == key_ns;
    if (!taken) pending->key_ns = key_ns;
    return;
  }
}

CompletedScan::View FusionQueue::view(const Pending& pending, std::size_t camera,
                                      StampNs now_ns) const {
  CompletedScan::View view;
  if (pending.cloud->empty()) {
    view.state = ViewState::kNone;
    return view;
  }
  const StampNs timeout_ns = config_.timeout_ns[camera];
  StampNs deadline_ns = pending.arrived_ns + timeout_ns + config_.selection_grace_ns;
  const Decision* const decided = pending.key_ns ? decisions_.find(*pending.key_ns) : nullptr;
  if (decided != nullptr && decided->selections[camera]) {
    const Selection& selection = *decided->selections[camera];
    if (!selection.image) {
      view.state = ViewState::kNone;
      return view;
    }
    view.image_stamp = *selection.image;
    if (const bool* ready = semantics_[camera].find(*selection.image)) {
      view.state = *ready ? ViewState::kReady : ViewState::kFailed;
      return view;
    }
    deadline_ns = std::max(pending.arrived_ns, selection.arrived_ns) + timeout_ns;
  }
  if (now_ns >= deadline_ns) {
    view.state = ViewState::kFailed;
    view.timed_out = true;
  }
  return view;
}

std::vector<CompletedScan> FusionQueue::advance(StampNs now_ns) {
  for (Pending& pending : pending_) {
    if (!pending.key_ns && !pending.cloud->empty()) matchKey(&pending);
  }
  std::vector<CompletedScan> completed;
  while (!pending_.empty()) {
    const Pending& pending = pending_.front();
    CompletedScan scan;
    scan.cloud = pending.cloud;
    bool complete = true;
    for (std::size_t camera = 0; camera < config_.timeout_ns.size(); ++camera) {
      scan.views.push_back(view(pending, camera, now_ns));
      complete = complete && scan.views.back().state != ViewState::kExpected;
    }
    if (!complete) break;
    if (pending.key_ns) decisions_.erase(*pending.key_ns);
    pending_points_ -= scan.cloud->size();
    pending_.pop_front();
    completed.push_back(std::move(scan));
  }
  return completed;
}

void FusionQueue::reset() {
  decisions_.clear();
  for (auto& known : semantics_) known.clear();
  pending_.clear();
  pending_points_ = 0;
  last_first_point_ns_.reset();
  last_stamp_ns_.reset();
}

}  // namespace semantic_lidar_fusion

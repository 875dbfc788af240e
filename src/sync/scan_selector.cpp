// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/sync/scan_selector.h"

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <limits>
#include <tuple>
#include <utility>

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

/// Of a camera's clock.
constexpr StampNs kMaxOffsetNs = 1000000000 * kNsPerSecond;
/// Bounds of memory where stamps are absurdly dense; 30 Hz for five minutes are 9000 images.
constexpr std::size_t kMaxImages = 16384;
constexpr std::size_t kLeastKnownScans = 64;
constexpr std::size_t kMaxSettled = 8;

/// |a - b|, or the largest number where that is beyond it.
StampNs distance(StampNs a, StampNs b) {
  const auto difference =
      static_cast<std::uint64_t>(std::max(a, b)) - static_cast<std::uint64_t>(std::min(a, b));
  constexpr StampNs kLargest = std::numeric_limits<StampNs>::max();
  return static_cast<StampNs>(std::min(difference, static_cast<std::uint64_t>(kLargest)));
}

/// The time closest to `target_ns`; of two the earlier.
std::optional<StampNs> closest(const std::set<StampNs>& times, StampNs target_ns) {
  const auto after = times.lower_bound(target_ns);
  if (after == times.begin()) {
    return after == times.end() ? std::nullopt : std::optional<StampNs>(*after);
  }
  const StampNs before_ns = *std::prev(after);
  if (after == times.end() || distance(target_ns, before_ns) <= distance(*after, target_ns))
    return before_ns;
  return *after;
}

/// Whether a time at or after the target is known.
bool reaches(const std::set<StampNs>& times, StampNs target_ns) {
  return !times.empty() && *times.rbegin() >= target_ns;
}

/// Whether no time to come can be closer to the target: a time at or after it is known, and all
/// that it may have overtaken have come.
bool isDecided(const std::set<StampNs>& times, StampNs target_ns, StampNs reorder_window_ns) {
  const auto after = times.lower_bound(target_ns);
  return after != times.end() &&
         (*after == target_ns || *after <= *times.rbegin() - reorder_window_ns);
}

bool isStamp(StampNs stamp) {
  return stamp >= -ScanSelector::kMaxStampNs && stamp <= ScanSelector::kMaxStampNs;
}

void checkNotNegative(const std::string& name, StampNs value, std::vector<std::string>* problems) {
  if (value < 0 || value > ScanSelector::kMaxStampNs) {
    problems->push_back(name + " = " + std::to_string(value) + " ns: must not be negative");
  }
}

StampNs longestWait(const SelectorConfig& config) {
  StampNs longest_ns = config.reference_timeout_ns;
  for (const SelectorCamera& camera : config.cameras) {
    longest_ns = std::max(longest_ns, camera.timeout_ns);
  }
  return longest_ns;
}

}  // namespace

ScanSelector::ScanSelector(SelectorConfig config)
    : config_(std::move(config)), room_(longestWait(config_)) {
  std::vector<std::string> problems;
  const int camera_count = static_cast<int>(config_.cameras.size());
  if (camera_count > 0 &&
      (config_.reference_camera < 0 || config_.reference_camera >= camera_count)) {
    problems.push_back("reference_camera = " + std::to_string(config_.reference_camera) +
                       ": must be an index of the " + std::to_string(camera_count) + " cameras");
  }
  checkNotNegative("reference_timeout_ns", config_.reference_timeout_ns, &problems);
  for (const SelectorCamera& camera : config_.cameras) {
    checkNotNegative("max_time_difference_ns", camera.max_time_difference_ns, &problems);
    checkNotNegative("timeout_ns", camera.timeout_ns, &problems);
    checkNotNegative("reorder_window_ns", camera.reorder_window_ns, &problems);
    if (distance(camera.time_offset_ns, 0) > kMaxOffsetNs) {
      problems.push_back("time_offset_ns = " + std::to_string(camera.time_offset_ns) +
                         ": must be within 1e9 s");
    }
  }
  if (config_.max_pending_scans == 0) {
    problems.push_back("max_pending_scans = 0: must be at least 1");
  }
  if (config_.image_history_ns < kLeastHistoryNs) {
    problems.push_back("image_history_ns = " + std::to_string(config_.image_history_ns) +
                       ": must be at least " + std::to_string(kLeastHistoryNs));
  }
  if (!problems.empty()) throw ConfigError(std::move(problems));
  cameras_.resize(config_.cameras.size());
  counters_.camera_timeouts.resize(config_.cameras.size());
  counters_.camera_none.resize(config_.cameras.size());
}

void ScanSelector::addScan(const SelectorScan& scan, StampNs now_ns) {
  const ScanInterval& interval = scan.interval;
  if (!isStamp(interval.first_ns) || !isStamp(interval.last_ns) ||
      interval.last_ns < interval.first_ns) {
    throw DataError("scan from " + std::to_string(interval.first_ns) + " to " +
                    std::to_string(interval.last_ns) + " ns: must not end before it starts");
  }
  if (config_.image_choice == ImageChoice::kClosestToSweep &&
      scan.sweep_ns.size() != config_.cameras.size()) {
    throw DataError("scan with " + std::to_string(scan.sweep_ns.size()) +
                    " sweep times: must be one for each of the " +
                    std::to_string(config_.cameras.size()) + " cameras");
  }
  for (const std::optional<StampNs>& sweep_ns : scan.sweep_ns) {
    if (sweep_ns && !isStamp(*sweep_ns)) {
      throw DataError("sweep time " + std::to_string(*sweep_ns) + " ns: is no time");
    }
  }

  if (scans_.count(interval.first_ns) > 0) {
    ++counters_.scans_duplicate;
    return;
  }
  ++counters_.scans;
  room_.observe(interval.first_ns);
  if (forgotten_ns_ && interval.first_ns <= *forgotten_ns_) {
    decisions_.dropped.push_back({interval.first_ns, DropReason::kTooOld});
    ++counters_.scans_dropped_old;
    return;
  }
  scans_.insert(interval.first_ns);
  while (scans_.size() > std::max(kLeastKnownScans, 2 * room_.capacity())) {
    forgotten_ns_ = *scans_.begin();
    scans_.erase(scans_.begin());
  }

  PendingScan pending;
  pending.scan = scan;
  pending.added_ns = now_ns;
  pending.settled.resize(config_.cameras.size(), false);
  const auto later = std::find_if(pending_.begin(), pending_.end(), [&](const PendingScan& other) {
    return other.scan.interval.first_ns > interval.first_ns;
  });
  pending_.insert(later, std::move(pending));
  settleAll(now_ns, Waiting::kAsConfigured);
  makeRoom();
}

void ScanSelector::setTimeOffset(int camera, StampNs offset_ns) {
  if (camera < 0 || camera >= static_cast<int>(cameras_.size()) ||
      distance(offset_ns, 0) > kMaxOffsetNs) {
    throw DataError("time offset " + std::to_string(offset_ns) + " ns of camera " +
                    std::to_string(camera) + ": no such camera, or no such offset");
  }
  const auto index = static_cast<std::size_t>(camera);
  const StampNs shift_ns = offset_ns - config_.cameras[index].time_offset_ns;
  if (shift_ns == 0) return;
  config_.cameras[index].time_offset_ns = offset_ns;
  std::set<StampNs> shifted;
  for (const StampNs image : cameras_[index].images) shifted.insert(image + shift_ns);
  cameras_[index].images.swap(shifted);
}

void ScanSelector::addImage(int camera, StampNs stamp) {
  if (camera < 0 || camera >= static_cast<int>(cameras_.size())) {
    throw DataError("image of camera " + std::to_string(camera) + ": there are " +
                    std::to_string(cameras_.size()) + " cameras");
  }
  if (!isStamp(stamp)) throw DataError("image stamp " + std::to_string(stamp) + " ns: is no time");
  CameraState& state = cameras_[static_cast<std::size_t>(camera)];
  std::set<StampNs>& images = state.images;
  const StampNs time_ns = stamp + config_.cameras[static_cast<std::size_t>(camera)].time_offset_ns;

  if (!images.insert(time_ns).second) {
    ++counters_.images_duplicate;
    return;
  }
  ++counters_.images;
  bool late = false;
  for (Settled& settled : state.settled) {
    const StampNs difference_ns = distance(time_ns, settled.target_ns);
    late = late || difference_ns < settled.difference_ns;
    settled.difference_ns = std::min(settled.difference_ns, difference_ns);
  }
  if (late) ++counters_.images_late;
  forgetOldImages(&images);
}

void ScanSelector::forgetOldImages(std::set<StampNs>* images) const {
  // One wild stamp ahead of the scans must not take the place of all others.
  StampNs newest_ns = *images->rbegin();
  if (!scans_.empty()) newest_ns = std::min(newest_ns, *scans_.rbegin());
  while (images->size() > kMaxImages || *images->begin() < newest_ns - config_.image_history_ns) {
    images->erase(images->begin());
  }
}

SelectorDecisions ScanSelector::advance(StampNs now_ns) {
  settleAll(now_ns, Waiting::kAsConfigured);
  return takeDecisions();
}

SelectorDecisions ScanSelector::finish() {
  settleAll(0, Waiting::kNoLonger);
  return takeDecisions();
}

void ScanSelector::reset() {
  for (const PendingScan& pending : pending_) {
    decisions_.dropped.push_back({pending.scan.interval.first_ns, DropReason::kNewEpoch});
  }
  counters_.scans_dropped_epoch += pending_.size();
  pending_.clear();
  scans_.clear();
  forgotten_ns_.reset();
  for (CameraState& state : cameras_) state = CameraState();
}

void ScanSelector::makeRoom() {
  const std::size_t most = std::max(config_.max_pending_scans, room_.capacity());
  while (pending_.size() > most) {
    PendingScan& oldest = pending_.front();
    if (oldest.reference_ns) {
      // Others work on this scan already: it must not stay without an answer.
      settleScan(&oldest, oldest.added_ns, Waiting::kNoLonger);
    } else {
      decisions_.dropped.push_back({oldest.scan.interval.first_ns, DropReason::kQueueFull});
      ++counters_.scans_dropped_pending;
    }
    pending_.pop_front();
  }
}

void ScanSelector::settleAll(StampNs now_ns, Waiting waiting) {
  for (auto pending = pending_.begin(); pending != pending_.end();) {
    pending = settleScan(&*pending, now_ns, waiting) ? pending_.erase(pending) : pending + 1;
  }
}

bool ScanSelector::settleScan(PendingScan* pending, StampNs now_ns, Waiting waiting) {
  // A clock that went back must not make a scan wait for ever.
  pending->added_ns = std::min(pending->added_ns, now_ns);
  const StampNs waited_ns = now_ns - pending->added_ns;
  if (!pending->reference_ns) settleReference(pending, waited_ns, waiting);
  if (!pending->reference_ns) return false;
  for (int camera = 0; camera < static_cast<int>(cameras_.size()); ++camera) {
    if (!pending->settled[static_cast<std::size_t>(camera)]) {
      settleCamera(pending, camera, waited_ns, waiting);
    }
  }
  return std::find(pending->settled.begin(), pending->settled.end(), false) ==
         pending->settled.end();
}

void ScanSelector::settleReference(PendingScan* pending, StampNs waited_ns, Waiting waiting) {
  const ScanInterval& interval = pending->scan.interval;
  ReferenceDecision decision;
  decision.scan_ns = interval.first_ns;
  decision.reference_ns = interval.middleNs();
  if (config_.choose == ReferenceChoice::kScanStart) {
    decision.reference_ns = interval.first_ns;
  } else if (config_.choose == ReferenceChoice::kScanEnd) {
    decision.reference_ns = interval.last_ns;
  } else if (config_.choose == ReferenceChoice::kClosestImage && !cameras_.empty()) {
    const auto camera = static_cast<std::size_t>(config_.reference_camera);
    const std::set<StampNs>& images = cameras_[camera].images;
    const StampNs target_ns = interval.middleNs();
    const bool timed_out = waited_ns >= config_.reference_timeout_ns;
    if (waiting == Waiting::kAsConfigured && !timed_out &&
        !isDecided(images, target_ns, config_.cameras[camera].reorder_window_ns)) {
      return;
    }
    const std::optional<StampNs> image_ns = closest(images, target_ns);
    if (image_ns && distance(*image_ns, target_ns) <= config_.reference_timeout_ns) {
      decision.reference_ns = *image_ns;
      remember(config_.reference_camera, target_ns, distance(*image_ns, target_ns));
    } else {
      decision.timed_out = true;
      ++counters_.reference_timeouts;
      remember(config_.reference_camera, target_ns, config_.reference_timeout_ns + 1);
    }
  }
  pending->reference_ns = decision.reference_ns;
  decisions_.references.push_back(decision);
}

void ScanSelector::settleCamera(PendingScan* pending, int camera, StampNs waited_ns,
                                Waiting waiting) {
  const auto index = static_cast<std::size_t>(camera);
  const SelectorCamera& config = config_.cameras[index];
  const std::set<StampNs>& images = cameras_[index].images;
  const StampNs target_ns = config_.image_choice == ImageChoice::kClosestToSweep
                                ? pending->scan.sweep_ns[index].value_or(*pending->reference_ns)
                                : *pending->reference_ns;
  if (waiting == Waiting::kAsConfigured && waited_ns < config.timeout_ns &&
      !isDecided(images, target_ns, config.reorder_window_ns)) {
    return;
  }
  SelectionDecision decision;
  decision.scan_ns = pending->scan.interval.first_ns;
  decision.camera = camera;
  decision.timed_out = !reaches(images, target_ns);
  const std::optional<StampNs> image_ns = closest(images, target_ns);
  if (image_ns && distance(*image_ns, target_ns) <= config.max_time_difference_ns) {
    decision.image_stamp = *image_ns - config.time_offset_ns;
    remember(camera, target_ns, distance(*image_ns, target_ns));
  } else {
    ++counters_.camera_none[index];
    remember(camera, target_ns, config.max_time_difference_ns + 1);
  }
  if (decision.timed_out) ++counters_.camera_timeouts[index];
  pending->settled[index] = true;
  decisions_.selections.push_back(decision);
}

void ScanSelector::remember(int camera, StampNs target_ns, StampNs difference_ns) {
  std::deque<Settled>& settled = cameras_[static_cast<std::size_t>(camera)].settled;
  settled.push_back({target_ns, difference_ns});
  if (settled.size() > kMaxSettled) settled.pop_front();
}

SelectorDecisions ScanSelector::takeDecisions() {
  SelectorDecisions decisions;
  std::swap(decisions, decisions_);
  // Additions may have settled scans in several steps.
  std::stable_sort(
      decisions.references.begin(), decisions.references.end(),
      [](const ReferenceDecision& a, const ReferenceDecision& b) { return a.scan_ns < b.scan_ns; });
  std::stable_sort(decisions.selections.begin(), decisions.selections.end(),
                   [](const SelectionDecision& a, const SelectionDecision& b) {
                     return std::tie(a.scan_ns, a.camera) < std::tie(b.scan_ns, b.camera);
                   });
  return decisions;
}

}  // namespace semantic_lidar_fusion

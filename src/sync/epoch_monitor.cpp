// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/sync/epoch_monitor.h"

#include <algorithm>

namespace semantic_lidar_fusion {

constexpr StampNs EpochMonitor::kBackwardNs;
constexpr StampNs EpochMonitor::kForwardNs;

StampVerdict EpochMonitor::observe(const std::string& source_name, StampNs stamp) {
  Source& source = sources_[source_name];
  const bool seen_in_epoch = source.epoch == epoch_ && epoch_ > 0;
  const auto accept = [&](StampVerdict verdict) {
    newest_ = verdict == StampVerdict::kNewEpoch ? stamp : std::max(newest_, stamp);
    source.newest =
        seen_in_epoch && verdict == StampVerdict::kCurrent ? std::max(source.newest, stamp) : stamp;
    source.epoch = epoch_;
    return verdict;
  };
  if (epoch_ == 0) {
    epoch_ = 1;
    newest_ = newest_before_ = stamp;
    return accept(StampVerdict::kCurrent);
  }
  if (stamp < newest_ - kBackwardNs) {
    // A source that has always lagged does not jump; one that goes back behind itself does.
    const bool went_back = seen_in_epoch && stamp < source.newest - kBackwardNs;
    if (!went_back) return accept(StampVerdict::kCurrent);
    newest_before_ = newest_;
    ++epoch_;
    return accept(StampVerdict::kNewEpoch);
  }
  if (stamp > newest_ + kForwardNs) {
    const bool straggler = epoch_ > 1 && !seen_in_epoch && stamp <= newest_before_ + kBackwardNs;
    if (straggler) return StampVerdict::kStale;
    newest_before_ = newest_;
    ++epoch_;
    return accept(StampVerdict::kNewEpoch);
  }
  return accept(StampVerdict::kCurrent);
}

}  // namespace semantic_lidar_fusion

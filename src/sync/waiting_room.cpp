// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/sync/waiting_room.h"

#include <algorithm>
#include <vector>

namespace semantic_lidar_fusion {
namespace {

constexpr std::size_t kMeasuredGaps = 16;
constexpr StampNs kLongestPeriodNs = kNsPerSecond / 20;
constexpr StampNs kShortestPeriodNs = kNsPerSecond / 4000;
/// Scans come with jitter: a quarter more of them than their rate says.
constexpr StampNs kMarginParts = 4;

}  // namespace

std::size_t scansThatWait(StampNs longest_ns, StampNs period_ns) {
  constexpr StampNs kLeast = 4, kMost = 4096;
  const StampNs meanwhile = (longest_ns + period_ns - 1) / period_ns + 1;
  return static_cast<std::size_t>(std::clamp(meanwhile, kLeast, kMost));
}

void WaitingRoom::observe(StampNs stamp) {
  const StampNs gap_ns = stamp - last_ns_;
  last_ns_ = stamp;
  if (gap_ns <= 0) return;
  gaps_ns_.push_back(gap_ns);
  if (gaps_ns_.size() > kMeasuredGaps) gaps_ns_.pop_front();
  std::vector<StampNs> sorted(gaps_ns_.begin(), gaps_ns_.end());
  const auto middle = sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2);
  std::nth_element(sorted.begin(), middle, sorted.end());
  const StampNs measured_ns = *middle - *middle / kMarginParts;
  period_ns_ = std::clamp(measured_ns, kShortestPeriodNs, kLongestPeriodNs);
}

}  // namespace semantic_lidar_fusion

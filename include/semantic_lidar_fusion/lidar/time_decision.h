// SPDX-License-Identifier: MIT
/// How the times of a scan's points were understood.
#pragma once

#include <cstdint>
#include <string>

namespace semantic_lidar_fusion {

enum class TimeUnit : std::uint8_t { kAuto, kSeconds, kMilliseconds, kMicroseconds, kNanoseconds };
/// What a time field counts from.
enum class TimeReference : std::uint8_t {
  kAuto,
  kStamp,     ///< the header stamp
  kAbsolute,  ///< the epoch
  kScanEnd,   ///< the header stamp is the scan's end: times up to 0 count from it, of others the
              ///< latest point takes it
};

/// The same for every scan of one driver.
struct TimeDecision {
  std::string field;  ///< of a PointCloud2; empty: no time field
  TimeUnit unit = TimeUnit::kAuto;
  TimeReference reference = TimeReference::kAuto;
  bool instant = false;  ///< all points have one time
  bool warning = false;  ///< worth a warning: a guess, or times that no scan has
  std::string text;      ///< one line for a log, without figures of the single scan
};

}  // namespace semantic_lidar_fusion

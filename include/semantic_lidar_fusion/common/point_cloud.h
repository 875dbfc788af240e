// SPDX-License-Identifier: MIT
/// Lidar clouds as structures of arrays; all arrays of one cloud have equal length.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

/// Points that share one pose lookup: one firing of all lasers, or the points of one distinct time.
struct Firing {
  StampNs begin_ns = 0;      ///< true time of its first point
  StampNs end_ns = 0;        ///< true time of its last point, >= begin_ns
  std::uint32_t packet = 0;  ///< index of the lidar packet; clouds without packets: own index
};

/// Finite points as measured: each in the lidar frame at the point's own time, in sensor order.
struct TimedCloud {
  std::string frame_id;  ///< the lidar frame
  StampNs header_stamp =
      0;  ///< raw stamp of the message; names an empty scan, never a point's time
  std::vector<float> x, y, z;         ///< m
  std::vector<float> intensity;       ///< as the sensor gives it; 0 if absent
  std::vector<std::uint16_t> ring;    ///< 0 = lowest laser; kNoRing if absent
  std::vector<StampNs> time_ns;       ///< true time of each point
  std::vector<std::uint32_t> firing;  ///< index into `firings`
  std::vector<Firing> firings;
  /// True time of each packet's first firing, whether it returned anything or not, by
  /// Firing::packet; empty for clouds without packets.
  std::vector<StampNs> packet_begin_ns;

  std::size_t size() const { return x.size(); }
  bool empty() const { return x.empty(); }
  void reserve(std::size_t points);
};

/// Earliest and latest true time of a cloud's points.
struct ScanInterval {
  StampNs first_ns = 0;
  StampNs last_ns = 0;
  /// (first + last) / 2 in integer ns, rounded down.
  StampNs middleNs() const { return first_ns + (last_ns - first_ns) / 2; }
};

/// Interval of a cloud; an empty cloud gives its header stamp twice.
ScanInterval scanInterval(const TimedCloud& cloud);

/// Rigid cloud: every point as seen from the lidar's pose at `stamp` (paper, eq. 5), except points
/// with status kNoOdometry, which stay as measured.
struct Cloud {
  std::string frame_id;
  StampNs stamp = 0;           ///< t_ref, true time
  StampNs first_point_ns = 0;  ///< earliest true time of the points; the key of the scan
  std::vector<float> x, y, z;  ///< m
  std::vector<float> intensity;
  std::vector<std::uint16_t> ring;   ///< 0 = lowest laser; kNoRing if absent
  std::vector<float> dt;             ///< s, true time of measurement minus `stamp`
  std::vector<std::uint8_t> status;  ///< PointStatus: kFused (no decision yet) or kNoOdometry

  std::size_t size() const { return x.size(); }
  bool empty() const { return x.empty(); }
  void resize(std::size_t points);
};

/// How many points have each PointStatus, by its value; a value that is none counts as the last.
std::array<std::uint64_t, kPointStatusNames.size()> countByStatus(const Cloud& cloud);

/// A rigid cloud with what the cameras say of each point.
struct SemanticCloud {
  Cloud points;  ///< with the final `status`
  int class_count = 0;
  std::vector<std::uint8_t> label;     ///< most likely class id, kNoLabel = none
  std::vector<float> confidence;       ///< probability of `label`; 0 unless fused
  std::vector<float> entropy;          ///< H / ln(class_count), 0..1; 1 unless fused
  std::vector<std::uint16_t> cameras;  ///< bit i: the i-th camera of the rig contributed
  std::vector<float> probabilities;    ///< size() x class_count, row-major; 0 unless fused

  std::size_t size() const { return points.size(); }
};

}  // namespace semantic_lidar_fusion

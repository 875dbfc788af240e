// SPDX-License-Identifier: MIT
/// Velodyne packets to points, each with the time and the azimuth of its own laser.
///
/// x = d cos(el) cos(az), y = -d cos(el) sin(az), z = d sin(el): x forward, y left, z up. Azimuth
/// between two blocks is linear in time; behind the last block, and before a part of the turn that
/// the sensor leaves out, the previous difference goes on.
///
/// A packet's time is its stamp while the stamps keep step with the packets' own clock (us since
/// the hour) to 50 us. Else (equal or coarse stamps, the jitter of a busy host) the clock tells the
/// times within the scan, and the stamps only where the scan lies.
#pragma once

#include <cstddef>
#include <map>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/lidar/lidar_spec.h"
#include "semantic_lidar_fusion/lidar/packet.h"
#include "semantic_lidar_fusion/lidar/time_decision.h"

namespace semantic_lidar_fusion {

struct PacketDecoderConfig {
  /// Null: the packets' factory byte decides. Set: packets without a return mode byte are read too,
  /// in the mode that their blocks tell. It must outlive the decoder.
  const LidarSpec* model = nullptr;
  /// kStart: the begin of the packet's first firing; kEnd: one firing period after the begin of its
  /// last; kMiddle: half-way.
  PacketStamp packet_stamp = PacketStamp::kStart;
  StampNs time_offset_ns = 0;  ///< true time = stamp + this
  double min_range_m = 0.0;    ///< nearer points do not come out; 0 = no limit
  double max_range_m = 0.0;    ///< farther points do not come out; 0 = no limit
  /// Packets farther than this from the scan's middle one are of another clock.
  StampNs longest_scan_ns = kNsPerSecond;
  /// Added to z, per ring, lowest first; empty = none.
  std::vector<double> vertical_offsets_m;
};

struct PacketCounters {
  std::size_t packets = 0;            ///< all that were given
  std::size_t duplicate_packets = 0;  ///< dropped: equal stamp and equal bytes
  std::size_t zero_packets = 0;       ///< skipped: all bytes zero
  std::size_t outlier_packets = 0;    ///< dropped: a stamp far from those of the others
  std::size_t bad_blocks = 0;         ///< skipped: flag is not 0xFFEE, or azimuth >= 360 deg
  std::size_t out_of_range_points = 0;
  std::size_t equal_returns = 0;  ///< second returns dropped as equal to the first
  /// Packets of unknown kind, by the reason, which names the byte.
  std::map<std::string, std::size_t> unknown_packets;
};

struct DecodedScan {
  TimedCloud cloud;
  TimeDecision time;
  PacketCounters counters;
};

class PacketDecoder {
 public:
  /// Throws ConfigError (range limits, count of vertical offsets).
  explicit PacketDecoder(PacketDecoderConfig config);

  /// One scan to one cloud; the packets may be in any order. Points: by packet (in order of
  /// stamps), block, firing, laser. Nothing throws: broken packets are counted.
  /// @param header_stamp raw stamp of the scan's message, kept as a name for an empty scan only
  DecodedScan decode(const std::vector<Packet>& packets, StampNs header_stamp,
                     const std::string& frame_id) const;

 private:
  PacketDecoderConfig config_;
};

}  // namespace semantic_lidar_fusion

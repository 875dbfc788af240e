// SPDX-License-Identifier: MIT
/// The time of each packet of a scan.
#pragma once

#include <cstddef>
#include <vector>

#include "semantic_lidar_fusion/lidar/packet.h"
#include "semantic_lidar_fusion/lidar/time_decision.h"

namespace semantic_lidar_fusion {

struct StampedPacket {
  const Packet* packet = nullptr;
  StampNs stamp = 0;  ///< of the moment that the packet's own stamp tells
};

struct PacketTimes {
  std::vector<StampedPacket> packets;  ///< in order of time
  std::size_t outliers = 0;            ///< left out
  TimeDecision decision;
};

/// @param packets in order of their stamps, those of one stamp as they came; without duplicates
PacketTimes packetTimes(const std::vector<const Packet*>& packets, StampNs longest_scan_ns);

}  // namespace semantic_lidar_fusion

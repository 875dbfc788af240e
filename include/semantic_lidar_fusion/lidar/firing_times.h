// SPDX-License-Identifier: MIT
/// When and where to each laser of a sensor fires.
///
/// From the manuals (VLP-16 63-9243: timing in 9.4, angles in table 9-1; VLP-32C 63-9325: table
/// 9-2, timing in 9.4, azimuth offsets in 9.5; HDL-32E 63-9113: firing order). In dual return mode
/// the two blocks of a pair tell the same firings and share their times.
#pragma once

#include <array>
#include <cstdint>
#include <string>

#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/lidar/packet.h"

namespace semantic_lidar_fusion {

constexpr int kBlocksPerPacket = 12;
constexpr int kReturnsPerBlock = 32;

/// One laser, in the order of a block's data.
struct Laser {
  double elevation_rad = 0.0;
  double azimuth_offset_rad = 0.0;  ///< added to the azimuth of the moment it fires
  StampNs time_ns = 0;              ///< after the begin of the firing
  std::uint16_t ring = 0;           ///< 0 = lowest elevation
};

struct FiringTimes {
  std::string model_name;  ///< as the rig file writes it
  int laser_count = 0;
  int firings_per_block = 0;
  StampNs firing_ns = 0;           ///< from the begin of one firing to the begin of the next
  double distance_unit_m = 0.0;    ///< of the raw distances
  std::array<Laser, 32> lasers{};  ///< the first laser_count are valid

  StampNs blockNs() const { return firings_per_block * firing_ns; }
  /// From the first firing of a packet to the first firing of the next.
  StampNs packetNs(bool dual_return) const {
    return blockNs() * (dual_return ? kBlocksPerPacket / 2 : kBlocksPerPacket);
  }
};

const FiringTimes& firingTimes(LidarModel model);

}  // namespace semantic_lidar_fusion

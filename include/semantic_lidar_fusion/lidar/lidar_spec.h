// SPDX-License-Identifier: MIT
/// What is known of each lidar model that packets are decoded for: one row a model, and nothing
/// about models anywhere else.
///
/// From the manuals (VLP-16 63-9243: timing in 9.4, angles in table 9-1; VLP-32C 63-9325: table
/// 9-2, timing in 9.4, azimuth offsets in 9.5; HDL-32E 63-9113: firing order; VLS-128 63-9483:
/// angles and azimuth offsets in table 9-2, timing in 9.4).
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

constexpr int kBlocksPerPacket = 12;
constexpr int kReturnsPerBlock = 32;
/// Blocks that may tell one firing together: 4 x 32 lasers.
constexpr int kMostBanks = 4;

/// One laser, in the order of a firing's data.
struct Laser {
  double elevation_rad = 0.0;
  double azimuth_offset_rad = 0.0;  ///< added to the azimuth of the moment it fires
  StampNs time_ns = 0;              ///< after the begin of the firing
  std::uint16_t ring = 0;           ///< 0 = lowest elevation
};

/// A slot is the part of a packet that one azimuth is told for: a block of 32 returns, or as many
/// blocks as a firing of more lasers takes (banks); twice as many in dual return mode, where two
/// blocks tell the same firings and share their times.
struct LidarSpec {
  std::string name;                  ///< as the rig file writes it
  std::vector<std::string> aliases;  ///< case, blanks, - and _ do not count
  std::uint8_t factory_byte = 0;     ///< the last byte of its packets
  double distance_unit_m = 0.0;      ///< of the raw distances
  StampNs firing_ns = 0;             ///< from the begin of one firing to the begin of the next
  /// The first two bytes of the blocks of a slot (little-endian), bank by bank; 1 to kMostBanks.
  std::vector<std::uint16_t> bank_flags;
  /// As many as divide kReturnsPerBlock, or kReturnsPerBlock for each bank; see makeLidarSpec.
  std::vector<Laser> lasers;

  int laserCount() const { return static_cast<int>(lasers.size()); }
  int bankCount() const { return static_cast<int>(bank_flags.size()); }
  int firingsPerSlot() const { return kReturnsPerBlock * bankCount() / laserCount(); }
  int blocksPerSlot(bool dual_return) const { return bankCount() * (dual_return ? 2 : 1); }
  /// Blocks that fill no slot are not used.
  int slotsPerPacket(bool dual_return) const {
    return kBlocksPerPacket / blocksPerSlot(dual_return);
  }
  StampNs slotNs() const { return firingsPerSlot() * firing_ns; }
  /// From the first firing of a packet to the first firing of the next.
  StampNs packetNs(bool dual_return) const { return slotsPerPacket(dual_return) * slotNs(); }
};

/// Completes a row: numbers the rings from the lowest laser up. Throws ConfigError if the lasers
/// and banks do not fill whole blocks.
LidarSpec makeLidarSpec(LidarSpec row);

/// All models.
const std::vector<LidarSpec>& lidarSpecs();

/// The row of a name or alias; null if there is none.
const LidarSpec* findLidarSpec(const std::string& name,
                               const std::vector<LidarSpec>& specs = lidarSpecs());
/// The row of a factory byte; null if there is none.
const LidarSpec* findLidarSpec(std::uint8_t factory_byte,
                               const std::vector<LidarSpec>& specs = lidarSpecs());
/// "VLP16, PuckHiRes, ...", for messages.
std::string lidarSpecNames(const std::vector<LidarSpec>& specs = lidarSpecs());

}  // namespace semantic_lidar_fusion

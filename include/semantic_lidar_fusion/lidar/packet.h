// SPDX-License-Identifier: MIT
/// Raw Velodyne data packets (VLP-16 user manual 63-9243, VLP-32C 63-9325, HDL-32E 63-9113): 12
/// blocks of (flag 0xFFEE, azimuth in 0.01 deg, 32 x (distance u16, intensity u8)), a time stamp in
/// us since the hour, the return mode and the product id.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

constexpr std::size_t kPacketBytes = 1206;

struct Packet {
  StampNs stamp = 0;  ///< raw stamp of the packet's message
  std::array<std::uint8_t, kPacketBytes> data{};
};

/// Which moment of a packet its stamp tells.
enum class PacketStamp : std::uint8_t { kStart, kMiddle, kEnd };

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// A VLP-16 on the moving vehicle: every shot from the sensor's pose at its own time.
#pragma once

#include <cstdint>
#include <vector>

#include "semantic_lidar_fusion/lidar/packet.h"
#include "tools/simulate_drive/drive_path.h"
#include "tools/simulate_drive/world.h"

namespace semantic_lidar_fusion {
namespace simulator {

constexpr double kLidarTurnsPerS = 10.0;

struct LidarOptions {
  std::uint64_t seed = 1;
  StampNs start_ns = 0;  ///< stamp of time 0
  Transform T_base_lidar = Transform::Identity();
  bool range_noise = true;
  int threads = 2;
};

/// The truth of one return.
struct Echo {
  StampNs time_ns = 0;
  int object = -1;
  Class kind = Class::kUnlabeled;
  std::uint32_t surface = 0;
  Eigen::Vector3d p_object;  ///< the point hit, in the object's coordinates
  Eigen::Vector3d p_lidar;   ///< the point hit, in the lidar's frame at its time, without noise
};

struct SimulatedScan {
  std::vector<Packet> packets;  ///< stamped with the begin of their first firing
  std::vector<Echo> echoes;     ///< in the order of the packets' data, zero ranges left out
};

/// Packets `first` to `last` - 1 of the drive; number 0 begins at time 0, at the back. Sets the
/// world's sweep.
SimulatedScan simulateScan(const DrivePath& path, const LidarOptions& options, int first, int last,
                           World* world);
/// First packet of scan `index`: a scan is a turn, in whole packets.
int firstPacketOfScan(int index);
/// From one packet to the next.
StampNs packetPeriodNs();

}  // namespace simulator
}  // namespace semantic_lidar_fusion

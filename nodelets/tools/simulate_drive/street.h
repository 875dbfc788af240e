// SPDX-License-Identifier: MIT
/// A street along a drive: a seeded choice of what stands and moves where.
#pragma once

#include <cstdint>

#include "tools/simulate_drive/drive_path.h"
#include "tools/simulate_drive/world.h"

namespace semantic_lidar_fusion {
namespace simulator {

struct StreetOptions {
  std::uint64_t seed = 1;
  bool moving = true;  ///< false: everything but the vehicle stands still
};

/// Fills an empty world and finishes it. The road has one lane a direction (traffic keeps left),
/// parking lanes, kerbs, footpaths and houses on both sides.
void buildStreet(const DrivePath& path, const StreetOptions& options, World* world);

}  // namespace simulator
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Occupied and free voxels as OctoMap files.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>

namespace semantic_lidar_fusion {

/// Whether liboctomap was there when this was compiled.
bool hasOctomap();

/// Voxel indices (x, y, z each) of an octree: voxel i spans [i, i + 1) edge lengths.
struct OctomapVoxels {
  const std::int64_t* indices = nullptr;
  std::size_t count = 0;
};

/// Writes occupied voxels of edge length `size_m` with their colours (`rgb`, 3 values each) and
/// free ones as a ColorOcTree (.ot) and, without colours, as a binary tree (.bt); of a voxel that
/// is both, occupied holds. Throws DataError if a voxel lies beyond the 32768 voxels that OctoMap's
/// keys reach, if a file cannot be written, or without liboctomap.
void writeOctomap(const OctomapVoxels& occupied, const std::uint8_t* rgb, const OctomapVoxels& free,
                  double size_m, const std::string& color_path, const std::string& binary_path);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Occupied voxels as OctoMap files.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>

namespace semantic_lidar_fusion {

/// Whether liboctomap was there when this was compiled.
bool hasOctomap();

/// Writes `count` occupied voxels of edge length `size_m` (centres `xyz`, colours `rgb`, 3 values
/// each) as a ColorOcTree (.ot) and, without colours, as a binary tree (.bt). Throws DataError
/// if a voxel lies beyond the 32768 voxels that OctoMap's keys reach, if a file cannot be written,
/// or without liboctomap.
void writeOctomap(const double* xyz, const std::uint8_t* rgb, std::size_t count, double size_m,
                  const std::string& color_path, const std::string& binary_path);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#pragma once

#include <vector>

namespace semantic_lidar_fusion {

/// Along one axis, the cell of a grid of `target_count` cells under the centre of each of
/// `source_count` cells: cellUnderCentre as a table, made without divisions.
std::vector<int> cellsUnderCentres(int source_count, int target_count);

}  // namespace semantic_lidar_fusion

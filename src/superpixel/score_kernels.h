// SPDX-License-Identifier: MIT
/// The inner loop over score cells, plain and for wider registers (see slic_kernels.h for why the
/// wide one has a file of its own).
#pragma once

#include <cstdint>

namespace semantic_lidar_fusion {

/// Label of a cell with a non-finite score.
constexpr int kNoVote = -1;

/// labels[i] = index of the highest of the `class_count` scores from scores[i * class_count], the
/// lowest index of equal ones; kNoVote if one of them is not finite.
using LabelCells = void (*)(const float* scores, int cell_count, int class_count, int* labels);

void labelCellsPlain(const float* scores, int cell_count, int class_count, int* labels);
void labelCellsAvx2(const float* scores, int cell_count, int class_count, int* labels);

/// The fastest that the machine has.
LabelCells labelCells();

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The inner loops over score cells and superpixel ids, plain and for wider registers (see
/// slic_kernels.h for why the wide ones have a file of their own).
#pragma once

#include <cstdint>

namespace semantic_lidar_fusion {

/// Label of a cell with a non-finite score.
constexpr int kNoVote = -1;

struct ScoreKernels {
  const char* name;

  /// labels[i] = class of the highest of the `class_count` scores of cell cells[i] of a row, the
  /// lowest class of equal ones; kNoVote if one of them is not finite.
  void (*labelFloats)(const float* row, const int* cells, int cell_count, int class_count,
                      int* labels);
  /// The same for integer scores. `flip`: each score counts as score ^ flip, so that all ones make
  /// the lowest score win.
  void (*labelBytes)(const std::uint8_t* row, const int* cells, int cell_count, int class_count,
                     std::uint8_t flip, int* labels);
  void (*labelWords)(const std::uint16_t* row, const int* cells, int cell_count, int class_count,
                     std::uint16_t flip, int* labels);

  /// Writes each place x in 0..count - 1 at which ids[x] or labels[x] differs from its left
  /// neighbour, place 0 included, to `starts`, which has room for count + 8. Returns their number.
  int (*segmentStarts)(const int* ids, const int* labels, int count, int* starts);
};

extern const ScoreKernels kPlainScoreKernels;
extern const ScoreKernels kAvx2ScoreKernels;  ///< where SLF_HAVE_AVX2

/// The fastest that the machine has.
const ScoreKernels& scoreKernels();

}  // namespace semantic_lidar_fusion

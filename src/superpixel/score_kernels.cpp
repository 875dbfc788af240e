// SPDX-License-Identifier: MIT
#include "score_kernels.h"

#include <cmath>

namespace semantic_lidar_fusion {

void labelCellsPlain(const float* scores, int cell_count, int class_count, int* labels) {
  for (int i = 0; i < cell_count; ++i, scores += class_count) {
    float highest = scores[0];
    int label = 0;
    bool finite = std::isfinite(scores[0]);
    for (int c = 1; c < class_count; ++c) {
      // Without branches: which class is the highest is hard to foretell.
      const bool higher = scores[c] > highest;
      highest = higher ? scores[c] : highest;
      label = higher ? c : label;
      finite &= std::isfinite(scores[c]);
    }
    labels[i] = finite ? label : kNoVote;
  }
}

LabelCells labelCells() {
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) return labelCellsAvx2;
#endif
  return labelCellsPlain;
}

}  // namespace semantic_lidar_fusion

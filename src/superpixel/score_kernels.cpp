// SPDX-License-Identifier: MIT
#include "score_kernels.h"

#include <cmath>
#include <cstddef>

namespace semantic_lidar_fusion {
namespace {

void labelFloats(const float* row, const int* cells, int cell_count, int class_count, int* labels) {
  for (int i = 0; i < cell_count; ++i) {
    const float* scores = row + static_cast<std::ptrdiff_t>(cells[i]) * class_count;
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

template <typename Score>
void labelIntegers(const Score* row, const int* cells, int cell_count, int class_count, Score flip,
                   int* labels) {
  for (int i = 0; i < cell_count; ++i) {
    const Score* scores = row + static_cast<std::ptrdiff_t>(cells[i]) * class_count;
    int highest = scores[0] ^ flip, label = 0;
    for (int c = 1; c < class_count; ++c) {
      const int score = scores[c] ^ flip;
      const bool higher = score > highest;
      highest = higher ? score : highest;
      label = higher ? c : label;
    }
    labels[i] = label;
  }
}

int segmentStarts(const int* ids, const int* labels, int count, int* starts) {
  int found = 0;
  for (int x = 0; x < count; ++x) {
    starts[found] = x;
    found += x == 0 || ids[x] != ids[x - 1] || labels[x] != labels[x - 1];
  }
  return found;
}

}  // namespace

const ScoreKernels kPlainScoreKernels = {"plain", labelFloats, labelIntegers<std::uint8_t>,
                                         labelIntegers<std::uint16_t>, segmentStarts};

const ScoreKernels& scoreKernels() {
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) return kAvx2ScoreKernels;
#endif
  return kPlainScoreKernels;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
// Compiled with AVX2 enabled: includes and uses nothing that could be emitted as a shared inline
// function (see slic_kernels.h).
#include <immintrin.h>

#include "score_kernels.h"

namespace semantic_lidar_fusion {
namespace {

/// The highest of all lanes, in each.
inline __m256 highestLane(__m256 v) {
  v = _mm256_max_ps(v, _mm256_permute2f128_ps(v, v, 1));
  v = _mm256_max_ps(v, _mm256_permute_ps(v, 0x4e));
  return _mm256_max_ps(v, _mm256_permute_ps(v, 0xb1));
}

/// 8 to 16 classes: two registers that overlap.
inline int labelOfTwo(const float* cell, int class_count) {
  const __m256 infinity = _mm256_set1_ps(__builtin_inff());
  const __m256 magnitude = _mm256_castsi256_ps(_mm256_set1_epi32(0x7fffffff));
  const __m256 low = _mm256_loadu_ps(cell), high = _mm256_loadu_ps(cell + class_count - 8);
  const __m256 finite =
      _mm256_and_ps(_mm256_cmp_ps(_mm256_and_ps(low, magnitude), infinity, _CMP_LT_OQ),
                    _mm256_cmp_ps(_mm256_and_ps(high, magnitude), infinity, _CMP_LT_OQ));
  const __m256 highest = highestLane(_mm256_max_ps(low, high));
  const unsigned is_low =
      static_cast<unsigned>(_mm256_movemask_ps(_mm256_cmp_ps(low, highest, _CMP_EQ_OQ)));
  const unsigned is_high =
      static_cast<unsigned>(_mm256_movemask_ps(_mm256_cmp_ps(high, highest, _CMP_EQ_OQ)));
  const unsigned is_highest = is_low | is_high << (class_count - 8);
  // The guard bit keeps the count defined where NaN is equal to nothing.
  const int label = __builtin_ctz(is_highest | 1U << 16);
  return _mm256_movemask_ps(finite) == 0xff ? label : kNoVote;
}

}  // namespace

void labelCellsAvx2(const float* scores, int cell_count, int class_count, int* labels) {
  if (class_count < 8 || class_count > 16) {
    labelCellsPlain(scores, cell_count, class_count, labels);
    return;
  }
  for (int i = 0; i < cell_count; ++i)
    labels[i] = labelOfTwo(scores + static_cast<std::int64_t>(i) * class_count, class_count);
}

}  // namespace semantic_lidar_fusion

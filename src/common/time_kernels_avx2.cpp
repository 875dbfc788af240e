// SPDX-License-Identifier: MIT
// Compiled with AVX2 enabled: includes and uses nothing that could be emitted as a shared inline
// function (see superpixel/slic_kernels.h).
#include <immintrin.h>

#include "time_kernels.h"

namespace semantic_lidar_fusion {
namespace {

void span(const std::int64_t* times, int count, std::int64_t* first, std::int64_t* last) {
  if (count < 8) {
    kPlainTimeKernels.span(times, count, first, last);
    return;
  }
  const auto load = [times](int i) {
    return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(times + i));
  };
  __m256i low0 = load(0), high0 = low0, low1 = load(4), high1 = low1;
  const auto include = [](__m256i value, __m256i* low, __m256i* high) {
    *low = _mm256_blendv_epi8(*low, value, _mm256_cmpgt_epi64(*low, value));
    *high = _mm256_blendv_epi8(*high, value, _mm256_cmpgt_epi64(value, *high));
  };
  for (int i = 8; i + 8 <= count; i += 8) {
    include(load(i), &low0, &high0);
    include(load(i + 4), &low1, &high1);
  }
  // The last eight again, with what is left.
  include(load(count - 8), &low0, &high0);
  include(load(count - 4), &low1, &high1);
  std::int64_t ends[16];
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(ends), low0);
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(ends + 4), low1);
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(ends + 8), high0);
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(ends + 12), high1);
  kPlainTimeKernels.span(ends, 16, first, last);
}

}  // namespace

const TimeKernels kAvx2TimeKernels = {"avx2", span};

}  // namespace semantic_lidar_fusion

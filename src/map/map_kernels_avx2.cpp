// SPDX-License-Identifier: MIT
// Compiled with AVX2 enabled: includes and uses nothing that could be emitted as a shared inline
// function (see slic_kernels.h).
#include <immintrin.h>

#include "map_kernels.h"
#include "map_kernels_local.h"

namespace semantic_lidar_fusion {

void logEvidenceAvx2(const float* probabilities, std::size_t count,
                     const EvidenceConstants& constants, const std::int32_t* prior,
                     std::int32_t* evidence) {
  const __m256 floor = _mm256_set1_ps(constants.floor), one = _mm256_set1_ps(1.0f);
  const __m256 scale = _mm256_set1_ps(constants.scale), half = _mm256_set1_ps(0.5f);
  const __m256i octave = _mm256_set1_epi32(constants.octave);
  const __m256i root_half = _mm256_set1_epi32(kRootHalfBits);
  const __m256i significand = _mm256_set1_epi32(kSignificand);
  const __m256i rounding = _mm256_set1_epi32(1 << (kGuardBits - 1));
  std::size_t i = 0;
  for (; i + 8 <= count; i += 8) {
    // max and min return their second operand if one is NaN.
    const __m256 p = _mm256_min_ps(_mm256_max_ps(_mm256_loadu_ps(probabilities + i), floor), one);
    const __m256i above = _mm256_sub_epi32(_mm256_castps_si256(p), root_half);
    const __m256i exponent = _mm256_srai_epi32(above, 23);
    const __m256 f = _mm256_sub_ps(
        _mm256_castsi256_ps(_mm256_add_epi32(_mm256_and_si256(above, significand), root_half)),
        one);
    __m256 y = _mm256_set1_ps(kLog[8]);
    for (int k = 7; k >= 0; --k) y = _mm256_add_ps(_mm256_mul_ps(y, f), _mm256_set1_ps(kLog[k]));
    const __m256 square = _mm256_mul_ps(f, f);
    y = _mm256_mul_ps(_mm256_mul_ps(f, square), y);
    y = _mm256_sub_ps(y, _mm256_mul_ps(half, square));
    const __m256i fine = _mm256_cvttps_epi32(_mm256_mul_ps(_mm256_add_ps(f, y), scale));
    __m256i sum = _mm256_add_epi32(_mm256_mullo_epi32(exponent, octave), fine);
    sum = _mm256_sub_epi32(sum, _mm256_loadu_si256(reinterpret_cast<const __m256i*>(prior + i)));
    sum = _mm256_srai_epi32(_mm256_add_epi32(sum, rounding), kGuardBits);
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(evidence + i), sum);
  }
  logEvidencePlain(probabilities + i, count - i, constants, prior + i, evidence + i);
}

void countEvidenceAvx2(const float* probabilities, std::size_t count,
                       const EvidenceConstants& constants, const std::int32_t* prior,
                       std::int32_t* evidence) {
  const __m256 zero = _mm256_setzero_ps(), one = _mm256_set1_ps(1.0f);
  const __m256 scale = _mm256_set1_ps(constants.scale), half = _mm256_set1_ps(0.5f);
  std::size_t i = 0;
  for (; i + 8 <= count; i += 8) {
    const __m256 p = _mm256_min_ps(_mm256_max_ps(_mm256_loadu_ps(probabilities + i), zero), one);
    const __m256i rounded = _mm256_cvttps_epi32(_mm256_add_ps(_mm256_mul_ps(p, scale), half));
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(evidence + i), rounded);
  }
  countEvidencePlain(probabilities + i, count - i, constants, prior, evidence + i);
}

void addEvidenceAvx2(const std::int32_t* evidence, int class_count, std::int64_t* sums) {
  int c = 0;
  for (; c + 4 <= class_count; c += 4) {
    __m256i* const at = reinterpret_cast<__m256i*>(sums + c);
    const __m256i added =
        _mm256_cvtepi32_epi64(_mm_loadu_si128(reinterpret_cast<const __m128i*>(evidence + c)));
    _mm256_storeu_si256(at, _mm256_add_epi64(_mm256_loadu_si256(at), added));
  }
  for (; c < class_count; ++c) sums[c] += evidence[c];
}

void placePointsAvx2(const PlacementConstants& constants, PlacedPoints* points) {
  const __m256d size = _mm256_set1_pd(constants.voxel_size_m);
  const __m256d most = _mm256_set1_pd(kMaxIndex), least = _mm256_set1_pd(-kMaxIndex);
  const __m256d unit = _mm256_set1_pd(kPositionUnit), half = _mm256_set1_pd(0.5);
  for (int i = 0; i < PlacedPoints::kMaxPoints; i += 4) {
    const __m256d x = _mm256_cvtps_pd(_mm_loadu_ps(points->x + i));
    const __m256d y = _mm256_cvtps_pd(_mm_loadu_ps(points->y + i));
    const __m256d z = _mm256_cvtps_pd(_mm_loadu_ps(points->z + i));
    int inside = 15;
    for (int axis = 0; axis < 3; ++axis) {
      const double* const row = constants.rows[axis];
      __m256d at = _mm256_add_pd(_mm256_mul_pd(_mm256_set1_pd(row[0]), x),
                                 _mm256_mul_pd(_mm256_set1_pd(row[1]), y));
      at = _mm256_add_pd(at, _mm256_mul_pd(_mm256_set1_pd(row[2]), z));
      at = _mm256_add_pd(at, _mm256_set1_pd(row[3]));
      const __m256d cell = _mm256_div_pd(at, size);
      const __m256d near = _mm256_and_pd(_mm256_cmp_pd(cell, most, _CMP_LT_OQ),
                                         _mm256_cmp_pd(cell, least, _CMP_GT_OQ));
      inside &= _mm256_movemask_pd(near);
      const __m256d whole = _mm256_floor_pd(_mm256_and_pd(cell, near));
      const __m256d within =
          _mm256_add_pd(_mm256_mul_pd(_mm256_sub_pd(at, _mm256_mul_pd(whole, size)), unit), half);
      _mm_storeu_si128(reinterpret_cast<__m128i*>(points->index[axis] + i),
                       _mm256_cvttpd_epi32(whole));
      _mm_storeu_si128(reinterpret_cast<__m128i*>(points->offset[axis] + i),
                       _mm256_cvttpd_epi32(_mm256_and_pd(within, near)));
    }
    for (int k = 0; k < 4; ++k) points->inside[i + k] = static_cast<std::uint8_t>(inside >> k & 1);
  }
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
// Compiled with AVX2 enabled: includes and uses nothing that could be emitted as a shared inline
// function (see superpixel/slic_kernels.h).
#include <immintrin.h>

#include "motion_kernels.h"

namespace semantic_lidar_fusion {
namespace {

/// The differences of eight times to a reference, lower and upper halves apart.
struct Differences {
  __m256i low, high;
};

inline Differences differences(const std::int64_t* times, __m256i reference) {
  const auto four = [&](const std::int64_t* from) {
    return _mm256_castsi256_ps(
        _mm256_sub_epi64(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(from)), reference));
  };
  const __m256 a = four(times), b = four(times + 4);
  const auto inOrder = [](__m256 halves) {
    return _mm256_permute4x64_epi64(_mm256_castps_si256(halves), _MM_SHUFFLE(3, 1, 2, 0));
  };
  return {inOrder(_mm256_shuffle_ps(a, b, _MM_SHUFFLE(2, 0, 2, 0))),
          inOrder(_mm256_shuffle_ps(a, b, _MM_SHUFFLE(3, 1, 3, 1)))};
}

int timesWithin(const std::int64_t* times, int count, std::int64_t begin, std::uint32_t length,
                float* ns) {
  const __m256i first = _mm256_set1_epi64x(begin);
  const __m256i most = _mm256_set1_epi32(static_cast<int>(length));
  int i = 0;
  for (; i + 8 <= count; i += 8) {
    const Differences since = differences(times + i, first);
    // Both sides are positive where the upper half is 0, since `length` is below 2^31.
    const __m256i early = _mm256_cmpeq_epi32(_mm256_min_epu32(since.low, most), since.low);
    const __m256i within =
        _mm256_and_si256(early, _mm256_cmpeq_epi32(since.high, _mm256_setzero_si256()));
    _mm256_storeu_ps(ns + i, _mm256_cvtepi32_ps(since.low));
    const auto outside = ~static_cast<unsigned>(_mm256_movemask_ps(_mm256_castsi256_ps(within)));
    if ((outside & 0xFFU) != 0) return i + __builtin_ctz(outside);
  }
  return i + kPlainMotionKernels.timesWithin(times + i, count - i, begin, length, ns + i);
}

void move(const LinearMotion& motion, const float* ns, int count, float* x, float* y, float* z) {
  const auto row = [](const float* m, __m256 px, __m256 py, __m256 pz) {
    return _mm256_add_ps(
        _mm256_add_ps(_mm256_mul_ps(_mm256_broadcast_ss(m), px),
                      _mm256_mul_ps(_mm256_broadcast_ss(m + 1), py)),
        _mm256_add_ps(_mm256_mul_ps(_mm256_broadcast_ss(m + 2), pz), _mm256_broadcast_ss(m + 3)));
  };
  int i = 0;
  for (; i + 8 <= count; i += 8) {
    const __m256 px = _mm256_loadu_ps(x + i), py = _mm256_loadu_ps(y + i);
    const __m256 pz = _mm256_loadu_ps(z + i), t = _mm256_loadu_ps(ns + i);
    const auto moved = [&](int k) {
      return _mm256_add_ps(row(motion.start + k, px, py, pz),
                           _mm256_mul_ps(t, row(motion.rate_per_ns + k, px, py, pz)));
    };
    _mm256_storeu_ps(x + i, moved(0));
    _mm256_storeu_ps(y + i, moved(4));
    _mm256_storeu_ps(z + i, moved(8));
  }
  kPlainMotionKernels.move(motion, ns + i, count - i, x + i, y + i, z + i);
}

void secondsSince(std::int64_t reference, const std::int64_t* times, int count, float* seconds) {
  const __m256i origin = _mm256_set1_epi64x(reference);
  const __m256d s_per_ns = _mm256_set1_pd(1e-9);
  const auto toSeconds = [&](__m128i ns) {
    return _mm256_cvtpd_ps(_mm256_mul_pd(s_per_ns, _mm256_cvtepi32_pd(ns)));
  };
  int i = 0;
  for (; i + 8 <= count; i += 8) {
    const __m256i ns = differences(times + i, origin).low;
    _mm_storeu_ps(seconds + i, toSeconds(_mm256_castsi256_si128(ns)));
    _mm_storeu_ps(seconds + i + 4, toSeconds(_mm256_extracti128_si256(ns, 1)));
  }
  kPlainMotionKernels.secondsSince(reference, times + i, count - i, seconds + i);
}

}  // namespace

const MotionKernels kAvx2MotionKernels = {"avx2", timesWithin, move, secondsSince};

}  // namespace semantic_lidar_fusion

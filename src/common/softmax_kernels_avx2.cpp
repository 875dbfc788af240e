// SPDX-License-Identifier: MIT
// Compiled with AVX2 enabled: includes and uses nothing that could be emitted as a shared inline
// function (see superpixel/slic_kernels.h).
#include <immintrin.h>

#include "semantic_lidar_fusion/common/softmax_kernels.h"

namespace semantic_lidar_fusion {
namespace {

/// The first n of four lanes, n = 0..4, from entry 4 - n on.
const long long kLanes64[8] = {-1, -1, -1, -1, 0, 0, 0, 0};
const int kLanes32[8] = {-1, -1, -1, -1, 0, 0, 0, 0};

inline __m256i lanes64(int n) {
  return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(kLanes64 + 4 - n));
}

/// Four of `count` scores from c on; those beyond the end repeat the first.
inline __m128 scoresAt(const float* scores, int c, int count) {
  if (c + 4 <= count) return _mm_loadu_ps(scores + c);
  const __m128i mask =
      _mm_loadu_si128(reinterpret_cast<const __m128i*>(kLanes32 + 4 - (count - c)));
  return _mm_blendv_ps(_mm_set1_ps(scores[0]), _mm_maskload_ps(scores + c, mask),
                       _mm_castsi128_ps(mask));
}

/// (c[0] + c[1] r) + (c[2] + c[3] r) r^2
inline __m256d fourTerms(const double* c, __m256d r, __m256d r2) {
  const __m256d low = _mm256_add_pd(_mm256_set1_pd(c[0]), _mm256_mul_pd(_mm256_set1_pd(c[1]), r));
  const __m256d high = _mm256_add_pd(_mm256_set1_pd(c[2]), _mm256_mul_pd(_mm256_set1_pd(c[3]), r));
  return _mm256_add_pd(low, _mm256_mul_pd(high, r2));
}

/// exp(x) for x <= 0.
inline __m256d exponential(__m256d x) {
  const __m256d rounder = _mm256_set1_pd(kRounder);
  const __m256d rounded = _mm256_add_pd(_mm256_mul_pd(x, _mm256_set1_pd(kLog2E)), rounder);
  const __m256d k = _mm256_sub_pd(rounded, rounder);
  const __m256d r = _mm256_sub_pd(_mm256_sub_pd(x, _mm256_mul_pd(k, _mm256_set1_pd(kLn2High))),
                                  _mm256_mul_pd(k, _mm256_set1_pd(kLn2Low)));
  const __m256d r2 = _mm256_mul_pd(r, r), r4 = _mm256_mul_pd(r2, r2), r8 = _mm256_mul_pd(r4, r4);
  const __m256d s0 = fourTerms(kExp, r, r2), s1 = fourTerms(kExp + 4, r, r2);
  const __m256d s2 = fourTerms(kExp + 8, r, r2);
  const __m256d low = _mm256_add_pd(s0, _mm256_mul_pd(s1, r4));
  const __m256d high = _mm256_add_pd(s2, _mm256_mul_pd(_mm256_set1_pd(kExp[12]), r4));
  const __m256d series = _mm256_add_pd(low, _mm256_mul_pd(high, r8));
  const __m256i power = _mm256_slli_epi64(_mm256_castpd_si256(rounded), 52);
  const __m256d value = _mm256_castsi256_pd(_mm256_add_epi64(_mm256_castpd_si256(series), power));
  return _mm256_and_pd(value, _mm256_cmp_pd(x, _mm256_set1_pd(kLeastExponent), _CMP_GE_OQ));
}

inline __m256d logarithm(__m256d x) {
  const __m256i bits = _mm256_castpd_si256(x);
  // 2^52 + exponent, by its bits
  const __m256d exponent_bits = _mm256_castsi256_pd(_mm256_or_si256(
      _mm256_srli_epi64(bits, 52), _mm256_castpd_si256(_mm256_set1_pd(4503599627370496.0))));
  const __m256d exponent =
      _mm256_sub_pd(exponent_bits, _mm256_set1_pd(4503599627370496.0 + 1023.0));
  const __m256d one = _mm256_set1_pd(1.0);
  const __m256d mantissa = _mm256_or_pd(
      _mm256_and_pd(x, _mm256_castsi256_pd(_mm256_set1_epi64x(0xfffffffffffffLL))), one);
  const __m256d large = _mm256_cmp_pd(mantissa, _mm256_set1_pd(kSqrt2), _CMP_GT_OQ);
  const __m256d m = _mm256_blendv_pd(mantissa, _mm256_mul_pd(mantissa, _mm256_set1_pd(0.5)), large);
  const __m256d e = _mm256_add_pd(exponent, _mm256_and_pd(one, large));
  const __m256d f = _mm256_div_pd(_mm256_sub_pd(m, one), _mm256_add_pd(m, one));
  const __m256d s = _mm256_mul_pd(f, f);
  __m256d series = _mm256_set1_pd(kLn[0]);
  for (int i = 1; i < 7; ++i) {
    series = _mm256_add_pd(_mm256_set1_pd(kLn[i]), _mm256_mul_pd(s, series));
  }
  return _mm256_add_pd(_mm256_mul_pd(e, _mm256_set1_pd(kLn2)), _mm256_mul_pd(f, series));
}

inline double sumOfLanes(__m256d v) {
  const __m256d pairs = _mm256_hadd_pd(v, v);  // 0 + 1, same, 2 + 3, same
  return _mm_cvtsd_f64(_mm_add_sd(_mm256_castpd256_pd128(pairs), _mm256_extractf128_pd(pairs, 1)));
}

bool softmax(const float* scores, int count, double inverse_tau, double* out) {
  const __m128 magnitude = _mm_castsi128_ps(_mm_set1_epi32(0x7fffffff));
  __m128 high = _mm_set1_ps(scores[0]);
  __m128 finite = _mm_castsi128_ps(_mm_set1_epi32(-1));
  for (int c = 0; c < count; c += 4) {
    const __m128 s = scoresAt(scores, c, count);
    finite =
        _mm_and_ps(finite, _mm_cmplt_ps(_mm_and_ps(s, magnitude), _mm_set1_ps(__builtin_inff())));
    high = _mm_max_ps(high, s);
  }
  if (_mm_movemask_ps(finite) != 0xf) return false;
  high = _mm_max_ps(high, _mm_movehl_ps(high, high));
  high = _mm_max_ss(high, _mm_shuffle_ps(high, high, 1));
  const __m256d highest = _mm256_cvtps_pd(_mm_shuffle_ps(high, high, 0));
  const __m256d per_tau = _mm256_set1_pd(inverse_tau), one = _mm256_set1_pd(1.0);
  __m256d sums = _mm256_setzero_pd();
  for (int c = 0; c < count; c += 4) {
    const __m256d below = _mm256_sub_pd(_mm256_cvtps_pd(scoresAt(scores, c, count)), highest);
    __m256d e = exponential(_mm256_mul_pd(below, per_tau));
    e = _mm256_blendv_pd(e, one, _mm256_cmp_pd(below, _mm256_setzero_pd(), _CMP_EQ_OQ));
    if (c + 4 <= count) {
      _mm256_storeu_pd(out + c, e);
    } else {
      const __m256i mask = lanes64(count - c);
      e = _mm256_and_pd(e, _mm256_castsi256_pd(mask));
      _mm256_maskstore_pd(out + c, mask, e);
    }
    sums = _mm256_add_pd(sums, e);
  }
  const double sum = sumOfLanes(sums);
  int c = 0;
  for (; c + 4 <= count; c += 4) {
    _mm256_storeu_pd(out + c, _mm256_div_pd(_mm256_loadu_pd(out + c), _mm256_set1_pd(sum)));
  }
  for (; c < count; ++c) out[c] = out[c] / sum;
  return true;
}

double entropy(const double* p, int count) {
  __m256d sums = _mm256_setzero_pd();
  for (int c = 0; c < count; c += 4) {
    const __m256d value =
        c + 4 <= count ? _mm256_loadu_pd(p + c) : _mm256_maskload_pd(p + c, lanes64(count - c));
    const __m256d term = _mm256_mul_pd(value, logarithm(value));
    sums = _mm256_add_pd(
        sums, _mm256_and_pd(term, _mm256_cmp_pd(value, _mm256_setzero_pd(), _CMP_GT_OQ)));
  }
  return -sumOfLanes(sums);
}

int narrow(const double* p, int count, float* out) {
  __m128 high = _mm_set1_ps(-__builtin_inff());
  int c = 0;
  for (; c + 4 <= count; c += 4) {
    const __m128 value = _mm256_cvtpd_ps(_mm256_loadu_pd(p + c));
    _mm_storeu_ps(out + c, value);
    high = _mm_max_ps(high, value);
  }
  for (; c < count; ++c) {
    out[c] = static_cast<float>(p[c]);
    high = _mm_max_ps(high, _mm_set1_ps(out[c]));
  }
  high = _mm_max_ps(high, _mm_movehl_ps(high, high));
  high = _mm_max_ss(high, _mm_shuffle_ps(high, high, 1));
  high = _mm_shuffle_ps(high, high, 0);
  for (c = 0; c + 4 <= count; c += 4) {
    const int equal = _mm_movemask_ps(_mm_cmpeq_ps(_mm_loadu_ps(out + c), high));
    if (equal != 0) return c + __builtin_ctz(static_cast<unsigned>(equal));
  }
  while (c + 1 < count && out[c] != _mm_cvtss_f32(high)) ++c;
  return c;
}

}  // namespace

const SoftmaxKernels kAvx2SoftmaxKernels = {"avx2", softmax, entropy, narrow};

}  // namespace semantic_lidar_fusion

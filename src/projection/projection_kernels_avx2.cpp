// SPDX-License-Identifier: MIT
// Compiled with AVX2 enabled: includes and uses nothing that could be emitted as a shared inline
// function (see superpixel/slic_kernels.h).
#include <immintrin.h>

#include "projection_kernels.h"

namespace semantic_lidar_fusion {
namespace {

/// For each 8-bit mask the lanes whose bit is set, in order, first.
struct LaneOrders {
  std::uint8_t lanes[256][8];
  constexpr LaneOrders() : lanes() {
    for (int mask = 0; mask < 256; ++mask) {
      int count = 0;
      for (int lane = 0; lane < 8; ++lane) {
        if (mask >> lane & 1) lanes[mask][count++] = static_cast<std::uint8_t>(lane);
      }
    }
  }
};
constexpr LaneOrders kLaneOrders;

inline __m256i lanesOf(unsigned mask) {
  return _mm256_cvtepu8_epi32(
      _mm_loadl_epi64(reinterpret_cast<const __m128i*>(kLaneOrders.lanes[mask])));
}

inline void store(__m256i order, __m256 values, float* out) {
  _mm256_storeu_ps(out, _mm256_permutevar8x32_ps(values, order));
}

inline void store(__m256i order, __m256i values, std::uint32_t* out) {
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(out), _mm256_permutevar8x32_epi32(values, order));
}

inline __m256 rowTimes(const float* m, __m256 x, __m256 y, __m256 z) {
  return _mm256_add_ps(
      _mm256_add_ps(_mm256_mul_ps(_mm256_set1_ps(m[0]), x), _mm256_mul_ps(_mm256_set1_ps(m[1]), y)),
      _mm256_add_ps(_mm256_mul_ps(_mm256_set1_ps(m[2]), z), _mm256_set1_ps(m[3])));
}

inline __m256d rowTimes(const double* m, __m256d x, __m256d y, __m256d z) {
  return _mm256_add_pd(
      _mm256_add_pd(_mm256_mul_pd(_mm256_set1_pd(m[0]), x), _mm256_mul_pd(_mm256_set1_pd(m[1]), y)),
      _mm256_add_pd(_mm256_mul_pd(_mm256_set1_pd(m[2]), z), _mm256_set1_pd(m[3])));
}

inline __m256 sumOfSquares(__m256 x, __m256 y) {
  return _mm256_add_ps(_mm256_mul_ps(x, x), _mm256_mul_ps(y, y));
}

inline __m256 joined(__m128 low, __m128 high) {
  return _mm256_insertf128_ps(_mm256_castps128_ps256(low), high, 1);
}

inline __m256 smaller(__m256 a, __m256 b) { return _mm256_cmp_ps(a, b, _CMP_LT_OQ); }

int select(const SightCone& cone, const float* x, const float* y, const float* z,
           const std::uint8_t* status, std::uint8_t excluded, int count, SelectedPoints* out) {
  const float* m = cone.matrix;
  const __m256 cosine = _mm256_set1_ps(cone.cosine), reach = _mm256_set1_ps(cone.reach_m);
  const __m256 most = _mm256_set1_ps(kMostSelectable);
  const __m256i unwanted = _mm256_set1_epi32(excluded);
  __m256i place = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
  int selected = 0, i = 0;
  for (; i + 8 <= count; i += 8) {
    const __m256 vx = _mm256_loadu_ps(x + i), vy = _mm256_loadu_ps(y + i);
    const __m256 vz = _mm256_loadu_ps(z + i);
    const __m256 px = rowTimes(m, vx, vy, vz), py = rowTimes(m + 4, vx, vy, vz);
    const __m256 pz = rowTimes(m + 8, vx, vy, vz);
    const __m256 distance =
        _mm256_sqrt_ps(_mm256_add_ps(sumOfSquares(px, py), _mm256_mul_ps(pz, pz)));
    const __m256 outside =
        _mm256_and_ps(smaller(pz, _mm256_sub_ps(_mm256_mul_ps(distance, cosine), reach)),
                      _mm256_cmp_ps(distance, most, _CMP_LE_OQ));
    const __m256i state =
        _mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(status + i)));
    const __m256 dropped =
        _mm256_or_ps(outside, _mm256_castsi256_ps(_mm256_cmpeq_epi32(state, unwanted)));
    const unsigned keep = ~static_cast<unsigned>(_mm256_movemask_ps(dropped)) & 0xffU;
    const __m256i order = lanesOf(keep);
    store(order, vx, out->x + selected);
    store(order, vy, out->y + selected);
    store(order, vz, out->z + selected);
    store(order, place, out->place + selected);
    selected += __builtin_popcount(keep);
    place = _mm256_add_epi32(place, _mm256_set1_epi32(8));
  }
  return selectFrom(cone, x, y, z, status, excluded, i, count, selected, out);
}

/// Four points in the axes of the image, in double precision.
struct Four {
  __m256d x, y, z, squared;
};

inline Four transformed(const double* m, const float* x, const float* y, const float* z) {
  const __m256d vx = _mm256_cvtps_pd(_mm_loadu_ps(x)), vy = _mm256_cvtps_pd(_mm_loadu_ps(y));
  const __m256d vz = _mm256_cvtps_pd(_mm_loadu_ps(z));
  Four p;
  p.x = rowTimes(m, vx, vy, vz);
  p.y = rowTimes(m + 4, vx, vy, vz);
  p.z = rowTimes(m + 8, vx, vy, vz);
  p.squared = _mm256_add_pd(_mm256_add_pd(_mm256_mul_pd(p.x, p.x), _mm256_mul_pd(p.y, p.y)),
                            _mm256_mul_pd(p.z, p.z));
  return p;
}

inline unsigned measurable(__m256d squared) {
  return static_cast<unsigned>(_mm256_movemask_pd(
      _mm256_and_pd(_mm256_cmp_pd(squared, _mm256_set1_pd(kLeastSquaredDistance), _CMP_GE_OQ),
                    _mm256_cmp_pd(squared, _mm256_set1_pd(kMostSquaredDistance), _CMP_LE_OQ))));
}

inline unsigned bits(__m256 mask) { return static_cast<unsigned>(_mm256_movemask_ps(mask)); }

int equidistant(const EquidistantLens& lens, const SelectedPoints& points, int count,
                PixelBlock* out) {
  const __m256 quarter = _mm256_set1_ps(kQuarterTurn), half = _mm256_set1_ps(kHalfTurn);
  const __m256 sign = _mm256_set1_ps(-0.0f);
  out->doubtful_count = 0;
  int kept = 0, i = 0;
  for (; i + 8 <= count; i += 8) {
    const Four low = transformed(lens.matrix, points.x + i, points.y + i, points.z + i);
    const Four high =
        transformed(lens.matrix, points.x + i + 4, points.y + i + 4, points.z + i + 4);
    const __m256 right = joined(_mm256_cvtpd_ps(low.x), _mm256_cvtpd_ps(high.x));
    const __m256 down = joined(_mm256_cvtpd_ps(low.y), _mm256_cvtpd_ps(high.y));
    const __m256 forward = joined(_mm256_cvtpd_ps(low.z), _mm256_cvtpd_ps(high.z));

    const __m256 from_axis = _mm256_sqrt_ps(sumOfSquares(right, down));
    const __m256 along = _mm256_andnot_ps(sign, forward);
    const __m256 near_axis = smaller(from_axis, along);
    const __m256 q = _mm256_div_ps(_mm256_blendv_ps(along, from_axis, near_axis),
                                   _mm256_blendv_ps(from_axis, along, near_axis));
    const __m256 s = _mm256_mul_ps(q, q);
    __m256 series = _mm256_set1_ps(kAtan[8]);
    for (int k = 7; k >= 0; --k) {
      series = _mm256_add_ps(_mm256_set1_ps(kAtan[k]), _mm256_mul_ps(s, series));
    }
    const __m256 atan = _mm256_mul_ps(q, series);
    __m256 theta = _mm256_blendv_ps(_mm256_sub_ps(quarter, atan), atan, near_axis);
    theta =
        _mm256_blendv_ps(theta, _mm256_sub_ps(half, theta), smaller(forward, _mm256_setzero_ps()));

    const __m256 w = _mm256_mul_ps(theta, theta);
    __m256 factor = _mm256_set1_ps(lens.k[3]);
    for (int k = 2; k >= 0; --k) {
      factor = _mm256_add_ps(_mm256_set1_ps(lens.k[k]), _mm256_mul_ps(w, factor));
    }
    factor = _mm256_add_ps(_mm256_set1_ps(1.0f), _mm256_mul_ps(w, factor));
    const __m256 scale = _mm256_div_ps(_mm256_mul_ps(theta, factor), from_axis);
    const __m256 a = _mm256_mul_ps(right, scale), b = _mm256_mul_ps(down, scale);
    const __m256 u =
        _mm256_add_ps(_mm256_mul_ps(_mm256_set1_ps(lens.focal_x),
                                    _mm256_add_ps(a, _mm256_mul_ps(_mm256_set1_ps(lens.skew), b))),
                      _mm256_set1_ps(lens.centre_x));
    const __m256 v = _mm256_add_ps(_mm256_mul_ps(_mm256_set1_ps(lens.focal_y), b),
                                   _mm256_set1_ps(lens.centre_y));

    const unsigned known =
        (measurable(low.squared) | measurable(high.squared) << 4) &
        bits(_mm256_cmp_ps(from_axis, _mm256_set1_ps(kLeastFromAxis), _CMP_GE_OQ));
    const unsigned sure = known & bits(smaller(theta, _mm256_set1_ps(lens.theta_sure)));
    const unsigned never = known & bits(smaller(_mm256_set1_ps(lens.theta_never), theta));
    const unsigned inside =
        bits(_mm256_and_ps(_mm256_and_ps(_mm256_cmp_ps(u, _mm256_set1_ps(lens.u_begin), _CMP_GE_OQ),
                                         smaller(u, _mm256_set1_ps(lens.u_end))),
                           _mm256_and_ps(_mm256_cmp_ps(v, _mm256_set1_ps(lens.v_begin), _CMP_GE_OQ),
                                         smaller(v, _mm256_set1_ps(lens.v_end)))));
    const unsigned doubtful = ~(sure | never) & 0xffU;
    const unsigned keep = doubtful | (sure & inside);
    for (unsigned rest = doubtful; rest != 0; rest &= rest - 1) {
      const unsigned before = (rest & -rest) - 1;
      out->doubtful[out->doubtful_count++] =
          static_cast<std::uint32_t>(kept + __builtin_popcount(keep & before));
    }
    const __m256 distance = joined(_mm256_cvtpd_ps(_mm256_sqrt_pd(low.squared)),
                                   _mm256_cvtpd_ps(_mm256_sqrt_pd(high.squared)));
    const __m256i order = lanesOf(keep);
    store(order, u, out->u + kept);
    store(order, v, out->v + kept);
    store(order, distance, out->distance + kept);
    store(order, theta, out->theta + kept);
    store(order, _mm256_loadu_si256(reinterpret_cast<const __m256i*>(points.place + i)),
          out->place + kept);
    kept += __builtin_popcount(keep);
  }
  return equidistantFrom(lens, points, i, count, kept, out);
}

}  // namespace

const ProjectionKernels kAvx2ProjectionKernels = {"avx2", select, equidistant};

}  // namespace semantic_lidar_fusion

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

inline __m256 along(const float* m, __m256 x, __m256 y, __m256 z) {
  return _mm256_add_ps(
      _mm256_add_ps(_mm256_mul_ps(_mm256_set1_ps(m[0]), x), _mm256_mul_ps(_mm256_set1_ps(m[1]), y)),
      _mm256_add_ps(_mm256_mul_ps(_mm256_set1_ps(m[2]), z), _mm256_set1_ps(m[3])));
}

inline __m256d along(const double* m, __m256d x, __m256d y, __m256d z) {
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
    const __m256 px = along(m, vx, vy, vz), py = along(m + 4, vx, vy, vz);
    const __m256 pz = along(m + 8, vx, vy, vz);
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
  p.x = along(m, vx, vy, vz);
  p.y = along(m + 4, vx, vy, vz);
  p.z = along(m + 8, vx, vy, vz);
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

/// Eight points.
struct Eight {
  __m256 x, y, z;
};

/// As in the plain kernels.
inline __m256 series(const float* c, __m256 s) {
  const __m256 s2 = _mm256_mul_ps(s, s);
  const __m256 low = _mm256_add_ps(_mm256_set1_ps(c[0]), _mm256_mul_ps(s, _mm256_set1_ps(c[1])));
  const __m256 middle = _mm256_add_ps(_mm256_set1_ps(c[2]), _mm256_mul_ps(s, _mm256_set1_ps(c[3])));
  const __m256 high = _mm256_add_ps(middle, _mm256_mul_ps(s2, _mm256_set1_ps(c[4])));
  return _mm256_add_ps(low, _mm256_mul_ps(s2, high));
}

/// As in the plain kernels.
struct RowSeen {
  __m256 time_s, sure, never;
};

inline RowSeen rowSeen(const RollingRows& rows, const Eight& p) {
  const __m256 right = p.x, down = p.y, forward = p.z;
  const __m256 squared_from_axis = sumOfSquares(right, down);
  const __m256 squared = _mm256_add_ps(squared_from_axis, _mm256_mul_ps(forward, forward));
  const __m256 from_axis = _mm256_sqrt_ps(squared_from_axis);
  const __m256 along_axis = _mm256_andnot_ps(_mm256_set1_ps(-0.0f), forward);
  const __m256 near_axis = smaller(from_axis, along_axis);
  const __m256 q = _mm256_div_ps(_mm256_blendv_ps(along_axis, from_axis, near_axis),
                                 _mm256_blendv_ps(from_axis, along_axis, near_axis));
  const __m256 atan = _mm256_mul_ps(q, series(kRoughAtan, _mm256_mul_ps(q, q)));
  const __m256 acute =
      _mm256_blendv_ps(_mm256_sub_ps(_mm256_set1_ps(kQuarterTurn), atan), atan, near_axis);
  const __m256 theta = _mm256_blendv_ps(acute, _mm256_sub_ps(_mm256_set1_ps(kHalfTurn), acute),
                                        smaller(forward, _mm256_setzero_ps()));
  const __m256 distorted = _mm256_mul_ps(theta, series(rows.k, _mm256_mul_ps(theta, theta)));
  const __m256 scale = _mm256_div_ps(distorted, from_axis);
  const __m256 a = _mm256_mul_ps(right, scale), b = _mm256_mul_ps(down, scale);
  const __m256 row = _mm256_add_ps(_mm256_add_ps(_mm256_mul_ps(_mm256_set1_ps(rows.per_right), a),
                                                 _mm256_mul_ps(_mm256_set1_ps(rows.per_down), b)),
                                   _mm256_set1_ps(rows.at_centre));
  const __m256 clamped =
      _mm256_max_ps(_mm256_min_ps(row, _mm256_set1_ps(rows.end)), _mm256_set1_ps(rows.begin));
  const __m256 most = _mm256_set1_ps(static_cast<float>(kMostSquaredDistance));
  const __m256 measurable = _mm256_and_ps(
      _mm256_and_ps(_mm256_cmp_ps(squared, _mm256_set1_ps(rows.least_squared_m2), _CMP_GE_OQ),
                    _mm256_cmp_ps(squared, most, _CMP_LE_OQ)),
      _mm256_cmp_ps(from_axis, _mm256_set1_ps(kLeastFromAxis), _CMP_GE_OQ));
  return {_mm256_add_ps(_mm256_set1_ps(rows.at_zero_s),
                        _mm256_mul_ps(_mm256_set1_ps(rows.per_px_s), clamped)),
          _mm256_and_ps(measurable, smaller(theta, _mm256_set1_ps(rows.theta_sure))),
          _mm256_and_ps(measurable, smaller(_mm256_set1_ps(rows.theta_never), theta))};
}

inline __m256 difference(float a, __m256 p, float b, __m256 q) {
  return _mm256_sub_ps(_mm256_mul_ps(_mm256_set1_ps(a), p), _mm256_mul_ps(_mm256_set1_ps(b), q));
}

inline Eight cross(const float* a, const Eight& b) {
  return {difference(a[1], b.z, a[2], b.y), difference(a[2], b.x, a[0], b.z),
          difference(a[0], b.y, a[1], b.x)};
}

inline __m256 later(__m256 p, __m256 t_s, __m256 half_s, __m256 first, __m256 second) {
  return _mm256_sub_ps(p, _mm256_mul_ps(t_s, _mm256_sub_ps(first, _mm256_mul_ps(half_s, second))));
}

/// As in the plain kernels.
inline Eight seenLater(const Flow& flow, const Eight& p, __m256 t_s) {
  const __m256 half_s = _mm256_mul_ps(_mm256_set1_ps(0.5f), t_s);
  Eight first = cross(flow.turn, p);
  first.x = _mm256_add_ps(first.x, _mm256_set1_ps(flow.velocity[0]));
  first.y = _mm256_add_ps(first.y, _mm256_set1_ps(flow.velocity[1]));
  first.z = _mm256_add_ps(first.z, _mm256_set1_ps(flow.velocity[2]));
  const Eight second = cross(flow.turn, first);
  return {later(p.x, t_s, half_s, first.x, second.x), later(p.y, t_s, half_s, first.y, second.y),
          later(p.z, t_s, half_s, first.z, second.z)};
}

/// secantTime() of rolling_shutter.h.
inline __m256 secant(__m256 t1, __m256 f_t1) {
  const __m256 sign = _mm256_set1_ps(-0.0f);
  const __m256 rise = _mm256_sub_ps(f_t1, t1);
  const __m256 steep = smaller(_mm256_mul_ps(_mm256_set1_ps(2.0f), _mm256_andnot_ps(sign, rise)),
                               _mm256_andnot_ps(sign, t1));
  return _mm256_blendv_ps(f_t1, _mm256_div_ps(_mm256_mul_ps(t1, t1), _mm256_sub_ps(t1, rise)),
                          steep);
}

/// The first round of a block. Rounds have loops of their own: a round is a chain of operations
/// that wait for each other, of which the processor overlaps those of several points.
struct FirstRound {
  float right[kProjectionRoom], down[kProjectionRoom], forward[kProjectionRoom];  ///< m
  float time_s[kProjectionRoom], sure[kProjectionRoom], never[kProjectionRoom];   ///< lanes' masks
};

inline void firstRound(const RollingRows& rows, const SelectedPoints& points, int i,
                       FirstRound* out) {
  const float* m = rows.matrix;
  const __m256 x = _mm256_loadu_ps(points.x + i), y = _mm256_loadu_ps(points.y + i);
  const __m256 z = _mm256_loadu_ps(points.z + i);
  const Eight p{along(m, x, y, z), along(m + 4, x, y, z), along(m + 8, x, y, z)};
  const RowSeen seen = rowSeen(rows, p);
  _mm256_storeu_ps(out->right + i, p.x);
  _mm256_storeu_ps(out->down + i, p.y);
  _mm256_storeu_ps(out->forward + i, p.z);
  _mm256_storeu_ps(out->time_s + i, seen.time_s);
  _mm256_storeu_ps(out->sure + i, seen.sure);
  _mm256_storeu_ps(out->never + i, seen.never);
}

int roll(const RollingRows& rows, const SelectedPoints& points, int count, SelectedPoints* out) {
  const __m256 nan = _mm256_castsi256_ps(_mm256_set1_epi32(0x7fc00000));
  const int whole = count / 8 * 8;
  FirstRound first;
  for (int i = 0; i < whole; i += 8) firstRound(rows, points, i, &first);
  int kept = 0;
  for (int i = 0; i < whole; i += 8) {
    const Eight p{_mm256_loadu_ps(first.right + i), _mm256_loadu_ps(first.down + i),
                  _mm256_loadu_ps(first.forward + i)};
    const __m256 t1 = _mm256_loadu_ps(first.time_s + i);
    const RowSeen seen = rowSeen(rows, seenLater(rows.in_image, p, t1));
    const __m256 first_sure = _mm256_loadu_ps(first.sure + i);
    const __m256 sure = _mm256_and_ps(first_sure, seen.sure);
    const __m256 never =
        _mm256_or_ps(_mm256_loadu_ps(first.never + i), _mm256_and_ps(first_sure, seen.never));
    const Eight from{_mm256_loadu_ps(points.x + i), _mm256_loadu_ps(points.y + i),
                     _mm256_loadu_ps(points.z + i)};
    const Eight to = seenLater(rows.in_lidar, from, secant(t1, seen.time_s));
    const unsigned keep = ~bits(never) & 0xffU;
    const __m256i order = lanesOf(keep);
    store(order, _mm256_blendv_ps(nan, to.x, sure), out->x + kept);
    store(order, to.y, out->y + kept);
    store(order, to.z, out->z + kept);
    store(order, _mm256_loadu_si256(reinterpret_cast<const __m256i*>(points.place + i)),
          out->place + kept);
    kept += __builtin_popcount(keep);
  }
  return rollFrom(rows, points, whole, count, kept, out);
}

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

const ProjectionKernels kAvx2ProjectionKernels = {"avx2", select, equidistant, roll};

}  // namespace semantic_lidar_fusion

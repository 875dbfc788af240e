// SPDX-License-Identifier: MIT
// Compiled with AVX2 enabled: includes and uses nothing that could be emitted as a shared inline
// function (see superpixel/slic_kernels.h).
#include <immintrin.h>

#include <cstddef>

#include "mask_kernels.h"

namespace semantic_lidar_fusion {
namespace {

inline __m256d rowTimes(const double* m, __m256d x, __m256d y, __m256d z) {
  return _mm256_add_pd(
      _mm256_add_pd(_mm256_mul_pd(_mm256_set1_pd(m[0]), x), _mm256_mul_pd(_mm256_set1_pd(m[1]), y)),
      _mm256_add_pd(_mm256_mul_pd(_mm256_set1_pd(m[2]), z), _mm256_set1_pd(m[3])));
}

inline __m256d magnitude(__m256d v) { return _mm256_andnot_pd(_mm256_set1_pd(-0.0), v); }
inline __m256 magnitude(__m256 v) { return _mm256_andnot_ps(_mm256_set1_ps(-0.0f), v); }
inline __m256 negative(__m256 v) { return _mm256_xor_ps(_mm256_set1_ps(-0.0f), v); }

inline __m256d angleOf(__m256d across, __m256d along) {
  const __m256d one = _mm256_set1_pd(1.0);
  const __m256d length = magnitude(along);
  const __m256d steep = _mm256_cmp_pd(across, length, _CMP_GT_OQ);
  const __m256d q = _mm256_div_pd(_mm256_blendv_pd(across, length, steep),
                                  _mm256_blendv_pd(length, across, steep));
  const __m256d turned = _mm256_cmp_pd(q, _mm256_set1_pd(kAtanTurned), _CMP_GT_OQ);
  const __m256d x =
      _mm256_blendv_pd(q, _mm256_div_pd(_mm256_sub_pd(q, one), _mm256_add_pd(q, one)), turned);
  const __m256d z = _mm256_mul_pd(x, x);
  __m256d p = _mm256_set1_pd(kAtanP[0]), d = _mm256_add_pd(z, _mm256_set1_pd(kAtanQ[0]));
  for (int i = 1; i < 5; ++i) {
    p = _mm256_add_pd(_mm256_mul_pd(p, z), _mm256_set1_pd(kAtanP[i]));
    d = _mm256_add_pd(_mm256_mul_pd(d, z), _mm256_set1_pd(kAtanQ[i]));
  }
  __m256d angle = _mm256_add_pd(_mm256_mul_pd(x, _mm256_mul_pd(z, _mm256_div_pd(p, d))), x);
  angle = _mm256_blendv_pd(angle, _mm256_add_pd(_mm256_set1_pd(kAtanQuarter), angle), turned);
  angle = _mm256_blendv_pd(angle, _mm256_sub_pd(_mm256_set1_pd(kAtanHalf), angle), steep);
  const __m256d behind = _mm256_cmp_pd(along, _mm256_setzero_pd(), _CMP_LT_OQ);
  return _mm256_blendv_pd(angle, _mm256_sub_pd(_mm256_set1_pd(kAtanWhole), angle), behind);
}

void projectTargets(const ExactLens& lens, int count, ArmTargets* targets) {
  const __m256d zero = _mm256_setzero_pd(), one = _mm256_set1_pd(1.0);
  const __m256d largest = _mm256_set1_pd(1.7976931348623157e308);
  int i = 0;
  for (; i + 4 <= count; i += 4) {
    const __m256d x = _mm256_cvtps_pd(_mm_loadu_ps(targets->x + i));
    const __m256d y = _mm256_cvtps_pd(_mm_loadu_ps(targets->y + i));
    const __m256d z = _mm256_cvtps_pd(_mm_loadu_ps(targets->z + i));
    const __m256d right = rowTimes(lens.matrix, x, y, z);
    const __m256d down = rowTimes(lens.matrix + 4, x, y, z);
    const __m256d forward = rowTimes(lens.matrix + 8, x, y, z);
    const __m256d squared = _mm256_add_pd(_mm256_mul_pd(right, right), _mm256_mul_pd(down, down));
    const __m256d from_axis = _mm256_sqrt_pd(squared);
    const __m256d theta = angleOf(from_axis, forward);
    const __m256d w = _mm256_mul_pd(theta, theta);
    __m256d factor = _mm256_set1_pd(lens.k[3]);
    for (int k = 2; k >= 0; --k) {
      factor = _mm256_add_pd(_mm256_set1_pd(lens.k[k]), _mm256_mul_pd(w, factor));
    }
    factor = _mm256_add_pd(one, _mm256_mul_pd(w, factor));
    const __m256d radius = _mm256_mul_pd(theta, factor);
    const __m256d off_axis = _mm256_cmp_pd(from_axis, zero, _CMP_GT_OQ);
    const __m256d scale = _mm256_and_pd(_mm256_div_pd(radius, from_axis), off_axis);
    const __m256d a = _mm256_mul_pd(right, scale), b = _mm256_mul_pd(down, scale);
    const __m256d u =
        _mm256_add_pd(_mm256_mul_pd(_mm256_set1_pd(lens.focal_x),
                                    _mm256_add_pd(a, _mm256_mul_pd(_mm256_set1_pd(lens.skew), b))),
                      _mm256_set1_pd(lens.centre_x));
    const __m256d v = _mm256_add_pd(_mm256_mul_pd(_mm256_set1_pd(lens.focal_y), b),
                                    _mm256_set1_pd(lens.centre_y));
    const __m256d in_lens =
        _mm256_and_pd(_mm256_cmp_pd(theta, _mm256_set1_pd(lens.theta_end), _CMP_LE_OQ),
                      _mm256_or_pd(off_axis, _mm256_cmp_pd(forward, zero, _CMP_GT_OQ)));
    const __m256d finite = _mm256_and_pd(_mm256_cmp_pd(magnitude(u), largest, _CMP_LE_OQ),
                                         _mm256_cmp_pd(magnitude(v), largest, _CMP_LE_OQ));
    const __m256d seen = _mm256_and_pd(in_lens, finite);
    const __m256d distance =
        _mm256_sqrt_pd(_mm256_add_pd(squared, _mm256_mul_pd(forward, forward)));
    const __m256d nearness =
        _mm256_div_pd(one, _mm256_max_pd(_mm256_set1_pd(kLeastMaskDistance), distance));
    const __m256d nan = _mm256_set1_pd(__builtin_nan(""));
    _mm_storeu_ps(targets->u + i, _mm256_cvtpd_ps(_mm256_blendv_pd(nan, u, seen)));
    _mm_storeu_ps(targets->v + i, _mm256_cvtpd_ps(v));
    _mm_storeu_ps(targets->nearness + i, _mm256_cvtpd_ps(nearness));
  }
  projectTargetsFrom(lens, i, count, targets);
}

/// std::min and std::max as they are with NaN: the first where they do not compare.
inline __m256 lesser(__m256 a, __m256 b) { return _mm256_min_ps(b, a); }
inline __m256 greater(__m256 a, __m256 b) { return _mm256_max_ps(b, a); }

inline __m256 hiddenBeyond(__m256 nearness, __m256 margin_m, __m256 margin_ratio) {
  const __m256 near = _mm256_div_ps(_mm256_set1_ps(1.0f), nearness);
  const __m256 beyond = _mm256_add_ps(near, greater(margin_m, _mm256_mul_ps(margin_ratio, near)));
  return _mm256_blendv_ps(_mm256_set1_ps(__FLT_MAX__), beyond,
                          _mm256_cmp_ps(nearness, _mm256_setzero_ps(), _CMP_GT_OQ));
}

inline __m256i tileAt(__m256 px, __m256 per_px, int count) {
  const __m256 at = _mm256_mul_ps(_mm256_add_ps(px, _mm256_set1_ps(0.5f)), per_px);
  const __m256 last = _mm256_set1_ps(static_cast<float>(count - 1));
  return _mm256_cvttps_epi32(greater(_mm256_setzero_ps(), lesser(at, last)));
}

/// Eight halves of one side.
struct EightHalves {
  __m256 values[14];  ///< in the order of HalfMask
  __m256i tiles[4];
  unsigned usable;  ///< lanes that are not seen edge-on
};

inline void makeHalves(const MaskCasters& casters, int i, MaskSide side, const TiledPoints& points,
                       EightHalves* halves) {
  const __m256 half = _mm256_set1_ps(0.5f), zero = _mm256_setzero_ps();
  const __m256 left_u = _mm256_loadu_ps(casters.arm_u[kMaskLeft] + i);
  const __m256 left_v = _mm256_loadu_ps(casters.arm_v[kMaskLeft] + i);
  const __m256 right_u = _mm256_loadu_ps(casters.arm_u[kMaskRight] + i);
  const __m256 right_v = _mm256_loadu_ps(casters.arm_v[kMaskRight] + i);
  const __m256 along_u = _mm256_loadu_ps(casters.arm_u[side] + i);
  const __m256 along_v = _mm256_loadu_ps(casters.arm_v[side] + i);
  const __m256 along_nearness = _mm256_loadu_ps(casters.arm_nearness[side] + i);
  const __m256 own = _mm256_loadu_ps(casters.nearness + i);
  const __m256 across_u = _mm256_mul_ps(half, _mm256_sub_ps(right_u, left_u));
  const __m256 across_v = _mm256_mul_ps(half, _mm256_sub_ps(right_v, left_v));
  const __m256 centre_u = _mm256_add_ps(_mm256_loadu_ps(casters.u + i),
                                        _mm256_mul_ps(half, _mm256_add_ps(right_u, left_u)));
  const __m256 centre_v = _mm256_add_ps(_mm256_loadu_ps(casters.v + i),
                                        _mm256_mul_ps(half, _mm256_add_ps(right_v, left_v)));
  const __m256 s_gain =
      _mm256_mul_ps(half, _mm256_sub_ps(_mm256_loadu_ps(casters.arm_nearness[kMaskRight] + i),
                                        _mm256_loadu_ps(casters.arm_nearness[kMaskLeft] + i)));
  const __m256 least = _mm256_sub_ps(lesser(own, along_nearness), magnitude(s_gain));
  const __m256 most = _mm256_add_ps(greater(own, along_nearness), magnitude(s_gain));

  const __m256 area =
      _mm256_sub_ps(_mm256_mul_ps(across_u, along_v), _mm256_mul_ps(across_v, along_u));
  const auto length = [](__m256 u, __m256 v) {
    return _mm256_sqrt_ps(_mm256_add_ps(_mm256_mul_ps(u, u), _mm256_mul_ps(v, v)));
  };
  const __m256 extent = _mm256_add_ps(length(across_u, across_v), length(along_u, along_v));
  halves->usable = static_cast<unsigned>(_mm256_movemask_ps(
      _mm256_cmp_ps(magnitude(area), _mm256_mul_ps(_mm256_set1_ps(kEdgeOn), extent), _CMP_GE_OQ)));
  const __m256 s_u = _mm256_div_ps(along_v, area), s_v = _mm256_div_ps(negative(along_u), area);
  const __m256 t_u = _mm256_div_ps(negative(across_v), area), t_v = _mm256_div_ps(across_u, area);
  const __m256 slack = _mm256_set1_ps(kMaskSlack_px);
  const __m256 s_slack = _mm256_mul_ps(slack, _mm256_add_ps(magnitude(s_u), magnitude(s_v)));
  const __m256 t_slack = _mm256_mul_ps(slack, _mm256_add_ps(magnitude(t_u), magnitude(t_v)));
  __m256* values = halves->values;
  values[0] = centre_u, values[1] = centre_v;
  values[2] = s_u, values[3] = s_v, values[4] = t_u, values[5] = t_v;
  values[6] = _mm256_add_ps(_mm256_set1_ps(1.0f), s_slack), values[7] = t_slack;
  values[8] = own, values[9] = s_gain, values[10] = _mm256_sub_ps(along_nearness, own);
  values[11] = least, values[12] = most;
  values[13] =
      hiddenBeyond(most, _mm256_set1_ps(points.margin_m), _mm256_set1_ps(points.margin_ratio));

  const __m256 twice = _mm256_set1_ps(2.0f * kMaskSlack_px), per_px = _mm256_set1_ps(points.per_px);
  const __m256 wide = _mm256_add_ps(magnitude(across_u), twice);
  const __m256 high = _mm256_add_ps(magnitude(across_v), twice);
  halves->tiles[0] = tileAt(_mm256_add_ps(_mm256_sub_ps(centre_u, wide), lesser(zero, along_u)),
                            per_px, points.columns);
  halves->tiles[1] = tileAt(_mm256_add_ps(_mm256_add_ps(centre_u, wide), greater(zero, along_u)),
                            per_px, points.columns);
  halves->tiles[2] = tileAt(_mm256_add_ps(_mm256_sub_ps(centre_v, high), lesser(zero, along_v)),
                            per_px, points.rows);
  halves->tiles[3] = tileAt(_mm256_add_ps(_mm256_add_ps(centre_v, high), greater(zero, along_v)),
                            per_px, points.rows);
}

/// Lanes in whose tiles something may be farther than they hide up to: exact for boxes of up to two
/// by two tiles.
inline unsigned maybeBehind(const EightHalves& halves, const TiledPoints& points) {
  const __m256i one = _mm256_set1_epi32(1);
  const __m256i large =
      _mm256_or_si256(_mm256_cmpgt_epi32(_mm256_sub_epi32(halves.tiles[1], halves.tiles[0]), one),
                      _mm256_cmpgt_epi32(_mm256_sub_epi32(halves.tiles[3], halves.tiles[2]), one));
  const __m256i tile = _mm256_add_epi32(
      _mm256_mullo_epi32(halves.tiles[2], _mm256_set1_epi32(points.columns)), halves.tiles[0]);
  const __m256 far = _mm256_i32gather_ps(points.far_of_four, tile, 4);
  const __m256 behind = _mm256_cmp_ps(far, halves.values[13], _CMP_GT_OQ);
  return static_cast<unsigned>(
             _mm256_movemask_ps(_mm256_or_ps(behind, _mm256_castsi256_ps(large)))) &
         halves.usable;
}

static_assert(offsetof(HalfMask, nearest) == 13 * sizeof(float), "the order of EightHalves");
static_assert(offsetof(HalfMask, tile_left) == 14 * sizeof(float), "the order of EightHalves");

int castHalves(const MaskCasters& casters, int count, const TiledPoints& points, HalfMask* halves) {
  int found = 0, i = 0;
  alignas(32) float lanes[18][8];
  for (; i + 8 <= count; i += 8) {
    for (const MaskSide side : kHalfSides) {
      EightHalves eight;
      makeHalves(casters, i, side, points, &eight);
      unsigned kept = maybeBehind(eight, points);
      if (kept == 0) continue;
      for (int k = 0; k < 14; ++k) _mm256_store_ps(lanes[k], eight.values[k]);
      for (int k = 0; k < 4; ++k) {
        _mm256_store_si256(reinterpret_cast<__m256i*>(lanes[14 + k]), eight.tiles[k]);
      }
      for (; kept != 0; kept &= kept - 1) {
        const int lane = __builtin_ctz(kept);
        HalfMask& half = halves[found];
        char* out = reinterpret_cast<char*>(&half);
        for (int k = 0; k < 18; ++k) {
          __builtin_memcpy(out + k * sizeof(float), &lanes[k][lane], sizeof(float));
        }
        found += anythingBehind(half, points);
      }
    }
  }
  return castHalvesFrom(casters, i, count, points, found, halves);
}

void hide(const HalfMask& mask, const TiledPoints& points, std::uint8_t* visible) {
  const __m256 nearest = _mm256_set1_ps(mask.nearest);
  const __m256 one = _mm256_set1_ps(1.0f);
  for (int row = mask.tile_top; row <= mask.tile_bottom; ++row) {
    const std::uint32_t* begin = points.begin + static_cast<std::ptrdiff_t>(row) * points.columns;
    const std::uint32_t end = begin[mask.tile_right + 1];
    for (std::uint32_t i = begin[mask.tile_left]; i < end; i += 8) {
      // The arrays are readable for a register beyond their end; those lanes do not count.
      const __m256 distance = _mm256_loadu_ps(points.distance + i);
      const unsigned lanes = end - i < 8 ? (1U << (end - i)) - 1 : 0xffU;
      const __m256 farther = _mm256_cmp_ps(distance, nearest, _CMP_GT_OQ);
      if ((static_cast<unsigned>(_mm256_movemask_ps(farther)) & lanes) == 0) continue;
      const __m256 du = _mm256_sub_ps(_mm256_loadu_ps(points.u + i), _mm256_set1_ps(mask.centre_u));
      const __m256 dv = _mm256_sub_ps(_mm256_loadu_ps(points.v + i), _mm256_set1_ps(mask.centre_v));
      const __m256 s = _mm256_add_ps(_mm256_mul_ps(_mm256_set1_ps(mask.s_u), du),
                                     _mm256_mul_ps(_mm256_set1_ps(mask.s_v), dv));
      const __m256 t = _mm256_add_ps(_mm256_mul_ps(_mm256_set1_ps(mask.t_u), du),
                                     _mm256_mul_ps(_mm256_set1_ps(mask.t_v), dv));
      const __m256 t_slack = _mm256_set1_ps(mask.t_slack);
      const __m256 beside =
          _mm256_or_ps(_mm256_cmp_ps(magnitude(s), _mm256_set1_ps(mask.s_most), _CMP_GT_OQ),
                       _mm256_or_ps(_mm256_cmp_ps(t, negative(t_slack), _CMP_LT_OQ),
                                    _mm256_cmp_ps(t, _mm256_add_ps(one, t_slack), _CMP_GT_OQ)));
      const __m256 within = _mm256_andnot_ps(beside, farther);
      if ((static_cast<unsigned>(_mm256_movemask_ps(within)) & lanes) == 0) continue;
      const __m256 straight =
          _mm256_add_ps(_mm256_add_ps(_mm256_set1_ps(mask.nearness),
                                      _mm256_mul_ps(_mm256_set1_ps(mask.s_gain), s)),
                        _mm256_mul_ps(_mm256_set1_ps(mask.t_gain), t));
      const __m256 nearness =
          lesser(_mm256_set1_ps(mask.most), greater(_mm256_set1_ps(mask.least), straight));
      const __m256 beyond = hiddenBeyond(nearness, _mm256_set1_ps(points.margin_m),
                                         _mm256_set1_ps(points.margin_ratio));
      const __m256 hidden = _mm256_and_ps(within, _mm256_cmp_ps(distance, beyond, _CMP_GT_OQ));
      unsigned bits = static_cast<unsigned>(_mm256_movemask_ps(hidden)) & lanes;
      for (; bits != 0; bits &= bits - 1) visible[points.place[i + __builtin_ctz(bits)]] = 0;
    }
  }
}

}  // namespace

const MaskKernels kAvx2MaskKernels = {"avx2", projectTargets, castHalves, hide};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
// The body of both versions of the kernels: loops without branches, which the compiler turns into
// the registers of the file that includes this.

#include <cmath>

#include "covariance_kernels.h"

namespace semantic_lidar_fusion {
namespace {

/// This near to the axis, as a part of the distance, the radius is the angle to single precision.
constexpr float kNearAxis = 1e-4f;

void equidistant(const RadialFit& lens, int count, CovarianceBlock* block) {
  float from_axis[kCovarianceBlock];
  for (int i = 0; i < count; ++i) {
    from_axis[i] = std::sqrt(block->x[i] * block->x[i] + block->y[i] * block->y[i]);
  }
  for (int i = 0; i < count; ++i) {
    const float x = block->x[i], y = block->y[i], z = block->z[i];
    const float rho = from_axis[i], squared = rho * rho + z * z;
    const float w = block->theta[i] * block->theta[i];
    const float factor = 1.0f + w * (lens.k[0] + w * (lens.k[1] + w * (lens.k[2] + w * lens.k[3])));
    const float slope =
        1.0f + w * (3.0f * lens.k[0] +
                    w * (5.0f * lens.k[1] + w * (7.0f * lens.k[2] + w * 9.0f * lens.k[3])));
    const bool on_axis = rho * rho < kNearAxis * kNearAxis * squared;
    const float safe = on_axis ? 1.0f : rho;
    // The plane's point is a = radius e, e = (x, y) / rho. A step along e turns theta by z / d^2,
    // one along z by -rho / d^2, one across e turns e by 1 / rho.
    const float across = on_axis ? z / squared : block->theta[i] * factor / safe;
    const float along = slope * z / squared;
    const float ex = on_axis ? 0.0f : x / safe, ey = on_axis ? 0.0f : y / safe;
    const float axx = across + (along - across) * ex * ex;
    const float axy = (along - across) * ex * ey;
    const float ayy = across + (along - across) * ey * ey;
    const float back = -slope / squared;
    const float axz = back * x, ayz = back * y;
    block->ju[0][i] = lens.focal_x * (axx + lens.skew * axy);
    block->ju[1][i] = lens.focal_x * (axy + lens.skew * ayy);
    block->ju[2][i] = lens.focal_x * (axz + lens.skew * ayz);
    block->jv[0][i] = lens.focal_y * axy;
    block->jv[1][i] = lens.focal_y * ayy;
    block->jv[2][i] = lens.focal_y * ayz;
  }
}

/// s g, with the symmetric matrix s.
inline void times(const float* s, const float* g, float* out) {
  out[0] =
      ((s[0] * g[0] + s[1] * g[1]) + (s[2] * g[2] + s[3] * g[3])) + (s[4] * g[4] + s[5] * g[5]);
  out[1] =
      ((s[1] * g[0] + s[6] * g[1]) + (s[7] * g[2] + s[8] * g[3])) + (s[9] * g[4] + s[10] * g[5]);
  out[2] =
      ((s[2] * g[0] + s[7] * g[1]) + (s[11] * g[2] + s[12] * g[3])) + (s[13] * g[4] + s[14] * g[5]);
  out[3] =
      ((s[3] * g[0] + s[8] * g[1]) + (s[12] * g[2] + s[15] * g[3])) + (s[16] * g[4] + s[17] * g[5]);
  out[4] =
      ((s[4] * g[0] + s[9] * g[1]) + (s[13] * g[2] + s[16] * g[3])) + (s[18] * g[4] + s[19] * g[5]);
  out[5] = ((s[5] * g[0] + s[10] * g[1]) + (s[14] * g[2] + s[17] * g[3])) +
           (s[19] * g[4] + s[20] * g[5]);
}

inline float dot(const float* a, const float* b) {
  return ((a[0] * b[0] + a[1] * b[1]) + (a[2] * b[2] + a[3] * b[3])) + (a[4] * b[4] + a[5] * b[5]);
}

template <bool kOdometry>
void addMotions(const CovarianceConstants& constants, int count, CovarianceBlock* block) {
  for (int i = 0; i < count; ++i) {
    const float x = block->x[i], y = block->y[i], z = block->z[i];
    float s[kSymmetric6];
    for (int k = 0; k < kSymmetric6; ++k) {
      s[k] = kOdometry ? constants.common[k] + block->motion_s2[i] * constants.odometry[k]
                       : constants.common[k];
    }
    // Rows of J M: j, and p x j.
    const float u0 = block->ju[0][i], u1 = block->ju[1][i], u2 = block->ju[2][i];
    const float v0 = block->jv[0][i], v1 = block->jv[1][i], v2 = block->jv[2][i];
    const float gu[6] = {u0, u1, u2, y * u2 - z * u1, z * u0 - x * u2, x * u1 - y * u0};
    const float gv[6] = {v0, v1, v2, y * v2 - z * v1, z * v0 - x * v2, x * v1 - y * v0};
    float su[6], sv[6];
    times(s, gu, su);
    times(s, gv, sv);
    block->uu[i] = constants.own_uu + dot(gu, su);
    block->uv[i] = dot(gu, sv);
    block->vv[i] = constants.own_vv + dot(gv, sv);
  }
}

void addBeam(const CovarianceConstants& constants, int count, CovarianceBlock* block) {
  const float* r = constants.rotation;
  for (int i = 0; i < count; ++i) {
    const float u0 = block->ju[0][i], u1 = block->ju[1][i], u2 = block->ju[2][i];
    const float v0 = block->jv[0][i], v1 = block->jv[1][i], v2 = block->jv[2][i];
    // J R
    const float ux = u0 * r[0] + u1 * r[3] + u2 * r[6], vx = v0 * r[0] + v1 * r[3] + v2 * r[6];
    const float uy = u0 * r[1] + u1 * r[4] + u2 * r[7], vy = v0 * r[1] + v1 * r[4] + v2 * r[7];
    const float uz = u0 * r[2] + u1 * r[5] + u2 * r[8], vz = v0 * r[2] + v1 * r[5] + v2 * r[8];
    const float bx = block->beam_x[i], by = block->beam_y[i], bz = block->beam_z[i];
    const float flat = block->flat_range[i], range = block->range[i];
    const float per_range2 = constants.range_m2 / (range * range);
    // r (-y, x, 0) / h and (-z x, -z y, h^2) / h: a radian sideways and up.
    const float scale = range / flat;
    const float side2 = constants.side_rad2 * scale * scale;
    const float up = 1.0f / flat;
    const float along_u = ux * bx + uy * by + uz * bz, along_v = vx * bx + vy * by + vz * bz;
    const float side_u = uy * bx - ux * by, side_v = vy * bx - vx * by;
    const float up_u = uz * flat - up * bz * (ux * bx + uy * by);
    const float up_v = vz * flat - up * bz * (vx * bx + vy * by);
    block->uu[i] += per_range2 * along_u * along_u +
                    (side2 * side_u * side_u + constants.up_rad2 * up_u * up_u);
    block->uv[i] += per_range2 * along_u * along_v +
                    (side2 * side_u * side_v + constants.up_rad2 * up_u * up_v);
    block->vv[i] += per_range2 * along_v * along_v +
                    (side2 * side_v * side_v + constants.up_rad2 * up_v * up_v);
  }
}

void covariances(const CovarianceConstants& constants, bool odometry, bool beam, int count,
                 CovarianceBlock* block) {
  if (odometry) {
    addMotions<true>(constants, count, block);
  } else {
    addMotions<false>(constants, count, block);
  }
  if (beam) addBeam(constants, count, block);
}

}  // namespace
}  // namespace semantic_lidar_fusion

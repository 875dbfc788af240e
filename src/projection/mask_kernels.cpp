// SPDX-License-Identifier: MIT
#include "mask_kernels.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace semantic_lidar_fusion {
namespace {

/// Angle of (along, across) from the axis, 0..pi; `across` is not negative.
double angleOf(double across, double along) {
  const double magnitude = std::fabs(along);
  const bool steep = across > magnitude;
  const double q = (steep ? magnitude : across) / (steep ? across : magnitude);
  const bool turned = q > kAtanTurned;
  const double x = turned ? (q - 1.0) / (q + 1.0) : q;
  const double z = x * x;
  double p = kAtanP[0], d = z + kAtanQ[0];
  for (int i = 1; i < 5; ++i) {
    p = p * z + kAtanP[i];
    d = d * z + kAtanQ[i];
  }
  double angle = x * (z * (p / d)) + x;
  angle = turned ? kAtanQuarter + angle : angle;
  angle = steep ? kAtanHalf - angle : angle;
  return along < 0.0 ? kAtanWhole - angle : angle;
}

/// Distance from which a mask of 1 / distance `nearness` hides; never if that is not positive.
float hiddenBeyond(float nearness, const TiledPoints& points) {
  if (!(nearness > 0.0f)) return std::numeric_limits<float>::max();
  const float near = 1.0f / nearness;
  return near + std::max(points.margin_m, points.margin_ratio * near);
}

int tileAt(float px, float per_px, int count) {
  const float at = (px + 0.5f) * per_px;
  return static_cast<int>(std::max(0.0f, std::min(at, static_cast<float>(count - 1))));
}

/// False for one that is seen edge-on.
bool makeHalf(const MaskCasters& casters, int i, MaskSide side, const TiledPoints& points,
              HalfMask* half) {
  const float left_u = casters.arm_u[kMaskLeft][i], left_v = casters.arm_v[kMaskLeft][i];
  const float right_u = casters.arm_u[kMaskRight][i], right_v = casters.arm_v[kMaskRight][i];
  const float along_u = casters.arm_u[side][i], along_v = casters.arm_v[side][i];
  const float along_nearness = casters.arm_nearness[side][i], own = casters.nearness[i];
  const float across_u = 0.5f * (right_u - left_u), across_v = 0.5f * (right_v - left_v);
  half->centre_u = casters.u[i] + 0.5f * (right_u + left_u);
  half->centre_v = casters.v[i] + 0.5f * (right_v + left_v);
  half->nearness = own;
  half->s_gain = 0.5f * (casters.arm_nearness[kMaskRight][i] - casters.arm_nearness[kMaskLeft][i]);
  half->t_gain = along_nearness - own;
  half->least = std::min(own, along_nearness) - std::fabs(half->s_gain);
  half->most = std::max(own, along_nearness) + std::fabs(half->s_gain);
  half->nearest = hiddenBeyond(half->most, points);

  const float area = across_u * along_v - across_v * along_u;
  const float extent = std::sqrt(across_u * across_u + across_v * across_v) +
                       std::sqrt(along_u * along_u + along_v * along_v);
  if (!(std::fabs(area) >= kEdgeOn * extent)) return false;
  half->s_u = along_v / area;
  half->s_v = -along_u / area;
  half->t_u = -across_v / area;
  half->t_v = across_u / area;
  half->s_most = 1.0f + kMaskSlack_px * (std::fabs(half->s_u) + std::fabs(half->s_v));
  half->t_slack = kMaskSlack_px * (std::fabs(half->t_u) + std::fabs(half->t_v));

  const float wide = std::fabs(across_u) + 2.0f * kMaskSlack_px;
  const float high = std::fabs(across_v) + 2.0f * kMaskSlack_px;
  const auto column = [&](float u) { return tileAt(u, points.per_px, points.columns); };
  const auto row = [&](float v) { return tileAt(v, points.per_px, points.rows); };
  half->tile_left = column(half->centre_u - wide + std::min(0.0f, along_u));
  half->tile_right = column(half->centre_u + wide + std::max(0.0f, along_u));
  half->tile_top = row(half->centre_v - high + std::min(0.0f, along_v));
  half->tile_bottom = row(half->centre_v + high + std::max(0.0f, along_v));
  return true;
}

void projectTargets(const ExactLens& lens, int count, ArmTargets* targets) {
  projectTargetsFrom(lens, 0, count, targets);
}

int castHalves(const MaskCasters& casters, int count, const TiledPoints& points, HalfMask* halves) {
  return castHalvesFrom(casters, 0, count, points, 0, halves);
}

void hide(const HalfMask& mask, const TiledPoints& points, std::uint8_t* visible) {
  for (int row = mask.tile_top; row <= mask.tile_bottom; ++row) {
    const std::uint32_t* begin = points.begin + static_cast<std::ptrdiff_t>(row) * points.columns;
    hideFrom(mask, points, begin[mask.tile_left], begin[mask.tile_right + 1], visible);
  }
}

}  // namespace

void projectTargetsFrom(const ExactLens& lens, int first, int count, ArmTargets* targets) {
  const double* m = lens.matrix;
  for (int i = first; i < count; ++i) {
    const double x = targets->x[i], y = targets->y[i], z = targets->z[i];
    const double right = (m[0] * x + m[1] * y) + (m[2] * z + m[3]);
    const double down = (m[4] * x + m[5] * y) + (m[6] * z + m[7]);
    const double forward = (m[8] * x + m[9] * y) + (m[10] * z + m[11]);
    const double squared = right * right + down * down;
    const double from_axis = std::sqrt(squared);
    const double theta = angleOf(from_axis, forward);
    const double w = theta * theta;
    const double radius =
        theta * (1.0 + w * (lens.k[0] + w * (lens.k[1] + w * (lens.k[2] + w * lens.k[3]))));
    const double scale = from_axis > 0.0 ? radius / from_axis : 0.0;
    const double a = right * scale, b = down * scale;
    const double u = lens.focal_x * (a + lens.skew * b) + lens.centre_x;
    const double v = lens.focal_y * b + lens.centre_y;
    // NaN where the lens has no pixel: an angle beyond its end, or the camera's centre.
    const bool seen = theta <= lens.theta_end && (from_axis > 0.0 || forward > 0.0) &&
                      std::fabs(u) <= std::numeric_limits<double>::max() &&
                      std::fabs(v) <= std::numeric_limits<double>::max();
    const double distance = std::sqrt(squared + forward * forward);
    targets->u[i] = seen ? static_cast<float>(u) : std::numeric_limits<float>::quiet_NaN();
    targets->v[i] = static_cast<float>(v);
    targets->nearness[i] = static_cast<float>(1.0 / std::max(distance, kLeastMaskDistance));
  }
}

bool anythingBehind(const HalfMask& mask, const TiledPoints& points) {
  for (int row = mask.tile_top; row <= mask.tile_bottom; ++row) {
    const float* far = points.far + static_cast<std::ptrdiff_t>(row) * points.columns;
    for (int column = mask.tile_left; column <= mask.tile_right; ++column) {
      if (far[column] > mask.nearest) return true;
    }
  }
  return false;
}

int castHalvesFrom(const MaskCasters& casters, int first, int count, const TiledPoints& points,
                   int found, HalfMask* halves) {
  for (int i = first; i < count; ++i) {
    for (const MaskSide side : kHalfSides) {
      HalfMask& half = halves[found];
      found += makeHalf(casters, i, side, points, &half) && anythingBehind(half, points);
    }
  }
  return found;
}

void hideFrom(const HalfMask& mask, const TiledPoints& points, std::uint32_t first,
              std::uint32_t end, std::uint8_t* visible) {
  for (std::uint32_t i = first; i < end; ++i) {
    const float distance = points.distance[i];
    if (!(distance > mask.nearest)) continue;
    const float du = points.u[i] - mask.centre_u, dv = points.v[i] - mask.centre_v;
    const float s = mask.s_u * du + mask.s_v * dv, t = mask.t_u * du + mask.t_v * dv;
    if (std::fabs(s) > mask.s_most || t < -mask.t_slack || t > 1.0f + mask.t_slack) continue;
    const float nearness = std::min(
        mask.most, std::max(mask.least, mask.nearness + mask.s_gain * s + mask.t_gain * t));
    if (distance > hiddenBeyond(nearness, points)) visible[points.place[i]] = 0;
  }
}

const MaskKernels kPlainMaskKernels = {"plain", projectTargets, castHalves, hide};

const MaskKernels& maskKernels() {
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) return kAvx2MaskKernels;
#endif
  return kPlainMaskKernels;
}

}  // namespace semantic_lidar_fusion

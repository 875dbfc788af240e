// SPDX-License-Identifier: MIT
#include "projection_kernels.h"

#include <cmath>

namespace semantic_lidar_fusion {
namespace {

int select(const SightCone& cone, const float* x, const float* y, const float* z,
           const std::uint8_t* status, std::uint8_t excluded, int count, SelectedPoints* out) {
  return selectFrom(cone, x, y, z, status, excluded, 0, count, 0, out);
}

int equidistant(const EquidistantLens& lens, const SelectedPoints& points, int count,
                PixelBlock* out) {
  out->doubtful_count = 0;
  return equidistantFrom(lens, points, 0, count, 0, out);
}

}  // namespace

int selectFrom(const SightCone& cone, const float* x, const float* y, const float* z,
               const std::uint8_t* status, std::uint8_t excluded, int first, int count,
               int selected, SelectedPoints* out) {
  const float* m = cone.matrix;
  for (int i = first; i < count; ++i) {
    const float px = (m[0] * x[i] + m[1] * y[i]) + (m[2] * z[i] + m[3]);
    const float py = (m[4] * x[i] + m[5] * y[i]) + (m[6] * z[i] + m[7]);
    const float pz = (m[8] * x[i] + m[9] * y[i]) + (m[10] * z[i] + m[11]);
    const float distance = std::sqrt((px * px + py * py) + pz * pz);
    // NaN is kept: whoever projects it exactly finds that it has no pixel.
    const bool outside = pz < distance * cone.cosine - cone.reach_m && distance <= kMostSelectable;
    out->x[selected] = x[i];
    out->y[selected] = y[i];
    out->z[selected] = z[i];
    out->place[selected] = static_cast<std::uint32_t>(i);
    selected += !outside && status[i] != excluded;
  }
  return selected;
}

int equidistantFrom(const EquidistantLens& lens, const SelectedPoints& points, int first, int count,
                    int kept, PixelBlock* out) {
  const double* m = lens.matrix;
  for (int i = first; i < count; ++i) {
    const double x = points.x[i], y = points.y[i], z = points.z[i];
    const double px = (m[0] * x + m[1] * y) + (m[2] * z + m[3]);
    const double py = (m[4] * x + m[5] * y) + (m[6] * z + m[7]);
    const double pz = (m[8] * x + m[9] * y) + (m[10] * z + m[11]);
    const double squared = (px * px + py * py) + pz * pz;

    const float right = static_cast<float>(px), down = static_cast<float>(py);
    const float forward = static_cast<float>(pz);
    const float from_axis = std::sqrt(right * right + down * down);
    const float along = std::fabs(forward);
    const bool near_axis = from_axis < along;
    const float q = (near_axis ? from_axis : along) / (near_axis ? along : from_axis);
    const float s = q * q;
    float series = kAtan[8];
    for (int k = 7; k >= 0; --k) series = kAtan[k] + s * series;
    const float atan = q * series;
    float theta = near_axis ? atan : kQuarterTurn - atan;
    theta = forward < 0.0f ? kHalfTurn - theta : theta;

    const float w = theta * theta;
    const float distorted =
        theta *
        (1.0f + w * (lens.k[0] + w * (lens.k[1] + w * (lens.k[2] + w * lens.k[3]))));  // eq. 9
    const float scale = distorted / from_axis;
    const float a = right * scale, b = down * scale;
    const float u = lens.focal_x * (a + lens.skew * b) + lens.centre_x;
    const float v = lens.focal_y * b + lens.centre_y;

    const bool measurable = squared >= kLeastSquaredDistance && squared <= kMostSquaredDistance &&
                            from_axis >= kLeastFromAxis;
    const bool sure = theta < lens.theta_sure && measurable;
    const bool never = theta > lens.theta_never && measurable;
    const bool inside = u >= lens.u_begin && u < lens.u_end && v >= lens.v_begin && v < lens.v_end;
    const bool doubtful = !sure && !never;
    if (!doubtful && !(sure && inside)) continue;
    if (doubtful) out->doubtful[out->doubtful_count++] = static_cast<std::uint32_t>(kept);
    out->u[kept] = u;
    out->v[kept] = v;
    out->distance[kept] = static_cast<float>(std::sqrt(squared));
    out->theta[kept] = theta;
    out->place[kept] = points.place[i];
    ++kept;
  }
  return kept;
}

const ProjectionKernels kPlainProjectionKernels = {"plain", select, equidistant};

ProjectionKernelList usableProjectionKernels() {
  ProjectionKernelList list{1, {&kPlainProjectionKernels, nullptr}};
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) list.kernels[list.count++] = &kAvx2ProjectionKernels;
#endif
  return list;
}

}  // namespace semantic_lidar_fusion

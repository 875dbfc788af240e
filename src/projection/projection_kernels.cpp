// SPDX-License-Identifier: MIT
#include "projection_kernels.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "semantic_lidar_fusion/projection/rolling_shutter.h"

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

int roll(const RollingRows& rows, const SelectedPoints& points, int count, SelectedPoints* out) {
  return rollFrom(rows, points, 0, count, 0, out);
}

float along(const float* row, float x, float y, float z) {
  return (row[0] * x + row[1] * y) + (row[2] * z + row[3]);
}

struct Point {
  float x, y, z;
};

Point cross(const float* a, const Point& b) {
  return {a[1] * b.z - a[2] * b.y, a[2] * b.x - a[0] * b.z, a[0] * b.y - a[1] * b.x};
}

/// seenLater().
Point seenLater(const Flow& flow, const Point& p, float t_s) {
  const float half_s = 0.5f * t_s;
  Point first = cross(flow.turn, p);
  first.x += flow.velocity[0], first.y += flow.velocity[1], first.z += flow.velocity[2];
  const Point second = cross(flow.turn, first);
  return {p.x - t_s * (first.x - half_s * second.x), p.y - t_s * (first.y - half_s * second.y),
          p.z - t_s * (first.z - half_s * second.z)};
}

/// c[0] + s (c[1] + s ...), of five coefficients, with few operations that wait for each other.
float series(const float* c, float s) {
  const float s2 = s * s;
  return (c[0] + s * c[1]) + s2 * ((c[2] + s * c[3]) + s2 * c[4]);
}

/// When the row of a point is exposed, and whether it has a pixel.
struct RowSeen {
  float time_s;
  bool sure, never;
};

RowSeen rowSeen(const RollingRows& rows, const Point& p) {
  const float right = p.x, down = p.y, forward = p.z;
  const float squared_from_axis = right * right + down * down;
  const float squared = squared_from_axis + forward * forward;
  const float from_axis = std::sqrt(squared_from_axis), along_axis = std::fabs(forward);
  const bool near_axis = from_axis < along_axis;
  const float q = (near_axis ? from_axis : along_axis) / (near_axis ? along_axis : from_axis);
  const float atan = q * series(kRoughAtan, q * q);
  const float acute = near_axis ? atan : kQuarterTurn - atan;
  const float theta = forward < 0.0f ? kHalfTurn - acute : acute;
  const float scale = theta * series(rows.k, theta * theta) / from_axis;
  const float a = right * scale, b = down * scale;
  const float row = (rows.per_right * a + rows.per_down * b) + rows.at_centre;
  const bool measurable = squared >= rows.least_squared_m2 &&
                          squared <= static_cast<float>(kMostSquaredDistance) &&
                          from_axis >= kLeastFromAxis;
  RowSeen seen{};
  seen.time_s = rows.at_zero_s + rows.per_px_s * std::max(rows.begin, std::min(row, rows.end));
  seen.sure = measurable && theta < rows.theta_sure;
  seen.never = measurable && theta > rows.theta_never;
  return seen;
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

int rollFrom(const RollingRows& rows, const SelectedPoints& points, int first, int count, int kept,
             SelectedPoints* out) {
  const float* m = rows.matrix;
  for (int i = first; i < count; ++i) {
    const float x = points.x[i], y = points.y[i], z = points.z[i];
    const Point p{along(m, x, y, z), along(m + 4, x, y, z), along(m + 8, x, y, z)};
    const RowSeen one = rowSeen(rows, p);
    const RowSeen two = rowSeen(rows, seenLater(rows.in_image, p, one.time_s));
    const bool sure = one.sure && two.sure;
    if (one.never || (one.sure && two.never)) continue;
    const Point later = seenLater(rows.in_lidar, {x, y, z}, secantTime(one.time_s, two.time_s));
    out->x[kept] = sure ? later.x : std::numeric_limits<float>::quiet_NaN();
    out->y[kept] = later.y;
    out->z[kept] = later.z;
    out->place[kept] = points.place[i];
    ++kept;
  }
  return kept;
}

const ProjectionKernels kPlainProjectionKernels = {"plain", select, equidistant, roll};

ProjectionKernelList usableProjectionKernels() {
  ProjectionKernelList list{1, {&kPlainProjectionKernels, nullptr}};
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) list.kernels[list.count++] = &kAvx2ProjectionKernels;
#endif
  return list;
}

}  // namespace semantic_lidar_fusion

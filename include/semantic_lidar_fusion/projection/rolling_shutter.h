// SPDX-License-Identifier: MIT
/// Pixels of a rolling shutter: a point is seen where it is when its own row is exposed.
///
/// The row follows from the pixel and the pixel from the row's time t, so t = rowTime(pixel(t)) is
/// solved by two rounds: from the pixel at the image's time, and then along the secant through
/// both. With 30 ms of readout at 15 m/s and 30 deg/s the pixel is right to 0.05 px from 3 m on.
/// What moves by itself is seen where a thing that stands still would be.
#pragma once

#include <cmath>
#include <optional>

#include "semantic_lidar_fusion/camera/camera_model.h"

namespace semantic_lidar_fusion {

/// A point as one camera sees it.
struct SeenPoint {
  Eigen::Vector2d pixel;
  Eigen::Vector3d p_camera;  ///< in the camera's frame when the pixel's row is exposed, m
};

/// What a camera sees of a point given in its frame at the image's time; empty if the lens has no
/// pixel for it in any round. `motion` is the camera's; null, or a camera without a rolling
/// shutter: the pixel at the image's time.
std::optional<SeenPoint> seePoint(const CameraModel& camera, const Twist* motion,
                                  const Eigen::Vector3d& p_camera);

/// A pixel's row time, s; pixels far outside the image count as one image's height outside.
double clampedRowTime(const CameraModel& camera, double u, double v);
/// The next guess of t = f(t) from two earlier ones, f(0) and f(t1) with t1 = f(0).
template <typename Real>
Real secantTime(Real t1, Real f_t1) {
  // With slope = (f(t1) - f(0)) / t1 the next is (f(t1) - slope t1) / (1 - slope).
  const Real rise = f_t1 - t1;
  return Real(2) * std::abs(rise) < std::abs(t1) ? t1 * t1 / (t1 - rise) : f_t1;
}

}  // namespace semantic_lidar_fusion

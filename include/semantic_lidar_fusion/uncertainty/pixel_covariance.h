// SPDX-License-Identifier: MIT
/// Covariance of the pixels of lidar points, to the first order of the errors.
///
/// A point p in the camera's frame has the pixel u(p), with the lens's Jacobian J. It is displaced
/// by small motions of the camera, which are common to all points (extrinsics, stamps; odometry
/// between the point's time and the image's), and by its own beam (range; a disc of uniform density
/// across, whose standard deviation is a quarter of its width):
///
///   Sigma = J [ M (S + g(D) S_odometry) M' + R S_beam R' ] J' + s_lens^2 I + cell^2 / 12
///   M = [I | -[p]x]
///
/// The last term is that of a distribution which is the same all over its score cell. Of a rolling
/// shutter p is where it is when its row is exposed, and J tells that a displaced point meets
/// another row.
#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/projection/cloud_projector.h"
#include "semantic_lidar_fusion/uncertainty/view_errors.h"

namespace semantic_lidar_fusion {

/// Symmetric 2 x 2 matrices, px^2; arrays of equal length.
struct PixelCovariances {
  std::vector<float> uu, uv, vv;

  std::size_t size() const { return uu.size(); }
  void resize(std::size_t count);
};

/// Of those of `points` that `places` names, in its order. The other arguments are those of
/// projectCloud. `cell_px`: width and height of a score cell; 0 leaves its term out.
PixelCovariances pixelCovariances(const Cloud& cloud, const ProjectedPoints& points,
                                  const std::vector<std::uint32_t>& places,
                                  const Transform& T_camera_lidar, const CameraModel& camera,
                                  const Twist* motion, const ViewErrors& errors,
                                  const Eigen::Vector2d& cell_px);

/// Points that stand for a normal distribution about the origin: their mean and covariance are its
/// own, and so are its moments up to the fifth along both axes.
struct SigmaPoints {
  int count = 0;
  float du[9], dv[9];  ///< in the covariance's unit; the first is 0, 0
  float weight[9];     ///< sum 1
};

/// For the ellipse of a covariance: the product of (0, +-sqrt(3)) standard deviations along both
/// axes with weights 2/3 and 1/6. An axis shorter than `negligible` (one standard deviation) has no
/// points of its own, so there are 9, 3 or 1.
SigmaPoints sigmaPoints(float uu, float uv, float vv, float negligible);

}  // namespace semantic_lidar_fusion

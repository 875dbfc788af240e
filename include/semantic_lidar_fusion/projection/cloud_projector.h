// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <vector>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/point_cloud.h"

namespace semantic_lidar_fusion {

/// Points of a cloud that have a pixel in or near one camera's image; arrays of equal length, in
/// the cloud's order.
struct ProjectedPoints {
  std::vector<std::uint32_t> index;  ///< into the cloud
  std::vector<float> u, v;           ///< px
  std::vector<float> distance;       ///< m, to the camera's origin
  std::vector<float> theta;          ///< rad, from the optical axis

  std::size_t size() const { return index.size(); }
};

/// Projects the points of `cloud` that have odometry. `T_camera_lidar` takes the lidar at the
/// cloud's stamp to the camera at its image's time. Pixels up to `margin_px` outside the image are
/// kept. `motion`: of the camera at that time, for a rolling shutter (see rolling_shutter.h); null
/// = none.
ProjectedPoints projectCloud(const Cloud& cloud, const Transform& T_camera_lidar,
                             const CameraModel& camera, double margin_px,
                             const Twist* motion = nullptr);

}  // namespace semantic_lidar_fusion

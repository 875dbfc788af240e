// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/projection/cloud_projector.h"

namespace semantic_lidar_fusion {

ProjectedPoints projectCloud(const Cloud& cloud, const Transform& T_camera_lidar,
                             const CameraModel& camera, double margin_px) {
  const double u_end = camera.imageSize().width - 0.5 + margin_px;
  const double v_end = camera.imageSize().height - 0.5 + margin_px;
  const double begin = -0.5 - margin_px;
  const auto no_odometry = static_cast<std::uint8_t>(PointStatus::kNoOdometry);

  ProjectedPoints result;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    if (cloud.status[i] == no_odometry) continue;
    const Eigen::Vector3d p_camera =
        T_camera_lidar * Eigen::Vector3d(cloud.x[i], cloud.y[i], cloud.z[i]);
    const auto pixel = camera.project(p_camera);
    if (!pixel) continue;
    // Cast before the test, so that a kept point with margin 0 is inside the image for its users.
    const auto u = static_cast<float>(pixel->x());
    const auto v = static_cast<float>(pixel->y());
    if (!(u >= begin && u < u_end && v >= begin && v < v_end)) continue;
    result.index.push_back(static_cast<std::uint32_t>(i));
    result.u.push_back(u);
    result.v.push_back(v);
    result.distance.push_back(static_cast<float>((p_camera - camera.opticalCentre()).norm()));
    result.theta.push_back(static_cast<float>(camera.theta(p_camera)));
  }
  return result;
}

}  // namespace semantic_lidar_fusion

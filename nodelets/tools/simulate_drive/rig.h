// SPDX-License-Identifier: MIT
/// The simulated vehicle: the names and frames of config/demo.yaml, and where its sensors are.
#pragma once

#include <string>
#include <vector>

#include "tools/simulate_drive/camera.h"

namespace semantic_lidar_fusion {
namespace simulator {

constexpr char kLidarFrame[] = "velodyne_front_link";
constexpr char kLidarTopic[] = "/velodyne/front/velodyne_packets";
constexpr int kFullWidth = 1920, kFullHeight = 1208;

struct MountedCamera {
  std::string name;  ///< topics live in /gmsl/<name>/
  CameraInfo said_info;
  Transform T_base_said;
  Camera camera;  ///< as it really is
};

/// Five fisheye cameras of 100 deg, `drop_m` below the lidar, images `scale` times 1920 x 1208.
std::vector<MountedCamera> makeCameras(double scale, double drop_m);
/// 1.37 m above base_link, tilted 7 deg forward.
Transform lidarPose();

}  // namespace simulator
}  // namespace semantic_lidar_fusion

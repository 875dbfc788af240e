// SPDX-License-Identifier: MIT
/// The simulated vehicle: the names and frames of config/demo.yaml, and where its sensors are.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "tools/simulate_drive/camera.h"
#include "tools/simulate_drive/errors.h"

namespace semantic_lidar_fusion {
namespace simulator {

constexpr char kLidarFrame[] = "velodyne_front_link";
constexpr char kLidarTopic[] = "/velodyne/front/velodyne_packets";
constexpr int kFullWidth = 1920, kFullHeight = 1208;

/// Lens and images of all cameras.
struct Optics {
  double scale = 0.5;  ///< of fisheyes of 100 deg with 1920 x 1208 pixels
  /// In place of them: images of the file's resolution.
  std::shared_ptr<const LensCalibration> lens;

  double imageScale() const { return lens ? 1.0 : scale; }
};

struct MountedCamera {
  std::string name;  ///< topics live in /gmsl/<name>/
  CameraInfo said_info;
  Transform T_base_said;
  Camera said;  ///< as the bag tells it
  Camera real;
};

/// Five cameras, `drop_m` below the lidar.
std::vector<MountedCamera> makeCameras(const Optics& optics, double drop_m,
                                       const DrawnErrors& errors);
/// 1.37 m above base_link, tilted 7 deg forward.
Transform lidarPose();

}  // namespace simulator
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Calibrations of lenses that sensor_msgs/CameraInfo cannot name, from the files that calibration
/// tools write:
///
/// - Kalibr's camchain: `cam0`, `cam1`, ... with `camera_model` pinhole, omni, ds or eucm,
///   `intrinsics`, `distortion_model` none, radtan or equidistant, `distortion_coeffs`,
///   `resolution` and, if known, `T_cam_imu` or `T_cn_cnm1` (from the camera before).
/// - The files of KITTI-360 and other users of camodocal: `model_type` MEI, PINHOLE or
///   KANNALA_BRANDT.
/// - This package's own: `model` (a name of lensKinds()), `resolution: [width, height]`, `focal:
///   [fx, fy]` (absent where the coefficients are in px: ocam, ftheta), `centre: [cx, cy]`, `skew`
///   (K[1] / K[0]) and `coefficients`.
#pragma once

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/camera/lens.h"
#include "semantic_lidar_fusion/common/types.h"

namespace YAML {
class Node;
}

namespace semantic_lidar_fusion {

/// One camera of a file.
struct LensCalibration {
  LensParameters lens;
  double fx = 1, fy = 1, cx = 0, cy = 0;  ///< px
  double skew = 0;                        ///< K[1] / K[0]
  ImageSize size;                         ///< full resolution
  std::string file;
  /// From the file's common body (the IMU, or its first camera) to this camera; if the file has it.
  std::optional<Transform> T_camera_body;
};

/// `camera`: its key in a file of several cameras; may be empty where there is one. Throws
/// ConfigError with every problem.
LensCalibration loadLens(const std::string& path, const std::string& camera);
/// The same for a tree that is already in memory; `path` names it in messages.
LensCalibration lensFromYaml(const YAML::Node& root, const std::string& path,
                             const std::string& camera);

/// A camera's calibration beside its extrinsics from tf.
struct MountedLens {
  std::string camera;  ///< the rig's name
  std::shared_ptr<const LensCalibration> lens;
  Transform T_camera_lidar = Transform::Identity();
};
/// One sentence for each camera that its file mounts more than 1 deg or 5 cm otherwise than tf
/// does, relative to the first camera of the same file.
std::vector<std::string> mountingContradictions(const std::vector<MountedLens>& cameras);

}  // namespace semantic_lidar_fusion

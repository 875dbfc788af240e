// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/camera_places.h"

#include <algorithm>
#include <utility>

#include "edge/topics.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {

CameraPlaces::CameraPlaces(const Rig& rig, const DriveIndex& index, const TfPoseSource& poses,
                           DropLog* drops, RigWatch* watch)
    : rig_(rig),
      index_(index),
      poses_(poses),
      drops_(*drops),
      watch_(*watch),
      models_(rig.cameras.size()) {}

CameraPlace CameraPlaces::at(std::size_t camera, const ros::Time& time,
                             const std::string& lidar_frame) {
  CameraPlace result;
  const CameraConfig& config = rig_.cameras[camera];
  const CameraInfo* known = cameraInfoAt(index_.cameras[camera], time);
  if (!known && !config.withoutCameraInfo()) return result;
  const CameraInfo info = known ? *known : config.assumedInfo();
  const std::string& frame = config.lens.frame.empty() ? info.frame_id : config.lens.frame;
  const std::string outcome = "camera " + rig_.cameras[camera].name + " sees nothing (status 2)";
  const std::optional<Transform> T_camera_lidar = extrinsics(frame, lidar_frame, outcome);
  if (!T_camera_lidar) return result;
  result.T_camera_lidar = config.nudge.applied(*T_camera_lidar);
  result.model = model(camera, info);
  return result;
}

std::shared_ptr<const CameraModel> CameraPlaces::model(std::size_t camera, const CameraInfo& info) {
  auto& models = models_[camera];
  const auto known = std::find_if(models.begin(), models.end(),
                                  [&](const auto& model) { return model.first == info; });
  if (known != models.end()) return known->second;
  const CameraConfig& config = rig_.cameras[camera];
  std::shared_ptr<const CameraModel> result;
  try {
    result = std::make_shared<const CameraModel>(info, config.modelOptions());
    watch_.lookAtInfo(camera, info, *result);
  } catch (const DataError& e) {
    drops_.count("camera " + config.name + ": unusable camera_info",
                 inputTopic(config, config.camera_info) + ": " + e.what());
  }
  models.emplace_back(info, result);
  return result;
}

std::optional<Transform> CameraPlaces::extrinsics(const std::string& target,
                                                  const std::string& source,
                                                  const std::string& consequence) {
  const auto key = std::make_pair(target, source);
  const auto known = extrinsics_.find(key);
  if (known != extrinsics_.end()) return known->second;
  const TransformAnswer answer = poses_.extrinsics(target, source);
  if (!answer) {
    DropLog::warn(consequence + ": " + answer.advice());
    missing_.insert(answer.message);
  }
  extrinsics_[key] = answer.transform;
  return answer.transform;
}

bool CameraPlaces::haveChanged() const {
  constexpr double kRounding = 1e-9;  // of tf's own interpolation between equal transforms
  return std::any_of(extrinsics_.begin(), extrinsics_.end(), [&](const auto& known) {
    const std::optional<Transform> latest =
        poses_.extrinsics(known.first.first, known.first.second).transform;
    if (latest.has_value() != known.second.has_value()) return true;
    return latest && !latest->isApprox(*known.second, kRounding);
  });
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Where each message of a rig is found. Names without a leading slash are relative.
#pragma once

#include <string>

#include "semantic_lidar_fusion/config/rig.h"

namespace semantic_lidar_fusion {

/// What this package publishes for a camera: `<camera name>/<name>`.
inline std::string cameraTopic(const CameraConfig& camera, const std::string& name) {
  return camera.name + "/" + name;
}

/// What others publish for a camera: `<namespace>/<name>`.
inline std::string inputTopic(const CameraConfig& camera, const std::string& name) {
  return camera.ns.empty() || camera.ns.back() == '/' ? camera.ns + name : camera.ns + "/" + name;
}

/// The camera's images as its driver publishes them; compressed ones below `<image>/compressed`.
inline std::string imageTopic(const CameraConfig& camera) {
  const std::string raw = inputTopic(camera, camera.image);
  return camera.transport == ImageTransport::kCompressed ? raw + "/compressed" : raw;
}

/// The camera's scores, labels or probabilities: this package's own network's, or another node's.
inline std::string semanticsTopic(const Rig& rig, const CameraConfig& camera) {
  return rig.segmentation.model.empty() ? inputTopic(camera, camera.scores)
                                        : cameraTopic(camera, "scores");
}

}  // namespace semantic_lidar_fusion

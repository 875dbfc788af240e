// SPDX-License-Identifier: MIT
/// Where the cameras of a drive stand, and through which lenses they look.
#pragma once

#include <cstddef>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "edge/tf_pose_source.h"
#include "semantic_lidar_fusion/check/rig_watch.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "tools/fuse_bag/drive_reader.h"
#include "tools/fuse_bag/drop_log.h"

namespace semantic_lidar_fusion {

class CameraPlaces {
 public:
  /// Keeps the references. `watch` is shown each calibration once.
  CameraPlaces(const Rig& rig, const DriveIndex& index, const TfPoseSource& poses, DropLog* drops,
               RigWatch* watch);

  /// With the camera_info that holds at record time `time`.
  CameraPlace at(std::size_t camera, const ros::Time& time, const std::string& lidar_frame);
  /// T_target_source, looked up once; where there is none it is told, with what that means.
  std::optional<Transform> extrinsics(const std::string& target, const std::string& source,
                                      const std::string& consequence);
  /// Of each transform that was looked up and is not there, why.
  const std::set<std::string>& missing() const { return missing_; }
  /// Whether a transform that was looked up has come to something else since.
  bool haveChanged() const;

 private:
  std::shared_ptr<const CameraModel> model(std::size_t camera, const CameraInfo& info);

  const Rig& rig_;
  const DriveIndex& index_;
  const TfPoseSource& poses_;
  DropLog& drops_;
  RigWatch& watch_;
  /// By camera.
  std::vector<std::vector<std::pair<CameraInfo, std::shared_ptr<const CameraModel>>>> models_;
  std::map<std::pair<std::string, std::string>, std::optional<Transform>> extrinsics_;
  std::set<std::string> missing_;
};

}  // namespace semantic_lidar_fusion

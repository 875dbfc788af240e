// SPDX-License-Identifier: MIT
/// What a rig needs of the bags, found in one pass: where its scans, images and scores stand, its
/// camera_infos, and all poses. Pixels and points are not decoded.
#pragma once

#include <rosbag/message_instance.h>

#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "edge/tf_pose_source.h"
#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "tools/common/bag_input.h"
#include "tools/fuse_bag/drop_log.h"

namespace semantic_lidar_fusion {

using MessagesByStamp = std::map<StampNs, rosbag::MessageInstance>;  ///< by raw stamp

/// One camera's messages.
struct CameraTrack {
  MessagesByStamp images;     ///< Image or CompressedImage
  MessagesByStamp semantics;  ///< scores, labels or probabilities, after the camera's `input`
  /// By record time, changes only.
  std::vector<std::pair<ros::Time, CameraInfo>> infos;
  bool has_images = false;     ///< the topic is in the bag
  bool has_semantics = false;  ///< the topic is in the bag
};

struct DriveIndex {
  std::vector<rosbag::MessageInstance> scans;       ///< in the order of the bag
  std::vector<CameraTrack> cameras;                 ///< in the rig file's order
  std::vector<rosbag::MessageInstance> transforms;  ///< tf and tf_static, in the order of the bag
};

/// Topics of the rig that the bag lacks, or has with another type, are named with what is there:
/// for the lidar in an Error, else as a warning. `poses` receives static transforms first.
/// `checkpoint` is called now and then and may throw.
DriveIndex indexDrive(const BagInput& input, const Rig& rig, TfPoseSource* poses, DropLog* drops,
                      bool show_progress, void (*checkpoint)());

/// The camera_info that holds at record time `time`: the last one at or before it, else the first
/// one after it; null if there is none.
const CameraInfo* cameraInfoAt(const CameraTrack& camera, const ros::Time& time);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#pragma once

#include <memory>
#include <optional>
#include <string>

#include "edge/conversions.h"
#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/config/rig.h"

namespace semantic_lidar_fusion {

/// The model of one camera, derived anew whenever its camera_info changes. A lens file that names
/// the camera's frame too needs no camera_info.
class CameraGeometry {
 public:
  explicit CameraGeometry(const CameraConfig& config)
      : options_(config.modelOptions()), frame_(config.lens.frame) {
    if (config.withoutCameraInfo()) {
      model_ = std::make_shared<const CameraModel>(config.assumedInfo(), options_);
    }
  }

  /// Throws DataError if the camera_info is unusable; the camera has no model then.
  void update(const sensor_msgs::CameraInfo& message) {
    const CameraInfo info = cameraInfo(message);
    if (info_ && *info_ == info) return;
    model_.reset();
    info_ = info;
    model_ = std::make_shared<const CameraModel>(info, options_);
  }

  const std::shared_ptr<const CameraModel>& model() const { return model_; }
  /// The last camera_info; empty until one came.
  const std::optional<CameraInfo>& info() const { return info_; }
  /// Empty until a camera_info came, unless the rig names it.
  std::string frame() const { return frame_.empty() && info_ ? info_->frame_id : frame_; }

 private:
  CameraModelOptions options_;
  std::string frame_;  ///< of the rig; empty = camera_info's
  std::optional<CameraInfo> info_;
  std::shared_ptr<const CameraModel> model_;
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The steps of one scan after the selection, without ROS: semantics of the selected images,
/// motion compensation, views, fusion.
#pragma once

#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <opencv2/core.hpp>
#include <optional>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/fusion/camera_semantics.h"
#include "semantic_lidar_fusion/fusion/semantic_projector.h"
#include "semantic_lidar_fusion/motion/compensation.h"
#include "semantic_lidar_fusion/motion/pose_buffer.h"
#include "semantic_lidar_fusion/segmentation/model.h"

namespace semantic_lidar_fusion {

/// What is known of one image: its pixels and semantics, and what was derived from them.
struct SegmentedImage {
  StampNs stamp = 0;  ///< raw
  cv::Mat image;      ///< CV_8UC1 or CV_8UC3 BGR; empty if nothing needs it
  cv::Mat input;      ///< scores, labels or probabilities, after the camera's `input`
  std::shared_ptr<const void> owner;  ///< keeps the memory of `image` and `input`
  cv::Mat superpixel_ids;             ///< empty for probabilities
  cv::Mat share;                      ///< scores only
  ImageSemantics semantics;           ///< what the projection reads
  bool from_network = false;          ///< `input` was made by the package's own network
  std::string note;                   ///< what to tell a user of its superpixels; mostly empty
};

/// Where one camera stands in one scan.
struct CameraPlace {
  std::shared_ptr<const CameraModel> model;          ///< null: no camera_info or no extrinsics
  Transform T_camera_lidar = Transform::Identity();  ///< extrinsics
};

class FusionChain {
 public:
  /// Loads the masks and, unless `with_network` is false, the rig's network. Throws ConfigError.
  explicit FusionChain(const Rig& rig, bool with_network = true);
  ~FusionChain();

  /// Superpixels and share of an image of camera `camera`, whose `image` and `input` are given
  /// (no `input`: the network makes scores). Images of one camera come in order of time. Throws
  /// DataError.
  void segment(std::size_t camera, SegmentedImage* image);

  /// Equation 5. `T_vehicle_lidar` empty: unknown, so no point has odometry. Motion disabled: the
  /// points as measured.
  CompensationResult compensated(TimedCloud scan, StampNs reference_ns, const PoseBuffer& odometry,
                                 const std::optional<Transform>& T_vehicle_lidar) const;

  /// The view of camera `camera`: with `image` if there is one and odometry covers its time.
  /// `reference_ns`, and the image's stamp plus the camera's time_offset, are true times.
  CameraView view(std::size_t camera, const CameraPlace& place, const SegmentedImage* image,
                  StampNs reference_ns, const PoseBuffer& odometry,
                  const std::optional<Transform>& T_vehicle_lidar) const;

  /// `with_pixels`: also where the points went in each camera, for overlays.
  FusionResult fused(const Cloud& cloud, std::vector<CameraView> views, bool with_pixels) const;

  /// A cloud without points, as an empty scan gives it.
  Cloud emptyCloud(const TimedCloud& scan) const;

 private:
  struct Camera;

  Rig rig_;
  std::vector<Camera> cameras_;
  std::unique_ptr<SegmentationModel> model_;
  std::unique_ptr<SemanticProjector> projector_;  ///< null for a rig without classes
};

FusionConfig fusionConfig(const Rig& rig);

/// Mean true time (rounded down) of the points of a raw scan that the static extrinsics put into
/// the camera's image; empty if there is none.
std::optional<StampNs> sweepTime(const TimedCloud& scan, const CameraPlace& place);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The fusion of one scan: projection, occlusion, transfer and merging, camera by camera.
#pragma once

#include <cstdint>
#include <memory>
#include <opencv2/core.hpp>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/fusion/camera_merger.h"
#include "semantic_lidar_fusion/projection/occlusion_mask.h"
#include "semantic_lidar_fusion/superpixel/uncertainty.h"

namespace semantic_lidar_fusion {

/// The semantics of one image, at any of the three stages; exactly one of the inputs is set.
struct ImageSemantics {
  ScoreMap scores;        ///< with `share`: evaluated lazily at visible points
  cv::Mat share;          ///< CV_32FC1, superpixel resolution
  cv::Mat probabilities;  ///< CV_32FC(n), superpixel resolution
};

/// What one camera brings to one scan.
struct CameraView {
  std::string name;                          ///< the order of evaluation
  int rig_index = 0;                         ///< bit of the `cameras` field
  std::shared_ptr<const CameraModel> model;  ///< null: camera_info never came, status 2
  Transform T_camera_lidar_static = Transform::Identity();  ///< extrinsics alone, judges status 3
  cv::Mat ego_mask;        ///< CV_8UC1 or empty; 0 = never transfer
  bool has_image = false;  ///< an image in time, with odometry and semantics
  StampNs image_ns = 0;    ///< true time of the image
  Transform T_camera_lidar = Transform::Identity();  ///< lidar at t_ref to camera at image_ns
  ImageSemantics semantics;
};

struct FusionConfig {
  int class_count = 0;
  UncertaintyConfig uncertainty;
  OcclusionConfig occlusion;
  OverlapRule overlap = OverlapRule::kMean;
  bool keep_unlabelled = true;  ///< false: only fused points come out, as in the paper
};

/// Where the points of one camera went; for overlays and diagnostics.
struct CameraFusionReport {
  std::string name;
  std::vector<std::uint32_t> index;  ///< into the input cloud: the points within the image
  std::vector<float> u, v;           ///< px
  std::vector<PointStatus> status;   ///< kFused, kOccluded or kOutsideImages (ego mask)
  std::size_t nonfinite = 0;         ///< visible points on a non-finite score cell (uniform P)
};

struct FusionResult {
  SemanticCloud cloud;
  std::vector<CameraFusionReport> cameras;  ///< sorted by name
};

class SemanticProjector {
 public:
  /// Throws ConfigError.
  explicit SemanticProjector(const FusionConfig& config);

  /// The order of `views` does not matter. Throws DataError if a view's scores, share,
  /// probabilities or mask do not fit the configuration or its model.
  FusionResult fuse(const Cloud& cloud, std::vector<CameraView> views) const;

 private:
  FusionConfig config_;
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The fusion of one scan: projection, occlusion, transfer and merging, camera by camera, then
/// smoothing along the lidar's surfaces.
#pragma once

#include <cstdint>
#include <memory>
#include <opencv2/core.hpp>
#include <optional>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/fusion/camera_merger.h"
#include "semantic_lidar_fusion/projection/occlusion_mask.h"
#include "semantic_lidar_fusion/smoothing/surface_smoother.h"
#include "semantic_lidar_fusion/superpixel/uncertainty.h"
#include "semantic_lidar_fusion/uncertainty/pixel_covariance.h"
#include "semantic_lidar_fusion/uncertainty/view_errors.h"

namespace semantic_lidar_fusion {

class ThreadPool;

/// The semantics of one image: either scores with their share, or probabilities (also those of
/// label images, see histogramProbabilities). Any resolution: image pixel -> superpixel pixel q ->
/// score cell under q's centre.
struct ImageSemantics {
  ScoreMap scores;        ///< with `share`: softmax evaluated lazily at visible points
  cv::Mat share;          ///< CV_32FC1, superpixel resolution
  cv::Mat probabilities;  ///< CV_32FC(n), superpixel resolution; rows that do not sum to 1 are
                          ///< normalised
};

/// What one camera brings to one scan.
struct CameraView {
  std::string name;                          ///< the order of evaluation
  int rig_index = 0;                         ///< bit of the `cameras` field
  std::shared_ptr<const CameraModel> model;  ///< null: camera_info never came, status 2
  Transform T_camera_lidar_static = Transform::Identity();  ///< extrinsics alone, judges status 3
  cv::Mat ego_mask;        ///< CV_8UC1 of any size, or empty; 0 = never transfer
  bool has_image = false;  ///< an image in time, with odometry and semantics
  StampNs image_ns = 0;    ///< true time of the image
  Transform T_camera_lidar = Transform::Identity();  ///< lidar at t_ref to camera at image_ns
  /// The camera's at image_ns, for a rolling shutter; empty: it stands still, or is not known.
  std::optional<Twist> motion;
  ViewErrors errors;  ///< what is known of the errors of this view; all 0: nothing
  ImageSemantics semantics;
  RowBand lidar_rows;  ///< in which superpixels were made; points beyond are counted
  /// Of each point of the cloud whether the camera sees it, where that is known; empty: the
  /// occlusion mask decides.
  std::vector<std::uint8_t> known_visible;
};

struct FusionConfig {
  int class_count = 0;
  UncertaintyConfig uncertainty;
  OcclusionConfig occlusion;
  TransferRule transfer = TransferRule::kExpected;
  OverlapRule overlap = OverlapRule::kMean;
  SmoothingConfig smoothing;
  bool keep_unlabelled = true;  ///< false: only fused points come out, as in the paper
  int threads = 1;              ///< that share the cameras, the caller's included
};

/// Where the points of one camera went; for overlays and diagnostics. Empty without an image; the
/// arrays also if they were not asked for.
struct CameraFusionReport {
  std::string name;
  std::vector<std::uint32_t> index;  ///< into the input cloud: the points within the image
  std::vector<float> u, v;           ///< px
  PixelCovariances covariances;      ///< of (u, v), see pixel_covariance.h
  bool has_errors = false;           ///< the view's errors are known: see ViewErrors::any
  std::vector<PointStatus> status;   ///< kFused, kOccluded or kOutsideImages (ego mask)
  std::vector<std::uint8_t> label;   ///< the point's label over all cameras, kNoLabel = none
  std::size_t nonfinite = 0;  ///< visible points given a uniform P: score not finite, share outside
                              ///< (0, 1] or probabilities that are no distribution
  std::size_t beyond_rows = 0;  ///< visible points beyond `lidar_rows`, whose share is that of a
                                ///< superpixel at the border
};

struct FusionResult {
  SemanticCloud cloud;
  std::vector<CameraFusionReport> cameras;  ///< sorted by name
  std::string note;  ///< what to tell a user of the lidar's beams, once; mostly empty
};

/// Stateless between scans; `fuse` may run in several threads.
class SemanticProjector {
 public:
  /// Throws ConfigError with every problem.
  explicit SemanticProjector(const FusionConfig& config);
  ~SemanticProjector();

  /// The status of a point is the best any camera gives it, 0 before 1 before 3 before 2. A camera
  /// with an image gives 0 (visible), 1 (hidden) or 2 (not in the image, or on a masked pixel, even
  /// if hidden); one without an image gives 3 where its static extrinsics put the point on a pixel
  /// that is not masked; one without a model gives 2. Points with status kNoOdometry keep it.
  ///
  /// The order of `views` does not matter, nor does the number of threads. `with_pixels`: fill the
  /// arrays of the reports, which cost more than the rest of the transfer. Throws DataError if
  /// names or rig indices repeat, if a view's scores, share, probabilities or mask do not fit the
  /// configuration, if `known_visible` is not as long as the cloud, or as beamGrid does.
  FusionResult fuse(const Cloud& cloud, std::vector<CameraView> views,
                    bool with_pixels = true) const;

 private:
  FusionConfig config_;
  std::unique_ptr<ThreadPool> pool_;
};

}  // namespace semantic_lidar_fusion

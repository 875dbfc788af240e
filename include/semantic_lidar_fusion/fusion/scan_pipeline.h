// SPDX-License-Identifier: MIT
/// The way of one scan after the selection, step by step, as the paper goes: the semantics of the
/// selected images (eq. 1-4), motion compensation (eq. 5), the view of each camera (eq. 6-11), and
/// occlusion, transfer and merging (eq. 12-14).
///
/// This is the one place where the steps are put together. On a vehicle each nodelet calls its own
/// step; fuse_bag calls all.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <opencv2/core.hpp>
#include <optional>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/fusion/semantic_projector.h"
#include "semantic_lidar_fusion/motion/compensation.h"
#include "semantic_lidar_fusion/motion/pose_buffer.h"

namespace semantic_lidar_fusion {

/// What is known of one image: its pixels and semantics, and what was derived from them.
struct SegmentedImage {
  StampNs stamp = 0;   ///< raw
  cv::Mat image;       ///< CV_8UC1 or CV_8UC3 BGR; empty if nothing needs it
  cv::Mat input;       ///< scores, labels or probabilities, after the camera's `input`
  RowBand lidar_rows;  ///< that points can reach (see LidarRows); with `lidar_rows: auto`
  std::shared_ptr<const void> owner;  ///< keeps the memory of `image` and `input`
  SuperpixelMap superpixels;          ///< empty until the image is clustered
  cv::Mat share;                      ///< CV_32FC1; scores only
  std::size_t nonfinite_cells = 0;    ///< of the scores, see ShareMap
  ImageSemantics semantics;           ///< what the projection reads
  bool from_network = false;          ///< `input` was made by the package's own network
  std::string note;                   ///< what to tell a user of its superpixels; mostly empty
};

/// Where one camera stands in one scan.
struct CameraPlace {
  std::shared_ptr<const CameraModel> model;          ///< null: no camera_info or no extrinsics
  Transform T_camera_lidar = Transform::Identity();  ///< extrinsics
};

enum class PipelineStep : std::uint8_t {
  kNetwork,  ///< the rig's own network, for `segment` of images that come without scores
  kSegment,
  kCompensate,
  kView,
  kFuse,
};
using PipelineSteps = std::vector<PipelineStep>;

class ScanPipeline {
 public:
  /// Builds what all steps need: masks, superpixel engines, network, threads. Throws ConfigError.
  explicit ScanPipeline(const Rig& rig);
  /// Builds what `steps` need, and only that. Another step must not be called: std::logic_error.
  ScanPipeline(const Rig& rig, const PipelineSteps& steps);
  ~ScanPipeline();

  /// Takes over what may change between two scans; see Rig::retune. No step runs meanwhile.
  void retune(const Rig& rig);

  /// Superpixels and share of an image of camera `camera`, whose `image` and `input` are given
  /// (no `input`: the network makes scores). Images of one camera come in order of time, one at a
  /// time; different cameras may be segmented in parallel where no network is built. Throws
  /// DataError.
  void segment(std::size_t camera, SegmentedImage* image);
  /// The first part of `segment`, for an image whose `input` is still to come: clusters it if the
  /// size of its superpixel map is known, and the map that it has is not of that size.
  void cluster(std::size_t camera, SegmentedImage* image);
  /// P(c) of every superpixel-map pixel of a segmented image, CV_32FC(n).
  cv::Mat probabilities(const SegmentedImage& image) const;

  /// Equation 5. `T_vehicle_lidar` empty: unknown, so no point has odometry. Motion disabled: the
  /// points as measured. A scan without points gives a cloud without points, stamped with the
  /// scan's header.
  CompensationResult compensate(TimedCloud scan, StampNs reference_ns, const PoseBuffer& odometry,
                                const std::optional<Transform>& T_vehicle_lidar) const;

  /// True time of an image of camera `camera`.
  StampNs imageTime(std::size_t camera, StampNs stamp) const;
  /// Whether odometry tells where camera `camera` was when it took the image; always without
  /// motion.
  bool coversImage(std::size_t camera, StampNs stamp, const PoseBuffer& odometry) const;
  /// The view of camera `camera`: with `image` if there is one and odometry covers its time.
  /// `reference_ns` is a true time.
  CameraView view(std::size_t camera, const CameraPlace& place, const SegmentedImage* image,
                  StampNs reference_ns, const PoseBuffer& odometry,
                  const std::optional<Transform>& T_vehicle_lidar) const;

  /// `with_pixels`: also where the points went in each camera, for overlays.
  FusionResult fuse(const Cloud& cloud, std::vector<CameraView> views, bool with_pixels) const;

 private:
  struct Segmentation;

  bool has(PipelineStep step) const;
  RowBand lidarRows(std::size_t index, const SegmentedImage& image) const;
  /// Throws std::logic_error if the step is not built.
  void require(PipelineStep step) const;

  Rig rig_;
  std::uint32_t steps_ = 0;                       ///< bits
  std::unique_ptr<Segmentation> segmentation_;    ///< null unless kSegment
  std::vector<cv::Mat> ego_masks_;                ///< by camera; empty unless kView
  std::unique_ptr<SemanticProjector> projector_;  ///< null unless kFuse, and without classes
};

FusionConfig fusionConfig(const Rig& rig);

/// Whether the points of a camera take the probabilities of whole images, and not scores that are
/// tempered where a point reads them: no scores come, or their superpixels' means are blended in.
bool transfersProbabilities(const Rig& rig, const CameraConfig& camera);

/// What has come of one image.
struct ImageParts {
  bool pixels = false;
  bool semantics = false;  ///< scores, labels or probabilities, after the camera's `input`
};
/// Whether an image can be chosen for a scan: its semantics are there or will be made of it
/// (`made_on_request`), and so are its pixels, unless nothing is clustered for its camera.
bool isCandidate(CameraInput input, const ImageParts& parts, bool made_on_request);

/// Mean true time (rounded down) of the points of a raw scan that the static extrinsics put into
/// the camera's image; empty if there is none.
std::optional<StampNs> sweepTime(const TimedCloud& scan, const CameraPlace& place);

}  // namespace semantic_lidar_fusion

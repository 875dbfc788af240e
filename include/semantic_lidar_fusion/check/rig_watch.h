// SPDX-License-Identifier: MIT
/// What looks wrong in a rig while it fuses: the rules that cost next to nothing. check_rig.py
/// looks closer, and says what to change.
///
/// Each nodelet shows a watch of its own what passes through it; fuse_bag shows one watch all. A
/// doubt is told once. Thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <mutex>
#include <opencv2/core.hpp>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/check/class_geometry.h"
#include "semantic_lidar_fusion/check/edge_alignment.h"
#include "semantic_lidar_fusion/check/own_motion.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/fusion/semantic_projector.h"
#include "semantic_lidar_fusion/motion/pose_buffer.h"

namespace semantic_lidar_fusion {

/// Something that looks wrong.
struct RigDoubt {
  std::string subject;  ///< "lidar", "odometry" or "camera front"
  std::string text;     ///< what was seen, and what is likely wrong
};

class RigWatch {
 public:
  explicit RigWatch(const Rig& rig);

  /// The stamp of a message and the time at which it arrived or was recorded, both raw.
  void lookAtArrival(const std::string& topic, StampNs stamp, StampNs arrival);
  /// A scan as measured: span of its times, unit of its ranges.
  void lookAtScan(const TimedCloud& scan);
  /// Consecutive scans as measured: their own motion against odometry's.
  void lookAtMotion(const TimedCloud& scan, const PoseBuffer& odometry,
                    const Transform& T_vehicle_lidar);
  /// A camera's calibration: principal point. `model` is made of `info`.
  void lookAtInfo(std::size_t camera, const CameraInfo& info, const CameraModel& model);
  /// Scores, labels or probabilities, after the camera's `input`, of an image of size `image`:
  /// aspect, labels out of range, probabilities sent as scores.
  void lookAtSemantics(std::size_t camera, const cv::Mat& semantics, const ImageSize& image);
  /// One scan's result: points of each camera, classes against the ground, axes of the cameras.
  void lookAtFusion(const SemanticCloud& cloud, const std::vector<CameraView>& views,
                    const std::optional<Transform>& T_vehicle_lidar);
  static constexpr std::uint64_t kEdgesEvery = 100;  ///< scans
  /// Whether edges are to be compared next: those of one scan in a hundred are.
  bool edgesAreDue() const;
  /// The lidar's edges against those of the images, by the views' rig index; empty images are left
  /// out. `edges` of the cloud that the views belong to.
  void lookAtEdges(const std::vector<LidarEdge>& edges, const std::vector<CameraView>& views,
                   const std::vector<cv::Mat>& images);
  /// The drive is over: cameras that contributed nothing to however few scans.
  void finish();

  /// What is doubted and was not taken before.
  std::vector<RigDoubt> takeDoubts();

  /// Figures of one camera, for people.
  struct CameraFigures {
    std::uint64_t points = 0;        ///< fused points that it contributed to
    std::uint64_t fused_points = 0;  ///< of all cameras
    EdgeScore edges;
  };
  CameraFigures figures(std::size_t camera) const;

 private:
  struct Camera {
    std::uint64_t points = 0;
    ClassGeometry classes;
    EdgeScore edges;
    std::uint64_t semantics = 0;  ///< images looked at
  };
  struct Stream {
    std::uint64_t messages = 0, ahead = 0;
    StampNs farthest = 0;
  };

  std::string nameOf(std::size_t camera) const { return "camera " + rig_.cameras[camera].name; }
  void doubt(const std::string& subject, const std::string& rule, const std::string& text);
  void lookAtMounting(const CameraView& view, const std::optional<Transform>& T_vehicle_lidar);
  void lookAtGround(const SemanticCloud& cloud, const Transform& T_vehicle_lidar);
  void lookAtLabels(std::size_t camera, const cv::Mat& labels);
  void lookAtScores(std::size_t camera, const cv::Mat& scores);
  void doubtEmptyCameras();

  const Rig rig_;
  mutable std::mutex mutex_;
  std::map<std::string, Stream> streams_;
  std::vector<Camera> cameras_;
  OwnMotion own_motion_;
  std::uint64_t scans_ = 0, fused_points_ = 0;
  std::uint64_t edges_due_ = 0;  ///< number of the scan
  int odd_spans_ = 0, odd_ranges_ = 0, overhead_ = 0;
  std::set<std::string> told_;  ///< subject and rule
  std::vector<RigDoubt> doubts_;
};

/// What a doubt ends with: the command that tells more.
extern const char kCheckCommand[];

}  // namespace semantic_lidar_fusion

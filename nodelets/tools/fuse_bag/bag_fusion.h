// SPDX-License-Identifier: MIT
/// The whole pipeline over a bag, scan by scan. Decisions come from the core's ScanSelector and
/// depend on stamps alone.
#pragma once

#include <array>
#include <chrono>
#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "edge/lidar_decoder.h"
#include "edge/tf_pose_source.h"
#include "semantic_lidar_fusion/fusion/calibration_notes.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "semantic_lidar_fusion/sync/scan_selector.h"
#include "tools/common/bag_input.h"
#include "tools/common/bag_output.h"
#include "tools/common/drop_log.h"
#include "tools/fuse_bag/drive_index.h"
#include "tools/fuse_bag/fuse_bag_options.h"
#include "tools/fuse_bag/truth.h"

namespace semantic_lidar_fusion {

class BagFusion {
 public:
  /// `checkpoint` is called between steps and may throw to end the work. Throws Error.
  BagFusion(const FuseBagOptions& options, void (*checkpoint)());

  /// Reads the input and writes the output. Throws Error; the output is then as before.
  void run();
  /// What came in, what came out, and what was dropped and why.
  std::string summary() const;

 private:
  struct Scan {
    const rosbag::MessageInstance* message = nullptr;
    SelectorScan times;
    bool usable = false;
    bool empty = false;
    StampNs reference_ns = 0;
    std::vector<std::optional<StampNs>> image_stamps;  ///< raw, per camera
  };
  struct CameraState {
    std::vector<std::pair<CameraInfo, std::shared_ptr<const CameraModel>>> models;
    std::deque<std::shared_ptr<const SegmentedImage>> recent;  ///< one image may serve two scans
    std::uint64_t used = 0;
    std::uint64_t none = 0;
    std::uint64_t lost = 0;
  };
  struct PointCounters {
    std::uint64_t decoded = 0;
    std::uint64_t written = 0;
    std::array<std::uint64_t, kPointStatusNames.size()> by_status{};
  };

  void fuseInto(BagOutput* output);
  void measureScans();
  void select();
  void fuseScans(BagOutput* output);
  void fuseScan(const Scan& scan, BagOutput* output);
  void copyTransforms(BagOutput* output);

  TimedCloud decode(const rosbag::MessageInstance& message);
  std::map<StampNs, StampNs> candidates(std::size_t camera) const;
  CameraPlace place(std::size_t camera, const ros::Time& time, const std::string& lidar_frame);
  std::shared_ptr<const CameraModel> model(std::size_t camera, const CameraInfo& info);
  std::optional<Transform> extrinsics(const std::string& target, const std::string& source,
                                      const std::string& consequence);
  std::shared_ptr<const SegmentedImage> segmentedImage(std::size_t camera, StampNs stamp,
                                                       const CameraPlace& place, BagOutput* output);
  std::shared_ptr<SegmentedImage> loadImage(std::size_t camera, StampNs stamp) const;
  void writeImageProducts(std::size_t camera, const SegmentedImage& image, BagOutput* output);
  void writeOverlays(const FusionResult& result,
                     const std::vector<std::shared_ptr<const SegmentedImage>>& images,
                     const std::vector<CameraView>& views, StampNs reference_ns, BagOutput* output);
  std::string cameraOutput(std::size_t camera, const std::string& name) const;

  FuseBagOptions options_;
  void (*checkpoint_)();
  std::chrono::steady_clock::time_point started_;
  DropLog drops_;
  bool counts_points_ = true;  ///< scans are decoded twice, their points are counted once
  Rig rig_;
  ScanPipeline pipeline_;
  LidarDecoder lidar_;
  BagInput input_;
  TfPoseSource poses_;
  DriveIndex index_;
  std::optional<VisibilityTruth> truth_;
  std::vector<Scan> scans_;
  std::vector<CameraState> cameras_;
  CalibrationNotes calibration_notes_;
  std::set<std::string> told_notes_;
  std::map<std::pair<std::string, std::string>, std::optional<Transform>> extrinsics_;
  PointCounters points_;
  std::uint64_t scans_written_ = 0;
};

}  // namespace semantic_lidar_fusion

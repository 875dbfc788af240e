// SPDX-License-Identifier: MIT
/// The whole pipeline over a bag, scan by scan.
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
#include "semantic_lidar_fusion/fusion/calibration_notes.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "tools/common/bag_input.h"
#include "tools/common/bag_output.h"
#include "tools/fuse_bag/drive_index.h"
#include "tools/fuse_bag/drop_log.h"
#include "tools/fuse_bag/fuse_bag_options.h"
#include "tools/fuse_bag/image_source.h"
#include "tools/fuse_bag/product_writer.h"
#include "tools/fuse_bag/run_report.h"
#include "tools/fuse_bag/scan_source.h"
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
  /// Why no point got a class though the rig has cameras; empty if one did.
  std::string whyNothingIsFused() const;

 private:
  void fuseInto(BagOutput* output);
  void measureScans();
  void fuseScans(ImageSource* images, ProductWriter* writer);
  void fuseScan(const BagScan& scan, ImageSource* images, ProductWriter* writer);
  ros::Time infoTime(const BagScan& scan, std::size_t camera) const;
  void countCamera(const BagScan& scan, std::size_t camera, bool has_image, const CameraView& view);
  void countDrops(const BagScan& scan, bool has_vehicle_extrinsics, const CompensationResult& rigid,
                  const FusionResult& result);

  CameraPlace place(std::size_t camera, const ros::Time& time, const std::string& lidar_frame);
  std::shared_ptr<const CameraModel> model(std::size_t camera, const CameraInfo& info);
  std::optional<Transform> extrinsics(const std::string& target, const std::string& source,
                                      const std::string& consequence);

  FuseBagOptions options_;
  void (*checkpoint_)();
  DropLog drops_;
  Rig rig_;
  RunReport report_;
  ScanPipeline pipeline_;
  BagInput input_;
  TfPoseSource poses_;
  DriveIndex index_;
  std::optional<VisibilityTruth> truth_;
  ScanSource scans_;
  /// By camera.
  std::vector<std::vector<std::pair<CameraInfo, std::shared_ptr<const CameraModel>>>> models_;
  CalibrationNotes calibration_notes_;
  std::set<std::string> told_notes_;
  std::map<std::pair<std::string, std::string>, std::optional<Transform>> extrinsics_;
};

}  // namespace semantic_lidar_fusion

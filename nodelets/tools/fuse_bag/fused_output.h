// SPDX-License-Identifier: MIT
/// One output of a run: what its rig makes of the scans, and the bag that holds it.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "edge/tf_pose_source.h"
#include "semantic_lidar_fusion/fusion/calibration_notes.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "tools/common/bag_output.h"
#include "tools/fuse_bag/camera_places.h"
#include "tools/fuse_bag/drop_log.h"
#include "tools/fuse_bag/fuse_bag_options.h"
#include "tools/fuse_bag/image_source.h"
#include "tools/fuse_bag/product_writer.h"
#include "tools/fuse_bag/run_report.h"
#include "tools/fuse_bag/scan_source.h"
#include "tools/fuse_bag/truth.h"

namespace semantic_lidar_fusion {

/// A scan on its way through one output.
struct OutputTask {
  struct Drop {
    std::string reason, detail;
    std::uint64_t count = 0;
  };

  CompensationResult rigid;
  std::optional<Transform> T_vehicle_lidar;
  std::vector<CameraPlace> places;  ///< by camera
  std::vector<CameraView> views;    ///< by camera
  std::vector<std::string> gaps;    ///< by camera: why odometry does not cover its image
  std::vector<Drop> drops;          ///< without a detail: only added up
  FusionResult result;
  ScanClouds clouds;
  std::string failure;  ///< why nothing of the scan is written
};

/// A scan on its way.
struct ScanTask {
  explicit ScanTask(BagScan decided) : scan(std::move(decided)) {}

  BagScan scan;
  std::vector<std::shared_ptr<ImageTask>> images;      ///< by camera; null: none
  std::vector<std::shared_ptr<ImageTask>> new_images;  ///< that no scan before asked for
  std::vector<OutputTask> outputs;
  std::size_t missing_images = 0;             ///< that are not made yet
  bool is_fused = false, is_written = false;  ///< the latter as soon as its turn has come
};

class FusedOutput {
 public:
  /// Makes the output's file. `rig` outlives it. Throws Error, ConfigError.
  FusedOutput(const FuseBagOptions& options, const OutputOptions& output, const Rig& rig);

  /// What needs poses: compensation, and where each camera looked. `truth` is null without. To be
  /// called scan by scan.
  OutputTask plan(const ScanTask& task, TimedCloud raw, TfPoseSource* poses, CameraPlaces* places,
                  const std::vector<ros::Time>& info_times, const VisibilityTruth* truth) const;
  /// Occlusion, transfer and merging, once the images are made. May run in several threads.
  void fuse(const ScanTask& task, OutputTask* result) const;
  /// Writes a fused scan, in the order of the bag.
  void write(const ScanTask& task, const OutputTask& result);

  void copyTransforms(const std::vector<rosbag::MessageInstance>& transforms) {
    writer_.copyTransforms(transforms);
  }
  /// Gives the file its name.
  void commit() { bag_.commit(); }

  const std::string& path() const { return path_; }
  bool takesTruth() const { return takes_truth_; }
  const Rig& rig() const { return rig_; }
  const RunReport& report() const { return report_; }
  const DropLog& drops() const { return drops_; }
  /// What was written is all.
  void finish() { watch_.finish(); }
  /// Its doubts are to be taken and told by the caller.
  RigWatch& watch() { return watch_; }
  const RigWatch& watch() const { return watch_; }

 private:
  void planDrops(const BagScan& scan, bool has_vehicle_extrinsics, TfPoseSource* poses,
                 OutputTask* result) const;
  void writeScan(const ScanTask& task, const OutputTask& result);
  void count(const ScanTask& task, const OutputTask& result);
  void watchScan(const ScanTask& task, const OutputTask& result);

  std::string path_;
  bool takes_truth_;
  bool all_;
  bool quiet_;
  const Rig& rig_;
  ScanPipeline pipeline_;
  BagOutput bag_;
  ProductWriter writer_;
  RunReport report_;
  DropLog drops_;
  CalibrationNotes calibration_notes_;
  RigWatch watch_;
};

}  // namespace semantic_lidar_fusion

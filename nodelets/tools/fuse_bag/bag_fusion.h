// SPDX-License-Identifier: MIT
/// The whole pipeline over a bag. One line of work reads the bag once, in the order of its
/// recording, decides about each scan as soon as what it needs is read, and compensates it. The
/// images of each camera are made in a line of their own, scans are fused side by side, and one
/// line writes them in the order of the bag: WorkLines shares these lines among the threads, and
/// the result does not depend on how many there are.
///
/// What a scan needs may stand anywhere in a bag. It is looked for within a while after the scan;
/// at the end each decision is made again with all that the bag holds, and where one comes out
/// otherwise, the bag is read again, further ahead.
#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <vector>

#include "edge/tf_pose_source.h"
#include "semantic_lidar_fusion/fusion/lidar_rows.h"
#include "tools/common/bag_input.h"
#include "tools/common/progress_bar.h"
#include "tools/common/work_lines.h"
#include "tools/fuse_bag/camera_places.h"
#include "tools/fuse_bag/drive_reader.h"
#include "tools/fuse_bag/drop_log.h"
#include "tools/fuse_bag/fuse_bag_options.h"
#include "tools/fuse_bag/fused_output.h"
#include "tools/fuse_bag/image_source.h"
#include "tools/fuse_bag/scan_source.h"
#include "tools/fuse_bag/truth.h"

namespace semantic_lidar_fusion {

/// One run over the bags that looks so far ahead of a scan.
class FusionRun {
 public:
  /// Keeps the references. `rigs`: of each output. `ahead_s`: empty for all of the bag.
  FusionRun(const FuseBagOptions& options, const std::vector<OutputOptions>& outputs,
            const std::vector<Rig>& rigs, const BagInput& input, std::optional<double> ahead_s);

  /// False if a scan needs what the bag holds further ahead; nothing is written then. `checkpoint`
  /// is called now and then and may throw to end the work. Throws Error.
  bool fuse(void (*checkpoint)());
  /// What came in, what came out, and what was dropped and why.
  std::string summary() const;
  /// Why no point of some output got a class though the rig has cameras; empty if they did.
  std::string whyNothingIsFused();

 private:
  struct Decided;

  std::size_t fuseLine(const ScanTask& task) const;
  std::size_t imageLine(std::size_t camera) const;
  std::size_t readLine() const;

  void readOn();
  bool isReady(const BagScan& scan) const;
  void start(BagScan scan);
  void plan(const std::shared_ptr<ScanTask>& task);
  void launch(const std::shared_ptr<ScanTask>& task);
  void imageMade(const std::shared_ptr<ImageTask>& image);
  void fuseScan(const std::shared_ptr<ScanTask>& task);
  void writeScan(const ScanTask& task);
  std::vector<ros::Time> infoTimes(const BagScan& scan) const;
  std::uint64_t posesAround(const BagScan& scan);
  std::ptrdiff_t camerasWithInfo() const;
  bool holds(const Decided& decided);
  void lookAgain();
  void tellDoubts();
  std::map<std::string, std::uint64_t> dropsOf(const FusedOutput& output) const;

  const FuseBagOptions& options_;
  const Rig& rig_;  ///< of the first output; the others read the same
  const BagInput& input_;
  std::optional<double> ahead_s_;
  DropLog drops_;
  RigWatch watch_;  ///< of what is read
  std::vector<std::string> doubts_;
  TfPoseSource poses_;
  std::deque<FusedOutput> outputs_;
  std::unique_ptr<ScanSource> scans_;
  DriveReader reader_;
  ImageSource images_;
  CameraPlaces places_;
  LidarRows lidar_rows_;
  std::optional<VisibilityTruth> truth_;
  ProgressBar progress_;
  std::size_t written_ = 0;

  /// Of the reading line.
  struct Decided {
    BagScan scan;
    std::ptrdiff_t cameras_with_info;
    std::uint64_t poses;  ///< see posesAround
  };
  bool has_ended_ = false;  ///< all is read
  std::deque<Decided> decided_;
  std::size_t checked_ = 0;  ///< of them, so many were looked at again

  std::mutex mutex_;  ///< guards what follows, and the states of tasks
  std::deque<std::shared_ptr<ScanTask>> under_way_;  ///< in the order of the bag
  std::size_t most_under_way_;
  bool is_reading_ = true;  ///< a task of the reading line waits or runs
  WorkLines* lines_ = nullptr;
};

/// All runs: outputs whose rigs read the bag alike share one.
class BagFusion {
 public:
  /// Throws Error, ConfigError.
  BagFusion(const FuseBagOptions& options, void (*checkpoint)());

  /// Reads the input and writes the outputs. Throws Error; the outputs of the run that failed are
  /// then as before.
  void run();
  std::string summary() const;
  std::string whyNothingIsFused() const;

 private:
  struct Group {
    std::string reading;
    std::vector<OutputOptions> outputs;
    std::vector<Rig> rigs;
    std::unique_ptr<FusionRun> run;
  };

  void run(Group* group);

  FuseBagOptions options_;
  void (*checkpoint_)();
  BagInput input_;
  std::deque<Group> groups_;
};

}  // namespace semantic_lidar_fusion

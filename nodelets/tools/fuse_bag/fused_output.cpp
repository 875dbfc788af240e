// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/fused_output.h"

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

/// Scans are fused side by side: each by one thread.
Rig withOneThread(Rig rig) {
  rig.threads = 1;
  return rig;
}

bool hasImage(const std::shared_ptr<ImageTask>& task) { return task && task->image; }

}  // namespace

FusedOutput::FusedOutput(const FuseBagOptions& options, const OutputOptions& output, const Rig& rig)
    : path_(output.path),
      takes_truth_(output.true_visibility),
      all_(options.all),
      quiet_(options.quiet),
      rig_(rig),
      pipeline_(withOneThread(rig),
                {PipelineStep::kCompensate, PipelineStep::kView, PipelineStep::kFuse}),
      bag_(output.path, "fuse_bag", options.force ? Existing::kReplace : Existing::kReplaceOwn),
      writer_(rig_, &bag_),
      report_(rig.cameras.size()),
      watch_(rig_) {
  if (!options.uncompressed) bag_.compress();
}

OutputTask FusedOutput::plan(const ScanTask& task, TimedCloud raw, TfPoseSource* poses,
                             CameraPlaces* places, const std::vector<ros::Time>& info_times,
                             const VisibilityTruth* truth) const {
  const BagScan& scan = task.scan;
  OutputTask result;
  const std::string lidar_frame = raw.frame_id;
  const std::optional<Transform> T_vehicle_lidar =
      rig_.motion_enabled
          ? places->extrinsics(rig_.vehicle_frame, lidar_frame, "all points have status 4")
          : std::nullopt;
  result.T_vehicle_lidar = T_vehicle_lidar;
  const PoseBuffer& odometry = poses->odometry();
  result.rigid = pipeline_.compensate(std::move(raw), scan.reference_ns, odometry, T_vehicle_lidar);
  result.gaps.resize(rig_.cameras.size());
  for (std::size_t c = 0; c < rig_.cameras.size(); ++c) {
    result.places.push_back(places->at(c, info_times[c], lidar_frame));
    SegmentedImage image;  // its semantics come when it is made
    if (task.images[c]) {
      image.stamp = task.images[c]->stamp;
      image.lidar_rows = task.images[c]->lidar_rows;
    }
    result.views.push_back(pipeline_.view(c, result.places[c], task.images[c] ? &image : nullptr,
                                          scan.reference_ns, odometry, T_vehicle_lidar));
    const CameraView& view = result.views.back();
    if (task.images[c] && !view.has_image) {
      result.gaps[c] = poses->gap(scan.reference_ns, view.image_ns);
    }
  }
  planDrops(scan, T_vehicle_lidar || !rig_.motion_enabled, poses, &result);
  try {
    if (truth != nullptr) {
      truth->apply(scan.times.interval.first_ns, result.rigid.cloud.size(), &result.views);
    }
  } catch (const DataError& e) {
    result.failure = e.what();
  }
  return result;
}

void FusedOutput::planDrops(const BagScan& scan, bool has_vehicle_extrinsics, TfPoseSource* poses,
                            OutputTask* result) const {
  const auto& counters = result->rigid.counters;
  if (!has_vehicle_extrinsics) {
    // Said when they were looked for.
    result->drops.push_back({"scans: no extrinsics of the lidar", "", 1});
  } else if (!counters.reference_covered) {
    result->drops.push_back(
        {"scans: no odometry for t_ref", poses->gap(scan.reference_ns, scan.reference_ns), 1});
  } else if (counters.marked_points + counters.dropped_points > 0) {
    result->drops.push_back({"firings: odometry does not cover them",
                             poses->gap(scan.times.interval.first_ns, scan.times.interval.last_ns),
                             counters.uncovered_firings});
  }
  result->drops.push_back(
      {"points: odometry missing, on_missing: drop", "", counters.dropped_points});
}

void FusedOutput::fuse(const ScanTask& task, OutputTask* result) const {
  if (!result->failure.empty()) return;
  try {
    for (std::size_t c = 0; c < result->views.size(); ++c) {
      CameraView& view = result->views[c];
      if (hasImage(task.images[c])) {
        view.semantics = task.images[c]->image->semantics;
      } else if (task.images[c]) {  // cannot be used
        std::vector<std::uint8_t> known_visible = std::move(view.known_visible);
        view = pipeline_.view(c, result->places[c], nullptr, 0, PoseBuffer(), std::nullopt);
        view.known_visible = std::move(known_visible);
      }
    }
    result->result = pipeline_.fuse(result->rigid.cloud, result->views, all_);
    result->clouds = writer_.clouds(result->rigid.cloud, result->result.cloud);
  } catch (const DataError& e) {
    result->failure = e.what();
  }
}

void FusedOutput::write(const ScanTask& task, const OutputTask& result) {
  for (const auto& image : task.new_images) {
    if (!hasImage(image)) continue;
    if (!image->image->note.empty() && !quiet_) DropLog::note(image->image->note);
    if (all_) writer_.writeImage(*image, pipeline_);
  }
  try {
    if (!result.failure.empty()) throw DataError(result.failure);
    writeScan(task, result);
    count(task, result);
    watchScan(task, result);
  } catch (const DataError& e) {
    drops_.count("scans: not fused",
                 "scan " + std::to_string(task.scan.number) + " is dropped: " + e.what());
  }
}

void FusedOutput::writeScan(const ScanTask& task, const OutputTask& result) {
  for (const std::string& note : calibration_notes_.news(rig_, result.views)) DropLog::warn(note);
  if (!result.result.note.empty() && !quiet_) DropLog::note(result.result.note);
  const StampNs reference_ns = result.rigid.cloud.stamp;
  writer_.writeScan(task.scan.times.interval.first_ns, reference_ns, task.scan.image_stamps,
                    result.clouds);
  if (all_) {
    writer_.writePixels(result.rigid.cloud, result.result);
    writer_.writeOverlays(result.result, task.images, result.views, reference_ns);
  }
  report_.countScan(result.result.cloud.points);
}

/// Shows the watch what a scan came to.
void FusedOutput::watchScan(const ScanTask& task, const OutputTask& result) {
  for (const auto& image : task.new_images) {
    if (!hasImage(image)) continue;
    watch_.lookAtSemantics(image->camera, image->image->input, image->size);
  }
  watch_.lookAtFusion(result.result.cloud, result.views, result.T_vehicle_lidar);
  if (!watch_.edgesAreDue()) return;
  std::vector<cv::Mat> pixels;
  for (const auto& image : task.images) {
    pixels.push_back(hasImage(image) ? image->image->image : cv::Mat());
  }
  watch_.lookAtEdges(lidarEdges(result.rigid.cloud), result.views, pixels);
}

void FusedOutput::count(const ScanTask& task, const OutputTask& result) {
  for (std::size_t c = 0; c < result.views.size(); ++c) {
    using Contribution = RunReport::Contribution;
    const std::string name = "camera " + rig_.cameras[c].name;
    if (!result.places[c].model) drops_.add(name + ": no transform or no camera_info", 1);
    if (result.views[c].has_image) {
      report_.countCamera(c, Contribution::kUsed);
      continue;
    }
    report_.countCamera(
        c, task.scan.image_stamps[c].has_value() ? Contribution::kLost : Contribution::kNone);
    if (hasImage(task.images[c])) {
      drops_.count(name + ": no odometry for its image", name + ": " + result.gaps[c]);
    }
  }
  for (const OutputTask::Drop& drop : result.drops) {
    if (drop.detail.empty()) {
      drops_.add(drop.reason, drop.count);
    } else {
      drops_.count(drop.reason, drop.detail, drop.count);
    }
  }
  drops_.add("points: without a class, keep_unlabelled: false",
             result.rigid.cloud.size() - result.result.cloud.size());
  for (const CameraFusionReport& report : result.result.cameras) {
    drops_.add("camera " + report.name + ": points on scores that are not finite (uniform)",
               report.nonfinite);
    drops_.add("camera " + report.name + ": points beyond lidar_rows", report.beyond_rows);
  }
}

}  // namespace semantic_lidar_fusion

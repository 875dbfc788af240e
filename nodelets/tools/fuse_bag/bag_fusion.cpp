// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/bag_fusion.h"

#include <algorithm>
#include <utility>

#include "edge/topics.h"
#include "semantic_lidar_fusion/common/error.h"
#include "tools/common/progress_bar.h"

namespace semantic_lidar_fusion {

BagFusion::BagFusion(const FuseBagOptions& options, void (*checkpoint)())
    : options_(options),
      checkpoint_(checkpoint),
      rig_(loadRig(options.rig, options.overrides)),
      report_(rig_.cameras.size()),
      pipeline_(rig_),
      input_(options.inputs),
      poses_(tfPoseSourceConfig(rig_, 0)),
      scans_(rig_, &drops_),
      models_(rig_.cameras.size()) {}

void BagFusion::run() {
  BagOutput output(options_.output, "fuse_bag",
                   options_.force ? Existing::kReplace : Existing::kReplaceOwn);
  try {
    fuseInto(&output);
  } catch (const rosbag::BagException& e) {
    throw Error(bagErrorText(input_.path(), e));
  }
  output.commit();
}

void BagFusion::fuseInto(BagOutput* output) {
  index_ = indexDrive(input_, rig_, &poses_, &drops_, !options_.quiet, checkpoint_);
  if (options_.true_visibility) truth_.emplace(input_, toNs(rig_.lidar.time_offset_s));
  ProductWriter writer(rig_, pipeline_, index_, output);
  ImageSource images(
      rig_, index_, &pipeline_, &drops_,
      [&](std::size_t camera, const SegmentedImage& image) {
        if (options_.all) writer.writeImage(camera, image);
      },
      [&](const std::string& note) {
        if (!options_.quiet) DropLog::note(note);
      });
  measureScans();
  ScanSource::Candidates candidates;
  for (std::size_t c = 0; c < rig_.cameras.size(); ++c) candidates.push_back(images.candidates(c));
  scans_.select(candidates);
  fuseScans(&images, &writer);
  if (options_.tf) writer.copyTransforms();
  if (report_.scansWritten() == 0) {
    const std::size_t count = index_.scans.size();
    throw Error(input_.path() + ": none of its " + std::to_string(count) + " scan" +
                (count == 1 ? "" : "s") + " can be used");
  }
}

void BagFusion::measureScans() {
  ProgressBar progress("measuring", index_.scans.size(), !options_.quiet);
  scans_.measure(
      index_.scans,
      [&](std::size_t camera, const ros::Time& time, const std::string& lidar_frame) {
        return place(camera, time, lidar_frame);
      },
      [&] {
        progress.update(scans_.scans().size());
        checkpoint_();
      });
}

void BagFusion::fuseScans(ImageSource* images, ProductWriter* writer) {
  ProgressBar progress("fusing", scans_.scans().size(), !options_.quiet);
  std::size_t done = 0;
  for (const BagScan& scan : scans_.scans()) {
    if (scan.usable) {
      try {
        fuseScan(scan, images, writer);
      } catch (const DataError& e) {
        drops_.count("scans: not fused",
                     "scan " + std::to_string(done) + " is dropped: " + e.what());
      }
    }
    progress.update(++done);
    checkpoint_();
  }
}

/// The way of one scan: decode, compensate, segment and view each camera's image, fuse, write.
void BagFusion::fuseScan(const BagScan& scan, ImageSource* images, ProductWriter* writer) {
  const TimedCloud raw = scans_.decode(*scan.message);
  const std::optional<Transform> T_vehicle_lidar =
      rig_.motion_enabled ? extrinsics(rig_.vehicle_frame, raw.frame_id, "all points have status 4")
                          : std::nullopt;
  const PoseBuffer& odometry = poses_.odometry();
  const CompensationResult rigid =
      pipeline_.compensate(raw, scan.reference_ns, odometry, T_vehicle_lidar);

  std::vector<CameraView> views;
  ScanImages used(rig_.cameras.size());
  for (std::size_t c = 0; c < used.size(); ++c) {
    const std::optional<StampNs>& stamp = scan.image_stamps[c];
    const CameraPlace at = place(c, infoTime(scan, c), raw.frame_id);
    if (stamp && at.model) used[c] = images->image(c, *stamp, at.model->imageSize());
    views.push_back(
        pipeline_.view(c, at, used[c].get(), scan.reference_ns, odometry, T_vehicle_lidar));
    countCamera(scan, c, used[c] != nullptr, views.back());
  }
  for (const std::string& note : calibration_notes_.news(rig_, views)) DropLog::warn(note);
  if (truth_) truth_->apply(scan.times.interval.first_ns, rigid.cloud.size(), &views);
  const FusionResult result = pipeline_.fuse(rigid.cloud, views, options_.all);
  if (!result.note.empty() && told_notes_.insert(result.note).second && !options_.quiet) {
    DropLog::note(result.note);
  }

  writer->writeScan(scan.times.interval.first_ns, scan.image_stamps, rigid.cloud, result.cloud);
  if (options_.all) writer->writeOverlays(result, used, views, rigid.cloud.stamp);
  report_.countScan(result.cloud.points);
  countDrops(scan, T_vehicle_lidar || !rig_.motion_enabled, rigid, result);
}

/// The time at which the camera_info in force is that of a scan's image.
ros::Time BagFusion::infoTime(const BagScan& scan, std::size_t camera) const {
  const std::optional<StampNs>& stamp = scan.image_stamps[camera];
  const MessagesByStamp& images = index_.cameras[camera].images;
  const auto image = stamp ? images.find(*stamp) : images.end();
  return image == images.end() ? scan.message->getTime() : image->second.getTime();
}

void BagFusion::countCamera(const BagScan& scan, std::size_t camera, bool has_image,
                            const CameraView& view) {
  if (view.has_image) {
    report_.countCamera(camera, RunReport::Contribution::kUsed);
    return;
  }
  const bool was_chosen = scan.image_stamps[camera].has_value();
  report_.countCamera(camera,
                      was_chosen ? RunReport::Contribution::kLost : RunReport::Contribution::kNone);
  if (has_image) {
    const std::string name = "camera " + rig_.cameras[camera].name;
    drops_.count(name + ": odometry does not cover its image",
                 name + ": " + poses_.gap(scan.reference_ns, view.image_ns));
  }
}

void BagFusion::countDrops(const BagScan& scan, bool has_vehicle_extrinsics,
                           const CompensationResult& rigid, const FusionResult& result) {
  if (!has_vehicle_extrinsics) {
    drops_.add("scans: no extrinsics of the lidar", 1);  // said when they were looked for
  } else if (!rigid.counters.reference_covered) {
    drops_.count("scans: odometry does not cover t_ref",
                 poses_.gap(scan.reference_ns, scan.reference_ns));
  } else if (rigid.counters.marked_points + rigid.counters.dropped_points > 0) {
    drops_.count("firings: odometry does not cover them",
                 poses_.gap(scan.times.interval.first_ns, scan.times.interval.last_ns),
                 rigid.counters.uncovered_firings);
  }
  drops_.add("points: odometry missing, on_missing: drop", rigid.counters.dropped_points);
  drops_.add("points: without a class, keep_unlabelled: false",
             rigid.cloud.size() - result.cloud.size());
  for (const CameraFusionReport& report : result.cameras) {
    drops_.add("camera " + report.name + ": points on scores that are not finite (uniform)",
               report.nonfinite);
  }
}

CameraPlace BagFusion::place(std::size_t camera, const ros::Time& time,
                             const std::string& lidar_frame) {
  CameraPlace result;
  const CameraConfig& config = rig_.cameras[camera];
  const CameraInfo* known = cameraInfoAt(index_.cameras[camera], time);
  if (!known && !config.withoutCameraInfo()) return result;
  const CameraInfo info = known ? *known : config.assumedInfo();
  const std::string& frame = config.lens.frame.empty() ? info.frame_id : config.lens.frame;
  const std::string outcome = "camera " + rig_.cameras[camera].name + " sees nothing (status 2)";
  const std::optional<Transform> T_camera_lidar = extrinsics(frame, lidar_frame, outcome);
  if (!T_camera_lidar) return result;
  result.T_camera_lidar = *T_camera_lidar;
  result.model = model(camera, info);
  return result;
}

std::shared_ptr<const CameraModel> BagFusion::model(std::size_t camera, const CameraInfo& info) {
  auto& models = models_[camera];
  const auto known = std::find_if(models.begin(), models.end(),
                                  [&](const auto& model) { return model.first == info; });
  if (known != models.end()) return known->second;
  const CameraConfig& config = rig_.cameras[camera];
  std::shared_ptr<const CameraModel> result;
  try {
    result = std::make_shared<const CameraModel>(info, config.modelOptions());
  } catch (const DataError& e) {
    drops_.count("camera " + config.name + ": unusable camera_info",
                 inputTopic(config, config.camera_info) + ": " + e.what());
  }
  models.emplace_back(info, result);
  return result;
}

std::optional<Transform> BagFusion::extrinsics(const std::string& target, const std::string& source,
                                               const std::string& consequence) {
  const auto key = std::make_pair(target, source);
  const auto known = extrinsics_.find(key);
  if (known != extrinsics_.end()) return known->second;
  const TransformAnswer answer = poses_.extrinsics(target, source);
  if (!answer) DropLog::warn("no extrinsics " + answer.message + "; " + consequence);
  extrinsics_[key] = answer.transform;
  return answer.transform;
}

std::string BagFusion::whyNothingIsFused() const {
  if (rig_.cameras.empty() || report_.fusedPoints() > 0) return {};
  std::string text = input_.path() + ": no point got a class: " + report_.commonestStatus();
  for (const auto& drop : drops_.counts()) {
    text += "; " + drop.first + ": " + std::to_string(drop.second);
  }
  return text + ". " + options_.output + " is written; check_rig.py looks for the cause";
}

std::string BagFusion::summary() const {
  RunReport::Input input;
  input.output = options_.output;
  input.scans = scans_.scans().size();
  input.time_decision = scans_.timeDecision();
  for (std::size_t c = 0; c < rig_.cameras.size(); ++c) {
    const CameraTrack& track = index_.cameras[c];
    input.cameras.push_back({rig_.cameras[c].name, track.images.size(), track.semantics.size()});
  }
  return report_.text(input, drops_);
}

}  // namespace semantic_lidar_fusion

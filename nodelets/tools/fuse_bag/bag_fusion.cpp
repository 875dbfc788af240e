// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/bag_fusion.h"

#include <sensor_msgs/CompressedImage.h>
#include <sensor_msgs/Image.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <cstdio>
#include <limits>
#include <set>
#include <utility>

#include "edge/conversions.h"
#include "edge/topics.h"
#include "edge/version.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/overlay/overlay.h"
#include "tools/common/progress_bar.h"

namespace semantic_lidar_fusion {
namespace {

/// Images of one camera that are kept after use.
constexpr std::size_t kRecentImages = 3;

std::string percent(std::uint64_t part, std::uint64_t whole) {
  char text[16];
  std::snprintf(text, sizeof(text), "%.1f %%",
                whole ? 100.0 * static_cast<double>(part) / static_cast<double>(whole) : 0.0);
  return text;
}

std::string count(std::uint64_t n, const std::string& thing) {
  return std::to_string(n) + " " + thing + (n == 1 ? "" : "s");
}

void checkSize(const SegmentedImage& image, const ImageSize& wanted) {
  if (image.image.empty()) return;
  if (image.image.cols != wanted.width || image.image.rows != wanted.height) {
    throw DataError("is " + sizeText({image.image.cols, image.image.rows}) + "; camera_info says " +
                    sizeText(wanted));
  }
}

}  // namespace

BagFusion::BagFusion(const FuseBagOptions& options, void (*checkpoint)())
    : options_(options),
      checkpoint_(checkpoint),
      started_(std::chrono::steady_clock::now()),
      rig_(loadRig(options.rig, options.overrides)),
      pipeline_(rig_),
      lidar_(rig_.lidar,
             [this](const std::string& reason, std::uint64_t n) {
               if (counts_points_) drops_.add("lidar: " + reason, n);
             }),
      input_(options.input),
      poses_(tfPoseSourceConfig(rig_, 0)),
      cameras_(rig_.cameras.size()) {}

void BagFusion::run() {
  BagOutput output(options_.output, options_.force);
  try {
    fuseInto(&output);
  } catch (const rosbag::BagException& e) {
    throw Error(bagErrorText(options_.input, e));
  }
  output.commit();
}

void BagFusion::fuseInto(BagOutput* output) {
  index_ = indexDrive(input_, rig_, &poses_, &drops_, !options_.quiet, checkpoint_);
  if (options_.true_visibility) truth_.emplace(input_, toNs(rig_.lidar.time_offset_s));
  measureScans();
  select();
  fuseScans(output);
  if (options_.tf) copyTransforms(output);
  if (scans_written_ == 0) {
    throw Error(options_.input + ": none of its " + count(index_.scans.size(), "scan") +
                " can be used");
  }
}

TimedCloud BagFusion::decode(const rosbag::MessageInstance& message) {
  if (rig_.lidar.input == LidarInput::kPackets) {
    const auto scan = message.instantiate<VelodyneScan>();
    if (!scan) throw DataError("has another definition of velodyne_msgs/VelodyneScan");
    return lidar_.decode(*scan);
  }
  const auto cloud = message.instantiate<sensor_msgs::PointCloud2>();
  if (!cloud) throw DataError("has another definition of sensor_msgs/PointCloud2");
  return lidar_.decode(*cloud);
}

/// Decodes each scan for its times; its points are decoded again when it is fused, which costs
/// less than keeping them.
void BagFusion::measureScans() {
  ProgressBar progress("measuring", index_.scans.size(), !options_.quiet);
  const bool sweeps = rig_.image_choice == ImageChoice::kClosestToSweep;
  for (const rosbag::MessageInstance& message : index_.scans) {
    Scan scan;
    scan.message = &message;
    scan.image_stamps.resize(rig_.cameras.size());
    try {
      const TimedCloud cloud = decode(message);
      scan.times.interval = scanInterval(cloud);
      scan.empty = cloud.empty();
      scan.usable = true;
      if (scan.times.interval.first_ns <= 0) throw DataError("has stamp 0");
      if (cloud.frame_id.empty()) throw DataError("has an empty frame_id");
      for (std::size_t c = 0; sweeps && c < rig_.cameras.size(); ++c) {
        const CameraPlace at = place(c, message.getTime(), cloud.frame_id);
        scan.times.sweep_ns.push_back(sweepTime(cloud, at));
      }
    } catch (const DataError& e) {
      scan.usable = false;
      drops_.count("scans: unusable", message.getTopic() + ": scan " +
                                          std::to_string(scans_.size()) +
                                          " is dropped: " + e.what());
    }
    scans_.push_back(std::move(scan));
    progress.update(scans_.size());
    checkpoint_();
  }
  counts_points_ = false;
  for (const LidarDecoder::Note& note : lidar_.takeNotes()) {
    if (note.warning) {
      DropLog::warn("lidar: " + note.text);
    } else if (note.text != lidar_.timeDecision()) {  // which the summary tells
      DropLog::note("lidar: " + note.text);
    }
  }
}

/// The images of a camera that can be chosen, by true time: where the bag has no scores of the
/// camera, the rig's network makes them.
std::map<StampNs, StampNs> BagFusion::candidates(std::size_t camera) const {
  const CameraTrack& track = index_.cameras[camera];
  const CameraConfig& config = rig_.cameras[camera];
  const bool made_on_request = !track.has_semantics && config.input == CameraInput::kScores &&
                               !rig_.segmentation.model.empty();
  std::map<StampNs, StampNs> result;
  for (const MessagesByStamp* messages : {&track.images, &track.semantics}) {
    for (const auto& message : *messages) {
      const StampNs stamp = message.first;
      const ImageParts parts{track.images.count(stamp) > 0, track.semantics.count(stamp) > 0};
      if (!isCandidate(config.input, parts, made_on_request)) continue;
      result[pipeline_.imageTime(camera, stamp)] = stamp;
    }
  }
  return result;
}

/// Each scan is decided with all stamps that may matter to it, as if nothing more would come: the
/// selector's bounds on memory and its timeouts, made for a live stream, do not touch the result.
void BagFusion::select() {
  SelectorConfig config = rig_.selectorConfig();
  std::vector<std::map<StampNs, StampNs>> images;  // of each camera
  StampNs reach_ns = config.reference_timeout_ns;
  for (std::size_t c = 0; c < rig_.cameras.size(); ++c) {
    reach_ns = std::max(reach_ns, config.cameras[c].max_time_difference_ns);
    images.push_back(candidates(c));
  }
  config.image_history_ns = std::numeric_limits<StampNs>::max() / 4;
  std::set<StampNs> seen;
  for (Scan& scan : scans_) {
    if (!scan.usable) continue;
    const ScanInterval& interval = scan.times.interval;
    if (!seen.insert(interval.first_ns).second) {
      scan.usable = false;
      drops_.count("scans: first point seen twice", "second scan with its first point at " +
                                                        std::to_string(interval.first_ns) +
                                                        " ns is dropped");
      continue;
    }
    if (scan.empty) {  // no time to choose by: stamped with its header
      scan.reference_ns = interval.first_ns;
      continue;
    }
    ScanSelector selector(config);
    selector.addScan(scan.times, 0);
    // t_ref is at most `reach_ns` off the scan, an image at most that off t_ref.
    for (std::size_t c = 0; c < images.size(); ++c) {
      for (auto image = images[c].lower_bound(interval.first_ns - 2 * reach_ns);
           image != images[c].end() && image->first <= interval.last_ns + 2 * reach_ns; ++image) {
        selector.addImage(static_cast<int>(c), image->second);
      }
    }
    const SelectorDecisions decisions = selector.finish();
    for (const ReferenceDecision& decision : decisions.references) {
      scan.reference_ns = decision.reference_ns;
    }
    for (const SelectionDecision& decision : decisions.selections) {
      scan.image_stamps[static_cast<std::size_t>(decision.camera)] = decision.image_stamp;
    }
  }
}

void BagFusion::fuseScans(BagOutput* output) {
  ProgressBar progress("fusing", scans_.size(), !options_.quiet);
  std::size_t done = 0;
  for (const Scan& scan : scans_) {
    if (scan.usable) {
      try {
        fuseScan(scan, output);
        ++scans_written_;
      } catch (const DataError& e) {
        drops_.count("scans: not fused",
                     "scan " + std::to_string(done) + " is dropped: " + e.what());
      }
    }
    progress.update(++done);
    checkpoint_();
  }
}

void BagFusion::fuseScan(const Scan& scan, BagOutput* output) {
  const std::size_t camera_count = rig_.cameras.size();
  const StampNs scan_ns = scan.times.interval.first_ns;
  const TimedCloud raw = decode(*scan.message);
  const std::optional<Transform> T_vehicle_lidar =
      rig_.motion_enabled ? extrinsics(rig_.vehicle_frame, raw.frame_id, "all points have status 4")
                          : std::nullopt;
  const PoseBuffer& odometry = poses_.odometry();

  const CompensationResult rigid =
      pipeline_.compensate(raw, scan.reference_ns, odometry, T_vehicle_lidar);

  std::vector<CameraView> views;
  std::vector<std::shared_ptr<const SegmentedImage>> images(camera_count);
  for (std::size_t c = 0; c < camera_count; ++c) {
    const std::optional<StampNs>& stamp = scan.image_stamps[c];
    const MessagesByStamp& images_by_stamp = index_.cameras[c].images;
    const auto image = stamp ? images_by_stamp.find(*stamp) : images_by_stamp.end();
    const ros::Time info_time =
        image == images_by_stamp.end() ? scan.message->getTime() : image->second.getTime();
    const CameraPlace at = place(c, info_time, raw.frame_id);
    if (stamp && at.model) images[c] = segmentedImage(c, *stamp, at, output);
    views.push_back(
        pipeline_.view(c, at, images[c].get(), scan.reference_ns, odometry, T_vehicle_lidar));
    CameraState& state = cameras_[c];
    if (views.back().has_image) {
      ++state.used;
    } else if (images[c]) {
      ++state.lost;
      drops_.count("camera " + rig_.cameras[c].name + ": odometry does not cover its image",
                   "camera " + rig_.cameras[c].name + ": " +
                       poses_.gap(scan.reference_ns, views.back().image_ns));
    } else if (stamp) {
      ++state.lost;
    } else {
      ++state.none;
    }
  }
  for (const std::string& note : calibration_notes_.news(rig_, views)) DropLog::warn(note);
  if (truth_) truth_->apply(scan_ns, rigid.cloud.size(), &views);
  const FusionResult result = pipeline_.fuse(rigid.cloud, views, options_.all);
  if (!result.note.empty() && told_notes_.insert(result.note).second && !options_.quiet) {
    DropLog::note(result.note);
  }
  const auto compensated = compensatedCloudMessage(rigid.cloud);
  const auto semantic = semanticCloudMessage(result.cloud, rig_.classes);

  if (scans_written_ == 0) {
    output->writeLatched("/class_info", rigid.cloud.stamp, classInfoMessage(rig_.classes));
    output->writeLatched("/configuration", rigid.cloud.stamp, configurationMessage(rig_));
  }
  output->write("/scan_reference", scan_ns, scanReferenceMessage(scan_ns, rigid.cloud.stamp));
  for (std::size_t c = 0; c < camera_count; ++c) {
    output->write(cameraOutput(c, "selection"), scan_ns,
                  selectionMessage(scan_ns, scan.image_stamps[c], rig_.cameras[c].name));
  }
  output->write("/points_compensated", rigid.cloud.stamp, *compensated);
  output->write("/points_semantic", rigid.cloud.stamp, *semantic);
  if (options_.all) writeOverlays(result, images, views, rigid.cloud.stamp, output);

  points_.decoded += raw.size();
  points_.written += result.cloud.size();
  const auto by_status = countByStatus(result.cloud.points);
  for (std::size_t s = 0; s < by_status.size(); ++s) points_.by_status[s] += by_status[s];
  if (!rigid.counters.reference_covered) {
    drops_.count("scans: odometry does not cover t_ref",
                 poses_.gap(scan.reference_ns, scan.reference_ns));
  } else if (rigid.counters.marked_points + rigid.counters.dropped_points > 0) {
    drops_.count("firings: odometry does not cover them",
                 poses_.gap(scan_ns, scan.times.interval.last_ns),
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

void BagFusion::copyTransforms(BagOutput* output) {
  for (const rosbag::MessageInstance& message : index_.transforms) {
    const auto transforms = message.instantiate<tf2_msgs::TFMessage>();
    if (!transforms) continue;
    const StampNs time = stampNs(message.getTime());
    if (bareTopic(message.getTopic()) == "tf_static") {
      output->writeLatched("/tf_static", time, *transforms);
    } else {
      output->write("/tf", time, *transforms);
    }
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
  auto& models = cameras_[camera].models;
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

std::shared_ptr<const SegmentedImage> BagFusion::segmentedImage(std::size_t camera, StampNs stamp,
                                                                const CameraPlace& place,
                                                                BagOutput* output) {
  CameraState& state = cameras_[camera];
  for (const auto& image : state.recent) {
    if (image->stamp == stamp) return image;
  }
  try {
    const std::shared_ptr<SegmentedImage> image = loadImage(camera, stamp);
    checkSize(*image, place.model->imageSize());
    pipeline_.segment(camera, image.get());
    if (!image->note.empty() && told_notes_.insert(image->note).second && !options_.quiet) {
      DropLog::note(image->note);
    }
    if (options_.all) writeImageProducts(camera, *image, output);
    state.recent.push_back(image);
    if (state.recent.size() > kRecentImages) state.recent.pop_front();
    return image;
  } catch (const DataError& e) {
    drops_.count("camera " + rig_.cameras[camera].name + ": unusable images or scores",
                 "camera " + rig_.cameras[camera].name + ", image " + std::to_string(stamp) +
                     " ns: " + e.what());
    return nullptr;
  }
}

std::shared_ptr<SegmentedImage> BagFusion::loadImage(std::size_t camera, StampNs stamp) const {
  const CameraTrack& track = index_.cameras[camera];
  const CameraConfig& config = rig_.cameras[camera];
  // The pixel views below point into these messages.
  struct Messages {
    sensor_msgs::ImageConstPtr image, semantics;
  };
  auto messages = std::make_shared<Messages>();
  auto result = std::make_shared<SegmentedImage>();
  result->stamp = stamp;
  result->owner = messages;
  const auto image = track.images.find(stamp);
  if (image != track.images.end()) {
    if (config.transport == ImageTransport::kCompressed) {
      const auto compressed = image->second.instantiate<sensor_msgs::CompressedImage>();
      if (!compressed) throw DataError("has another definition of sensor_msgs/CompressedImage");
      result->image = decodedImage(*compressed);
    } else {
      messages->image = image->second.instantiate<sensor_msgs::Image>();
      if (!messages->image) throw DataError("has another definition of sensor_msgs/Image");
      result->image = colorImage(messages->image);
    }
  }
  const auto semantics = track.semantics.find(stamp);
  if (semantics != track.semantics.end()) {
    messages->semantics = semantics->second.instantiate<sensor_msgs::Image>();
    if (!messages->semantics) throw DataError("has another definition of sensor_msgs/Image");
    result->input = pixelView(*messages->semantics);
  }
  return result;
}

void BagFusion::writeImageProducts(std::size_t camera, const SegmentedImage& image,
                                   BagOutput* output) {
  std_msgs::Header header;
  header.stamp = rosTime(image.stamp);
  const auto& infos = index_.cameras[camera].infos;
  if (!infos.empty()) header.frame_id = infos.front().second.frame_id;
  const auto write = [&](const std::string& name, const cv::Mat& pixels) {
    if (!pixels.empty()) {
      output->write(cameraOutput(camera, name), image.stamp, *imageMessage(pixels, header));
    }
  };
  if (image.from_network) write("scores", image.input);
  write("superpixels", image.superpixels.ids);
  write("share", image.share);
  write("probabilities", pipeline_.probabilities(image));
  if (!image.share.empty()) {
    write("uncertainty_overlay", drawUncertainty(image.image, image.superpixels.ids, image.share));
  }
}

void BagFusion::writeOverlays(const FusionResult& result,
                              const std::vector<std::shared_ptr<const SegmentedImage>>& images,
                              const std::vector<CameraView>& views, StampNs reference_ns,
                              BagOutput* output) {
  for (std::size_t c = 0; c < images.size(); ++c) {
    if (!views[c].has_image || images[c]->image.empty()) continue;
    const auto report =
        std::find_if(result.cameras.begin(), result.cameras.end(),
                     [&](const CameraFusionReport& r) { return r.name == views[c].name; });
    if (report == result.cameras.end()) continue;
    std_msgs::Header header;
    header.stamp = rosTime(images[c]->stamp);
    const auto& infos = index_.cameras[c].infos;
    if (!infos.empty()) header.frame_id = infos.front().second.frame_id;
    const cv::Mat drawn = drawProjection(images[c]->image, *report, result.cloud, rig_.classes,
                                         toSeconds(views[c].image_ns - reference_ns));
    output->write(cameraOutput(c, "projection_overlay"), images[c]->stamp,
                  *imageMessage(drawn, header));
  }
}

std::string BagFusion::cameraOutput(std::size_t camera, const std::string& name) const {
  return "/" + cameraTopic(rig_.cameras[camera], name);
}

std::string BagFusion::summary() const {
  std::string text = options_.output + ": " + count(scans_written_, "scan") + " of " +
                     std::to_string(scans_.size()) + ", " + count(points_.written, "point") + " (";
  for (std::size_t s = 0; s < points_.by_status.size(); ++s) {
    text += (s ? ", " : "") + std::string(kPointStatusNames[s]) + " " +
            percent(points_.by_status[s], points_.written);
  }
  text += ")\n";
  for (std::size_t c = 0; c < cameras_.size(); ++c) {
    text += "  camera " + rig_.cameras[c].name + ": in " + count(cameras_[c].used, "scan") +
            "; no image in time in " + std::to_string(cameras_[c].none) + ", image not usable in " +
            std::to_string(cameras_[c].lost) + "; " +
            count(index_.cameras[c].images.size(), "image") + " and " +
            std::to_string(index_.cameras[c].semantics.size()) + " of scores in the bag\n";
  }
  if (!lidar_.timeDecision().empty()) text += "  " + lidar_.timeDecision() + "\n";
  if (drops_.counts().empty()) text += "  nothing was dropped\n";
  for (const auto& drop : drops_.counts()) {
    text += "  counted: " + drop.first + ": " + std::to_string(drop.second) + "\n";
  }
  const double seconds =
      std::chrono::duration<double>(std::chrono::steady_clock::now() - started_).count();
  char time[80];
  std::snprintf(time, sizeof(time), "  %.1f s (%.1f scans/s)\n", seconds,
                static_cast<double>(scans_.size()) / std::max(seconds, 1e-9));
  return text + time;
}

}  // namespace semantic_lidar_fusion

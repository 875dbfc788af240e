// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/check/rig_watch.h"

#include <algorithm>
#include <cmath>
#include <cstdarg>
#include <cstdio>

namespace semantic_lidar_fusion {

const char kCheckCommand[] = "check_rig.py BAG --rig FILE tells more";

namespace {

constexpr StampNs kAheadNs = 20000000;  // more than clocks kept by NTP differ
constexpr std::uint64_t kFewestMessages = 5;
constexpr StampNs kShortestScanNs = 1000000;
constexpr double kLongestMedianRange_m = 400.0, kShortestMedianRange_m = 0.2;
constexpr int kFewestOddScans = 3;
constexpr double kOffCentre = 0.2;  // share of the image's width or height
constexpr double kOtherAspect = 0.08;
constexpr double kLargestVehicle_m = 50.0;
constexpr double kSteep = 0.85;  // of a unit vector's z: 58 deg above or below the ground
constexpr double kGroundAbove_m = 0.3, kLeastGroundShare = 0.15;
constexpr std::uint64_t kGroundEvery = 10;  // scans
constexpr std::uint64_t kScansWithoutPoints = 100;
constexpr std::size_t kFewestEdges = 300;
constexpr double kLeastLift = 0.06, kMostChance = 0.5;
constexpr int kSampled = 1009;  // of cells and pixels, a prime

std::string format(const char* pattern, ...) __attribute__((format(printf, 1, 2)));
std::string format(const char* pattern, ...) {
  char text[400];
  std::va_list arguments;
  va_start(arguments, pattern);
  std::vsnprintf(text, sizeof(text), pattern, arguments);
  va_end(arguments);
  return text;
}

double medianRange(const TimedCloud& scan) {
  std::vector<float> ranges;
  for (std::size_t i = 0; i < scan.size(); i += 1 + scan.size() / kSampled) {
    ranges.push_back(std::hypot(scan.x[i], scan.y[i], scan.z[i]));
  }
  const auto middle = ranges.begin() + static_cast<std::ptrdiff_t>(ranges.size() / 2);
  std::nth_element(ranges.begin(), middle, ranges.end());
  return static_cast<double>(*middle);
}

}  // namespace

RigWatch::RigWatch(const Rig& rig) : rig_(rig), cameras_(rig.cameras.size()) {}

void RigWatch::doubt(const std::string& subject, const std::string& rule, const std::string& text) {
  if (told_.insert(subject + "\n" + rule).second) doubts_.push_back({subject, text});
}

void RigWatch::lookAtArrival(const std::string& topic, StampNs stamp, StampNs arrival) {
  std::lock_guard<std::mutex> lock(mutex_);
  Stream& stream = streams_[topic];
  ++stream.messages;
  if (stamp - arrival > kAheadNs) {
    ++stream.ahead;
    stream.farthest = std::max(stream.farthest, stamp - arrival);
  }
  if (stream.ahead >= kFewestMessages && 2 * stream.ahead > stream.messages) {
    doubt(topic, "ahead",
          format("stamps are up to %.3f s ahead of their arrival: no message can arrive before its "
                 "time; synchronise the clocks, or set time_offset",
                 toSeconds(stream.farthest)));
  }
}

void RigWatch::lookAtScan(const TimedCloud& scan) {
  if (scan.empty()) return;
  const ScanInterval interval = scanInterval(scan);
  const StampNs span_ns = interval.last_ns - interval.first_ns;
  const double range_m = medianRange(scan);
  std::lock_guard<std::mutex> lock(mutex_);
  // A span of 0 has no times at all, which the decoder tells.
  if (span_ns > 0 && span_ns < kShortestScanNs) ++odd_spans_;
  if (odd_spans_ >= kFewestOddScans) {
    doubt("lidar", "span",
          format("a scan takes %.3g ms: no lidar turns so fast; the unit of the points' times is "
                 "another (lidar.time_unit)",
                 1e3 * toSeconds(span_ns)));
  }
  if (range_m > kLongestMedianRange_m || range_m < kShortestMedianRange_m) ++odd_ranges_;
  if (odd_ranges_ >= kFewestOddScans) {
    doubt("lidar", "range",
          format("half of the points lie %s %.4g m: they are not in metres, but in millimetres or "
                 "the like",
                 range_m > kLongestMedianRange_m ? "beyond" : "within", range_m));
  }
}

void RigWatch::lookAtMotion(const TimedCloud& scan, const PoseBuffer& odometry,
                            const Transform& T_vehicle_lidar) {
  std::lock_guard<std::mutex> lock(mutex_);
  own_motion_.add(scan, odometry, T_vehicle_lidar);
  const std::string text = own_motion_.doubt();
  if (!text.empty()) doubt("odometry", "motion", text);
}

void RigWatch::lookAtInfo(std::size_t camera, const CameraInfo& info, const CameraModel& model) {
  if (rig_.cameras[camera].lens.calibration) return;
  // The centre of a part of the image is not that of the lens.
  if (info.roi_x != 0 || info.roi_y != 0 || info.roi_width != 0 || info.roi_height != 0) return;
  const ImageSize size = model.imageSize();
  const double off =
      std::max(std::abs(model.cx() / size.width - 0.5), std::abs(model.cy() / size.height - 0.5));
  if (off <= kOffCentre) return;
  std::lock_guard<std::mutex> lock(mutex_);
  doubt(nameOf(camera), "centre",
        format("its principal point (%.0f, %.0f) lies far off the centre of images of %s: K "
               "belongs to another resolution",
               model.cx(), model.cy(), sizeText(size).c_str()));
}

void RigWatch::lookAtSemantics(std::size_t camera, const cv::Mat& semantics,
                               const ImageSize& image) {
  if (semantics.empty() || image.width <= 0 || image.height <= 0) return;
  std::lock_guard<std::mutex> lock(mutex_);
  ++cameras_[camera].semantics;
  const double ratio = (1.0 * semantics.cols / semantics.rows) / (1.0 * image.width / image.height);
  // A small map may be a row or column off.
  const double rounding = 1.0 / semantics.cols + 1.0 / semantics.rows;
  // The package's own network gets the whole image, brought to its input's size.
  const bool is_own = !rig_.segmentation.model.empty();
  if (!is_own && std::abs(ratio - 1.0) > kOtherAspect + rounding) {
    doubt(nameOf(camera), "aspect",
          format("its %dx%d scores or labels have another aspect than its images of %s: the "
                 "network's input was letterboxed or cropped",
                 semantics.cols, semantics.rows, sizeText(image).c_str()));
  }
  if (rig_.cameras[camera].input == CameraInput::kLabels) {
    lookAtLabels(camera, semantics);
  } else if (rig_.cameras[camera].input == CameraInput::kScores) {
    lookAtScores(camera, semantics);
  }
}

void RigWatch::lookAtLabels(std::size_t camera, const cv::Mat& labels) {
  if (labels.type() != CV_8UC1) return;  // the histogram refuses it
  const int classes = rig_.classes.size();
  int highest = 0;
  const std::size_t pixels = labels.total();
  for (std::size_t i = cameras_[camera].semantics % 7; i < pixels; i += 7) {
    const auto row = static_cast<int>(i / static_cast<std::size_t>(labels.cols));
    const auto column = static_cast<int>(i % static_cast<std::size_t>(labels.cols));
    const int label = labels.at<std::uint8_t>(row, column);
    if (label != kNoLabel) highest = std::max(highest, label);
  }
  if (highest >= classes) {
    doubt(nameOf(camera), "labels",
          format("label %d is at or above the number of classes, %d: the class set is not the "
                 "network's, or its ids are one too high",
                 highest, classes));
  }
}

void RigWatch::lookAtScores(std::size_t camera, const cv::Mat& scores) {
  const int classes = rig_.classes.size();
  // Integer scores are never distributions before their scale and offset; few say enough.
  if (scores.depth() != CV_32F || scores.channels() != classes || classes < 2) return;
  if (cameras_[camera].semantics > 3) return;
  const std::size_t cells = scores.total(), step = 1 + cells / kSampled;
  for (std::size_t i = 0; i < cells; i += step) {
    const auto row = static_cast<int>(i / static_cast<std::size_t>(scores.cols));
    const auto column = i % static_cast<std::size_t>(scores.cols);
    const float* cell = scores.ptr<float>(row) + column * static_cast<std::size_t>(classes);
    double sum = 0.0;
    for (int c = 0; c < classes; ++c) {
      if (!(cell[c] >= 0.0f)) return;
      sum += static_cast<double>(cell[c]);
    }
    if (std::abs(sum - 1.0) > 1e-3) return;
  }
  doubt(nameOf(camera), "probabilities",
        "its scores are probabilities (none is negative, each cell sums to 1): a second softmax "
        "makes all classes about as likely; set its input: probabilities");
}

void RigWatch::lookAtMounting(const CameraView& view,
                              const std::optional<Transform>& T_vehicle_lidar) {
  if (!view.model) return;
  const std::string name = nameOf(static_cast<std::size_t>(view.rig_index));
  const double away_m = view.T_camera_lidar_static.translation().norm();
  if (away_m > kLargestVehicle_m) {
    doubt(name, "position",
          format("it stands %.0f m from the lidar: its transform is in millimetres or centimetres",
                 away_m));
  }
  if (!T_vehicle_lidar) return;
  const Eigen::Matrix3d R_vehicle_camera =
      (*T_vehicle_lidar * view.T_camera_lidar_static.inverse()).linear();
  const double forward_z = R_vehicle_camera(2, 2), down_z = R_vehicle_camera(2, 1);
  if (std::abs(forward_z) > kSteep) {
    doubt(
        name, "axes",
        format("it looks straight %s in tf: its frame is not optical (z forward, x right), or its "
               "transform is inverted",
               forward_z > 0.0 ? "up" : "down"));
  } else if (down_z > 0.5) {
    doubt(name, "axes", "it stands on its head in tf");
  }
}

void RigWatch::lookAtGround(const SemanticCloud& cloud, const Transform& T_vehicle_lidar) {
  const std::optional<GroundPlane> ground = groundPlane(cloud.points, T_vehicle_lidar);
  if (!ground || ground->share < kLeastGroundShare) return;
  if (ground->above_lidar_m > kGroundAbove_m && !ground->has_other_side) {
    ++overhead_;
    if (overhead_ > 1 || scans_ > kGroundEvery) {
      doubt("lidar", "upside down",
            format("the ground lies %.1f m above it: it stands upside down in tf",
                   ground->above_lidar_m));
    }
    return;
  }
  for (std::size_t c = 0; c < cameras_.size(); ++c) {
    cameras_[c].classes.add(cloud, static_cast<int>(c), T_vehicle_lidar, *ground);
    const ClassGeometry::Answer answer = cameras_[c].classes.judge(rig_.classes);
    if (!answer.text.empty()) doubt(nameOf(c), "classes", answer.text);
  }
}

void RigWatch::lookAtFusion(const SemanticCloud& cloud, const std::vector<CameraView>& views,
                            const std::optional<Transform>& T_vehicle_lidar) {
  std::lock_guard<std::mutex> lock(mutex_);
  const auto fused = static_cast<std::uint8_t>(PointStatus::kFused);
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    if (cloud.points.status[i] != fused) continue;
    ++fused_points_;
    for (std::size_t c = 0; c < cameras_.size(); ++c) {
      cameras_[c].points += (cloud.cameras[i] >> c) & 1u;
    }
  }
  for (const CameraView& view : views) lookAtMounting(view, T_vehicle_lidar);
  if (scans_++ % kGroundEvery == 0 && T_vehicle_lidar) lookAtGround(cloud, *T_vehicle_lidar);
  if (scans_ == kScansWithoutPoints) doubtEmptyCameras();
}

void RigWatch::doubtEmptyCameras() {
  for (std::size_t c = 0; c < cameras_.size(); ++c) {
    if (cameras_[c].points > 0) continue;
    doubt(
        nameOf(c), "points",
        format("it gave no point of %llu scans a class", static_cast<unsigned long long>(scans_)));
  }
}

void RigWatch::finish() {
  std::lock_guard<std::mutex> lock(mutex_);
  if (scans_ > 0) doubtEmptyCameras();
}

bool RigWatch::edgesAreDue() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return scans_ >= edges_due_;
}

void RigWatch::lookAtEdges(const std::vector<LidarEdge>& edges,
                           const std::vector<CameraView>& views,
                           const std::vector<cv::Mat>& images) {
  for (const CameraView& view : views) {
    const auto camera = static_cast<std::size_t>(view.rig_index);
    if (!view.model || !view.has_image || images[camera].empty()) continue;
    const EdgeScore seen = scoreEdges(edges, *view.model, view.T_camera_lidar, images[camera]);
    std::lock_guard<std::mutex> lock(mutex_);
    edges_due_ = scans_ + kEdgesEvery;
    EdgeScore& sum = cameras_[camera].edges;
    sum.add(seen);
    if (sum.edges < kFewestEdges || sum.meanChance() > kMostChance || sum.lift() >= kLeastLift) {
      continue;
    }
    doubt(
        nameOf(camera), "edges",
        format("edges of the lidar meet those of its images hardly better than by chance (%.2f of "
               "1; a right rig gives 0.3 and more): its transform, lens or times are wrong",
               sum.lift()));
  }
}

std::vector<RigDoubt> RigWatch::takeDoubts() {
  std::lock_guard<std::mutex> lock(mutex_);
  std::vector<RigDoubt> doubts;
  doubts.swap(doubts_);
  return doubts;
}

RigWatch::CameraFigures RigWatch::figures(std::size_t camera) const {
  std::lock_guard<std::mutex> lock(mutex_);
  return {cameras_[camera].points, fused_points_, cameras_[camera].edges};
}

}  // namespace semantic_lidar_fusion

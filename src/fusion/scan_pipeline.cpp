// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"

#include <opencv2/imgcodecs.hpp>
#include <stdexcept>
#include <utility>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/fusion/camera_superpixels.h"
#include "semantic_lidar_fusion/projection/cloud_projector.h"
#include "semantic_lidar_fusion/segmentation/model.h"

namespace semantic_lidar_fusion {

/// What `segment` keeps from one image to the next.
struct ScanPipeline::Segmentation {
  std::vector<CameraSuperpixels> cameras;
  std::unique_ptr<SegmentationModel> model;  ///< null without a network
};

namespace {

/// The images that hide the vehicle itself, by camera; empty where none is given.
std::vector<cv::Mat> loadEgoMasks(const std::vector<CameraConfig>& cameras) {
  std::vector<cv::Mat> masks;
  std::vector<std::string> problems;
  for (const CameraConfig& camera : cameras) {
    masks.emplace_back();
    if (camera.mask.empty()) continue;
    masks.back() = cv::imread(camera.mask, cv::IMREAD_GRAYSCALE);
    if (masks.back().empty()) {
      problems.push_back("cameras." + camera.name + ".mask: " + camera.mask +
                         " is not a readable image");
    }
  }
  if (!problems.empty()) throw ConfigError(problems);
  return masks;
}

/// The cloud of a rig without classes, where no point can have one.
FusionResult unclassified(const Cloud& cloud, bool keep_unlabelled) {
  FusionResult result;
  SemanticCloud& points = result.cloud;
  points.points = cloud;
  if (!keep_unlabelled) points.points.resize(0);
  for (std::uint8_t& status : points.points.status) {
    if (status != static_cast<std::uint8_t>(PointStatus::kNoOdometry)) {
      status = static_cast<std::uint8_t>(PointStatus::kOutsideImages);
    }
  }
  points.label.assign(points.size(), kNoLabel);
  points.confidence.assign(points.size(), 0.0f);
  points.entropy.assign(points.size(), 1.0f);
  points.cameras.assign(points.size(), 0);
  return result;
}

}  // namespace

FusionConfig fusionConfig(const Rig& rig) {
  FusionConfig config;
  config.class_count = rig.classes.size();
  config.uncertainty = rig.uncertainty;
  config.occlusion = rig.occlusion;
  config.transfer = rig.transfer;
  config.overlap = rig.overlap;
  config.smoothing = rig.smoothing;
  config.keep_unlabelled = rig.keep_unlabelled;
  config.threads = rig.threads;
  return config;
}

ScanPipeline::ScanPipeline(const Rig& rig)
    : ScanPipeline(rig, {PipelineStep::kNetwork, PipelineStep::kSegment, PipelineStep::kCompensate,
                         PipelineStep::kView, PipelineStep::kFuse}) {}

ScanPipeline::ScanPipeline(const Rig& rig, const PipelineSteps& steps) : rig_(rig) {
  for (const PipelineStep step : steps) steps_ |= 1u << static_cast<unsigned>(step);
  if (has(PipelineStep::kView)) ego_masks_ = loadEgoMasks(rig_.cameras);
  if (has(PipelineStep::kSegment)) {
    segmentation_ = std::make_unique<Segmentation>();
    for (std::size_t i = 0; i < rig_.cameras.size(); ++i) {
      segmentation_->cameras.emplace_back(rig_.superpixels);
    }
    if (has(PipelineStep::kNetwork) && !rig_.segmentation.model.empty()) {
      segmentation_->model =
          std::make_unique<SegmentationModel>(rig_.segmentation.model, rig_.classes);
    }
  }
  if (has(PipelineStep::kFuse) && rig_.classes.size() > 0) {
    projector_ = std::make_unique<SemanticProjector>(fusionConfig(rig_));
  }
}

ScanPipeline::~ScanPipeline() = default;

void ScanPipeline::retune(const Rig& rig) {
  rig_.retune(rig);
  if (projector_) projector_ = std::make_unique<SemanticProjector>(fusionConfig(rig_));
}

bool ScanPipeline::has(PipelineStep step) const {
  return (steps_ >> static_cast<unsigned>(step) & 1u) != 0;
}

void ScanPipeline::require(PipelineStep step) const {
  if (!has(step)) throw std::logic_error("a step of the pipeline is called that was not built");
}

/// Those of the rig, or those found.
RowBand ScanPipeline::lidarRows(std::size_t index, const SegmentedImage& image) const {
  const CameraConfig& camera = rig_.cameras[index];
  return camera.finds_lidar_rows ? image.lidar_rows : camera.lidar_rows;
}

// --- Semantics of an image (eq. 1-4)

void ScanPipeline::segment(std::size_t index, SegmentedImage* image) {
  require(PipelineStep::kSegment);
  const CameraConfig& camera = rig_.cameras.at(index);
  const int class_count = rig_.classes.size();
  if (camera.input == CameraInput::kProbabilities) {
    if (image->input.type() != CV_32FC(class_count)) {
      throw DataError("probabilities are " + sizeText({image->input.cols, image->input.rows}) +
                      " with " + std::to_string(image->input.channels()) + " channels; 32FC" +
                      std::to_string(class_count) + " is wanted");
    }
    image->semantics.probabilities = image->input;
    return;
  }
  if (image->input.empty()) {
    if (!segmentation_->model || camera.input != CameraInput::kScores) {
      throw DataError("image without scores, and no segmentation.model to make them");
    }
    image->input = segmentation_->model->scores(image->image);
    image->from_network = true;
  }
  cluster(index, image);
  if (camera.input == CameraInput::kLabels) {
    image->semantics.probabilities =
        histogramProbabilities(image->superpixels, image->input, class_count);
    return;
  }
  const ScoreMap scores(image->input, class_count, camera.score_format);
  const ShareMap share = computeShare(image->superpixels, scores);
  image->share = share.share;
  image->nonfinite_cells = share.nonfinite_cells;
  if (transfersProbabilities(rig_, camera)) {
    const cv::Mat blended = blendScores(image->superpixels, scores, rig_.uncertainty.blend);
    image->semantics.probabilities =
        denseProbabilities(ScoreMap(blended, class_count, {}), share.share, rig_.uncertainty);
  } else {
    image->semantics.scores = scores;
    image->semantics.share = share.share;
  }
}

void ScanPipeline::cluster(std::size_t index, SegmentedImage* image) {
  require(PipelineStep::kSegment);
  CameraSuperpixels& camera = segmentation_->cameras.at(index);
  if (rig_.cameras[index].input != CameraInput::kProbabilities) camera.noteScores(image->input);
  const std::optional<ImageSize> size = camera.mapSize({image->image.cols, image->image.rows});
  const cv::Mat& ids = image->superpixels.ids;
  if (!size || (!ids.empty() && ImageSize{ids.cols, ids.rows} == *size)) return;
  image->note = camera.clampNote(*size);
  image->superpixels = camera.cluster(image->image, *size, image->stamp, lidarRows(index, *image));
}

cv::Mat ScanPipeline::probabilities(const SegmentedImage& image) const {
  return image.semantics.scores.empty()
             ? image.semantics.probabilities
             : denseProbabilities(image.semantics.scores, image.share, rig_.uncertainty);
}

// --- Motion (eq. 5)

CompensationResult ScanPipeline::compensate(TimedCloud scan, StampNs reference_ns,
                                            const PoseBuffer& odometry,
                                            const std::optional<Transform>& T_vehicle_lidar) const {
  require(PipelineStep::kCompensate);
  // Without extrinsics no pose of the lidar is known: the same as odometry that covers nothing.
  static const PoseBuffer kUnknown;
  return semantic_lidar_fusion::compensate(
      std::move(scan), reference_ns, T_vehicle_lidar ? odometry : kUnknown,
      T_vehicle_lidar.value_or(Transform::Identity()), rig_.compensationConfig());
}

// --- Projection (eq. 6-11)

StampNs ScanPipeline::imageTime(std::size_t index, StampNs stamp) const {
  return stamp + toNs(rig_.cameras.at(index).time_offset_s);
}

bool ScanPipeline::coversImage(std::size_t index, StampNs stamp, const PoseBuffer& odometry) const {
  return !rig_.motion_enabled || odometry.covers(imageTime(index, stamp));
}

CameraView ScanPipeline::view(std::size_t index, const CameraPlace& place,
                              const SegmentedImage* image, StampNs reference_ns,
                              const PoseBuffer& odometry,
                              const std::optional<Transform>& T_vehicle_lidar) const {
  require(PipelineStep::kView);
  CameraView view;
  view.name = rig_.cameras.at(index).name;
  view.rig_index = static_cast<int>(index);
  view.model = place.model;
  view.T_camera_lidar_static = place.T_camera_lidar;
  view.T_camera_lidar = place.T_camera_lidar;
  view.ego_mask = ego_masks_[index];
  if (!image || !place.model) return view;
  view.image_ns = imageTime(index, image->stamp);
  view.semantics = image->semantics;
  view.lidar_rows = lidarRows(index, *image);
  view.has_image = true;
  const CameraErrors& errors = rig_.cameras[index].errors;
  const bool rolling = place.model->rollingShutter();
  const bool moving = rig_.motion_enabled && T_vehicle_lidar;
  std::optional<ViewMotion> motion;
  if (moving && (rolling || statesErrors(rig_.errors, errors))) {
    if (const std::optional<Twist> twist = odometry.twist(view.image_ns)) {
      motion = {place.T_camera_lidar * T_vehicle_lidar->inverse(Eigen::Isometry), *T_vehicle_lidar,
                *twist};
    }
  }
  view.errors = viewErrors(rig_.errors, errors, motion, toSeconds(view.image_ns - reference_ns));
  if (!rig_.motion_enabled || (view.image_ns == reference_ns && !rolling)) return view;

  const std::optional<Transform> T_vehicle_image_vehicle_reference =
      vehicleMotion(odometry, reference_ns, view.image_ns, rig_.compensationConfig());
  if (!moving || !T_vehicle_image_vehicle_reference) {
    view.has_image = false;
    return view;
  }
  if (rolling && motion) view.motion = twistOf(motion->T_camera_vehicle, motion->vehicle);
  if (view.image_ns == reference_ns) return view;
  const Transform T_camera_vehicle =
      place.T_camera_lidar * T_vehicle_lidar->inverse(Eigen::Isometry);
  view.T_camera_lidar = T_camera_vehicle * *T_vehicle_image_vehicle_reference * *T_vehicle_lidar;
  return view;
}

// --- Occlusion, transfer, merging (eq. 12-14)

FusionResult ScanPipeline::fuse(const Cloud& cloud, std::vector<CameraView> views,
                                bool with_pixels) const {
  require(PipelineStep::kFuse);
  if (!projector_) return unclassified(cloud, rig_.keep_unlabelled);
  return projector_->fuse(cloud, std::move(views), with_pixels);
}

// --- Selection

bool transfersProbabilities(const Rig& rig, const CameraConfig& camera) {
  return camera.input != CameraInput::kScores || rig.uncertainty.blend > 0.0;
}

bool isCandidate(CameraInput input, const ImageParts& parts, bool made_on_request) {
  const bool needs_pixels = made_on_request || input != CameraInput::kProbabilities;
  return (parts.pixels || !needs_pixels) && (parts.semantics || made_on_request);
}

std::optional<StampNs> sweepTime(const TimedCloud& scan, const CameraPlace& place) {
  if (!place.model) return std::nullopt;
  Cloud raw;
  raw.x = scan.x;
  raw.y = scan.y;
  raw.z = scan.z;
  raw.status.assign(scan.size(), static_cast<std::uint8_t>(PointStatus::kFused));
  const ProjectedPoints points = projectCloud(raw, place.T_camera_lidar, *place.model, 0.0);
  // Relative to one of them, so that the sum stays small; the mean is rounded down.
  std::int64_t sum = 0;
  std::int64_t count = 0;
  StampNs origin = 0;
  for (std::size_t k = 0; k < points.size(); ++k) {
    if (!inImage(points.u[k], points.v[k], place.model->imageSize())) continue;
    const StampNs time = scan.time_ns[points.index[k]];
    if (count == 0) origin = time;
    sum += time - origin;
    ++count;
  }
  if (count == 0) return std::nullopt;
  const std::int64_t mean = sum / count - (sum % count < 0 ? 1 : 0);
  return origin + mean;
}

}  // namespace semantic_lidar_fusion

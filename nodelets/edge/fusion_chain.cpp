// SPDX-License-Identifier: MIT
#include "edge/fusion_chain.h"

#include <opencv2/imgcodecs.hpp>
#include <utility>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/projection/cloud_projector.h"

namespace semantic_lidar_fusion {

struct FusionChain::Camera {
  CameraConfig config;
  CameraSemantics semantics;
  cv::Mat ego_mask;
};

namespace {

std::string sizeText(const cv::Mat& image) {
  return std::to_string(image.cols) + "x" + std::to_string(image.rows);
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
  config.overlap = rig.overlap;
  config.keep_unlabelled = rig.keep_unlabelled;
  config.threads = rig.threads;
  return config;
}

FusionChain::FusionChain(const Rig& rig, bool with_network) : rig_(rig) {
  std::vector<std::string> problems;
  for (const CameraConfig& config : rig_.cameras) {
    Camera camera{
        config, CameraSemantics(rig_.superpixels, rig_.classes.size(), config.score_format), {}};
    if (!config.mask.empty()) {
      camera.ego_mask = cv::imread(config.mask, cv::IMREAD_GRAYSCALE);
      if (camera.ego_mask.empty()) {
        problems.push_back("cameras." + config.name + ".mask: " + config.mask +
                           " is not a readable image");
      }
    }
    cameras_.push_back(std::move(camera));
  }
  if (!problems.empty()) throw ConfigError(problems);
  if (with_network && !rig_.segmentation.model.empty()) {
    model_ = std::make_unique<SegmentationModel>(rig_.segmentation.model, rig_.classes);
  }
  if (rig_.classes.size() > 0) {
    projector_ = std::make_unique<SemanticProjector>(fusionConfig(rig_));
  }
}

FusionChain::~FusionChain() = default;

void FusionChain::segment(std::size_t index, SegmentedImage* image) {
  Camera& camera = cameras_.at(index);
  if (camera.config.input == CameraInput::kProbabilities) {
    if (image->input.type() != CV_32FC(rig_.classes.size())) {
      throw DataError("probabilities are " + sizeText(image->input) + " with " +
                      std::to_string(image->input.channels()) + " channels; 32FC" +
                      std::to_string(rig_.classes.size()) + " is wanted");
    }
    image->semantics.probabilities = image->input;
    return;
  }
  if (image->input.empty()) {
    if (!model_ || camera.config.input != CameraInput::kScores) {
      throw DataError("image without scores, and no segmentation.model to make them");
    }
    image->input = model_->scores(image->image);
    image->from_network = true;
  }
  camera.semantics.noteScores(image->input);
  const ImageSize pixels{image->image.cols, image->image.rows};
  const ImageSize map_size = camera.semantics.mapSize(pixels).value_or(pixels);
  image->note = camera.semantics.clampNote(map_size);
  const SuperpixelMap superpixels = camera.semantics.cluster(image->image, map_size, image->stamp);
  image->superpixel_ids = superpixels.ids;
  if (camera.config.input == CameraInput::kLabels) {
    image->semantics.probabilities =
        histogramProbabilities(superpixels, image->input, rig_.classes.size());
    return;
  }
  image->semantics.scores = ScoreMap(image->input, rig_.classes.size(), camera.config.score_format);
  image->share = computeShare(superpixels, image->semantics.scores).share;
  image->semantics.share = image->share;
}

CompensationResult FusionChain::compensated(TimedCloud scan, StampNs reference_ns,
                                            const PoseBuffer& odometry,
                                            const std::optional<Transform>& T_vehicle_lidar) const {
  // Without extrinsics no pose of the lidar is known: the same as odometry that covers nothing.
  const PoseBuffer unknown;
  return compensate(std::move(scan), reference_ns, T_vehicle_lidar ? odometry : unknown,
                    T_vehicle_lidar.value_or(Transform::Identity()), rig_.compensationConfig());
}

CameraView FusionChain::view(std::size_t index, const CameraPlace& place,
                             const SegmentedImage* image, StampNs reference_ns,
                             const PoseBuffer& odometry,
                             const std::optional<Transform>& T_vehicle_lidar) const {
  const Camera& camera = cameras_.at(index);
  CameraView view;
  view.name = camera.config.name;
  view.rig_index = static_cast<int>(index);
  view.model = place.model;
  view.T_camera_lidar_static = place.T_camera_lidar;
  view.T_camera_lidar = place.T_camera_lidar;
  view.ego_mask = camera.ego_mask;
  if (!image || !place.model) return view;
  view.image_ns = image->stamp + toNs(camera.config.time_offset_s);
  view.semantics = image->semantics;
  view.has_image = true;
  if (!rig_.motion_enabled || view.image_ns == reference_ns) return view;

  const std::optional<Transform> T_vehicle_image_vehicle_reference =
      vehicleMotion(odometry, reference_ns, view.image_ns);
  if (!T_vehicle_lidar || !T_vehicle_image_vehicle_reference) {
    view.has_image = false;
    return view;
  }
  const Transform T_camera_vehicle =
      place.T_camera_lidar * T_vehicle_lidar->inverse(Eigen::Isometry);
  view.T_camera_lidar = T_camera_vehicle * *T_vehicle_image_vehicle_reference * *T_vehicle_lidar;
  return view;
}

FusionResult FusionChain::fused(const Cloud& cloud, std::vector<CameraView> views,
                                bool with_pixels) const {
  if (!projector_) return unclassified(cloud, rig_.keep_unlabelled);
  return projector_->fuse(cloud, std::move(views), with_pixels);
}

Cloud FusionChain::emptyCloud(const TimedCloud& scan) const {
  Cloud cloud;
  cloud.frame_id = scan.frame_id;
  cloud.stamp = scan.header_stamp;
  cloud.first_point_ns = scan.header_stamp;
  return cloud;
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

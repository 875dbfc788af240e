// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/fusion/camera_semantics.h"

#include <algorithm>
#include <cmath>

namespace semantic_lidar_fusion {
namespace {

SlicConfig slicConfig(const SuperpixelConfig& config) {
  SlicConfig slic;
  slic.count = config.count;
  slic.compactness = config.compactness;
  slic.iterations = config.iterations;
  slic.warm_start = config.warm_start;
  return slic;
}

}  // namespace

CameraSemantics::CameraSemantics(const SuperpixelConfig& config, int class_count,
                                 const ScoreFormat& format)
    : config_(config), class_count_(class_count), format_(format), slic_(slicConfig(config)) {}

std::optional<ImageSize> CameraSemantics::mapSize(const ImageSize& image) const {
  if (config_.scale <= 0) return scores_size_;
  return ImageSize{std::max(1, static_cast<int>(std::floor(image.width * config_.scale))),
                   std::max(1, static_cast<int>(std::floor(image.height * config_.scale)))};
}

std::string CameraSemantics::clampNote(const ImageSize& map_size) const {
  const int most = clampedSuperpixelCount(slicConfig(config_), map_size);
  if (most >= config_.count) return {};
  return "superpixels.count = " + std::to_string(config_.count) + ": a map of " +
         std::to_string(map_size.width) + "x" + std::to_string(map_size.height) +
         " pixels holds no more than " + std::to_string(most) +
         "; raise superpixels.scale for more";
}

void CameraSemantics::noteScores(const cv::Mat& scores) {
  if (!scores.empty()) scores_size_ = ImageSize{scores.cols, scores.rows};
}

SuperpixelMap CameraSemantics::cluster(const cv::Mat& image, const ImageSize& map_size,
                                       StampNs stamp) {
  return slic_.cluster(image, map_size, stamp);
}

ShareMap CameraSemantics::share(const SuperpixelMap& superpixels, const cv::Mat& scores) const {
  return computeShare(superpixels, ScoreMap(scores, class_count_, format_));
}

}  // namespace semantic_lidar_fusion

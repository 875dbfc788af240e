// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/fusion/camera_superpixels.h"

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

CameraSuperpixels::CameraSuperpixels(const SuperpixelConfig& config)
    : config_(config), slic_(slicConfig(config)) {}

std::optional<ImageSize> CameraSuperpixels::mapSize(const ImageSize& image) const {
  if (config_.scale <= 0) return scores_size_;
  return ImageSize{std::max(1, static_cast<int>(std::floor(image.width * config_.scale))),
                   std::max(1, static_cast<int>(std::floor(image.height * config_.scale)))};
}

std::string CameraSuperpixels::clampNote(const ImageSize& map_size) const {
  const int most = clampedSuperpixelCount(slicConfig(config_), map_size);
  if (most >= config_.count) return {};
  return "superpixels.count = " + std::to_string(config_.count) + ": a map of " +
         sizeText(map_size) + " pixels holds no more than " + std::to_string(most) +
         "; raise superpixels.scale for more";
}

void CameraSuperpixels::noteScores(const cv::Mat& scores) {
  if (!scores.empty()) scores_size_ = ImageSize{scores.cols, scores.rows};
}

SuperpixelMap CameraSuperpixels::cluster(const cv::Mat& image, const ImageSize& map_size,
                                         StampNs stamp, const RowBand& lidar_rows) {
  slic_.setRows(lidar_rows);
  return slic_.cluster(image, map_size, stamp);
}

}  // namespace semantic_lidar_fusion

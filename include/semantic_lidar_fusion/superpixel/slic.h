// SPDX-License-Identifier: MIT
/// SLIC superpixels (Achanta et al., "SLIC Superpixels Compared to State-of-the-Art Superpixel
/// Methods", PAMI 2012): local k-means in colour and position, then one region per superpixel.
#pragma once

#include <opencv2/core.hpp>

#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/superpixel/superpixel_map.h"

namespace semantic_lidar_fusion {

struct SlicConfig {
  int count = 1000;           ///< wanted superpixels; clamped to 1..pixels / 64
  double compactness = 10.0;  ///< weight of position against colour (CIELab units), > 0
  int iterations = 10;        ///< of the k-means, 1..100
};

/// Number of superpixels that `cluster` aims at: `config.count` clamped to 1..pixels / 64.
int clampedSuperpixelCount(const SlicConfig& config, const ImageSize& map_size);

/// Clusters images of one camera. Not thread-safe; one instance per camera.
class Slic {
 public:
  /// Throws ConfigError.
  explicit Slic(const SlicConfig& config);

  /// `image`: CV_8UC1 or CV_8UC3 (BGR), any size from 1x1. The map has `map_size`, the image being
  /// brought to it by averaging over each map pixel's box (exact, also for a map that is larger).
  /// Obtains clampedSuperpixelCount within 10 %; ids are in raster order of first appearance.
  /// Deterministic. Throws DataError on an empty image, another type, or a map size below 1x1.
  SuperpixelMap cluster(const cv::Mat& image, const ImageSize& map_size);

 private:
  SlicConfig config_;
};

}  // namespace semantic_lidar_fusion

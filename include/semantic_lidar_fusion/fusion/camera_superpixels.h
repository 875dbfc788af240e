// SPDX-License-Identifier: MIT
/// Superpixels of one camera's images, after the rig file.
#pragma once

#include <opencv2/core.hpp>
#include <optional>
#include <string>

#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/superpixel/slic.h"
#include "semantic_lidar_fusion/superpixel/superpixel_map.h"

namespace semantic_lidar_fusion {

/// Superpixels of one camera's images, in the order in which the images are given. Not thread-safe.
class CameraSuperpixels {
 public:
  /// Throws ConfigError.
  explicit CameraSuperpixels(const SuperpixelConfig& config);

  /// Size of the superpixel map of an image: floor(image * scale), at least 1 x 1; without a scale
  /// the size of the scores, which is empty until scores were seen.
  std::optional<ImageSize> mapSize(const ImageSize& image) const;
  /// What to tell a user if a map of this size cannot hold `superpixels.count`; empty if it can.
  std::string clampNote(const ImageSize& map_size) const;
  /// Tells the size of the scores, for maps of their size. An empty image is ignored.
  void noteScores(const cv::Mat& scores);

  /// `image`: CV_8UC1 or CV_8UC3 (BGR), taken at `stamp`; with `superpixels.warm_start` the result
  /// depends on the image before, if it is recent. `lidar_rows`: those in which superpixels are
  /// wanted; with others than for the image before it starts cold. Throws DataError, ConfigError.
  SuperpixelMap cluster(const cv::Mat& image, const ImageSize& map_size, StampNs stamp,
                        const RowBand& lidar_rows);

 private:
  SuperpixelConfig config_;
  std::optional<ImageSize> scores_size_;
  Slic slic_;
};

}  // namespace semantic_lidar_fusion

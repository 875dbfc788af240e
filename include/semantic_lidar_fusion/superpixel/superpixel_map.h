// SPDX-License-Identifier: MIT
#pragma once

#include <opencv2/core.hpp>
#include <vector>

namespace semantic_lidar_fusion {

/// Partition of an image into superpixels: ids 0..count-1, all used, each a 4-connected region.
struct SuperpixelMap {
  cv::Mat ids;  ///< CV_32SC1
  int count = 0;
  std::vector<int> sizes;  ///< pixels of each superpixel
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#pragma once

#include <opencv2/core.hpp>
#include <vector>

namespace semantic_lidar_fusion {

/// Rows of an image, as parts of its height.
struct RowBand {
  double first = 0.0;
  double last = 1.0;
};

/// Partition of an image into superpixels: ids 0..count-1, all used, each a 4-connected region.
struct SuperpixelMap {
  cv::Mat ids;  ///< CV_32SC1
  int count = 0;
  std::vector<int> sizes;  ///< pixels of each superpixel
  /// The rows that were clustered; those before and behind repeat the nearest of them.
  cv::Range rows = cv::Range::all();

  int firstRow() const { return rows == cv::Range::all() ? 0 : rows.start; }
  int endRow() const { return rows == cv::Range::all() ? ids.rows : rows.end; }
};

}  // namespace semantic_lidar_fusion

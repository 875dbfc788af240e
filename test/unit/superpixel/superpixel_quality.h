// SPDX-License-Identifier: MIT
/// Agreement of superpixels with human labels.
#pragma once

#include <algorithm>
#include <map>
#include <opencv2/core.hpp>
#include <string>
#include <utility>
#include <vector>

#include "semantic_lidar_fusion/superpixel/slic.h"

namespace semantic_lidar_fusion {

/// Neubert and Protzel's undersegmentation error: for each segment and each superpixel that touches
/// it, the smaller of the parts inside and outside, summed, per pixel. `truth`: 8UC1, segment ids.
inline double undersegmentationError(const cv::Mat& ids, const cv::Mat& truth) {
  std::map<std::pair<int, int>, int> overlap;  // (superpixel, segment)
  std::map<int, int> size;
  for (int y = 0; y < ids.rows; ++y) {
    for (int x = 0; x < ids.cols; ++x) {
      ++overlap[{ids.at<int>(y, x), truth.at<uchar>(y, x)}];
      ++size[ids.at<int>(y, x)];
    }
  }
  double error = 0.0;
  for (const auto& [key, inside] : overlap) error += std::min(inside, size[key.first] - inside);
  return error / static_cast<double>(ids.total());
}

/// Share of the label boundaries' pixels that have a superpixel boundary within `tolerance` pixels.
/// A boundary pixel differs from its right or lower neighbour.
inline double boundaryRecall(const cv::Mat& ids, const cv::Mat& truth, int tolerance = 2) {
  const auto boundary = [](const auto& at, int x, int y, int width, int height) {
    return (x + 1 < width && at(x, y) != at(x + 1, y)) ||
           (y + 1 < height && at(x, y) != at(x, y + 1));
  };
  const auto id = [&](int x, int y) { return ids.at<int>(y, x); };
  const auto label = [&](int x, int y) { return static_cast<int>(truth.at<uchar>(y, x)); };
  int found = 0, total = 0;
  for (int y = 0; y < ids.rows; ++y) {
    for (int x = 0; x < ids.cols; ++x) {
      if (!boundary(label, x, y, ids.cols, ids.rows)) continue;
      ++total;
      bool near = false;
      for (int v = std::max(0, y - tolerance); v <= std::min(ids.rows - 1, y + tolerance); ++v) {
        for (int u = std::max(0, x - tolerance); u <= std::min(ids.cols - 1, x + tolerance); ++u) {
          near = near || boundary(id, u, v, ids.cols, ids.rows);
        }
      }
      found += near;
    }
  }
  return total == 0 ? 1.0 : static_cast<double>(found) / total;
}

/// The map with `count` superpixels, or with as few less as requests around it obtain.
inline SuperpixelMap clusterToCount(const cv::Mat& image, int count, SlicConfig config = {}) {
  SuperpixelMap closest;
  const auto attempt = [&](int request) {
    config.count = request;
    SuperpixelMap map = Slic(config).cluster(image, {image.cols, image.rows});
    const int obtained = map.count;
    if (obtained <= count && obtained > closest.count) closest = std::move(map);
    return obtained;
  };
  int request = count;
  for (int i = 0; i < 4 && closest.count != count; ++i) request += count - attempt(request);
  for (int i = 1; i < 12 && closest.count != count; ++i) attempt(request + (i % 2 ? i : -i) / 2);
  return closest;
}

inline std::vector<std::string> camvidNames() {
  return {"0001TP_008550",  "0001TP_009150",  "0001TP_009750",  "0001TP_010350",
          "Seq05VD_f00540", "Seq05VD_f01140", "Seq05VD_f01740", "Seq05VD_f02340",
          "Seq05VD_f02940", "Seq05VD_f03540", "Seq05VD_f04140", "Seq05VD_f04740"};
}

}  // namespace semantic_lidar_fusion

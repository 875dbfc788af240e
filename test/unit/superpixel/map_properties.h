// SPDX-License-Identifier: MIT
/// What every superpixel map must fulfil, checked by plain flood fill.
#pragma once

#include <gtest/gtest.h>

#include <cmath>
#include <map>
#include <random>
#include <set>
#include <vector>

#include "semantic_lidar_fusion/superpixel/superpixel_map.h"

namespace semantic_lidar_fusion {

/// 4-connected regions of equal ids.
inline int countRegions(const cv::Mat& ids) {
  cv::Mat seen(ids.size(), CV_8UC1, cv::Scalar(0));
  int regions = 0;
  std::vector<cv::Point> stack;
  for (int y = 0; y < ids.rows; ++y) {
    for (int x = 0; x < ids.cols; ++x) {
      if (seen.at<uchar>(y, x)) continue;
      ++regions;
      seen.at<uchar>(y, x) = 1;
      stack.push_back({x, y});
      while (!stack.empty()) {
        const cv::Point p = stack.back();
        stack.pop_back();
        for (const cv::Point& step :
             {cv::Point(1, 0), cv::Point(-1, 0), cv::Point(0, 1), cv::Point(0, -1)}) {
          const cv::Point q = p + step;
          if (q.x < 0 || q.y < 0 || q.x >= ids.cols || q.y >= ids.rows || seen.at<uchar>(q) ||
              ids.at<int>(q) != ids.at<int>(p)) {
            continue;
          }
          seen.at<uchar>(q) = 1;
          stack.push_back(q);
        }
      }
    }
  }
  return regions;
}

/// Ids dense from 0 in raster order of first appearance, true sizes, each id one region.
inline void expectValidMap(const SuperpixelMap& map, int width, int height) {
  ASSERT_EQ(map.ids.type(), CV_32SC1);
  ASSERT_EQ(map.ids.cols, width);
  ASSERT_EQ(map.ids.rows, height);
  std::vector<int> sizes;
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const int id = map.ids.at<int>(y, x);
      ASSERT_GE(id, 0) << "at " << x << ", " << y;
      ASSERT_LE(id, static_cast<int>(sizes.size())) << "id skipped at " << x << ", " << y;
      if (id == static_cast<int>(sizes.size())) sizes.push_back(0);
      ++sizes[id];
    }
  }
  EXPECT_EQ(map.count, static_cast<int>(sizes.size()));
  EXPECT_EQ(map.sizes, sizes);
  EXPECT_EQ(countRegions(map.ids), map.count);
}

inline void expectCountWithinTenPercent(int count, int wanted) {
  EXPECT_LE(std::abs(count - wanted) * 10, wanted) << count << " superpixels, wanted " << wanted;
}

/// Colour patches with soft edges and noise: what the tests call a natural image.
inline cv::Mat patchImage(int width, int height, int type, unsigned seed, double noise = 6.0) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> unit(0.0, 1.0);
  std::normal_distribution<double> normal(0.0, noise);
  struct Patch {
    double x, y, colour[3];
  };
  std::vector<Patch> patches(12);
  for (Patch& patch : patches) {
    patch = {unit(random) * width, unit(random) * height, {}};
    for (double& value : patch.colour) value = 255.0 * unit(random);
  }
  const int channels = CV_MAT_CN(type);
  cv::Mat image(height, width, type);
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const Patch* nearest = &patches[0];
      for (const Patch& patch : patches) {
        if (std::hypot(patch.x - x, patch.y - y) < std::hypot(nearest->x - x, nearest->y - y)) {
          nearest = &patch;
        }
      }
      for (int c = 0; c < channels; ++c) {
        image.ptr(y)[x * channels + c] =
            cv::saturate_cast<uchar>(nearest->colour[c] + normal(random));
      }
    }
  }
  return image;
}

inline cv::Mat noiseImage(int width, int height, int type, unsigned seed) {
  std::mt19937 random(seed);
  cv::Mat image(height, width, type);
  for (int y = 0; y < height; ++y) {
    for (int i = 0; i < width * CV_MAT_CN(type); ++i) {
      image.ptr(y)[i] = static_cast<uchar>(random());
    }
  }
  return image;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <string>

#include "map_properties.h"
#include "superpixel/connected_regions.h"

namespace semantic_lidar_fusion {
namespace {

RunImage toRuns(const cv::Mat& labels) {
  RunImage image;
  image.size = {labels.cols, labels.rows};
  image.row_first.push_back(0);
  for (int y = 0; y < labels.rows; ++y) {
    for (int x = 0; x < labels.cols; ++x) {
      if (x > 0 && labels.at<int>(y, x) == labels.at<int>(y, x - 1)) continue;
      image.runs.push_back({x, labels.at<int>(y, x)});
    }
    image.runs.push_back({labels.cols, -1});
    image.row_first.push_back(static_cast<int>(image.runs.size()));
  }
  return image;
}

SuperpixelMap connectedRegions(const cv::Mat& labels, int wanted) {
  return RegionConnector().connect(toRuns(labels), wanted);
}

cv::Mat randomLabels(int width, int height, int label_count, unsigned seed) {
  std::mt19937 random(seed);
  cv::Mat labels(height, width, CV_32SC1);
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) labels.at<int>(y, x) = static_cast<int>(random()) % label_count;
  }
  return labels;
}

TEST(ConnectedRegions, HoldsTheCountForAnyLabels) {
  for (const auto& [width, height] :
       {std::pair<int, int>{1, 1}, {1, 70}, {70, 1}, {13, 11}, {64, 48}, {97, 5}}) {
    for (const int label_count : {1, 2, 3, 50, 100000}) {
      const cv::Mat labels = randomLabels(width, height, label_count, 7);
      for (const int wanted : {1, 3, 20, width * height / 2, width * height}) {
        if (wanted < 1 || wanted > width * height) continue;
        SCOPED_TRACE(std::to_string(width) + "x" + std::to_string(height) + ", labels " +
                     std::to_string(label_count) + ", wanted " + std::to_string(wanted));
        const SuperpixelMap map = connectedRegions(labels, wanted);
        expectValidMap(map, width, height);
        expectCountWithinTenPercent(map.count, wanted);
      }
    }
  }
}

TEST(ConnectedRegions, KeepsRegionsThatFit) {
  cv::Mat labels(40, 60, CV_32SC1);
  for (int y = 0; y < 40; ++y) {
    for (int x = 0; x < 60; ++x) labels.at<int>(y, x) = 100 + (y / 20) * 3 + x / 20;
  }
  const SuperpixelMap map = connectedRegions(labels, 6);
  ASSERT_EQ(map.count, 6);
  EXPECT_EQ(cv::norm(map.ids, labels - 100, cv::NORM_L1), 0.0);
}

TEST(ConnectedRegions, JoinsSpecksToTheirSurroundings) {
  cv::Mat labels(40, 60, CV_32SC1);
  for (int y = 0; y < 40; ++y) {
    for (int x = 0; x < 60; ++x) labels.at<int>(y, x) = (y / 20) * 3 + x / 20;
  }
  const cv::Mat clean = labels.clone();
  labels.at<int>(10, 10) = 5;  // a cluster's far speck
  labels.at<int>(30, 50) = 77;
  labels.at<int>(0, 0) = 78;  // without a neighbour to the left or above
  labels.at<int>(0, 1) = 79;
  const SuperpixelMap map = connectedRegions(labels, 6);
  ASSERT_EQ(map.count, 6);
  EXPECT_EQ(cv::norm(map.ids, clean, cv::NORM_L1), 0.0);
}

TEST(ConnectedRegions, SplitsIntoConnectedPartsNearHalf) {
  const SuperpixelMap map = connectedRegions(cv::Mat(32, 32, CV_32SC1, cv::Scalar(4)), 8);
  expectValidMap(map, 32, 32);
  EXPECT_EQ(map.count, 8);
  // In a tree of degree 4 some cut leaves at least a quarter (less one node) on each side.
  for (const int size : map.sizes) EXPECT_GE(size, 1024 / 64 - 1);
}

}  // namespace
}  // namespace semantic_lidar_fusion

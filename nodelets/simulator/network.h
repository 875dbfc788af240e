// SPDX-License-Identifier: MIT
/// What a segmentation network would say of a picture, made from the true labels.
#pragma once

#include <cstdint>
#include <opencv2/core.hpp>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {
namespace simulator {

/// CV_32FC(12) scores of `size` cells: displaced and blurred borders, classes taken for similar
/// ones in patches, and logits that are too sure of themselves.
/// Its border shifts, confusions and gain follow ENet's on twelve labelled CamVid photos (480 x
/// 360): accuracy by distance from a true class edge, in cells of 1/240 of the width, was 0.58
/// below 1 cell, 0.75 at 1-2, 0.83 at 2-3, 0.87 at 3-5, 0.89 at 5-20 and 0.93 beyond, 0.85 in all;
/// the best logit exceeded the second by 7.4 (median), and the softmax claimed 0.95 on average.
cv::Mat imitateNetwork(const cv::Mat& labels, const ImageSize& size, std::uint64_t key);
/// Scores of a network that never errs, at the labels' size: 10 for the class, else 0.
cv::Mat perfectScores(const cv::Mat& labels);

}  // namespace simulator
}  // namespace semantic_lidar_fusion

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
cv::Mat imitateNetwork(const cv::Mat& labels, const ImageSize& size, std::uint64_t key);
/// Scores of a network that never errs, at the labels' size: 10 for the class, else 0.
cv::Mat perfectScores(const cv::Mat& labels);

}  // namespace simulator
}  // namespace semantic_lidar_fusion

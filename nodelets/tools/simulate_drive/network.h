// SPDX-License-Identifier: MIT
/// What a segmentation network would say of a picture, made from the true labels.
#pragma once

#include <cstdint>
#include <opencv2/core.hpp>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {
namespace simulator {

/// CV_32FC(12) scores of `size` cells: displaced and blurred borders, less on what is thin; classes
/// taken for similar ones in patches; thin classes seen fatter than they are, as training with
/// class weights does; and logits that are too sure of themselves.
///
/// Matched to ENet on twelve labelled CamVid photos by test/benchmark/network_errors.py, which
/// measures both on cells of 1/240 of the width (ENet / imitation, ten scans of seed 1):
/// - accuracy 0.82 / 0.84; by cells from a true class edge, below 1, 2, 3, 5, 20 and beyond:
///   0.53 0.72 0.78 0.83 0.88 0.93 / 0.54 0.76 0.85 0.89 0.91 0.94;
/// - predicted borders: 1 cell from true ones in the median both, 2 to 6 at 90 % / 1 to 4;
/// - recall: pole 0.44 / 0.45 (0.31 / 0.25 where a cell wide), sign 0.43 / 0.44, pedestrian 0.62 /
///   0.62, rider 0.71 / 0.57, building 0.78 / 0.79, road 0.97 / 0.96, footpath 0.84 / 0.76,
///   vegetation 0.73 / 0.72, vehicle 0.86 / 0.90; precision of poles 0.31 / 0.28;
/// - best logit 10.0 / 9.2, lead over the second 7.5 / 7.2 (medians);
/// - raw softmax: ECE 0.127 / 0.133, constant temperature of least NLL 2.1 / 2.2.
/// Not matched: fences, of which the photos hold few (0.03 / 0.27), and how errors follow colours.
cv::Mat imitateNetwork(const cv::Mat& labels, const ImageSize& size, std::uint64_t key);
/// Scores of a network that never errs, at the labels' size: 10 for the class, else 0.
cv::Mat perfectScores(const cv::Mat& labels);

}  // namespace simulator
}  // namespace semantic_lidar_fusion

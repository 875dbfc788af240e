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
/// measures both on cells of 1/240 of the width (ENet / imitation, three scans of seed 1):
///   accuracy 0.82 / 0.84; by cells from a true class edge 0.53, 0.72, 0.78, 0.83, 0.88, 0.93 /
///   0.54, 0.76, 0.85, 0.89, 0.91, 0.93 (below 1, 2, 3, 5, 20, beyond); predicted borders within a
///   cell of true ones in the median, 3 to 6 cells at 90 % / 2 to 4; recall of poles 0.44 / 0.55
///   (0.31 / 0.25 where one cell wide), signs 0.43 / 0.55, pedestrians 0.62 / 0.69, riders 0.71 /
///   0.60, building 0.78 / 0.79, road 0.97 / 0.97, footpath 0.84 / 0.80, vegetation 0.73 / 0.73,
///   vehicles 0.86 / 0.86; precision of poles 0.31 / 0.44; logits: best 10.0 / 9.2, lead over the
///   second 7.5 / 7.1; raw softmax: ECE 0.127 / 0.130, constant temperature of least NLL 2.1 / 2.1.
/// Not matched: fences, of which the photos hold few (0.03 / 0.26), and errors that follow the
/// light.
cv::Mat imitateNetwork(const cv::Mat& labels, const ImageSize& size, std::uint64_t key);
/// Scores of a network that never errs, at the labels' size: 10 for the class, else 0.
cv::Mat perfectScores(const cv::Mat& labels);

}  // namespace simulator
}  // namespace semantic_lidar_fusion

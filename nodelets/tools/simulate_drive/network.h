// SPDX-License-Identifier: MIT
/// What a segmentation network would say of a picture, made from the true labels.
#pragma once

#include <cstdint>
#include <opencv2/core.hpp>

#include "tools/simulate_drive/camera.h"

namespace semantic_lidar_fusion {
namespace simulator {

/// Errors depend on these alone.
struct NetworkKeys {
  std::uint64_t drive;  ///< and on what is seen
  std::uint64_t image;
};

/// CV_32FC(12) scores of `size` cells: displaced and blurred borders, less on what is thin; classes
/// taken for similar ones in patches, which fade at their rims; thin classes seen fatter than they
/// are, as training with class weights does; and logits that are too sure of themselves.
///
/// Errors hang on places of things: seen again, from elsewhere or by another camera, a place is
/// taken for the same again. A small part is drawn for each image.
///
/// Matched by test/benchmark/network_errors.py, on cells of 1/240 of the width, truly unlabelled
/// cells left out, to ENet on twelve labelled CamVid photos (ENet / imitation, twelve scans of each
/// of seeds 1 and 2):
/// - error 0.149 / 0.154 0.136; accuracy by cells from a true class edge, below 1, 2, 3, 5, 20 and
///   beyond: 0.60 0.77 0.83 0.87 0.89 0.93 / 0.57 0.81 0.87 0.89 0.90 0.93 (seed 1);
/// - raw softmax: ECE 0.102 / 0.103 0.086, NLL 0.67 / 0.68 0.55; claimed of wrong cells, 25, 50 and
///   75 %: 0.723 0.925 0.993 / 0.741 0.927 0.989 (seed 1);
/// - recall: pole 0.44 / 0.47, sign 0.43 / 0.55, pedestrian 0.62 / 0.53, rider 0.71 / 0.74,
///   building 0.78 / 0.82, road 0.97 / 0.95, footpath 0.84 / 0.80, vegetation 0.73 / 0.75, vehicle
///   0.86 / 0.92 (seed 2); precision of poles 0.34 / 0.31;
/// and in their persistence to ESPNetv2, which looked at the pictures of seed 1: for one place,
/// one, three and five scans later (1.0, 2.9, 4.8 m),
/// - correlation of being wrong 0.70 0.58 0.55 / 0.72 0.68 0.64;
/// - share of places with another label 0.085 0.125 0.142 / 0.124 0.158 0.190.
/// Not matched: fences, of which the photos hold few (0.03 / 0.22); how errors follow colours; the
/// size of wrong patches (half of their area above 41 / 13 cells).
cv::Mat imitateNetwork(const Picture& picture, const ImageSize& size, double radians_per_pixel,
                       const NetworkKeys& keys);
/// Scores of a network that never errs, at the labels' size: 10 for the class, else 0.
cv::Mat perfectScores(const cv::Mat& labels);

}  // namespace simulator
}  // namespace semantic_lidar_fusion

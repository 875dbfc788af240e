// SPDX-License-Identifier: MIT
/// Pictures for people: what was projected where, and how sure the semantics are.
#pragma once

#include <opencv2/core.hpp>
#include <string>

#include "semantic_lidar_fusion/common/label_set.h"
#include "semantic_lidar_fusion/fusion/semantic_projector.h"

namespace semantic_lidar_fusion {

/// Points over the image (BGR): fused ones in their class colour, occluded ones as hollow dark
/// marks, with a legend of the classes present, counts per status and `time_difference_s` (image
/// minus t_ref).
cv::Mat drawProjection(const cv::Mat& image, const CameraFusionReport& report,
                       const SemanticCloud& cloud, const LabelSet& classes,
                       double time_difference_s);

/// Superpixel borders over the image, tinted by 1 - share (blue = sure, red = torn), with a scale
/// bar.
cv::Mat drawUncertainty(const cv::Mat& image, const cv::Mat& superpixel_ids, const cv::Mat& share);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Pictures for people: what was projected where, and how sure the semantics are.
#pragma once

#include <opencv2/core.hpp>
#include <string>

#include "semantic_lidar_fusion/common/label_set.h"
#include "semantic_lidar_fusion/fusion/semantic_projector.h"

namespace semantic_lidar_fusion {

/// Points over the image: fused ones as discs in their class colour, with a shaded rim; occluded
/// ones as hollow black rings with a white halo; those on masked pixels as grey dots. Discs have a
/// radius of some 2 px at 1242x375 and grow with the image, but shrink where points are dense.
/// Where the errors of the view are known, fused points here and there have the ellipse of one
/// standard deviation of their pixel. Beneath the image a legend: the camera's name,
/// `time_difference_s` (image minus t_ref), this camera's points per status, the scan's points per
/// status (of `cloud`) and every class with its colour and its number of points in this camera.
///
/// `image`: CV_8UC1, CV_8UC3 (BGR) or CV_8UC4, as large as the camera's. Gives CV_8UC3; the image
/// stands at the top left, the picture is at least 320 px wide, and its size depends only on the
/// image's size, the camera's name, `classes` and whether errors are known. Throws DataError on an
/// empty image or another type.
cv::Mat drawProjection(const cv::Mat& image, const CameraFusionReport& report,
                       const SemanticCloud& cloud, const LabelSet& classes,
                       double time_difference_s);

/// Superpixel borders over the image, tinted by 1 - share (light yellow = sure, violet = torn; the
/// scale ends at a share of 0.25), with a scale bar beneath. Superpixels whose share is not in (0,
/// 1] keep the image's colours.
///
/// `superpixel_ids` (CV_32SC1) and `share` (CV_32FC1) have one size, not necessarily the image's;
/// either may be empty. `image` and result as above. Throws DataError.
cv::Mat drawUncertainty(const cv::Mat& image, const cv::Mat& superpixel_ids, const cv::Mat& share);

/// `share` (CV_32FC1) as CV_8UC1, 255 = sure, for viewers that do not show floats; 0 where it is
/// not in (0, 1].
cv::Mat drawShare(const cv::Mat& share);

/// The largest class probability of each pixel of `probabilities` (CV_32FC<classes>) as CV_8UC1,
/// 255 = sure; 0 where it is not in (0, 1]. Throws DataError.
cv::Mat drawConfidence(const cv::Mat& probabilities);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// A semantic segmentation network run by OpenCV DNN, described by a model file (YAML):
///   file: network.onnx            # relative to the model file
///   input: {width: 1024, height: 512, channels: rgb|bgr, scale: 0.00392157, mean: [r, g, b],
///           std: [r, g, b]}       # x = (scale * value - mean) / std, channel order as `channels`
///   classes: {road: [0], ...}     # rig class name -> output channels; S(c) = log-sum-exp of them
///   ignore: [19]                  # output channels of no class
/// Every output channel must occur once; a rig class without a channel gets the least score of the
/// cell minus 20 (its probability vanishes).
#pragma once

#include <memory>
#include <opencv2/core.hpp>
#include <string>

#include "semantic_lidar_fusion/common/label_set.h"

namespace semantic_lidar_fusion {

class SegmentationModel {
 public:
  /// Throws ConfigError listing every problem of the file, the network or the class mapping.
  SegmentationModel(const std::string& model_file, const LabelSet& classes);
  ~SegmentationModel();

  /// Unnormalised scores CV_32FC(class count) at the network's output size. `image`: CV_8UC1 or
  /// CV_8UC3 BGR, resized to the input. Not thread-safe. Throws DataError.
  cv::Mat scores(const cv::Mat& image);

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace semantic_lidar_fusion

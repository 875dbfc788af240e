// SPDX-License-Identifier: MIT
/// A semantic segmentation network run by OpenCV DNN, described by a model file (YAML):
///   file: network.onnx            # relative to the model file; the network itself is the user's
///   input:
///     width: 1024                 # what the network takes; images are resized to it
///     height: 512
///     channels: rgb               # or bgr: order of the network's input channels
///     scale: 0.00392157           # x = (scale * value - mean) / std, value 0..255;
///     mean: [0.485, 0.456, 0.406] # mean and std in the order of `channels`
///     std: [0.229, 0.224, 0.225]  # defaults: rgb, scale 1/255, mean 0, std 1
///   classes: {road: [0], ...}     # rig class name -> output channels; S(c) = log-sum-exp of them
///   ignore: [19]                  # output channels of no class; default none
/// Every output channel must occur once; a rig class without a channel gets the least score of the
/// cell's classes minus 20 (its probability vanishes).
///
/// `classes` may also be a list of {classes: {...}, ignore: [...]}, one for each class set that the
/// network serves: the first whose names are all in the rig's class set is used.
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

  /// Unnormalised scores CV_32FC(class count) at the network's output size, not shared with the
  /// model. `image`: CV_8UC1 or CV_8UC3 BGR of any size, resized to the input (by area where it
  /// shrinks both ways, else bilinear; the aspect ratio is not kept). Not thread-safe. Throws
  /// DataError.
  cv::Mat scores(const cv::Mat& image);

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The images of a bag with their semantics.
#pragma once

#include <cstddef>
#include <deque>
#include <memory>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "tools/fuse_bag/drive_reader.h"

namespace semantic_lidar_fusion {

/// An image on its way: asked for, then made in another thread.
struct ImageTask {
  std::size_t camera = 0;
  StampNs stamp = 0;   ///< raw
  ImageSize size;      ///< what camera_info says
  RowBand lidar_rows;  ///< see SegmentedImage
  std::string frame_id;
  sensor_msgs::CompressedImageConstPtr file;
  sensor_msgs::ImageConstPtr pixels, semantics;

  /// What has come of it: the image, or why there is none.
  std::shared_ptr<const SegmentedImage> image;
  std::string failure;
  bool is_made = false;
  bool keeps_pixels = false;  ///< also those that nothing but a comparison of edges needs
};

class ImageSource {
 public:
  /// Keeps the references. `keep_pixels`: images keep what only pictures of them need.
  ImageSource(const Rig& rig, const DriveIndex& index, bool keep_pixels);

  /// Whether an image of a camera can be chosen. Where the bag has no scores of the camera, the
  /// rig's network makes them.
  bool isCandidate(std::size_t camera, StampNs stamp) const;

  /// Finds the messages of an image; `is_new` is false if it was asked for lately. Images of one
  /// camera are asked for in order of time.
  std::shared_ptr<ImageTask> find(std::size_t camera, StampNs stamp, const ImageSize& size,
                                  bool* is_new);

  /// Decodes and segments. The images of one line come in the order in which they were asked for,
  /// those of different lines side by side.
  void make(ImageTask* task);
  std::size_t lineCount() const;
  std::size_t lineOf(std::size_t camera) const;

  const ScanPipeline& pipeline() const { return pipeline_; }

 private:
  bool networkMakesScores(std::size_t camera) const;

  const Rig& rig_;
  const DriveIndex& index_;
  bool keep_pixels_;
  ScanPipeline pipeline_;
  /// By camera: one image may serve two scans.
  std::vector<std::deque<std::shared_ptr<ImageTask>>> recent_;
};

}  // namespace semantic_lidar_fusion

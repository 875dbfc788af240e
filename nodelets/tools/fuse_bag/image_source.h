// SPDX-License-Identifier: MIT
/// The images of a bag with their semantics.
#pragma once

#include <cstddef>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "tools/fuse_bag/drive_index.h"
#include "tools/fuse_bag/drop_log.h"

namespace semantic_lidar_fusion {

class ImageSource {
 public:
  /// Keeps the references. `segmented` is told each image that was segmented, once; `note` what a
  /// user should know of its superpixels, once.
  ImageSource(const Rig& rig, const DriveIndex& index, ScanPipeline* pipeline, DropLog* drops,
              std::function<void(std::size_t camera, const SegmentedImage&)> segmented,
              std::function<void(const std::string&)> note);

  /// The images of a camera that can be chosen: raw stamps by true time. Where the bag has no
  /// scores of the camera, the rig's network makes them.
  std::map<StampNs, StampNs> candidates(std::size_t camera) const;

  /// An image of the bag, segmented; null, counted and told if it is unusable. Images of one camera
  /// are asked for in order of time. `size`: what camera_info says.
  std::shared_ptr<const SegmentedImage> image(std::size_t camera, StampNs stamp,
                                              const ImageSize& size);

 private:
  std::shared_ptr<SegmentedImage> load(std::size_t camera, StampNs stamp) const;

  const Rig& rig_;
  const DriveIndex& index_;
  ScanPipeline& pipeline_;
  DropLog& drops_;
  std::function<void(std::size_t, const SegmentedImage&)> segmented_;
  std::function<void(const std::string&)> note_;
  std::set<std::string> told_notes_;
  /// By camera: one image may serve two scans.
  std::vector<std::deque<std::shared_ptr<const SegmentedImage>>> recent_;
};

}  // namespace semantic_lidar_fusion

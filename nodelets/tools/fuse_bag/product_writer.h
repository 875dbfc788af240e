// SPDX-License-Identifier: MIT
/// What fuse_bag writes: decisions, clouds, and on request what was made of the images.
#pragma once

#include <cstddef>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "tools/common/bag_output.h"
#include "tools/fuse_bag/drive_index.h"

namespace semantic_lidar_fusion {

/// The images that one scan uses, by camera; null where a camera has none.
using ScanImages = std::vector<std::shared_ptr<const SegmentedImage>>;

class ProductWriter {
 public:
  /// Keeps the references.
  ProductWriter(const Rig& rig, const ScanPipeline& pipeline, const DriveIndex& index,
                BagOutput* output)
      : rig_(rig), pipeline_(pipeline), index_(index), output_(*output) {}

  /// `image_stamps`: raw, by camera.
  void writeScan(StampNs scan_ns, const std::vector<std::optional<StampNs>>& image_stamps,
                 const Cloud& compensated, const SemanticCloud& semantic);
  /// Superpixels, share, probabilities and overlay, as far as the image has them.
  void writeImage(std::size_t camera, const SegmentedImage& image);
  /// Where the points went in each camera. `reference_ns`: t_ref.
  void writeOverlays(const FusionResult& result, const ScanImages& images,
                     const std::vector<CameraView>& views, StampNs reference_ns);
  void copyTransforms();

 private:
  std::string topic(std::size_t camera, const std::string& name) const;
  std_msgs::Header header(std::size_t camera, StampNs stamp) const;

  const Rig& rig_;
  const ScanPipeline& pipeline_;
  const DriveIndex& index_;
  BagOutput& output_;
  bool has_written_ = false;
};

}  // namespace semantic_lidar_fusion

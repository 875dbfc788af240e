// SPDX-License-Identifier: MIT
/// What fuse_bag writes: decisions, clouds, and on request what was made of the images.
#pragma once

#include <sensor_msgs/PointCloud2.h>

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "tools/common/bag_output.h"
#include "tools/fuse_bag/image_source.h"

namespace semantic_lidar_fusion {

/// The clouds of one scan as messages.
struct ScanClouds {
  sensor_msgs::PointCloud2Ptr compensated, semantic;
};

class ProductWriter {
 public:
  /// Keeps the references.
  ProductWriter(const Rig& rig, BagOutput* output) : rig_(rig), output_(*output) {}

  /// Throws DataError if a cloud cannot be a message. May run in several threads.
  ScanClouds clouds(const Cloud& compensated, const SemanticCloud& semantic) const;
  /// `image_stamps`: raw, by camera.
  void writeScan(StampNs scan_ns, StampNs reference_ns,
                 const std::vector<std::optional<StampNs>>& image_stamps, const ScanClouds& clouds);
  /// Superpixels, share, probabilities and overlay, as far as the image has them.
  void writeImage(const ImageTask& task, const ScanPipeline& pipeline);
  /// Where the points went in each camera. `images`: by camera, null where there is none;
  /// `reference_ns`: t_ref.
  void writeOverlays(const FusionResult& result,
                     const std::vector<std::shared_ptr<ImageTask>>& images,
                     const std::vector<CameraView>& views, StampNs reference_ns);
  /// Pixels and their covariances, camera by camera. `cloud`: the one that was fused.
  void writePixels(const Cloud& cloud, const FusionResult& result);
  void copyTransforms(const std::vector<rosbag::MessageInstance>& transforms);

 private:
  std::string topic(std::size_t camera, const std::string& name) const;

  const Rig& rig_;
  BagOutput& output_;
  bool has_written_ = false;
};

}  // namespace semantic_lidar_fusion

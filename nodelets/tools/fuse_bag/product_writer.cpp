// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/product_writer.h"

#include <tf2_msgs/TFMessage.h>

#include <algorithm>

#include "edge/conversions.h"
#include "edge/topics.h"
#include "edge/version.h"
#include "semantic_lidar_fusion/fusion/report_pixels.h"
#include "semantic_lidar_fusion/overlay/overlay.h"

namespace semantic_lidar_fusion {

namespace {

std_msgs::Header header(const ImageTask& task) {
  std_msgs::Header header;
  header.stamp = rosTime(task.stamp);
  header.frame_id = task.frame_id;
  return header;
}

}  // namespace

ScanClouds ProductWriter::clouds(const Cloud& compensated, const SemanticCloud& semantic) const {
  return {compensatedCloudMessage(compensated), semanticCloudMessage(semantic, rig_.classes)};
}

void ProductWriter::writeScan(StampNs scan_ns, StampNs reference_ns,
                              const std::vector<std::optional<StampNs>>& image_stamps,
                              const ScanClouds& clouds) {
  if (!has_written_) {
    output_.writeLatched("/class_info", reference_ns, classInfoMessage(rig_.classes));
    output_.writeLatched("/configuration", reference_ns, configurationMessage(rig_));
    has_written_ = true;
  }
  output_.write("/scan_reference", scan_ns, scanReferenceMessage(scan_ns, reference_ns));
  for (std::size_t c = 0; c < image_stamps.size(); ++c) {
    output_.write(topic(c, "selection"), scan_ns,
                  selectionMessage(scan_ns, image_stamps[c], rig_.cameras[c].name));
  }
  output_.write("/points_compensated", reference_ns, *clouds.compensated);
  output_.write("/points_semantic", reference_ns, *clouds.semantic);
}

void ProductWriter::writeImage(const ImageTask& task, const ScanPipeline& pipeline) {
  const SegmentedImage& image = *task.image;
  const auto write = [&](const std::string& name, const cv::Mat& pixels) {
    if (!pixels.empty()) {
      output_.write(topic(task.camera, name), task.stamp, *imageMessage(pixels, header(task)));
    }
  };
  if (image.from_network) write("scores", image.input);
  write("superpixels", image.superpixels.ids);
  write("share", image.share);
  write("probabilities", pipeline.probabilities(image));
  if (!image.share.empty()) {
    write("uncertainty_overlay", drawUncertainty(image.image, image.superpixels.ids, image.share));
  }
}

void ProductWriter::writeOverlays(const FusionResult& result,
                                  const std::vector<std::shared_ptr<ImageTask>>& images,
                                  const std::vector<CameraView>& views, StampNs reference_ns) {
  for (std::size_t c = 0; c < images.size(); ++c) {
    if (!views[c].has_image || images[c]->image->image.empty()) continue;
    const auto report =
        std::find_if(result.cameras.begin(), result.cameras.end(),
                     [&](const CameraFusionReport& r) { return r.name == views[c].name; });
    if (report == result.cameras.end()) continue;
    const cv::Mat drawn = drawProjection(images[c]->image->image, *report, result.cloud,
                                         rig_.classes, toSeconds(views[c].image_ns - reference_ns));
    output_.write(topic(c, "projection_overlay"), images[c]->stamp,
                  *imageMessage(drawn, header(*images[c])));
  }
}

void ProductWriter::writePixels(const Cloud& cloud, const FusionResult& result) {
  for (std::size_t c = 0; c < rig_.cameras.size(); ++c) {
    for (const CameraFusionReport& report : result.cameras) {
      if (report.name != rig_.cameras[c].name) continue;
      output_.write(topic(c, "points_pixel"), cloud.stamp,
                    *pixelCloudMessage(cloud, pixelsOf(report)));
    }
  }
}

void ProductWriter::copyTransforms(const std::vector<rosbag::MessageInstance>& transforms) {
  for (const rosbag::MessageInstance& message : transforms) {
    const auto value = messageOf<tf2_msgs::TFMessage>(message);
    if (!value) continue;
    const StampNs time = stampNs(message.getTime());
    if (bareTopic(message.getTopic()) == bareTopic(rig_.tf_static_topic)) {
      output_.writeLatched("/tf_static", time, *value);
    } else {
      output_.write("/tf", time, *value);
    }
  }
}

std::string ProductWriter::topic(std::size_t camera, const std::string& name) const {
  return "/" + cameraTopic(rig_.cameras[camera], name);
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/product_writer.h"

#include <tf2_msgs/TFMessage.h>

#include <algorithm>

#include "edge/conversions.h"
#include "edge/topics.h"
#include "edge/version.h"
#include "semantic_lidar_fusion/overlay/overlay.h"

namespace semantic_lidar_fusion {

void ProductWriter::writeScan(StampNs scan_ns,
                              const std::vector<std::optional<StampNs>>& image_stamps,
                              const Cloud& compensated, const SemanticCloud& semantic) {
  // Made first: a cloud that cannot be a message leaves nothing of its scan.
  const auto compensated_message = compensatedCloudMessage(compensated);
  const auto semantic_message = semanticCloudMessage(semantic, rig_.classes);
  const StampNs reference_ns = compensated.stamp;
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
  output_.write("/points_compensated", reference_ns, *compensated_message);
  output_.write("/points_semantic", reference_ns, *semantic_message);
}

void ProductWriter::writeImage(std::size_t camera, const SegmentedImage& image) {
  const auto write = [&](const std::string& name, const cv::Mat& pixels) {
    if (!pixels.empty()) {
      output_.write(topic(camera, name), image.stamp,
                    *imageMessage(pixels, header(camera, image.stamp)));
    }
  };
  if (image.from_network) write("scores", image.input);
  write("superpixels", image.superpixels.ids);
  write("share", image.share);
  write("probabilities", pipeline_.probabilities(image));
  if (!image.share.empty()) {
    write("uncertainty_overlay", drawUncertainty(image.image, image.superpixels.ids, image.share));
  }
}

void ProductWriter::writeOverlays(const FusionResult& result, const ScanImages& images,
                                  const std::vector<CameraView>& views, StampNs reference_ns) {
  for (std::size_t c = 0; c < images.size(); ++c) {
    if (!views[c].has_image || images[c]->image.empty()) continue;
    const auto report =
        std::find_if(result.cameras.begin(), result.cameras.end(),
                     [&](const CameraFusionReport& r) { return r.name == views[c].name; });
    if (report == result.cameras.end()) continue;
    const cv::Mat drawn = drawProjection(images[c]->image, *report, result.cloud, rig_.classes,
                                         toSeconds(views[c].image_ns - reference_ns));
    output_.write(topic(c, "projection_overlay"), images[c]->stamp,
                  *imageMessage(drawn, header(c, images[c]->stamp)));
  }
}

void ProductWriter::copyTransforms() {
  for (const rosbag::MessageInstance& message : index_.transforms) {
    const auto transforms = message.instantiate<tf2_msgs::TFMessage>();
    if (!transforms) continue;
    const StampNs time = stampNs(message.getTime());
    if (bareTopic(message.getTopic()) == "tf_static") {
      output_.writeLatched("/tf_static", time, *transforms);
    } else {
      output_.write("/tf", time, *transforms);
    }
  }
}

std::string ProductWriter::topic(std::size_t camera, const std::string& name) const {
  return "/" + cameraTopic(rig_.cameras[camera], name);
}

std_msgs::Header ProductWriter::header(std::size_t camera, StampNs stamp) const {
  std_msgs::Header header;
  header.stamp = rosTime(stamp);
  const auto& infos = index_.cameras[camera].infos;
  if (!infos.empty()) header.frame_id = infos.front().second.frame_id;
  return header;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/image_source.h"

#include <sensor_msgs/CompressedImage.h>
#include <sensor_msgs/Image.h>

#include <utility>

#include "edge/conversions.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

/// Images of one camera that are kept after use.
constexpr std::size_t kRecentImages = 3;

void checkSize(const SegmentedImage& image, const ImageSize& wanted) {
  if (image.image.empty()) return;
  if (image.image.cols != wanted.width || image.image.rows != wanted.height) {
    throw DataError("is " + sizeText({image.image.cols, image.image.rows}) + "; camera_info says " +
                    sizeText(wanted));
  }
}

}  // namespace

ImageSource::ImageSource(const Rig& rig, const DriveIndex& index, ScanPipeline* pipeline,
                         DropLog* drops,
                         std::function<void(std::size_t, const SegmentedImage&)> segmented,
                         std::function<void(const std::string&)> note)
    : rig_(rig),
      index_(index),
      pipeline_(*pipeline),
      drops_(*drops),
      segmented_(std::move(segmented)),
      note_(std::move(note)),
      recent_(rig.cameras.size()) {}

std::map<StampNs, StampNs> ImageSource::candidates(std::size_t camera) const {
  const CameraTrack& track = index_.cameras[camera];
  const CameraConfig& config = rig_.cameras[camera];
  const bool made_on_request = !track.has_semantics && config.input == CameraInput::kScores &&
                               !rig_.segmentation.model.empty();
  std::map<StampNs, StampNs> result;
  for (const MessagesByStamp* messages : {&track.images, &track.semantics}) {
    for (const auto& message : *messages) {
      const StampNs stamp = message.first;
      const ImageParts parts{track.images.count(stamp) > 0, track.semantics.count(stamp) > 0};
      if (!isCandidate(config.input, parts, made_on_request)) continue;
      result[pipeline_.imageTime(camera, stamp)] = stamp;
    }
  }
  return result;
}

std::shared_ptr<const SegmentedImage> ImageSource::image(std::size_t camera, StampNs stamp,
                                                         const ImageSize& size) {
  auto& recent = recent_[camera];
  for (const auto& image : recent) {
    if (image->stamp == stamp) return image;
  }
  try {
    const std::shared_ptr<SegmentedImage> image = load(camera, stamp);
    checkSize(*image, size);
    pipeline_.segment(camera, image.get());
    if (!image->note.empty() && told_notes_.insert(image->note).second) note_(image->note);
    segmented_(camera, *image);
    recent.push_back(image);
    if (recent.size() > kRecentImages) recent.pop_front();
    return image;
  } catch (const DataError& e) {
    drops_.count("camera " + rig_.cameras[camera].name + ": unusable images or scores",
                 "camera " + rig_.cameras[camera].name + ", image " + std::to_string(stamp) +
                     " ns: " + e.what());
    return nullptr;
  }
}

std::shared_ptr<SegmentedImage> ImageSource::load(std::size_t camera, StampNs stamp) const {
  const CameraTrack& track = index_.cameras[camera];
  const CameraConfig& config = rig_.cameras[camera];
  // The pixel views below point into these messages.
  struct Messages {
    sensor_msgs::ImageConstPtr image, semantics;
  };
  auto messages = std::make_shared<Messages>();
  auto result = std::make_shared<SegmentedImage>();
  result->stamp = stamp;
  result->owner = messages;
  const auto image = track.images.find(stamp);
  if (image != track.images.end()) {
    if (config.transport == ImageTransport::kCompressed) {
      const auto compressed = image->second.instantiate<sensor_msgs::CompressedImage>();
      if (!compressed) throw DataError("has another definition of sensor_msgs/CompressedImage");
      result->image = decodedImage(*compressed);
    } else {
      messages->image = image->second.instantiate<sensor_msgs::Image>();
      if (!messages->image) throw DataError("has another definition of sensor_msgs/Image");
      result->image = colorImage(messages->image);
    }
  }
  const auto semantics = track.semantics.find(stamp);
  if (semantics != track.semantics.end()) {
    messages->semantics = semantics->second.instantiate<sensor_msgs::Image>();
    if (!messages->semantics) throw DataError("has another definition of sensor_msgs/Image");
    result->input = pixelView(*messages->semantics);
  }
  return result;
}

}  // namespace semantic_lidar_fusion

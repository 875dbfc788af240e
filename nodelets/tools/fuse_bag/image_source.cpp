// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/image_source.h"

#include <algorithm>
#include <utility>

#include "edge/conversions.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

/// Images of one camera that are kept after use.
constexpr std::size_t kRecentImages = 3;

/// The image with its pixels, from its messages. `owner` keeps what it refers to.
std::shared_ptr<SegmentedImage> decoded(const ImageTask& task) {
  auto result = std::make_shared<SegmentedImage>();
  result->stamp = task.stamp;
  result->lidar_rows = task.lidar_rows;
  if (task.file) result->image = decodedImage(*task.file, task.size);
  if (task.pixels) {
    checkImageSize(imageSize(*task.pixels), task.size);
    result->image = colorImage(task.pixels);
  }
  if (task.semantics) result->input = pixelView(*task.semantics);
  using Messages = std::pair<sensor_msgs::ImageConstPtr, sensor_msgs::ImageConstPtr>;
  result->owner = std::make_shared<const Messages>(task.pixels, task.semantics);
  return result;
}

}  // namespace

ImageSource::ImageSource(const Rig& rig, const DriveIndex& index, bool keep_pixels)
    : rig_(rig),
      index_(index),
      keep_pixels_(keep_pixels),
      pipeline_(rig, {PipelineStep::kNetwork, PipelineStep::kSegment}),
      recent_(rig.cameras.size()) {}

bool ImageSource::networkMakesScores(std::size_t camera) const {
  return !index_.cameras[camera].has_semantics && !rig_.segmentation.model.empty() &&
         rig_.cameras[camera].input == CameraInput::kScores;
}

bool ImageSource::isCandidate(std::size_t camera, StampNs stamp) const {
  const CameraTrack& track = index_.cameras[camera];
  const ImageParts parts{track.images.count(stamp) > 0, track.semantics.count(stamp) > 0};
  return semantic_lidar_fusion::isCandidate(rig_.cameras[camera].input, parts,
                                            networkMakesScores(camera));
}

std::shared_ptr<ImageTask> ImageSource::find(std::size_t camera, StampNs stamp,
                                             const ImageSize& size, bool* is_new) {
  auto& recent = recent_[camera];
  const auto known =
      std::find_if(recent.begin(), recent.end(), [&](const std::shared_ptr<ImageTask>& task) {
        return task->stamp == stamp && task->size == size;
      });
  *is_new = known == recent.end();
  if (!*is_new) return *known;
  auto task = std::make_shared<ImageTask>();
  task->camera = camera;
  task->stamp = stamp;
  task->size = size;
  const CameraTrack& track = index_.cameras[camera];
  if (!track.infos.empty()) task->frame_id = track.infos.front().second.frame_id;
  try {
    const auto image = track.images.find(stamp);
    if (image != track.images.end()) {
      if (rig_.cameras[camera].transport == ImageTransport::kCompressed) {
        task->file = image->second.file();
      } else {
        task->pixels = image->second.pixels();
      }
    }
    const auto semantics = track.semantics.find(stamp);
    if (semantics != track.semantics.end()) task->semantics = semantics->second.pixels();
  } catch (const DataError& e) {
    task->failure = e.what();
  }
  recent.push_back(task);
  if (recent.size() > kRecentImages) recent.pop_front();
  return task;
}

void ImageSource::make(ImageTask* task) {
  if (!task->failure.empty()) return;
  try {
    const std::shared_ptr<SegmentedImage> image = decoded(*task);
    pipeline_.segment(task->camera, image.get());
    if (!keep_pixels_) {
      if (!task->keeps_pixels) image->image.release();
      image->superpixels = SuperpixelMap();
      using Kept = std::pair<sensor_msgs::ImageConstPtr, sensor_msgs::ImageConstPtr>;
      image->owner = std::make_shared<const Kept>(
          task->semantics, task->keeps_pixels ? task->pixels : sensor_msgs::ImageConstPtr());
    }
    task->image = image;
  } catch (const DataError& e) {
    task->failure = e.what();
  }
  task->file.reset();
  task->pixels.reset();
  task->semantics.reset();
}

/// The network serves one image at a time.
std::size_t ImageSource::lineCount() const {
  return rig_.segmentation.model.empty() ? rig_.cameras.size() : 1;
}

std::size_t ImageSource::lineOf(std::size_t camera) const {
  return rig_.segmentation.model.empty() ? camera : 0;
}

}  // namespace semantic_lidar_fusion

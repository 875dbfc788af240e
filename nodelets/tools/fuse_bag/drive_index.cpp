// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/drive_index.h"

#include <nav_msgs/Odometry.h>
#include <sensor_msgs/CameraInfo.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <functional>
#include <iterator>
#include <limits>
#include <tuple>

#include "edge/conversions.h"
#include "edge/topics.h"
#include "semantic_lidar_fusion/common/error.h"
#include "tools/common/progress_bar.h"

namespace semantic_lidar_fusion {
namespace {

using Handler = std::function<void(const rosbag::MessageInstance&)>;

/// The topic as the bag has it; empty (and `problem` filled) if it is absent or of another type.
std::string findTopic(const BagInput& input, const std::string& topic, const std::string& datatype,
                      const std::string& purpose, std::string* problem) {
  const BagInput::Topic* found = input.find(topic);
  if (!found) {
    *problem = purpose + ": no message on " + topic + "; " + input.candidates(datatype);
    return {};
  }
  if (found->datatype != datatype) {
    *problem = purpose + ": " + found->name + " is " + found->datatype + "; " + datatype +
               " is wanted; " + input.candidates(datatype);
    return {};
  }
  return bareTopic(found->name);
}

template <typename Message>
boost::shared_ptr<Message> instantiate(const rosbag::MessageInstance& message) {
  const auto result = message.instantiate<Message>();
  if (!result) throw DataError("has another definition of " + message.getDataType());
  return result;
}

/// Adds a message by its stamp; what cannot be matched is dropped.
void addByStamp(const rosbag::MessageInstance& message, const std::string& what,
                MessagesByStamp* messages, DropLog* drops) {
  const StampNs stamp = stampNs(instantiate<StampedMessage>(message)->header.stamp);
  if (stamp == 0) {
    drops->count(what + ": stamp 0", message.getTopic() + ": message with stamp 0 is dropped");
  } else if (!messages->emplace(stamp, message).second) {
    drops->count(what + ": stamp seen twice", message.getTopic() + ": second message of stamp " +
                                                  std::to_string(stamp) + " ns is dropped");
  }
}

std::string semanticsName(CameraInput input) {
  switch (input) {
    case CameraInput::kLabels:
      return "labels";
    case CameraInput::kProbabilities:
      return "probabilities";
    default:
      return "scores";
  }
}

/// Handlers by topic for everything but static transforms.
class Router {
 public:
  Router(const BagInput& input, const Rig& rig, TfPoseSource* poses, DropLog* drops,
         DriveIndex* index)
      : input_(input), rig_(rig), poses_(poses), drops_(drops), index_(index) {
    addLidar();
    for (std::size_t i = 0; i < rig.cameras.size(); ++i) addCamera(i);
    addPoses();
  }

  const std::map<std::string, std::vector<Handler>>& handlers() const { return handlers_; }

 private:
  void addLidar() {
    const std::string datatype = rig_.lidar.input == LidarInput::kPackets
                                     ? "velodyne_msgs/VelodyneScan"
                                     : "sensor_msgs/PointCloud2";
    std::string problem;
    const std::string topic = findTopic(input_, rig_.lidar.topic, datatype, "lidar", &problem);
    if (topic.empty()) throw Error(input_.path() + ": " + problem);
    handlers_[topic].push_back(
        [this](const rosbag::MessageInstance& m) { index_->scans.push_back(m); });
  }

  void addCamera(std::size_t i) {
    const CameraConfig& camera = rig_.cameras[i];
    CameraTrack* track = &index_->cameras[i];
    const std::string name = "camera " + camera.name;
    std::string problem;

    const std::string image =
        findTopic(input_, imageTopic(camera),
                  camera.transport == ImageTransport::kCompressed ? "sensor_msgs/CompressedImage"
                                                                  : "sensor_msgs/Image",
                  name, &problem);
    track->has_images = !image.empty();
    if (track->has_images) {
      handlers_[image].push_back([=](const rosbag::MessageInstance& m) {
        addByStamp(m, name + " images", &track->images, drops_);
      });
    } else if (camera.input != CameraInput::kProbabilities) {
      const bool raw = camera.transport == ImageTransport::kRaw;
      CameraConfig other = camera;
      other.transport = raw ? ImageTransport::kCompressed : ImageTransport::kRaw;
      if (input_.find(imageTopic(other))) {
        problem += "; there is " + imageTopic(other) +
                   ": is transport: " + (raw ? "compressed" : "raw") + " meant?";
      }
      DropLog::warn(problem);
    }

    const std::string semantics =
        findTopic(input_, inputTopic(camera, camera.scores), "sensor_msgs/Image", name, &problem);
    track->has_semantics = !semantics.empty();
    if (track->has_semantics) {
      handlers_[semantics].push_back([=](const rosbag::MessageInstance& m) {
        addByStamp(m, name + " " + semanticsName(camera.input), &track->semantics, drops_);
      });
    } else if (rig_.segmentation.model.empty() || camera.input != CameraInput::kScores) {
      DropLog::warn(problem);
    }

    const std::string info = findTopic(input_, inputTopic(camera, camera.camera_info),
                                       "sensor_msgs/CameraInfo", name, &problem);
    if (info.empty()) {
      if (!camera.withoutCameraInfo()) DropLog::warn(problem);
      return;
    }
    handlers_[info].push_back([track](const rosbag::MessageInstance& m) {
      CameraInfo value = cameraInfo(*instantiate<sensor_msgs::CameraInfo>(m));
      if (track->infos.empty() || !(track->infos.back().second == value)) {
        track->infos.emplace_back(m.getTime(), std::move(value));
      }
    });
  }

  void addPoses() {
    if (const BagInput::Topic* tf = input_.find("/tf")) {
      handlers_[bareTopic(tf->name)].push_back(
          [this](const rosbag::MessageInstance& m) { addTransforms(m, false); });
    }
    if (rig_.odometry.source != OdometrySource::kTopic) return;
    std::string problem;
    const std::string topic =
        findTopic(input_, rig_.odometry.topic, "nav_msgs/Odometry", "odometry", &problem);
    if (topic.empty()) {
      if (rig_.motion_enabled) DropLog::warn(problem);
      return;
    }
    handlers_[topic].push_back([this](const rosbag::MessageInstance& m) {
      if (!poses_->add(*instantiate<nav_msgs::Odometry>(m))) {
        drops_->add("odometry: unusable", 1);  // its note says why
      }
      poses_->read();
    });
  }

 public:
  void addTransforms(const rosbag::MessageInstance& m, bool is_static) {
    index_->transforms.push_back(m);
    const auto message = instantiate<tf2_msgs::TFMessage>(m);
    for (const auto& transform : message->transforms) {
      const std::uint64_t repeated = poses_->counters().repeated;
      if (!poses_->add(transform, is_static) && poses_->counters().repeated == repeated) {
        drops_->add("tf: unusable transforms", 1);  // its note says why
      }
    }
    poses_->read();  // near the end of tf's buffer: its search is linear
  }

 private:
  const BagInput& input_;
  const Rig& rig_;
  TfPoseSource* poses_;
  DropLog* drops_;
  DriveIndex* index_;
  std::map<std::string, std::vector<Handler>> handlers_;
};

/// Scores and images belong together by their stamps. Says how far apart they are if none do.
void comparePairs(const CameraConfig& camera, const CameraTrack& track, DropLog* drops) {
  if (track.images.empty() || track.semantics.empty()) return;
  std::uint64_t alone = 0;
  StampNs nearest = std::numeric_limits<StampNs>::max();
  for (const auto& semantics : track.semantics) {
    const StampNs stamp = semantics.first;
    const auto after = track.images.lower_bound(stamp);
    if (after != track.images.end() && after->first == stamp) continue;
    ++alone;
    const auto consider = [&](StampNs image) {
      if (std::abs(stamp - image) < std::abs(nearest)) nearest = stamp - image;
    };
    if (after != track.images.end()) consider(after->first);
    if (after != track.images.begin()) consider(std::prev(after)->first);
  }
  const std::string name = semanticsName(camera.input);
  const std::string reason =
      "camera " + camera.name + ": " + name + " without an image of their stamp";
  if (alone < track.semantics.size()) {
    drops->add(reason, alone);
    return;
  }
  char difference[32];
  std::snprintf(difference, sizeof(difference), "%.6f",
                1e-6 * static_cast<double>(std::abs(nearest)));
  drops->count(reason,
               "camera " + camera.name + ": none of the " + std::to_string(alone) + " " + name +
                   " carries the stamp of an image; the nearest is " + difference + " ms " +
                   (nearest > 0 ? "after" : "before") +
                   " one. Copy the header of the image in the node that makes them",
               alone);
}

}  // namespace

DriveIndex indexDrive(const BagInput& input, const Rig& rig, TfPoseSource* poses, DropLog* drops,
                      bool show_progress, void (*checkpoint)()) {
  DriveIndex index;
  index.cameras.resize(rig.cameras.size());
  Router router(input, rig, poses, drops, &index);

  const auto guarded = [&](const rosbag::MessageInstance& message, const Handler& handle) {
    try {
      handle(message);
    } catch (const DataError& e) {
      drops->count(message.getTopic() + ": unusable message", message.getTopic() + ": " + e.what());
    } catch (const ros::serialization::StreamOverrunException&) {
      drops->count(message.getTopic() + ": message shorter than its type",
                   message.getTopic() + ": message shorter than its type is dropped");
    }
  };

  if (const BagInput::Topic* tf_static = input.find("/tf_static")) {
    rosbag::View statics;
    input.addTo({tf_static->name}, &statics);
    for (const rosbag::MessageInstance& message : statics) {
      guarded(message, [&](const rosbag::MessageInstance& m) { router.addTransforms(m, true); });
    }
  }

  std::vector<std::string> topics;
  for (const auto& handler : router.handlers()) topics.push_back(handler.first);
  rosbag::View view;
  input.addTo(topics, &view);
  ProgressBar progress("indexing", view.size(), show_progress);
  std::size_t done = 0;
  for (const rosbag::MessageInstance& message : view) {
    for (const Handler& handle : router.handlers().at(bareTopic(message.getTopic()))) {
      guarded(message, handle);
    }
    progress.update(++done);
    checkpoint();
  }
  for (std::size_t c = 0; c < index.cameras.size(); ++c) {
    comparePairs(rig.cameras[c], index.cameras[c], drops);
  }
  poses->odometry();
  for (const std::string& note : poses->takeNotes()) DropLog::warn("tf: " + note);
  return index;
}

const CameraInfo* cameraInfoAt(const CameraTrack& camera, const ros::Time& time) {
  if (camera.infos.empty()) return nullptr;
  const auto after =
      std::upper_bound(camera.infos.begin(), camera.infos.end(), time,
                       [](const ros::Time& t, const auto& info) { return t < info.first; });
  return after == camera.infos.begin() ? &after->second : &std::prev(after)->second;
}

}  // namespace semantic_lidar_fusion

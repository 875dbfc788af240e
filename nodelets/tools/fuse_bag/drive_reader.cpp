// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/drive_reader.h"

#include <nav_msgs/Odometry.h>
#include <sensor_msgs/CameraInfo.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <functional>
#include <iterator>
#include <limits>
#include <new>

#include "edge/conversions.h"
#include "edge/topics.h"
#include "semantic_lidar_fusion/common/error.h"

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
  boost::shared_ptr<Message> result;
  try {
    result = messageOf<Message>(message);
  } catch (const ros::serialization::StreamOverrunException&) {
    throw DataError("is shorter than a " + message.getDataType());
  } catch (const std::bad_alloc&) {
    throw DataError("says that it is larger than memory");
  }
  if (!result) throw DataError("has another definition of " + message.getDataType());
  return result;
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

sensor_msgs::ImageConstPtr StoredImage::pixels() const {
  return kept_pixels ? kept_pixels : instantiate<sensor_msgs::Image>(place);
}

sensor_msgs::CompressedImageConstPtr StoredImage::file() const {
  return kept_file ? kept_file : instantiate<sensor_msgs::CompressedImage>(place);
}

/// Handlers by topic for everything but static transforms.
class DriveReader::Router {
 public:
  explicit Router(DriveReader* reader)
      : reader_(*reader),
        input_(reader->input_),
        rig_(reader->rig_),
        poses_(&reader->poses_),
        drops_(&reader->drops_),
        index_(&reader->index_) {
    addLidar();
    for (std::size_t i = 0; i < rig_.cameras.size(); ++i) addCamera(i);
    addPoses();
  }

  const std::map<std::string, std::vector<Handler>>& handlers() const { return handlers_; }
  /// The lidar's topic, and those of camera_infos.
  const std::string& lidarTopic() const { return lidar_topic_; }
  const std::vector<std::string>& infoTopics() const { return info_topics_; }

 private:
  void addLidar() {
    const std::string datatype = rig_.lidar.input == LidarInput::kPackets
                                     ? "velodyne_msgs/VelodyneScan"
                                     : "sensor_msgs/PointCloud2";
    std::string problem;
    const std::string topic = findTopic(input_, rig_.lidar.topic, datatype, "lidar", &problem);
    if (topic.empty()) throw Error(input_.path() + ": " + problem);
    lidar_topic_ = topic;
    handlers_[topic].push_back([this](const rosbag::MessageInstance& m) {
      if (reader_.counts(m)) reader_.take_scan_(m);
    });
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
      const std::string what = name + " images";
      handlers_[image].push_back([=](const rosbag::MessageInstance& m) {
        if (camera.transport == ImageTransport::kCompressed) {
          reader_.addImage(m, what, &track->images, &StoredImage::kept_file);
        } else {
          reader_.addImage(m, what, &track->images, &StoredImage::kept_pixels);
        }
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
        reader_.addImage(m, name + " " + semanticsName(camera.input), &track->semantics,
                         &StoredImage::kept_pixels);
      });
      if (!rig_.segmentation.model.empty() && camera.input == CameraInput::kScores) {
        DropLog::warn(name + ": its scores come from the bag (" + semantics +
                      "); segmentation.model is not used for it. To use it, name another topic in "
                      "cameras." +
                      camera.name + ".scores");
      }
    } else if (rig_.segmentation.model.empty() || camera.input != CameraInput::kScores) {
      DropLog::warn(problem);
    }

    const std::string info = findTopic(input_, inputTopic(camera, camera.camera_info),
                                       "sensor_msgs/CameraInfo", name, &problem);
    if (info.empty()) {
      if (!camera.withoutCameraInfo()) DropLog::warn(problem);
      return;
    }
    info_topics_.push_back(info);
    handlers_[info].push_back([track](const rosbag::MessageInstance& m) {
      CameraInfo value = cameraInfo(*instantiate<sensor_msgs::CameraInfo>(m));
      if (track->infos.empty() || !(track->infos.back().second == value)) {
        track->infos.emplace_back(m.getTime(), std::move(value));
      }
    });
  }

  void addPoses() {
    if (const BagInput::Topic* tf = input_.find(rig_.tf_topic)) {
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
      const auto odometry = instantiate<nav_msgs::Odometry>(m);
      reader_.watch_.lookAtArrival(m.getTopic(), stampNs(odometry->header.stamp),
                                   stampNs(m.getTime()));
      if (!poses_->add(*odometry)) {
        drops_->add("odometry: unusable", 1);  // its note says why
      }
      poses_->read();
    });
  }

 public:
  void addTransforms(const rosbag::MessageInstance& m, bool is_static) {
    const auto message = instantiate<tf2_msgs::TFMessage>(m);
    index_->transforms.push_back(m);  // those that can be copied
    for (const auto& transform : message->transforms) {
      const std::uint64_t repeated = poses_->counters().repeated;
      if (!poses_->add(transform, is_static) && poses_->counters().repeated == repeated) {
        drops_->add("tf: unusable transforms", 1);  // its note says why
      }
    }
    poses_->read();  // near the end of tf's buffer: its search is linear
  }

 private:
  DriveReader& reader_;
  const BagInput& input_;
  const Rig& rig_;
  TfPoseSource* poses_;
  DropLog* drops_;
  DriveIndex* index_;
  std::map<std::string, std::vector<Handler>> handlers_;
  std::string lidar_topic_;
  std::vector<std::string> info_topics_;
};

namespace {

/// `time` moved by `seconds`, within the range of ros::Time.
ros::Time moved(const ros::Time& time, double seconds) {
  const double moved_s = time.toSec() + seconds;
  if (moved_s <= ros::TIME_MIN.toSec()) return ros::TIME_MIN;
  if (moved_s >= ros::TIME_MAX.toSec()) return ros::TIME_MAX;
  return time + ros::Duration(seconds);
}

}  // namespace

DriveReader::DriveReader(const BagInput& input, const Rig& rig, const ReadingWindow& window,
                         TfPoseSource* poses, DropLog* drops, RigWatch* watch, TakeScan take_scan)
    : input_(input),
      rig_(rig),
      most_kept_bytes_(window.kept_bytes),
      start_(moved(input.beginTime(), window.start_s)),
      end_(window.end_s ? moved(input.beginTime(), *window.end_s) : ros::TIME_MAX),
      poses_(*poses),
      drops_(*drops),
      watch_(*watch),
      take_scan_(std::move(take_scan)) {
  if (window.start_s > 0.0) begin_ = moved(start_, -window.before_s);
  index_.cameras.resize(rig.cameras.size());
  router_ = std::make_unique<Router>(this);
  rosbag::View scans;
  input.addTo({router_->lidarTopic()}, &scans, start_, end_);
  for (const rosbag::MessageInstance& scan : scans) scan_count_ += counts(scan) ? 1 : 0;
  readStatics();
  readEarlierInfos(router_->infoTopics());
  std::vector<std::string> topics;
  for (const auto& handler : router_->handlers()) topics.push_back(handler.first);
  input.addTo(topics, &view_, begin_, moved(end_, window.after_s));
}

DriveReader::~DriveReader() = default;

void DriveReader::readStatics() {
  const BagInput::Topic* tf_static = input_.find(rig_.tf_static_topic);
  if (tf_static == nullptr) return;
  rosbag::View statics;
  input_.addTo({tf_static->name}, &statics);
  for (const rosbag::MessageInstance& message : statics) {
    guarded(message, [&](const rosbag::MessageInstance& m) { router_->addTransforms(m, true); });
  }
}

/// The last camera_info of each camera before what is read.
void DriveReader::readEarlierInfos(const std::vector<std::string>& topics) {
  for (const std::string& topic : topics) {
    rosbag::View view;
    input_.addTo({topic}, &view, ros::TIME_MIN, begin_);
    std::optional<rosbag::View::iterator> last;
    for (auto i = view.begin(); i != view.end(); ++i) {
      if (i->getTime() < begin_) last = i;
    }
    if (!last) continue;
    for (const Handler& handle : router_->handlers().at(topic)) guarded(**last, handle);
  }
}

void DriveReader::guarded(const rosbag::MessageInstance& message,
                          const std::function<void(const rosbag::MessageInstance&)>& handle) {
  try {
    handle(message);
  } catch (const DataError& e) {
    drops_.count(message.getTopic() + ": unusable message", message.getTopic() + ": " + e.what());
  } catch (const ros::serialization::StreamOverrunException&) {
    drops_.count(message.getTopic() + ": message shorter than its type",
                 message.getTopic() + ": message shorter than its type is dropped");
  }
}

/// Finds the messages of a short time. They are read in their order in the file, so that each chunk
/// is decompressed once also where record times of a chunk reach into the next one: unless that is
/// not the order of time within a topic.
void DriveReader::findTogether() {
  constexpr double kTogetherS = 0.1;
  if (!next_) next_ = view_.begin();
  if (*next_ == view_.end()) return;
  time_ = together_until_ = (*next_)->getTime();
  std::vector<const rosbag::Bag*> bags;  // in the order of the view, which depends on no address
  std::map<std::string, PlaceInBags> last;
  std::vector<rosbag::MessageInstance> messages;
  bool is_orderly = true;
  for (; *next_ != view_.end(); ++*next_) {
    const rosbag::MessageInstance& message = **next_;
    if (message.getTime().toSec() > time_.toSec() + kTogetherS) break;
    together_until_ = message.getTime();
    const auto [bag, chunk, offset] = placeOf(message);
    const auto known = std::find(bags.begin(), bags.end(), bag);
    const auto number = static_cast<std::size_t>(known - bags.begin());
    if (known == bags.end()) bags.push_back(bag);
    const PlaceInBags place(number, chunk, offset);
    const auto [topic, is_first] = last.emplace(message.getTopic(), place);
    is_orderly = is_orderly && (is_first || topic->second < place);
    topic->second = place;
    together_.emplace(place, message);
    messages.push_back(message);
  }
  if (is_orderly) return;
  together_.clear();
  for (std::size_t i = 0; i < messages.size(); ++i) {
    together_.emplace(PlaceInBags(i, 0, 0), messages[i]);
  }
}

bool DriveReader::readOne() {
  if (together_.empty()) findTogether();
  if (together_.empty()) return false;
  const auto next = together_.extract(together_.begin());
  const rosbag::MessageInstance& message = next.mapped();
  for (const Handler& handle : router_->handlers().at(bareTopic(message.getTopic()))) {
    guarded(message, handle);
  }
  if (together_.empty()) time_ = together_until_;
  return true;
}

/// Adds a message by its stamp; what cannot be matched is dropped.
template <typename Message>
void DriveReader::addImage(const rosbag::MessageInstance& message, const std::string& what,
                           ImagesByStamp* images,
                           boost::shared_ptr<const Message> StoredImage::*kept) {
  boost::shared_ptr<const Message> whole;
  if (most_kept_bytes_ > 0) {
    try {
      whole = instantiate<Message>(message);
    } catch (const DataError&) {  // is told where it is chosen
    }
  }
  const ros::Time time =
      whole ? whole->header.stamp : instantiate<StampedMessage>(message)->header.stamp;
  const StampNs stamp = stampNs(time);
  watch_.lookAtArrival(message.getTopic(), stamp, stampNs(message.getTime()));
  if (stamp == 0) {
    drops_.count(what + ": stamp 0", message.getTopic() + ": message with stamp 0 is dropped");
    return;
  }
  const auto added = images->emplace(stamp, StoredImage(message));
  if (!added.second) {
    drops_.count(what + ": stamp seen twice", message.getTopic() + ": second message of stamp " +
                                                  std::to_string(stamp) + " ns is dropped");
    return;
  }
  if (!whole) return;
  StoredImage* image = &added.first->second;
  image->*kept = whole;
  keep(image, whole->data.size());
}

void DriveReader::keep(StoredImage* image, std::size_t bytes) {
  kept_.push_back({image, bytes});
  kept_bytes_ += bytes;
  while (kept_bytes_ > most_kept_bytes_) dropOldest();
}

void DriveReader::dropOldest() {
  kept_.front().image->kept_pixels.reset();
  kept_.front().image->kept_file.reset();
  kept_bytes_ -= kept_.front().bytes;
  kept_.pop_front();
}

void DriveReader::release(const ros::Time& time, double seconds) {
  const ros::Time limit = moved(time, -seconds);
  while (!kept_.empty() && kept_.front().image->place.getTime() < limit) dropOldest();
}

void DriveReader::finish() {
  for (std::size_t c = 0; c < index_.cameras.size(); ++c) {
    comparePairs(rig_.cameras[c], index_.cameras[c], &drops_);
  }
  const std::vector<std::string> topics = input_.namesOf("nav_msgs/Odometry");
  if (poses_.odometry().empty() && rig_.motion_enabled && !topics.empty() &&
      rig_.odometry.source == OdometrySource::kTf) {
    DropLog::warn(topics.front() +
                  " exists: set odometry.source: topic and odometry.topic: " + topics.front());
  }
  for (const std::string& note : poses_.takeNotes()) DropLog::warn("tf: " + note);
}

const CameraInfo* cameraInfoAt(const CameraTrack& camera, const ros::Time& time) {
  if (camera.infos.empty()) return nullptr;
  const auto after =
      std::upper_bound(camera.infos.begin(), camera.infos.end(), time,
                       [](const ros::Time& t, const auto& info) { return t < info.first; });
  return after == camera.infos.begin() ? &after->second : &std::prev(after)->second;
}

}  // namespace semantic_lidar_fusion

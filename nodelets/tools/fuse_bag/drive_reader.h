// SPDX-License-Identifier: MIT
/// What a rig needs of the bags, read message by message in the order of their recording: scans,
/// images and scores by their stamps, camera_infos, and poses.
#pragma once

#include <rosbag/message_instance.h>
#include <sensor_msgs/CompressedImage.h>
#include <sensor_msgs/Image.h>

#include <cstddef>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "edge/tf_pose_source.h"
#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/check/rig_watch.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "tools/common/bag_input.h"
#include "tools/fuse_bag/drop_log.h"

namespace semantic_lidar_fusion {

/// A message where it stands in the bag and, while it is kept, itself: one of the two is set.
struct StoredImage {
  explicit StoredImage(rosbag::MessageInstance message) : place(std::move(message)) {}

  /// Throw DataError where the bag holds another definition of the type, or less than it.
  sensor_msgs::ImageConstPtr pixels() const;
  sensor_msgs::CompressedImageConstPtr file() const;

  rosbag::MessageInstance place;
  sensor_msgs::ImageConstPtr kept_pixels;
  sensor_msgs::CompressedImageConstPtr kept_file;
};
using ImagesByStamp = std::map<StampNs, StoredImage>;  ///< by raw stamp

/// One camera's messages.
struct CameraTrack {
  ImagesByStamp images;     ///< Image or CompressedImage
  ImagesByStamp semantics;  ///< scores, labels or probabilities, after the camera's `input`
  /// By record time, changes only.
  std::vector<std::pair<ros::Time, CameraInfo>> infos;
  bool has_images = false;     ///< the topic is in the bag
  bool has_semantics = false;  ///< the topic is in the bag
};

struct DriveIndex {
  std::vector<CameraTrack> cameras;                 ///< in the rig file's order
  std::vector<rosbag::MessageInstance> transforms;  ///< tf and tf_static, in the order of the bag
};

/// What of the bags is read; times in s.
struct ReadingWindow {
  /// Scans recorded within [start, end) count, both since the first message of the bags; no `end`:
  /// to the last one.
  double start_s = 0.0;
  std::optional<double> end_s;
  /// The rest is read from so long before the start to so long after the end; the last camera_infos
  /// before that, and static transforms, always are.
  double before_s = 0.0, after_s = 0.0;
  /// Images are kept in memory as they are read, up to this size; the oldest go first. What is not
  /// kept is read again where it is needed. 0 keeps none.
  std::size_t kept_bytes = 0;
};

class DriveReader {
 public:
  using TakeScan = std::function<void(const rosbag::MessageInstance&)>;

  /// Topics of the rig that the bag lacks, or has with another type, are named with what is there:
  /// for the lidar in an Error, else as a warning. `poses` receives static transforms first;
  /// `watch` is shown when images and odometry were recorded. Keeps the references.
  DriveReader(const BagInput& input, const Rig& rig, const ReadingWindow& window,
              TfPoseSource* poses, DropLog* drops, RigWatch* watch, TakeScan take_scan);
  ~DriveReader();

  /// Reads one message; false if there is no other.
  bool readOne();
  /// All that was recorded before is read.
  ros::Time time() const { return time_; }
  /// Keeps no image any more that was recorded more than `seconds` before `time`.
  void release(const ros::Time& time, double seconds);
  /// Tells what only the whole bag tells.
  void finish();

  std::uint64_t scanCount() const { return scan_count_; }
  const DriveIndex& index() const { return index_; }

 private:
  class Router;
  struct Kept {
    StoredImage* image;
    std::size_t bytes;
  };

  void readStatics();
  void readEarlierInfos(const std::vector<std::string>& topics);
  bool counts(const rosbag::MessageInstance& scan) const {
    return scan.getTime() >= start_ && scan.getTime() < end_;
  }
  void guarded(const rosbag::MessageInstance& message,
               const std::function<void(const rosbag::MessageInstance&)>& handle);
  template <typename Message>
  void addImage(const rosbag::MessageInstance& message, const std::string& what,
                ImagesByStamp* images, boost::shared_ptr<const Message> StoredImage::*kept);
  void findTogether();
  void keep(StoredImage* image, std::size_t bytes);
  void dropOldest();

  const BagInput& input_;
  const Rig& rig_;
  std::size_t most_kept_bytes_;
  ros::Time begin_ = ros::TIME_MIN;  ///< of what is read
  ros::Time start_, end_;            ///< of the scans that count
  TfPoseSource& poses_;
  DropLog& drops_;
  RigWatch& watch_;
  TakeScan take_scan_;
  DriveIndex index_;
  std::unique_ptr<Router> router_;
  rosbag::View view_;
  std::optional<rosbag::View::iterator> next_;
  /// Messages that are read together, by bag and place in it.
  using PlaceInBags = std::tuple<std::size_t, std::uint64_t, std::uint32_t>;
  std::map<PlaceInBags, rosbag::MessageInstance> together_;
  ros::Time together_until_;  ///< record time of the last of them
  ros::Time time_;
  std::uint64_t scan_count_ = 0;
  std::deque<Kept> kept_;  ///< in the order in which they were read
  std::size_t kept_bytes_ = 0;
};

/// The camera_info that holds at record time `time`: the last one at or before it, else the first
/// one after it; null if there is none.
const CameraInfo* cameraInfoAt(const CameraTrack& camera, const ros::Time& time);

}  // namespace semantic_lidar_fusion

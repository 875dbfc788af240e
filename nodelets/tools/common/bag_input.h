// SPDX-License-Identifier: MIT
/// The bags of one drive that are read: opening them with errors a user understands, and finding
/// topics in them.
#pragma once

#include <rosbag/bag.h>
#include <rosbag/view.h>
#include <std_msgs/Header.h>

#include <cstdint>
#include <deque>
#include <map>
#include <string>
#include <tuple>
#include <vector>

#include "edge/declared_lengths.h"

namespace semantic_lidar_fusion {

/// The header of any message that starts with one; the rest is not read.
struct StampedMessage {
  std_msgs::Header header;
};

/// Where a message stands: its bag, the position of its chunk in the file, and that within the
/// chunk.
std::tuple<const rosbag::Bag*, std::uint64_t, std::uint32_t> placeOf(
    const rosbag::MessageInstance& message);

/// Throws DataError where a damaged index or record leads beyond the message's chunk: rosbag reads
/// there whatever memory follows.
void checkRecord(const rosbag::MessageInstance& message);

/// A message of a bag. Null where the bag has another definition of the type. Throws DataError
/// where its record is damaged, and where the message declares more than it holds, before that is
/// allocated.
template <class M>
boost::shared_ptr<M> messageOf(const rosbag::MessageInstance& message) {
  checkRecord(message);
  if (!message.instantiate<DeclaredLengths<M>>()) return nullptr;
  return message.instantiate<M>();
}

class BagInput {
 public:
  /// Throws Error, one line with path and reason: absent, not a bag, truncated, not indexed.
  explicit BagInput(const std::vector<std::string>& paths);

  /// The paths, for messages.
  const std::string& path() const { return path_; }
  /// Adds the messages of these topics of all bags, recorded within [begin, end], to a view, which
  /// merges them by record time.
  void addTo(const std::vector<std::string>& topics, rosbag::View* view,
             const ros::Time& begin = ros::TIME_MIN, const ros::Time& end = ros::TIME_MAX) const;
  /// When the first message was recorded.
  const ros::Time& beginTime() const { return begin_time_; }

  /// Type and number of messages of a topic; a leading slash does not matter.
  struct Topic {
    std::string name;  ///< as in the first bag that has it
    std::string datatype;
    std::uint64_t messages = 0;
  };
  /// Null if no bag has such a topic.
  const Topic* find(const std::string& topic) const;
  /// The topics of one type.
  std::vector<std::string> namesOf(const std::string& datatype) const;
  /// "/a, /b (2 more)": the topics of one type; all topics if there is none of it.
  std::string candidates(const std::string& datatype) const;

 private:
  void open(const std::string& path);

  std::string path_;
  ros::Time begin_time_ = ros::TIME_MAX;
  std::deque<rosbag::Bag> bags_;         ///< in the order of the command line; a bag cannot move
  std::map<std::string, Topic> topics_;  ///< by name without leading slash
};

/// Topic names compare without their leading slashes.
std::string bareTopic(const std::string& topic);

/// One line for a user from what rosbag throws.
std::string bagErrorText(const std::string& path, const std::exception& error);

}  // namespace semantic_lidar_fusion

namespace ros {
namespace message_traits {
template <>
struct IsMessage<semantic_lidar_fusion::StampedMessage> : TrueType {};
template <>
struct MD5Sum<semantic_lidar_fusion::StampedMessage> {
  static const char* value() { return "*"; }
  static const char* value(const semantic_lidar_fusion::StampedMessage&) { return value(); }
};
template <>
struct DataType<semantic_lidar_fusion::StampedMessage> {
  static const char* value() { return "*"; }
  static const char* value(const semantic_lidar_fusion::StampedMessage&) { return value(); }
};
}  // namespace message_traits
namespace serialization {
template <>
struct Serializer<semantic_lidar_fusion::StampedMessage> {
  template <typename Stream>
  inline static void read(Stream& stream, semantic_lidar_fusion::StampedMessage& message) {
    stream.next(message.header);
  }
};
}  // namespace serialization
}  // namespace ros

// SPDX-License-Identifier: MIT
#include "tools/common/bag_input.h"

#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <exception>
#include <fstream>

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

// Where a message stands, and the chunk around it, are known to rosbag alone; an explicit
// instantiation may name what is private.
template <typename Tag, typename Tag::Member kMember>
struct Named {
  friend typename Tag::Member member(Tag) { return kMember; }
};
struct PlaceOfMessage {
  using Member = const rosbag::IndexEntry rosbag::MessageInstance::*;
  friend Member member(PlaceOfMessage);
};
struct BagOfMessage {
  using Member = const rosbag::Bag* rosbag::MessageInstance::*;
  friend Member member(BagOfMessage);
};
struct ReadChunk {
  using Member = void (rosbag::Bag::*)(std::uint64_t) const;
  friend Member member(ReadChunk);
};
struct ChunkThatIsRead {
  using Member = rosbag::Buffer* rosbag::Bag::*;
  friend Member member(ChunkThatIsRead);
};
template struct Named<PlaceOfMessage, &rosbag::MessageInstance::index_entry_>;
template struct Named<BagOfMessage, &rosbag::MessageInstance::bag_>;
template struct Named<ReadChunk, &rosbag::Bag::decompressChunk>;
template struct Named<ChunkThatIsRead, &rosbag::Bag::current_buffer_>;

/// A range of bytes that is read from its front; each part is a length and as many bytes.
struct Bytes {
  const std::uint8_t* data;
  std::size_t size;

  /// Takes the part at the front; false where not all of it is there.
  bool take(Bytes* part) {
    std::uint32_t length = 0;
    if (size < sizeof(length)) return false;
    std::memcpy(&length, data, sizeof(length));
    if (size - sizeof(length) < length) return false;
    *part = {data + sizeof(length), length};
    data += sizeof(length) + length;
    size -= sizeof(length) + length;
    return true;
  }
};

/// Whether the header of a record is that of a message: fields "name=value", one of them op=2.
bool isHeaderOfMessage(Bytes header) {
  static const std::string kOperation = "op=\x02";
  bool is_message = false;
  for (Bytes field{}; header.size > 0;) {
    if (!header.take(&field)) return false;
    is_message = is_message || std::string(field.data, field.data + field.size) == kOperation;
  }
  return is_message;
}

/// What rosbag says badly or not at all.
void checkFile(const std::string& path) {
  struct stat status {};
  if (::stat(path.c_str(), &status) != 0) throw Error(path + ": " + std::strerror(errno));
  static const std::string kRos2 =
      ": is a bag of ROS 2; import_dataset.py ros2 makes one of ROS 1 of it";
  if (S_ISDIR(status.st_mode)) {
    if (::access((path + "/metadata.yaml").c_str(), F_OK) == 0) throw Error(path + kRos2);
    throw Error(path + ": is a directory, not a bag");
  }
  if (!S_ISREG(status.st_mode)) throw Error(path + ": is a pipe or a device, not a bag");
  if (status.st_size == 0) throw Error(path + ": is an empty file, not a bag");
  std::string start(8, '\0');
  std::ifstream(path, std::ios::binary).read(&start[0], static_cast<std::streamsize>(start.size()));
  if (start == "SQLite f" || start.compare(0, 5, "\x89MCAP") == 0) throw Error(path + kRos2);
}

}  // namespace

std::tuple<const rosbag::Bag*, std::uint64_t, std::uint32_t> placeOf(
    const rosbag::MessageInstance& message) {
  const rosbag::IndexEntry& entry = message.*member(PlaceOfMessage());
  return {message.*member(BagOfMessage()), entry.chunk_pos, entry.offset};
}

void checkRecord(const rosbag::MessageInstance& message) {
  const auto [bag, chunk, offset] = placeOf(message);
  if (bag->getMajorVersion() < 2) return;  // those bags have no chunks
  (bag->*member(ReadChunk()))(chunk);
  rosbag::Buffer* buffer = bag->*member(ChunkThatIsRead());
  const std::size_t begin = std::min(offset, buffer->getSize());
  Bytes rest{buffer->getData() + begin, buffer->getSize() - begin};
  Bytes header{}, data{};
  if (!rest.take(&header) || !isHeaderOfMessage(header) || !rest.take(&data)) {
    throw DataError("is damaged: the bag's index leads to no whole message");
  }
}

std::string bareTopic(const std::string& topic) {
  const std::size_t begin = topic.find_first_not_of('/');
  return begin == std::string::npos ? std::string() : topic.substr(begin);
}

std::string bagErrorText(const std::string& path, const std::exception& error) {
  if (dynamic_cast<const rosbag::BagUnindexedException*>(&error)) {
    return path + ": the bag has no index (was its recording cut short?); run: rosbag reindex " +
           path;
  }
  return path + ": " + error.what();
}

BagInput::BagInput(const std::vector<std::string>& paths) {
  for (const std::string& path : paths) {
    path_ += (path_.empty() ? "" : ", ") + path;
    open(path);
  }
  if (topics_.empty()) {
    throw Error(path_ + ": the bag" + (paths.size() == 1 ? " holds" : "s hold") + " no messages");
  }
}

void BagInput::open(const std::string& path) {
  checkFile(path);
  try {
    bags_.emplace_back();
    bags_.back().open(path, rosbag::bagmode::Read);
    rosbag::View view(bags_.back());
    for (const rosbag::ConnectionInfo* connection : view.getConnections()) {
      Topic& topic = topics_[bareTopic(connection->topic)];
      if (!topic.name.empty()) continue;
      topic.name = connection->topic;
      topic.datatype = connection->datatype;
    }
    // One pass over the index; messages are not read.
    if (view.size() > 0) begin_time_ = std::min(begin_time_, view.getBeginTime());
    for (const rosbag::MessageInstance& message : view) {
      ++topics_.at(bareTopic(message.getTopic())).messages;
    }
  } catch (const std::exception& e) {
    throw Error(bagErrorText(path, e));
  }
}

void BagInput::addTo(const std::vector<std::string>& topics, rosbag::View* view,
                     const ros::Time& begin, const ros::Time& end) const {
  std::vector<std::string> names;  // recorders differ in the leading slash
  for (const std::string& topic : topics) {
    names.push_back(bareTopic(topic));
    names.push_back("/" + bareTopic(topic));
  }
  for (const rosbag::Bag& bag : bags_) view->addQuery(bag, rosbag::TopicQuery(names), begin, end);
}

const BagInput::Topic* BagInput::find(const std::string& topic) const {
  const auto found = topics_.find(bareTopic(topic));
  return found == topics_.end() || found->second.messages == 0 ? nullptr : &found->second;
}

std::vector<std::string> BagInput::namesOf(const std::string& datatype) const {
  std::vector<std::string> names;
  for (const auto& topic : topics_) {
    if (topic.second.datatype == datatype) names.push_back(topic.second.name);
  }
  return names;
}

std::string BagInput::candidates(const std::string& datatype) const {
  constexpr std::size_t kShown = 8;
  std::vector<std::string> names = namesOf(datatype);
  std::string text = "topics of type " + datatype + ": ";
  if (names.empty()) {
    text = "no topic of type " + datatype + "; all topics: ";
    for (const auto& topic : topics_) names.push_back(topic.second.name);
  }
  for (std::size_t i = 0; i < names.size() && i < kShown; ++i) text += (i ? ", " : "") + names[i];
  if (names.size() > kShown) text += " (" + std::to_string(names.size() - kShown) + " more)";
  return text;
}

}  // namespace semantic_lidar_fusion

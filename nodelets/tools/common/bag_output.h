// SPDX-License-Identifier: MIT
/// A bag that is written aside and takes its name only when it is whole.
#pragma once

#include <rosbag/bag.h>
#include <rosbag/exceptions.h>

#include <cstdint>
#include <memory>
#include <string>

#include "edge/conversions.h"
#include "semantic_lidar_fusion/common/error.h"
#include "tools/common/unfinished_file.h"

namespace semantic_lidar_fusion {

/// What becomes of a file that has the name of an output.
enum class Existing : std::uint8_t {
  kRefuse,
  kReplaceOwn,  ///< replaced if it is empty or the same program's output
  kReplace,
};

class BagOutput {
 public:
  /// Writes to an UnfinishedFile until commit. `program` signs all messages (`callerid`). Throws
  /// Error if the file cannot be made, or if `path` exists and must not be replaced.
  BagOutput(const std::string& path, const std::string& program, Existing existing);
  /// Removes what was written unless committed.
  ~BagOutput();
  BagOutput(const BagOutput&) = delete;
  BagOutput& operator=(const BagOutput&) = delete;

  /// Throws Error naming the file (a full disk, for one).
  template <typename Message>
  void write(const std::string& topic, StampNs stamp, const Message& message) {
    const ros::Time time = rosTime(stamp);
    guarded([&] { bag_->write(topic, time, message, connectionHeader(topic, message, false)); });
  }
  /// The same for a message that late subscribers get too.
  template <typename Message>
  void writeLatched(const std::string& topic, StampNs stamp, const Message& message) {
    const ros::Time time = rosTime(stamp);
    guarded([&] { bag_->write(topic, time, message, connectionHeader(topic, message, true)); });
  }

  /// Compresses what is written from here on.
  void compress() { bag_->setCompression(rosbag::compression::LZ4); }

  /// Completes the file, has it on the disk, and gives it its name. Throws Error.
  void commit();

 private:
  template <typename Message>
  boost::shared_ptr<ros::M_string> connectionHeader(const std::string& topic,
                                                    const Message& message, bool latched) const {
    auto header = boost::make_shared<ros::M_string>();
    (*header)["topic"] = topic;
    (*header)["type"] = ros::message_traits::datatype(message);
    (*header)["md5sum"] = ros::message_traits::md5sum(message);
    (*header)["message_definition"] = ros::message_traits::definition(message);
    (*header)["callerid"] = "/" + program_;
    (*header)["latching"] = latched ? "1" : "0";
    return header;
  }
  template <typename Action>
  void guarded(const Action& action) {
    try {
      action();
    } catch (const std::exception& e) {
      fail(e.what());
    }
  }
  void close();
  /// Throws Error if the output must not take its name.
  void checkExisting() const;
  [[noreturn]] void fail(const std::string& why) const;

  std::string path_;
  std::string program_;
  Existing existing_;
  std::unique_ptr<UnfinishedFile> file_;
  std::unique_ptr<rosbag::Bag> bag_;
};

/// Closes a bag, or throws rosbag's exception. One that cannot be closed is kept until the program
/// ends: its destructor would write to it again, and an exception there ends the program.
void closeBag(std::unique_ptr<rosbag::Bag> bag);

}  // namespace semantic_lidar_fusion

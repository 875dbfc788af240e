// SPDX-License-Identifier: MIT
#include "tools/common/bag_output.h"

#include <fcntl.h>
#include <rosbag/view.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdio>
#include <cstring>
#include <utility>
#include <vector>

namespace semantic_lidar_fusion {
namespace {

/// Whether a file holds nothing that cannot be made again: an empty one, or this program's output.
bool isReplaceable(const std::string& path, off_t size) {
  if (size == 0) return true;
  try {
    rosbag::Bag bag(path, rosbag::bagmode::Read);
    rosbag::View view(bag);
    const auto connections = view.getConnections();
    return !connections.empty() && std::all_of(connections.begin(), connections.end(),
                                               [](const rosbag::ConnectionInfo* connection) {
                                                 const auto caller =
                                                     connection->header->find("callerid");
                                                 return caller != connection->header->end() &&
                                                        caller->second == BagOutput::kCaller;
                                               });
  } catch (const std::exception&) {
    return false;  // not a bag
  }
}

}  // namespace

BagOutput::BagOutput(const std::string& path, bool overwrite)
    : path_(path), written_path_(path + ".tmp") {
  struct stat status {};
  if (::stat(path.c_str(), &status) == 0) {
    if (!S_ISREG(status.st_mode)) throw Error(path + ": exists and is not a file");
    if (!overwrite && !isReplaceable(path, status.st_size)) {
      throw Error(path + ": exists and is not from fuse_bag; give --force to replace it");
    }
  }
  bag_ = std::make_unique<rosbag::Bag>();
  try {
    bag_->open(written_path_, rosbag::bagmode::Write);
  } catch (const std::exception& e) {
    fail(e.what());
  }
}

BagOutput::~BagOutput() {
  if (committed_) return;
  try {
    close();
  } catch (const std::exception&) {
    // Of no interest: the file goes.
  }
  ::unlink(written_path_.c_str());
}

/// Closes the bag once.
void BagOutput::close() {
  if (bag_) guarded([&] { closeBag(std::move(bag_)); });
}

void BagOutput::commit() {
  close();
  const int file = ::open(written_path_.c_str(), O_RDONLY | O_CLOEXEC);
  const bool flushed = file >= 0 && ::fsync(file) == 0;
  const std::string flush_error = flushed ? "" : std::strerror(errno);
  if (file >= 0) ::close(file);
  if (!flushed) fail(flush_error);
  if (std::rename(written_path_.c_str(), path_.c_str()) != 0) fail(std::strerror(errno));
  committed_ = true;
}

void BagOutput::fail(const std::string& why) { throw Error(path_ + ": cannot be written: " + why); }

void closeBag(std::unique_ptr<rosbag::Bag> bag) {
  try {
    bag->close();
  } catch (...) {
    static auto* const kept = new std::vector<std::unique_ptr<rosbag::Bag>>;
    kept->push_back(std::move(bag));
    throw;
  }
}

}  // namespace semantic_lidar_fusion

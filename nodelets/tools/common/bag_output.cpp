// SPDX-License-Identifier: MIT
#include "tools/common/bag_output.h"

#include <rosbag/view.h>
#include <sys/stat.h>

#include <algorithm>
#include <cstdio>
#include <utility>
#include <vector>

namespace semantic_lidar_fusion {
namespace {

/// Whether a file holds nothing that cannot be made again: an empty one, or the program's output.
bool isReplaceable(const std::string& path, off_t size, const std::string& program) {
  if (size == 0) return true;
  try {
    rosbag::Bag bag(path, rosbag::bagmode::Read);
    rosbag::View view(bag);
    const auto connections = view.getConnections();
    return !connections.empty() && std::all_of(connections.begin(), connections.end(),
                                               [&](const rosbag::ConnectionInfo* connection) {
                                                 const auto caller =
                                                     connection->header->find("callerid");
                                                 return caller != connection->header->end() &&
                                                        caller->second == "/" + program;
                                               });
  } catch (const std::exception&) {
    return false;  // not a bag
  }
}

void keepToTheEnd(std::unique_ptr<rosbag::Bag> bag) {
  static auto* const kept = new std::vector<std::unique_ptr<rosbag::Bag>>;
  kept->push_back(std::move(bag));
}

}  // namespace

BagOutput::BagOutput(const std::string& path, const std::string& program, Existing existing)
    : path_(path), program_(program), existing_(existing) {
  checkExisting();
  file_ = std::make_unique<UnfinishedFile>(path_);
  for (const std::string& leftover : file_->removedLeftovers()) {
    std::fprintf(stderr, "%s: note: %s: left by a run that was killed; removed\n", program_.c_str(),
                 leftover.c_str());
  }
  auto bag = std::make_unique<rosbag::Bag>();
  try {
    bag->open(file_->path(), rosbag::bagmode::Write);
  } catch (const std::exception& e) {
    keepToTheEnd(std::move(bag));
    fail(e.what());
  }
  bag_ = std::move(bag);
}

BagOutput::~BagOutput() {
  try {
    close();
  } catch (const std::exception&) {
    // Of no interest: the file goes.
  }
}

void BagOutput::checkExisting() const {
  struct stat status {};
  if (::stat(path_.c_str(), &status) != 0) return;
  if (!S_ISREG(status.st_mode)) throw Error(path_ + ": exists and is not a file");
  if (existing_ == Existing::kRefuse) {
    throw Error(path_ + ": exists; give --force to replace it");
  }
  if (existing_ == Existing::kReplaceOwn && !isReplaceable(path_, status.st_size, program_)) {
    throw Error(path_ + ": exists and is not from " + program_ + "; give --force to replace it");
  }
}

/// Closes the bag once.
void BagOutput::close() {
  if (bag_) guarded([&] { closeBag(std::move(bag_)); });
}

void BagOutput::commit() {
  close();
  checkExisting();  // again: it may have come meanwhile
  file_->commit();
}

void BagOutput::fail(const std::string& why) const {
  throw Error(path_ + ": cannot be written: " + why);
}

void closeBag(std::unique_ptr<rosbag::Bag> bag) {
  try {
    bag->close();
  } catch (...) {
    keepToTheEnd(std::move(bag));
    throw;
  }
}

}  // namespace semantic_lidar_fusion

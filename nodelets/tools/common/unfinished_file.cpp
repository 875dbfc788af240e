// SPDX-License-Identifier: MIT
#include "tools/common/unfinished_file.h"

#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdio>
#include <cstring>
#include <filesystem>

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

const char* const kMark = ".unfinished-";

/// Whether `path` still names the file that is open as `file`.
bool isNameOf(const std::string& path, int file) {
  struct stat by_name {
  }, by_file{};
  return ::lstat(path.c_str(), &by_name) == 0 && ::fstat(file, &by_file) == 0 &&
         by_name.st_dev == by_file.st_dev && by_name.st_ino == by_file.st_ino;
}

/// Whether `name` is that of an unfinished file of the target that is called `target_name`.
bool isUnfinished(const std::string& name, const std::string& target_name) {
  const std::string start = target_name + kMark;
  if (name.compare(0, start.size(), start) != 0) return false;
  const std::string rest = name.substr(start.size());
  const std::size_t dash = rest.find('-');
  const auto isNumber = [](const std::string& text) {
    return !text.empty() && text.find_first_not_of("0123456789") == std::string::npos;
  };
  return dash != std::string::npos && isNumber(rest.substr(0, dash)) &&
         isNumber(rest.substr(dash + 1));
}

}  // namespace

UnfinishedFile::UnfinishedFile(const std::string& target) : target_(target) {
  removeLeftovers();
  make();
}

UnfinishedFile::~UnfinishedFile() {
  if (!committed_) ::unlink(path_.c_str());
  ::close(lock_);
}

void UnfinishedFile::make() {
  constexpr int kMostAttempts = 1000;
  for (int number = 0; number < kMostAttempts; ++number) {
    path_ = target_ + kMark + std::to_string(::getpid()) + "-" + std::to_string(number);
    const int file =
        ::open(path_.c_str(), O_RDWR | O_CREAT | O_EXCL | O_NOFOLLOW | O_CLOEXEC, 0666);
    if (file < 0 && errno == EEXIST) continue;
    if (file < 0) fail(errno);
    // Where a file system has no locks, leftovers stay.
    ::flock(file, LOCK_EX | LOCK_NB);
    if (isNameOf(path_, file)) {
      lock_ = file;
      return;
    }
    ::close(file);  // another run took it for a leftover before it was locked
  }
  fail(EEXIST);
}

void UnfinishedFile::removeLeftovers() {
  namespace fs = std::filesystem;
  const fs::path target(target_);
  const fs::path folder = target.has_parent_path() ? target.parent_path() : fs::path(".");
  std::error_code ignored;  // a folder that cannot be read is the writer's to report
  for (const fs::directory_entry& entry : fs::directory_iterator(folder, ignored)) {
    const std::string name = entry.path().filename().string();
    if (!isUnfinished(name, target.filename().string())) continue;
    const int file = ::open(entry.path().c_str(), O_RDONLY | O_NOFOLLOW | O_NONBLOCK | O_CLOEXEC);
    if (file < 0) continue;
    struct stat status {};
    const bool is_left = ::fstat(file, &status) == 0 && S_ISREG(status.st_mode) &&
                         ::flock(file, LOCK_EX | LOCK_NB) == 0;
    if (is_left && isNameOf(entry.path().string(), file) && ::unlink(entry.path().c_str()) == 0) {
      removed_.push_back(entry.path().string());
    }
    ::close(file);
  }
  std::sort(removed_.begin(), removed_.end());
}

void UnfinishedFile::commit() {
  if (::fsync(lock_) != 0) fail(errno);
  if (!isNameOf(path_, lock_)) fail(ENOENT);
  if (std::rename(path_.c_str(), target_.c_str()) != 0) fail(errno);
  committed_ = true;
}

void UnfinishedFile::fail(int error) const {
  throw Error(target_ + ": cannot be written: " + std::strerror(error));
}

}  // namespace semantic_lidar_fusion

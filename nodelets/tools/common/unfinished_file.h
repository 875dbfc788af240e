// SPDX-License-Identifier: MIT
#pragma once

#include <string>
#include <vector>

namespace semantic_lidar_fusion {

/// The name and the lock of a file that is written beside its target and takes the target's name
/// when it is whole: `<target>.unfinished-<process>-<number>`. Each is made anew, never opened, so
/// that two runs with one target do not meet and no file or link that is there is touched. It is
/// locked while its process lives: what a killed run has left behind is told by its free lock.
class UnfinishedFile {
 public:
  /// Makes the empty file, and removes what killed runs have left of the same target. Throws Error.
  explicit UnfinishedFile(const std::string& target);
  /// Removes the file unless it was committed.
  ~UnfinishedFile();
  UnfinishedFile(const UnfinishedFile&) = delete;
  UnfinishedFile& operator=(const UnfinishedFile&) = delete;

  const std::string& path() const { return path_; }
  /// Names of the files that killed runs had left, now removed.
  const std::vector<std::string>& removedLeftovers() const { return removed_; }

  /// Has the file on the disk, then gives it the target's name. Throws Error.
  void commit();

 private:
  void make();
  void removeLeftovers();
  [[noreturn]] void fail(int error) const;

  std::string target_;
  std::string path_;
  int lock_ = -1;  ///< file descriptor
  std::vector<std::string> removed_;
  bool committed_ = false;
};

}  // namespace semantic_lidar_fusion

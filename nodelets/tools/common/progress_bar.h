// SPDX-License-Identifier: MIT
/// Progress of long work on standard error: a bar on a terminal, else a line for every tenth.
#pragma once

#include <cstddef>
#include <string>

namespace semantic_lidar_fusion {

class ProgressBar {
 public:
  ProgressBar(std::string label, std::size_t total, bool enabled);
  /// Ends the line of an unfinished bar.
  ~ProgressBar();
  void update(std::size_t done);

 private:
  std::string label_;
  std::size_t total_;
  bool enabled_;
  bool terminal_;
  bool open_line_ = false;
  int shown_ = -1;  ///< percent on a terminal, else tenths
};

}  // namespace semantic_lidar_fusion

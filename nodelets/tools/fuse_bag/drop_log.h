// SPDX-License-Identifier: MIT
/// Counts what was discarded, by reason; the first case of each reason is told at once.
#pragma once

#include <cstdint>
#include <cstdio>
#include <map>
#include <string>

namespace semantic_lidar_fusion {

class DropLog {
 public:
  /// `reason` is a short text without numbers; `detail` names the thing and the value.
  void count(const std::string& reason, const std::string& detail, std::uint64_t n = 1) {
    if (n == 0) return;
    std::uint64_t& total = counts_[reason];
    if (total == 0) warn(detail);
    total += n;
  }
  /// Adds up without a word.
  void add(const std::string& reason, std::uint64_t n) {
    if (n > 0) counts_[reason] += n;
  }
  static void warn(const std::string& text) {
    std::fprintf(stderr, "fuse_bag: warning: %s\n", text.c_str());
  }
  static void note(const std::string& text) {
    std::fprintf(stderr, "fuse_bag: note: %s\n", text.c_str());
  }
  const std::map<std::string, std::uint64_t>& counts() const { return counts_; }

 private:
  std::map<std::string, std::uint64_t> counts_;
};

}  // namespace semantic_lidar_fusion

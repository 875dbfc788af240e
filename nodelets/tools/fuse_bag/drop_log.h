// SPDX-License-Identifier: MIT
/// Counts what was discarded, by reason; the first case of each reason is told at once.
#pragma once

#include <cstdint>
#include <map>
#include <mutex>
#include <string>

namespace semantic_lidar_fusion {

/// May be used by several threads.
class DropLog {
 public:
  /// `reason` is a short text without numbers; `detail` names the thing and the value.
  void count(const std::string& reason, const std::string& detail, std::uint64_t n = 1);
  /// Adds up without a word.
  void add(const std::string& reason, std::uint64_t n);
  std::map<std::string, std::uint64_t> counts() const;

  /// Lines for the user; the program tells each once.
  static void warn(const std::string& text);
  static void note(const std::string& text);

 private:
  mutable std::mutex mutex_;
  std::map<std::string, std::uint64_t> counts_;
};

}  // namespace semantic_lidar_fusion

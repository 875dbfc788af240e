// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/drop_log.h"

#include <cstdio>
#include <set>

#include "semantic_lidar_fusion/common/plain_text.h"

namespace semantic_lidar_fusion {
namespace {

void tellOnce(const std::string& line) {
  static std::mutex mutex;
  static std::set<std::string> told;
  const std::lock_guard<std::mutex> lock(mutex);
  if (!told.insert(line).second) return;
  // Lines hold texts of messages, which may hold anything.
  constexpr std::size_t kLongest = 2000;
  std::fprintf(stderr, "fuse_bag: %s\n", plainText(line, kLongest).c_str());
}

}  // namespace

void DropLog::count(const std::string& reason, const std::string& detail, std::uint64_t n) {
  if (n == 0) return;
  const std::lock_guard<std::mutex> lock(mutex_);
  std::uint64_t& total = counts_[reason];
  if (total == 0) warn(detail);
  total += n;
}

void DropLog::add(const std::string& reason, std::uint64_t n) {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (n > 0) counts_[reason] += n;
}

std::map<std::string, std::uint64_t> DropLog::counts() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  return counts_;
}

void DropLog::warn(const std::string& text) { tellOnce("warning: " + text); }

void DropLog::note(const std::string& text) { tellOnce("note: " + text); }

}  // namespace semantic_lidar_fusion

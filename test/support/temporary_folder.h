// SPDX-License-Identifier: MIT
/// A folder of its own for a test, wherever the system keeps such; it goes with what it holds.
#pragma once

#include <gtest/gtest.h>
#include <stdlib.h>

#include <filesystem>
#include <stdexcept>
#include <string>

namespace semantic_lidar_fusion {

class TemporaryFolder {
 public:
  TemporaryFolder() : path_(testing::TempDir() + "slf_" + std::string(6, 'X')) {
    if (mkdtemp(&path_[0]) == nullptr) throw std::runtime_error("no folder " + path_);
  }
  ~TemporaryFolder() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  TemporaryFolder(const TemporaryFolder&) = delete;
  TemporaryFolder& operator=(const TemporaryFolder&) = delete;

  const std::string& path() const { return path_; }

 private:
  std::string path_;
};

}  // namespace semantic_lidar_fusion

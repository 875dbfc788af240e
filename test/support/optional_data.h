// SPDX-License-Identifier: MIT
/// Real data and networks that tests use where they are at hand (environment variable
/// SLF_SHARED_DIR, else a folder `shared` beside the package's) and skip, saying so, where not.
#pragma once

#include <cstdlib>
#include <fstream>
#include <string>

namespace semantic_lidar_fusion {

inline std::string sharedPath(const std::string& relative) {
  const char* given = std::getenv("SLF_SHARED_DIR");
  return (given ? std::string(given) : std::string(SLF_SOURCE_DIR) + "/../shared") + "/" + relative;
}

inline bool readable(const std::string& path) { return std::ifstream(path).good(); }

}  // namespace semantic_lidar_fusion

/// Ends a test as skipped unless the file `relative` of the optional data is readable.
#define SLF_SKIP_WITHOUT(relative)                                                       \
  if (!::semantic_lidar_fusion::readable(::semantic_lidar_fusion::sharedPath(relative))) \
  GTEST_SKIP() << "optional data not found: " << relative

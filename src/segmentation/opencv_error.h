// SPDX-License-Identifier: MIT
#pragma once

#include <string>

namespace semantic_lidar_fusion {

/// The first line of a text that may have many, e.g. of OpenCV's errors.
inline std::string firstLine(const std::string& text) {
  const std::size_t begin = text.find_first_not_of(" \n");
  if (begin == std::string::npos) return "unknown error";
  return text.substr(begin, text.find('\n', begin) - begin);
}

}  // namespace semantic_lidar_fusion

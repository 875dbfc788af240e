// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/common/error.h"

#include <utility>

namespace semantic_lidar_fusion {
namespace {

std::string oneALine(const std::vector<std::string>& problems) {
  std::string text;
  for (const std::string& problem : problems) {
    if (!text.empty()) text += '\n';
    text += problem;
  }
  return text.empty() ? "configuration error" : text;
}

}  // namespace

ConfigError::ConfigError(std::vector<std::string> problems)
    : Error(oneALine(problems)), problems_(std::move(problems)) {}

}  // namespace semantic_lidar_fusion

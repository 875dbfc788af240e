// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/common/error.h"

#include <algorithm>
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

/// Names and paths in a problem may hold line breaks, which a quoted YAML text can: "a\nb".
std::vector<std::string> withoutBreaks(std::vector<std::string> problems) {
  for (std::string& problem : problems) {
    std::replace_if(
        problem.begin(), problem.end(), [](char c) { return c == '\n' || c == '\r'; }, '?');
  }
  return problems;
}

}  // namespace

ConfigError::ConfigError(std::vector<std::string> problems)
    : Error(oneALine(withoutBreaks(problems))), problems_(withoutBreaks(std::move(problems))) {}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#pragma once

#include <cstddef>
#include <string>

namespace semantic_lidar_fusion {

/// Number of single-letter edits that make b of a (Levenshtein).
std::size_t editDistance(const std::string& a, const std::string& b);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <random>
#include <string>

#include "semantic_lidar_fusion/common/edit_distance.h"

namespace semantic_lidar_fusion {
namespace {

/// The definition, by recursion on the first letters.
std::size_t distanceByDefinition(const std::string& a, const std::string& b) {
  if (a.empty() || b.empty()) return std::max(a.size(), b.size());
  const std::string a_less = a.substr(1), b_less = b.substr(1);
  return std::min({distanceByDefinition(a_less, b) + 1, distanceByDefinition(a, b_less) + 1,
                   distanceByDefinition(a_less, b_less) + (a[0] == b[0] ? 0 : 1)});
}

TEST(EditDistanceTest, IsTheLeastNumberOfEdits) {
  EXPECT_EQ(editDistance("kitten", "sitting"), 3u);
  EXPECT_EQ(editDistance("", "abc"), 3u);
  EXPECT_EQ(editDistance("Abc", "abc"), 1u);
  std::mt19937 random(11);
  for (int trial = 0; trial < 200; ++trial) {
    std::string words[2];
    for (std::string& word : words) {
      for (unsigned k = random() % 6; k > 0; --k) word += static_cast<char>('a' + random() % 3);
    }
    EXPECT_EQ(editDistance(words[0], words[1]), distanceByDefinition(words[0], words[1]))
        << words[0] << " " << words[1];
  }
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <limits>
#include <memory>
#include <random>
#include <string>
#include <vector>

#include "common/time_kernels.h"

namespace semantic_lidar_fusion {
namespace {

std::vector<const TimeKernels*> usable() {
  const TimeKernelList list = usableTimeKernels();
  return {list.kernels, list.kernels + list.count};
}

class EveryTimeKernel : public testing::TestWithParam<const TimeKernels*> {};

TEST_P(EveryTimeKernel, SpansAllTimes) {
  std::mt19937_64 random(7);
  for (const int count : {1, 7, 8, 9, 15, 16, 17, 100, 255, 256}) {
    for (int trial = 0; trial < 50; ++trial) {
      // Exactly its length, so that a sanitizer sees each access beyond it.
      const std::unique_ptr<std::int64_t[]> times(
          new std::int64_t[static_cast<std::size_t>(count)]());
      for (int i = 0; i < count; ++i) times[i] = static_cast<std::int64_t>(random());
      if (trial == 0) times[count / 2] = std::numeric_limits<std::int64_t>::min();
      if (trial == 1) times[count / 2] = std::numeric_limits<std::int64_t>::max();
      std::int64_t first = 0, last = 0;
      GetParam()->span(times.get(), count, &first, &last);
      EXPECT_EQ(first, *std::min_element(times.get(), times.get() + count));
      EXPECT_EQ(last, *std::max_element(times.get(), times.get() + count));
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Kernels, EveryTimeKernel, testing::ValuesIn(usable()),
                         [](const auto& info) { return std::string(info.param->name); });

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cstring>
#include <limits>
#include <memory>
#include <random>
#include <string>
#include <vector>

#include "motion/motion_kernels.h"

namespace semantic_lidar_fusion {
namespace {

constexpr std::int64_t kSecond = 1000000000;
const std::vector<int> kCounts = {0, 1, 7, 8, 9, 15, 16, 17, 100, 255, 256};

/// An array of exactly its length, so that a sanitizer sees each access beyond it.
template <typename T>
std::unique_ptr<T[]> array(int count) {
  return std::unique_ptr<T[]>(new T[static_cast<std::size_t>(count)]());
}

template <typename T>
void expectSameBytes(const T* a, const T* b, int count, const char* what) {
  if (count == 0) return;
  EXPECT_EQ(std::memcmp(a, b, sizeof(T) * static_cast<std::size_t>(count)), 0) << what;
}

std::vector<const MotionKernels*> usable() {
  const MotionKernelList list = usableMotionKernels();
  return {list.kernels, list.kernels + list.count};
}

class EveryMotionKernel : public testing::TestWithParam<const MotionKernels*> {};

TEST_P(EveryMotionKernel, FindsTheLeadingTimesWithin) {
  const std::int64_t starts[] = {0, 1600000000 * kSecond, -5 * kSecond,
                                 std::numeric_limits<std::int64_t>::max() - kSecond};
  for (const std::int64_t begin : starts) {
    for (const int count : kCounts) {
      // The first time that is not within, one too early or too late, near or far; none at `count`.
      for (int outside = 0; outside <= count; ++outside) {
        for (const std::int64_t by :
             {std::int64_t{-1}, std::int64_t{1}, -(std::int64_t{1} << 32), std::int64_t{1} << 33}) {
          const std::uint32_t length = 1000;
          auto times = array<std::int64_t>(count);
          auto ns = array<float>(count);
          for (int i = 0; i < count; ++i) times[i] = begin + (i * 37) % (length + 1);
          if (count > 1) times[count - 1] = begin + length;
          if (outside < count) {
            if (by > 0 && begin > std::numeric_limits<std::int64_t>::max() - 2 * length - by) {
              continue;
            }
            times[outside] = begin + by + (by > 0 ? length : 0);
          }
          ASSERT_EQ(GetParam()->timesWithin(times.get(), count, begin, length, ns.get()), outside)
              << count << " times from " << begin << ", one off by " << by;
          for (int i = 0; i < outside; ++i) {
            ASSERT_EQ(ns[i], static_cast<float>(times[i] - begin)) << i;
          }
        }
      }
    }
  }
}

TEST_P(EveryMotionKernel, WritesTheTimeOfAFirstPointThatIsOutside) {
  for (const int count : {1, 7, 8, 16}) {
    auto times = array<std::int64_t>(count);
    auto ns = array<float>(count);
    for (int i = 0; i < count; ++i) times[i] = 5 * kSecond - 300;
    EXPECT_EQ(GetParam()->timesWithin(times.get(), count, 5 * kSecond, 1000, ns.get()), 0);
    EXPECT_EQ(ns[0], -300.0f);
  }
}

/// The equations in double precision, and the plain kernel byte for byte.
TEST_P(EveryMotionKernel, MovesPoints) {
  std::mt19937 random(5);
  std::normal_distribution<float> unit;
  for (const int count : kCounts) {
    LinearMotion motion;
    for (int k = 0; k < 12; ++k) {
      motion.start[k] = unit(random);
      motion.rate_per_ns[k] = 1e-8f * unit(random);
    }
    auto ns = array<float>(count);
    std::unique_ptr<float[]> p[3], plain[3];
    double before[3][256];
    for (int axis = 0; axis < 3; ++axis) {
      p[axis] = array<float>(count);
      plain[axis] = array<float>(count);
      for (int i = 0; i < count; ++i) {
        p[axis][i] = plain[axis][i] = 30.0f * unit(random);
        before[axis][i] = p[axis][i];
      }
    }
    for (int i = 0; i < count; ++i) ns[i] = 1e6f * unit(random);
    GetParam()->move(motion, ns.get(), count, p[0].get(), p[1].get(), p[2].get());
    kPlainMotionKernels.move(motion, ns.get(), count, plain[0].get(), plain[1].get(),
                             plain[2].get());
    for (int axis = 0; axis < 3; ++axis) {
      expectSameBytes(p[axis].get(), plain[axis].get(), count, "coordinates");
      for (int i = 0; i < count; ++i) {
        double expected = 0.0;
        for (int k = 0; k < 4; ++k) {
          const double entry =
              static_cast<double>(motion.start[4 * axis + k]) +
              static_cast<double>(ns[i]) * static_cast<double>(motion.rate_per_ns[4 * axis + k]);
          expected += entry * (k < 3 ? before[k][i] : 1.0);
        }
        EXPECT_NEAR(p[axis][i], expected, 1e-4) << "axis " << axis << " of point " << i;
      }
    }
  }
}

TEST_P(EveryMotionKernel, GivesSecondsToTheLastBit) {
  std::mt19937_64 random(6);
  const std::int64_t reference = 1600000000 * kSecond + 123456789;
  const std::int64_t most = std::numeric_limits<std::int32_t>::max();
  for (const int count : kCounts) {
    auto times = array<std::int64_t>(count);
    auto seconds = array<float>(count);
    for (int i = 0; i < count; ++i) {
      const auto off = static_cast<std::int64_t>(random() % (2 * static_cast<std::uint64_t>(most)));
      times[i] = reference + off - most;
    }
    if (count > 1) times[0] = reference - most;
    if (count > 1) times[1] = reference + most;
    GetParam()->secondsSince(reference, times.get(), count, seconds.get());
    for (int i = 0; i < count; ++i) {
      EXPECT_EQ(seconds[i], static_cast<float>(1e-9 * static_cast<double>(times[i] - reference)));
    }
  }
}

INSTANTIATE_TEST_SUITE_P(All, EveryMotionKernel, testing::ValuesIn(usable()),
                         [](const auto& info) { return std::string(info.param->name); });

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>
#include <random>
#include <string>
#include <vector>

#include "superpixel/slic_kernels.h"

namespace semantic_lidar_fusion {
namespace {

using Bytes = std::vector<std::uint8_t>;

/// Each set of kernels that this machine runs.
std::vector<const SlicKernels*> allKernels() {
  const SlicKernelList list = usableSlicKernels();
  return {list.kernels, list.kernels + list.count};
}

Bytes randomBytes(std::size_t count, std::mt19937* random, int levels = 256) {
  Bytes bytes(count);
  for (std::uint8_t& byte : bytes) byte = static_cast<std::uint8_t>((*random)() % levels);
  return bytes;
}

/// A block and its candidates with buffers of exactly the readable size, so that a sanitizer sees
/// any byte read beyond.
struct Scene {
  Scene(unsigned seed, int rows, int columns, int candidate_count, int levels) : random(seed) {
    block.stride = kBlockWidth + static_cast<int>(random() % 3) * 7;
    block.first_row = static_cast<int>(random() % 4);
    block.row_step = 1 + static_cast<int>(random() % 4);
    block.row_count = rows;
    block.column_count = columns;
    for (int c = 0; c < 3; ++c) {
      // One byte in front, so that rows are not aligned.
      plane[c] = randomBytes(1 + (rows - 1) * block.stride + kBlockWidth, &random, levels);
      block.plane[c] = &plane[c][1];
    }
    candidates.count = candidate_count;
    for (int k = 0; k < candidate_count; ++k) {
      // Some candidates equal the one before: ties must go to the earlier.
      const bool repeated = k > 0 && random() % 4 == 0;
      tables.push_back(randomBytes(kBlockWidth + kBlockHeight, &random, levels));
      if (repeated) tables.back() = tables[tables.size() - 2];
      for (int c = 0; c < 3; ++c) {
        candidates.colour[k][c] =
            repeated ? candidates.colour[k - 1][c] : static_cast<std::uint8_t>(random() % levels);
      }
    }
    for (int k = 0; k < candidate_count; ++k) {
      candidates.dx[k] = tables[k].data();
      candidates.dy[k] = tables[k].data() + kBlockWidth;
    }
  }

  std::mt19937 random;
  SlicBlock block;
  SlicCandidates candidates;
  Bytes plane[3];
  std::vector<Bytes> tables;
};

/// The rule of SlicCandidates, literally: index and distance of the first nearest candidate.
std::pair<int, int> nearestByDefinition(const Scene& scene, int x, int y) {
  std::pair<int, int> nearest{-1, 1 << 20};
  for (int k = 0; k < scene.candidates.count; ++k) {
    int distance = scene.candidates.dx[k][x] + scene.candidates.dy[k][y];
    for (int c = 0; c < 3; ++c) {
      distance += std::abs(static_cast<int>(scene.block.plane[c][y * scene.block.stride + x]) -
                           static_cast<int>(scene.candidates.colour[k][c]));
    }
    distance = std::min(distance, 255);
    if (distance < nearest.second) nearest = {k, distance};
  }
  return nearest;
}

/// Calls `check(scene)` for blocks of many shapes and contents.
template <typename Check>
void forManyScenes(const Check& check) {
  unsigned seed = 0;
  for (const int rows : {1, 2, 3, 7, kBlockHeight}) {
    for (const int columns : {1, 2, 15, 16, 17, 31, kBlockWidth}) {
      for (const int candidate_count : {1, 2, 9, 17, kMaxCandidates}) {
        for (const int levels : {2, 40, 256}) {  // ties, unsaturated, saturated
          const Scene scene(++seed, rows, columns, candidate_count, levels);
          SCOPED_TRACE(std::to_string(rows) + " rows, " + std::to_string(columns) + " columns, " +
                       std::to_string(candidate_count) + " candidates, levels " +
                       std::to_string(levels) + ", first row " +
                       std::to_string(scene.block.first_row) + ", step " +
                       std::to_string(scene.block.row_step));
          check(scene);
          if (::testing::Test::HasFatalFailure()) return;
        }
      }
    }
  }
}

class SlicKernelsTest : public ::testing::TestWithParam<const SlicKernels*> {};

TEST_P(SlicKernelsTest, AssignTheFirstNearestCandidate) {
  forManyScenes([](const Scene& scene) {
    const int stride = kBlockWidth + 3;
    const std::uint8_t untouched = 123;
    Bytes index(1 + (scene.block.row_count - 1) * stride + kBlockWidth, untouched);
    GetParam()->assign(scene.block, scene.candidates, &index[1], stride);
    for (int y = 0; y < scene.block.row_count; ++y) {
      const bool visited =
          y >= scene.block.first_row && (y - scene.block.first_row) % scene.block.row_step == 0;
      for (int x = 0; x < kBlockWidth; ++x) {
        int expected = untouched;
        if (visited) {
          expected = x < scene.block.column_count ? nearestByDefinition(scene, x, y).first
                                                  : static_cast<int>(kNoCandidate);
        }
        ASSERT_EQ(index[1 + y * stride + x], expected) << "at " << x << ", " << y;
      }
    }
  });
}

TEST_P(SlicKernelsTest, AccumulateTheSumsOfEachCandidate) {
  forManyScenes([](const Scene& scene) {
    std::vector<SlicSums> expected(scene.candidates.count, SlicSums{});
    std::uint32_t expected_residual = 0;
    for (int y = scene.block.first_row; y < scene.block.row_count; y += scene.block.row_step) {
      for (int x = 0; x < scene.block.column_count; ++x) {
        const auto [index, distance] = nearestByDefinition(scene, x, y);
        SlicSums& sum = expected[index];
        for (int c = 0; c < 3; ++c) {
          sum.colour[c] += scene.block.plane[c][y * scene.block.stride + x];
        }
        sum.x += x;
        sum.y += y;
        ++sum.pixels;
        expected_residual += distance;
      }
    }
    std::vector<SlicSums> sums(scene.candidates.count);
    ASSERT_EQ(GetParam()->accumulate(scene.block, scene.candidates, sums.data()),
              expected_residual);
    for (int k = 0; k < scene.candidates.count; ++k) {
      for (int c = 0; c < 3; ++c) ASSERT_EQ(sums[k].colour[c], expected[k].colour[c]) << k;
      ASSERT_EQ(sums[k].x, expected[k].x) << k;
      ASSERT_EQ(sums[k].y, expected[k].y) << k;
      ASSERT_EQ(sums[k].pixels, expected[k].pixels) << k;
    }
  });
}

TEST_P(SlicKernelsTest, AccumulateTheLargestSums) {
  Scene scene(1, kBlockHeight, kBlockWidth, 1, 1);
  scene.block.first_row = 0;
  scene.block.row_step = 1;
  for (Bytes& plane : scene.plane) std::fill(plane.begin(), plane.end(), 255);
  SlicSums sum;
  EXPECT_EQ(GetParam()->accumulate(scene.block, scene.candidates, &sum), 512U * 255U);
  EXPECT_EQ(sum.pixels, 512U);
  EXPECT_EQ(sum.x, 16U * 496U);
  EXPECT_EQ(sum.y, 32U * 120U);
  for (const std::uint32_t colour : sum.colour) EXPECT_EQ(colour, 512U * 255U);
}

TEST_P(SlicKernelsTest, OpponentColoursFollowTheFormula) {
  std::mt19937 random(3);
  for (const int count : {1, 15, 16, 17, 31, 33, 257}) {
    Bytes bgr = randomBytes(3 * count, &random);
    // The extremes of each formula.
    const std::uint8_t corners[] = {0, 0, 255, 255, 0, 0, 0, 255, 0, 255, 0, 255, 255, 255, 255};
    std::copy_n(corners, std::min<std::size_t>(bgr.size(), sizeof(corners)), bgr.begin());
    Bytes planes[3] = {Bytes(count), Bytes(count), Bytes(count)};
    std::uint8_t* const out[3] = {planes[0].data(), planes[1].data(), planes[2].data()};
    GetParam()->opponentColours(bgr.data(), count, out);
    for (int i = 0; i < count; ++i) {
      const double b = bgr[3 * i], g = bgr[3 * i + 1], r = bgr[3 * i + 2];
      const auto expected = [](double value) {
        return static_cast<int>(std::min(255.0, std::max(0.0, std::floor(value))));
      };
      ASSERT_EQ(planes[0][i], expected((b + 2 * g + r) / 4)) << i << " of " << count;
      ASSERT_EQ(planes[1][i], expected(128 + r - b)) << i << " of " << count;
      ASSERT_EQ(planes[2][i], expected(128 + (2 * g - b - r) / 2)) << i << " of " << count;
    }
  }
}

TEST_P(SlicKernelsTest, SmoothByTheMeanOfMeans) {
  std::mt19937 random(4);
  for (const int count : {1, 31, 32, 33, 200}) {
    const Bytes a = randomBytes(count, &random), b = randomBytes(count, &random);
    const Bytes c = randomBytes(count, &random);
    Bytes out(count);
    GetParam()->smooth(a.data(), b.data(), c.data(), count, out.data());
    for (int i = 0; i < count; ++i) {
      const double outer = std::ceil((a[i] + c[i]) / 2.0);
      ASSERT_EQ(out[i], static_cast<int>(std::ceil((outer + b[i]) / 2.0))) << i << " of " << count;
    }
  }
}

TEST_P(SlicKernelsTest, SumRowsByTheirWeights) {
  std::mt19937 random(5);
  for (const int row_count : {1, 2, 3, 4, 7}) {
    for (const int count : {1, 15, 16, 17, 97}) {
      for (const std::uint32_t largest : {1U, 604U, 32767U, 100000U}) {
        std::vector<Bytes> rows;
        std::vector<const std::uint8_t*> pointers;
        std::vector<std::uint32_t> weights;
        for (int r = 0; r < row_count; ++r) {
          rows.push_back(randomBytes(count, &random));
          weights.push_back(r == 0 ? largest : 1 + random() % largest);
        }
        for (const Bytes& row : rows) pointers.push_back(row.data());
        std::vector<std::uint32_t> sums(count);
        GetParam()->sumRows(pointers.data(), weights.data(), row_count, count, sums.data());
        for (int i = 0; i < count; ++i) {
          std::uint64_t expected = 0;
          for (int r = 0; r < row_count; ++r) {
            expected += static_cast<std::uint64_t>(weights[r]) * rows[r][i];
          }
          ASSERT_EQ(sums[i], expected) << i << " of " << count << ", rows " << row_count;
        }
      }
    }
  }
}

TEST_P(SlicKernelsTest, RunStartsMarkChangesWithinABlock) {
  std::mt19937 random(6);
  for (const int block_count : {1, 2, 5}) {
    for (const int levels : {1, 2, 256}) {
      const Bytes index = randomBytes(block_count * kBlockWidth, &random, levels);
      std::vector<std::uint32_t> starts(block_count);
      GetParam()->runStarts(index.data(), block_count, starts.data());
      for (int i = 0; i < block_count * kBlockWidth; ++i) {
        const bool expected = i % kBlockWidth != 0 && index[i] != index[i - 1];
        ASSERT_EQ((starts[i / kBlockWidth] >> (i % kBlockWidth)) & 1U, expected ? 1U : 0U) << i;
      }
    }
  }
}

INSTANTIATE_TEST_SUITE_P(All, SlicKernelsTest, ::testing::ValuesIn(allKernels()),
                         [](const auto& info) { return std::string(info.param->name); });

}  // namespace
}  // namespace semantic_lidar_fusion

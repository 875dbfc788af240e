// SPDX-License-Identifier: MIT
#include "slic_kernels.h"

#include <algorithm>
#include <cstddef>
#include <cstdlib>

namespace semantic_lidar_fusion {
namespace {

struct Nearest {
  int index, distance;
};

Nearest nearestCandidate(const SlicCandidates& candidates, const std::uint8_t colour[3], int x,
                         int y) {
  Nearest nearest{0, 256};
  for (int k = 0; k < candidates.count; ++k) {
    int distance = candidates.dx[k][x] + candidates.dy[k][y];
    for (int c = 0; c < 3; ++c) distance += std::abs(colour[c] - candidates.colour[k][c]);
    distance = std::min(distance, 255);
    if (distance < nearest.distance) nearest = {k, distance};
  }
  return nearest;
}

template <typename Visit>
void forEachPixel(const SlicBlock& block, const SlicCandidates& candidates, const Visit& visit) {
  for (int y = block.first_row; y < block.row_count; y += block.row_step) {
    for (int x = 0; x < block.column_count; ++x) {
      const int at = y * block.stride + x;
      const std::uint8_t colour[3] = {block.plane[0][at], block.plane[1][at], block.plane[2][at]};
      visit(x, y, colour, nearestCandidate(candidates, colour, x, y));
    }
  }
}

void assign(const SlicBlock& block, const SlicCandidates& candidates, std::uint8_t* index,
            int index_stride) {
  forEachPixel(block, candidates, [&](int x, int y, const std::uint8_t*, const Nearest& nearest) {
    index[y * index_stride + x] = static_cast<std::uint8_t>(nearest.index);
  });
  for (int y = block.first_row; y < block.row_count; y += block.row_step) {
    std::fill(index + y * index_stride + block.column_count, index + y * index_stride + kBlockWidth,
              kNoCandidate);
  }
}

std::uint32_t accumulate(const SlicBlock& block, const SlicCandidates& candidates, SlicSums* sums) {
  std::fill_n(sums, candidates.count, SlicSums{});
  std::uint32_t residual = 0;
  forEachPixel(block, candidates,
               [&](int x, int y, const std::uint8_t* colour, const Nearest& nearest) {
                 SlicSums& sum = sums[nearest.index];
                 ++sum.pixels;
                 sum.x += x;
                 sum.y += y;
                 for (int c = 0; c < 3; ++c) sum.colour[c] += colour[c];
                 residual += nearest.distance;
               });
  return residual;
}

std::uint8_t saturated(int value) {
  return static_cast<std::uint8_t>(std::min(std::max(value, 0), 255));
}

void opponentColours(const std::uint8_t* bgr, int count, std::uint8_t* const planes[3]) {
  for (int i = 0; i < count; ++i) {
    const int b = bgr[3 * i], g = bgr[3 * i + 1], r = bgr[3 * i + 2];
    planes[0][i] = static_cast<std::uint8_t>((b + 2 * g + r) >> 2);
    planes[1][i] = saturated(128 + r - b);
    planes[2][i] = saturated((256 + 2 * g - b - r) >> 1);
  }
}

void smooth(const std::uint8_t* a, const std::uint8_t* b, const std::uint8_t* c, int count,
            std::uint8_t* out) {
  for (int i = 0; i < count; ++i) {
    const int outer = (a[i] + c[i] + 1) >> 1;
    out[i] = static_cast<std::uint8_t>((outer + b[i] + 1) >> 1);
  }
}

void sumRows(const std::uint8_t* const* rows, const std::uint32_t* weights, int row_count,
             int count, std::uint32_t* sums) {
  std::fill_n(sums, count, 0U);
  for (int row = 0; row < row_count; ++row) {
    for (int i = 0; i < count; ++i) sums[i] += weights[row] * rows[row][i];
  }
}

// The quotient of two numbers, cut to an integer, is exact here. With floats numerators stay below
// 2^24, and a quotient below 256 that is no integer is at least 1 / area from the next one, more
// than its rounding error of 2^-17; with doubles all that is below 2^31 is exact likewise.
template <typename Real>
void averageColumnsBy(const std::uint32_t* sums, const BoxColumns& columns, std::uint8_t* out) {
  const auto divisor = static_cast<Real>(columns.area);
  for (int i = 0; i < columns.count; ++i) {
    const BoxSpan& span = columns.spans[i];
    const std::uint32_t* first = sums + static_cast<std::ptrdiff_t>(span.first) * 3;
    const std::uint32_t* last = first + static_cast<std::ptrdiff_t>(span.count - 1) * 3;
    for (int c = 0; c < 3; ++c) {
      std::uint32_t between = 0;
      for (const std::uint32_t* in = first + 3; in < last; in += 3) between += in[c];
      const std::uint32_t sum = span.first_weight * first[c] + columns.whole_weight * between +
                                span.last_weight * last[c] + columns.area / 2;
      *out++ = static_cast<std::uint8_t>(
          static_cast<int>(static_cast<Real>(static_cast<int>(sum)) / divisor));
    }
  }
}

void averageColumns(const std::uint32_t* sums, const BoxColumns& columns, std::uint8_t* out) {
  if (columns.area < kFloatBoxArea) {
    averageColumnsBy<float>(sums, columns, out);
  } else {
    averageColumnsBy<double>(sums, columns, out);
  }
}

void runStarts(const std::uint8_t* index, int block_count, std::uint32_t* starts) {
  for (int block = 0; block < block_count; ++block, index += kBlockWidth) {
    std::uint32_t bits = 0;
    for (int x = 1; x < kBlockWidth; ++x) {
      bits |= static_cast<std::uint32_t>(index[x] != index[x - 1]) << x;
    }
    starts[block] = bits;
  }
}

}  // namespace

const SlicKernels kPlainSlicKernels = {"plain", assign,         accumulate, opponentColours, smooth,
                                       sumRows, averageColumns, nullptr,    runStarts};

SlicKernelList usableSlicKernels() {
  SlicKernelList list{1, {&kPlainSlicKernels, nullptr, nullptr}};
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) list.kernels[list.count++] = &kAvx2SlicKernels;
#endif
#ifdef SLF_HAVE_AVX512
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq")) {
    list.kernels[list.count++] = &kAvx512SlicKernels;
  }
#endif
  return list;
}

}  // namespace semantic_lidar_fusion

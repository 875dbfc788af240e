// SPDX-License-Identifier: MIT
// Compiled with AVX-512 (F, BW, DQ, VL) enabled: includes and uses nothing that could be emitted as
// a shared inline function (see slic_kernels.h).
// GCC 12's own intrinsics set off these warnings: their undefined registers are initialised with
// themselves.
#pragma GCC diagnostic ignored "-Wuninitialized"
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#include <immintrin.h>

#include <cstddef>

#include "slic_kernels.h"

namespace semantic_lidar_fusion {
namespace {

static_assert(kBlockWidth == 32, "one register is two rows of a block");

inline __m256i loadRow(const std::uint8_t* p) {
  return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p));
}

/// `low` and `high` of 32 bytes in the halves of a register.
inline __m512i loadRows(const std::uint8_t* low, const std::uint8_t* high) {
  return _mm512_inserti64x4(_mm512_castsi256_si512(loadRow(low)), loadRow(high), 1);
}

inline __m512i absoluteDifference(__m512i a, __m512i b) {
  return _mm512_sub_epi8(_mm512_max_epu8(a, b), _mm512_min_epu8(a, b));
}

/// Candidates with their constants spread over a register each.
struct WideCandidates {
  __m512i colour[kMaxCandidates][3];
  __m512i dx[kMaxCandidates];
  __m512i dy[kMaxCandidates];  ///< the block's rows, in each 128 bits
};

inline void widen(const SlicCandidates& candidates, WideCandidates* wide) {
  static_assert(kBlockHeight == 16, "the rows of a block fill 128 bits");
  for (int k = 0; k < candidates.count; ++k) {
    for (int c = 0; c < 3; ++c) {
      wide->colour[k][c] = _mm512_set1_epi8(static_cast<char>(candidates.colour[k][c]));
    }
    wide->dx[k] = _mm512_broadcast_i64x4(loadRow(candidates.dx[k]));
    wide->dy[k] =
        _mm512_broadcast_i32x4(_mm_loadu_si128(reinterpret_cast<const __m128i*>(candidates.dy[k])));
  }
}

/// Of the pixels of two rows.
struct Nearest {
  __m512i index, distance;
};

inline __m512i rowIndices(int y0, int y1) {
  return _mm512_inserti64x4(_mm512_castsi256_si512(_mm256_set1_epi8(static_cast<char>(y0))),
                            _mm256_set1_epi8(static_cast<char>(y1)), 1);
}

/// Rows y0 and y1 together, and y2 and y3: they share the loads of the candidates' constants.
inline void nearestCandidates(const SlicBlock& block, const SlicCandidates& candidates,
                              const WideCandidates& wide, const int y[4], Nearest nearest[2]) {
  __m512i colour[2][3], rows[2], best[2], least[2];
  for (int i = 0; i < 2; ++i) {
    for (int c = 0; c < 3; ++c) {
      colour[i][c] = loadRows(block.plane[c] + y[2 * i] * block.stride,
                              block.plane[c] + y[2 * i + 1] * block.stride);
    }
    rows[i] = rowIndices(y[2 * i], y[2 * i + 1]);
    best[i] = _mm512_setzero_si512();
    least[i] = _mm512_set1_epi8(-1);
  }
  __m512i index = _mm512_setzero_si512();
  const __m512i one = _mm512_set1_epi8(1);
  for (int k = 0; k < candidates.count; ++k) {
    for (int i = 0; i < 2; ++i) {
      const __m512i position =
          _mm512_adds_epu8(wide.dx[k], _mm512_shuffle_epi8(wide.dy[k], rows[i]));
      const __m512i d0 = absoluteDifference(colour[i][0], wide.colour[k][0]);
      const __m512i d1 = absoluteDifference(colour[i][1], wide.colour[k][1]);
      const __m512i d2 = absoluteDifference(colour[i][2], wide.colour[k][2]);
      const __m512i distance =
          _mm512_adds_epu8(_mm512_adds_epu8(d0, d1), _mm512_adds_epu8(d2, position));
      // Of equal distances the earlier candidate stays.
      const __mmask64 nearer = _mm512_cmplt_epu8_mask(distance, least[i]);
      least[i] = _mm512_min_epu8(least[i], distance);
      best[i] = _mm512_mask_mov_epi8(best[i], nearer, index);
    }
    index = _mm512_add_epi8(index, one);
  }
  for (int i = 0; i < 2; ++i) nearest[i] = {best[i], least[i]};
}

/// Lanes of columns inside the image, in both rows.
inline __mmask64 insideMask(int column_count) {
  const std::uint64_t row = 0xffffffffU >> (kBlockWidth - column_count);
  return row | row << 32;
}

/// The next four visited rows from y on, the last one again where there are fewer; how many.
inline int nextRows(const SlicBlock& block, int y, int rows[4]) {
  int count = 0;
  int last = y;
  for (int i = 0; i < 4; ++i) {
    if (y < block.row_count) {
      last = y;
      ++count;
    }
    rows[i] = last;
    y += block.row_step;
  }
  return count;
}

inline void storeRow(std::uint8_t* p, __m256i v) {
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), v);
}

void assign(const SlicBlock& block, const SlicCandidates& candidates, std::uint8_t* index,
            int index_stride) {
  WideCandidates wide;
  widen(candidates, &wide);
  const __mmask64 inside = insideMask(block.column_count);
  const __m512i none = _mm512_set1_epi8(static_cast<char>(kNoCandidate));
  for (int y = block.first_row; y < block.row_count; y += 4 * block.row_step) {
    int rows[4];
    nextRows(block, y, rows);
    Nearest nearest[2];
    nearestCandidates(block, candidates, wide, rows, nearest);
    for (int i = 0; i < 2; ++i) {
      const __m512i both = _mm512_mask_mov_epi8(none, inside, nearest[i].index);
      storeRow(index + rows[2 * i] * index_stride, _mm512_castsi512_si256(both));
      storeRow(index + rows[2 * i + 1] * index_stride, _mm512_extracti64x4_epi64(both, 1));
    }
  }
}

std::uint32_t accumulate(const SlicBlock& block, const SlicCandidates& candidates, SlicSums* sums) {
  WideCandidates wide;
  widen(candidates, &wide);
  const __m512i zero = _mm512_setzero_si512();
  const __mmask64 inside = insideMask(block.column_count);
  const __m512i none = _mm512_set1_epi8(static_cast<char>(kNoCandidate));
  // Pairs of visited rows; a pair's missing second row is nobody's.
  __m512i index_of[kBlockHeight / 2 + 1], y_of[kBlockHeight / 2 + 1];
  __m512i colours[3][kBlockHeight / 2 + 1];
  __m512i residual = zero;
  int pairs = 0;
  for (int y = block.first_row; y < block.row_count; y += 4 * block.row_step) {
    int rows[4];
    const int count = nextRows(block, y, rows);
    Nearest nearest[2];
    nearestCandidates(block, candidates, wide, rows, nearest);
    for (int i = 0; 2 * i < count; ++i) {
      const __mmask64 counted = 2 * i + 1 < count ? inside : inside & 0xffffffffU;
      index_of[pairs] = _mm512_mask_mov_epi8(none, counted, nearest[i].index);
      y_of[pairs] = rowIndices(rows[2 * i], rows[2 * i + 1]);
      for (int c = 0; c < 3; ++c) {
        colours[c][pairs] = loadRows(block.plane[c] + rows[2 * i] * block.stride,
                                     block.plane[c] + rows[2 * i + 1] * block.stride);
      }
      residual = _mm512_add_epi64(
          residual, _mm512_sad_epu8(_mm512_maskz_mov_epi8(counted, nearest[i].distance), zero));
      ++pairs;
    }
  }

  const __m512i columns = _mm512_broadcast_i64x4(
      _mm256_setr_epi8(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21,
                       22, 23, 24, 25, 26, 27, 28, 29, 30, 31));
  __m512i index = zero;
  const __m512i one = _mm512_set1_epi8(1);
  for (int k = 0; k < candidates.count; ++k) {
    // Sums of eight pixels each in 64-bit lanes.
    __m512i colour0 = zero, colour1 = zero, colour2 = zero, x = zero, row = zero;
    std::uint32_t pixels = 0;
    for (int i = 0; i < pairs; ++i) {
      const __mmask64 won = _mm512_cmpeq_epi8_mask(index_of[i], index);
      pixels += static_cast<std::uint32_t>(__builtin_popcountll(won));
      const auto sum = [&](__m512i values) {
        return _mm512_sad_epu8(_mm512_maskz_mov_epi8(won, values), zero);
      };
      colour0 = _mm512_add_epi64(colour0, sum(colours[0][i]));
      colour1 = _mm512_add_epi64(colour1, sum(colours[1][i]));
      colour2 = _mm512_add_epi64(colour2, sum(colours[2][i]));
      x = _mm512_add_epi64(x, sum(columns));
      row = _mm512_add_epi64(row, sum(y_of[i]));
    }
    // Totals fit 32 bits: two sums share the halves of the 64-bit lanes.
    const auto total = [](__m512i low, __m512i high) {
      return static_cast<std::uint64_t>(
          _mm512_reduce_add_epi64(_mm512_or_si512(low, _mm512_slli_epi64(high, 32))));
    };
    const std::uint64_t c01 = total(colour0, colour1), c2x = total(colour2, x);
    sums[k].colour[0] = static_cast<std::uint32_t>(c01);
    sums[k].colour[1] = static_cast<std::uint32_t>(c01 >> 32);
    sums[k].colour[2] = static_cast<std::uint32_t>(c2x);
    sums[k].x = static_cast<std::uint32_t>(c2x >> 32);
    sums[k].y = static_cast<std::uint32_t>(_mm512_reduce_add_epi64(row));
    sums[k].pixels = pixels;
    index = _mm512_add_epi8(index, one);
  }
  return static_cast<std::uint32_t>(_mm512_reduce_add_epi64(residual));
}

// What is left gains nothing from wider registers: memory and shuffles bound it.

void opponentColours(const std::uint8_t* bgr, int count, std::uint8_t* const planes[3]) {
  kAvx2SlicKernels.opponentColours(bgr, count, planes);
}

void smooth(const std::uint8_t* a, const std::uint8_t* b, const std::uint8_t* c, int count,
            std::uint8_t* out) {
  kAvx2SlicKernels.smooth(a, b, c, count, out);
}

void sumRows(const std::uint8_t* const* rows, const std::uint32_t* weights, int row_count,
             int count, std::uint32_t* sums) {
  kAvx2SlicKernels.sumRows(rows, weights, row_count, count, sums);
}

void averageColumns(const std::uint32_t* sums, const BoxColumns& columns, std::uint8_t* out) {
  kAvx2SlicKernels.averageColumns(sums, columns, out);
}

void averageNarrowBoxes(const std::uint8_t* const* rows, const std::uint32_t* weights,
                        int row_count, int ahead_count, const NarrowBoxes& boxes,
                        std::uint8_t* out) {
  kAvx2SlicKernels.averageNarrowBoxes(rows, weights, row_count, ahead_count, boxes, out);
}

void runStarts(const std::uint8_t* index, int block_count, std::uint32_t* starts) {
  kAvx2SlicKernels.runStarts(index, block_count, starts);
}

}  // namespace

const SlicKernels kAvx512SlicKernels = {"avx512", assign,  accumulate,     opponentColours,
                                        smooth,   sumRows, averageColumns, averageNarrowBoxes,
                                        runStarts};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
// Compiled with AVX2 enabled: includes and uses nothing that could be emitted as a shared inline
// function (see slic_kernels.h).
#include <immintrin.h>

#include "score_kernels.h"

namespace semantic_lidar_fusion {
namespace {

/// The highest of all lanes, in each.
inline __m256 highestLane(__m256 v) {
  v = _mm256_max_ps(v, _mm256_permute2f128_ps(v, v, 1));
  v = _mm256_max_ps(v, _mm256_permute_ps(v, 0x4e));
  return _mm256_max_ps(v, _mm256_permute_ps(v, 0xb1));
}

inline __m256 finiteLanes(__m256 v) {
  const __m256 magnitude = _mm256_castsi256_ps(_mm256_set1_epi32(0x7fffffff));
  return _mm256_cmp_ps(_mm256_and_ps(v, magnitude), _mm256_set1_ps(__builtin_inff()), _CMP_LT_OQ);
}

inline unsigned equalLanes(__m256 a, __m256 b) {
  return static_cast<unsigned>(_mm256_movemask_ps(_mm256_cmp_ps(a, b, _CMP_EQ_OQ)));
}

/// 8 to 16 classes: two registers that overlap.
inline int labelOfTwo(const float* cell, int class_count) {
  const __m256 low = _mm256_loadu_ps(cell), high = _mm256_loadu_ps(cell + class_count - 8);
  const __m256 finite = _mm256_and_ps(finiteLanes(low), finiteLanes(high));
  const __m256 highest = highestLane(_mm256_max_ps(low, high));
  const unsigned is_highest = equalLanes(low, highest) | equalLanes(high, highest)
                                                             << (class_count - 8);
  // The guard bit keeps the count defined where NaN is equal to nothing.
  const int label = __builtin_ctz(is_highest | 1U << 16);
  return _mm256_movemask_ps(finite) == 0xff ? label : kNoVote;
}

/// Of the registers that cover more than 16 classes, the last one overlaps.
inline int lastOf(int c, int width, int class_count) {
  return c + width <= class_count ? c : class_count - width;
}

inline int labelOfMany(const float* cell, int class_count) {
  __m256 highest = _mm256_loadu_ps(cell);
  __m256 finite = finiteLanes(highest);
  for (int c = 8; c < class_count; c += 8) {
    const __m256 scores = _mm256_loadu_ps(cell + lastOf(c, 8, class_count));
    finite = _mm256_and_ps(finite, finiteLanes(scores));
    highest = _mm256_max_ps(highest, scores);
  }
  if (_mm256_movemask_ps(finite) != 0xff) return kNoVote;
  highest = highestLane(highest);
  for (int c = 0;; c += 8) {
    const int at = lastOf(c, 8, class_count);
    const unsigned equal = equalLanes(_mm256_loadu_ps(cell + at), highest);
    if (equal != 0) return at + __builtin_ctz(equal);
  }
}

void labelFloats(const float* row, const int* cells, int cell_count, int class_count, int* labels) {
  if (class_count < 8) {
    kPlainScoreKernels.labelFloats(row, cells, cell_count, class_count, labels);
    return;
  }
  for (int i = 0; i < cell_count; ++i) {
    const float* cell = row + static_cast<std::int64_t>(cells[i]) * class_count;
    labels[i] = class_count <= 16 ? labelOfTwo(cell, class_count) : labelOfMany(cell, class_count);
  }
}

/// Scores of 8 or 16 bits. `Lanes` tells how many fit a register, and how to find the lowest.
struct Bytes {
  using Score = std::uint8_t;
  static constexpr int kLanes = 16, kBytesPerScore = 1;
  static __m128i spread(int value) { return _mm_set1_epi8(static_cast<char>(value)); }
  static __m128i least(__m128i a, __m128i b) { return _mm_min_epu8(a, b); }
  static __m128i equal(__m128i a, __m128i b) { return _mm_cmpeq_epi8(a, b); }
  static int leastLane(__m128i v) {
    const __m128i pairs = _mm_min_epu8(v, _mm_srli_epi16(v, 8));
    return _mm_cvtsi128_si32(_mm_minpos_epu16(_mm_and_si128(pairs, _mm_set1_epi16(0xff)))) & 0xff;
  }
};

struct Words {
  using Score = std::uint16_t;
  static constexpr int kLanes = 8, kBytesPerScore = 2;
  static __m128i spread(int value) { return _mm_set1_epi16(static_cast<short>(value)); }
  static __m128i least(__m128i a, __m128i b) { return _mm_min_epu16(a, b); }
  static __m128i equal(__m128i a, __m128i b) { return _mm_cmpeq_epi16(a, b); }
  static int leastLane(__m128i v) { return _mm_cvtsi128_si32(_mm_minpos_epu16(v)) & 0xffff; }
};

/// The lowest of `flipped` scores, since the machine finds the lowest lane in one instruction.
template <typename Lanes>
inline int lowestOf(const typename Lanes::Score* cell, int class_count, __m128i flip) {
  constexpr int kWidth = Lanes::kLanes;
  const auto scoresAt = [&](int at) {
    return _mm_xor_si128(_mm_loadu_si128(reinterpret_cast<const __m128i*>(cell + at)), flip);
  };
  __m128i least = scoresAt(0);
  for (int c = kWidth; c < class_count; c += kWidth) {
    least = Lanes::least(least, scoresAt(lastOf(c, kWidth, class_count)));
  }
  const __m128i lowest = Lanes::spread(Lanes::leastLane(least));
  for (int c = 0;; c += kWidth) {
    const int at = lastOf(c, kWidth, class_count);
    const auto equal = static_cast<unsigned>(_mm_movemask_epi8(Lanes::equal(scoresAt(at), lowest)));
    if (equal != 0) return at + __builtin_ctz(equal) / Lanes::kBytesPerScore;
  }
}

/// 8 to 15 classes of a byte each: two halves of a register, which overlap.
inline int lowestOfHalves(const std::uint8_t* cell, int class_count, __m128i flip) {
  const __m128i low = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(cell));
  const __m128i high = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(cell + class_count - 8));
  const __m128i scores = _mm_xor_si128(_mm_unpacklo_epi64(low, high), flip);
  const __m128i lowest = Bytes::spread(Bytes::leastLane(scores));
  const auto equal = static_cast<unsigned>(_mm_movemask_epi8(Bytes::equal(scores, lowest)));
  return __builtin_ctz((equal & 0xffU) | (equal >> 8) << (class_count - 8));
}

void labelBytes(const std::uint8_t* row, const int* cells, int cell_count, int class_count,
                std::uint8_t flip, int* labels) {
  if (class_count < 8) {
    kPlainScoreKernels.labelBytes(row, cells, cell_count, class_count, flip, labels);
    return;
  }
  const __m128i flips = Bytes::spread(~flip);
  for (int i = 0; i < cell_count; ++i) {
    const std::uint8_t* cell = row + static_cast<std::int64_t>(cells[i]) * class_count;
    labels[i] = class_count < 16 ? lowestOfHalves(cell, class_count, flips)
                                 : lowestOf<Bytes>(cell, class_count, flips);
  }
}

void labelWords(const std::uint16_t* row, const int* cells, int cell_count, int class_count,
                std::uint16_t flip, int* labels) {
  if (class_count < 8) {
    kPlainScoreKernels.labelWords(row, cells, cell_count, class_count, flip, labels);
    return;
  }
  const __m128i flips = Words::spread(~flip);
  for (int i = 0; i < cell_count; ++i) {
    const std::uint16_t* cell = row + static_cast<std::int64_t>(cells[i]) * class_count;
    labels[i] = lowestOf<Words>(cell, class_count, flips);
  }
}

inline __m256i load(const int* p) {
  return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p));
}

int segmentStarts(const int* ids, const int* labels, int count, int* starts) {
  if (count < 1) return 0;
  starts[0] = 0;
  int found = 1, x = 1;
  for (; x + 8 <= count; x += 8) {
    const __m256i same =
        _mm256_and_si256(_mm256_cmpeq_epi32(load(ids + x), load(ids + x - 1)),
                         _mm256_cmpeq_epi32(load(labels + x), load(labels + x - 1)));
    unsigned starting =
        static_cast<unsigned>(_mm256_movemask_ps(_mm256_castsi256_ps(same))) ^ 0xffU;
    for (; starting != 0; starting &= starting - 1) starts[found++] = x + __builtin_ctz(starting);
  }
  for (; x < count; ++x) {
    starts[found] = x;
    found += ids[x] != ids[x - 1] || labels[x] != labels[x - 1];
  }
  return found;
}

}  // namespace

const ScoreKernels kAvx2ScoreKernels = {"avx2", labelFloats, labelBytes, labelWords, segmentStarts};

}  // namespace semantic_lidar_fusion

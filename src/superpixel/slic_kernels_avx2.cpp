// SPDX-License-Identifier: MIT
// Compiled with AVX2 enabled: includes and uses nothing that could be emitted as a shared inline
// function (see slic_kernels.h).
#include <immintrin.h>

#include <cstddef>

#include "slic_kernels.h"

namespace semantic_lidar_fusion {
namespace {

static_assert(kBlockWidth == 32, "one register is one row of a block");

inline __m256i load(const std::uint8_t* p) {
  return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p));
}

inline void store(std::uint8_t* p, __m256i v) {
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), v);
}

inline __m256i absoluteDifference(__m256i a, __m256i b) {
  return _mm256_or_si256(_mm256_subs_epu8(a, b), _mm256_subs_epu8(b, a));
}

/// Candidates with their constants spread over a register each.
struct WideCandidates {
  __m256i colour[kMaxCandidates][3];
  __m256i dx[kMaxCandidates];
};

void widen(const SlicCandidates& candidates, WideCandidates* wide) {
  for (int k = 0; k < candidates.count; ++k) {
    for (int c = 0; c < 3; ++c) {
      wide->colour[k][c] = _mm256_set1_epi8(static_cast<char>(candidates.colour[k][c]));
    }
    wide->dx[k] = load(candidates.dx[k]);
  }
}

/// Of the pixels of one row.
struct Nearest {
  __m256i index, distance;
};

/// Rows y0 and y1 together: they share the loads of the candidates' constants.
inline void nearestCandidates(const SlicBlock& block, const SlicCandidates& candidates,
                              const WideCandidates& wide, int y0, int y1, Nearest* nearest0,
                              Nearest* nearest1) {
  __m256i colour0[3], colour1[3];
  for (int c = 0; c < 3; ++c) {
    colour0[c] = load(block.plane[c] + y0 * block.stride);
    colour1[c] = load(block.plane[c] + y1 * block.stride);
  }
  __m256i index0 = _mm256_setzero_si256(), least0 = _mm256_set1_epi8(-1);
  __m256i index1 = index0, least1 = least0;
  __m256i index = _mm256_setzero_si256();
  const __m256i one = _mm256_set1_epi8(1);
  const auto compete = [&](int k, int y, const __m256i* colour, __m256i* best, __m256i* least) {
    const __m256i position =
        _mm256_adds_epu8(wide.dx[k], _mm256_set1_epi8(static_cast<char>(candidates.dy[k][y])));
    const __m256i d0 = absoluteDifference(colour[0], wide.colour[k][0]);
    const __m256i d1 = absoluteDifference(colour[1], wide.colour[k][1]);
    const __m256i d2 = absoluteDifference(colour[2], wide.colour[k][2]);
    const __m256i distance =
        _mm256_adds_epu8(_mm256_adds_epu8(d0, d1), _mm256_adds_epu8(d2, position));
    const __m256i former = *least;
    *least = _mm256_min_epu8(former, distance);
    // Where the former least holds, equal or not, the earlier candidate stays.
    *best = _mm256_blendv_epi8(index, *best, _mm256_cmpeq_epi8(*least, former));
  };
  for (int k = 0; k < candidates.count; ++k) {
    compete(k, y0, colour0, &index0, &least0);
    compete(k, y1, colour1, &index1, &least1);
    index = _mm256_add_epi8(index, one);
  }
  *nearest0 = {index0, least0};
  *nearest1 = {index1, least1};
}

/// All ones in the lanes of columns inside the image.
inline __m256i insideMask(int column_count) {
  alignas(32) std::uint8_t lanes[kBlockWidth];
  for (int x = 0; x < kBlockWidth; ++x) lanes[x] = x < column_count ? 255 : 0;
  return load(lanes);
}

void assign(const SlicBlock& block, const SlicCandidates& candidates, std::uint8_t* index,
            int index_stride) {
  WideCandidates wide;
  widen(candidates, &wide);
  const __m256i outside = _mm256_xor_si256(insideMask(block.column_count), _mm256_set1_epi8(-1));
  for (int y = block.first_row; y < block.row_count; y += 2 * block.row_step) {
    const int next = y + block.row_step < block.row_count ? y + block.row_step : y;
    Nearest nearest0, nearest1;
    nearestCandidates(block, candidates, wide, y, next, &nearest0, &nearest1);
    store(index + y * index_stride, _mm256_or_si256(nearest0.index, outside));
    store(index + next * index_stride, _mm256_or_si256(nearest1.index, outside));
  }
}

/// Sum of the two 64-bit sums in each half of v: {low, high} parts a, b in the 32-bit halves.
inline __m128i sumOfHalves(__m256i v) {
  const __m128i sum = _mm_add_epi64(_mm256_castsi256_si128(v), _mm256_extracti128_si256(v, 1));
  return _mm_add_epi64(sum, _mm_unpackhi_epi64(sum, sum));
}

std::uint32_t accumulate(const SlicBlock& block, const SlicCandidates& candidates, SlicSums* sums) {
  WideCandidates wide;
  widen(candidates, &wide);
  const __m256i zero = _mm256_setzero_si256();
  const __m256i one = _mm256_set1_epi8(1), one16 = _mm256_set1_epi16(1);
  const __m256i inside = insideMask(block.column_count);
  const __m256i outside = _mm256_xor_si256(inside, _mm256_set1_epi8(-1));
  __m256i nearest_index[kBlockHeight + 1];
  __m256i residual = zero;
  int visited = 0;
  for (int y = block.first_row; y < block.row_count; y += 2 * block.row_step) {
    const bool paired = y + block.row_step < block.row_count;
    Nearest nearest0, nearest1;
    nearestCandidates(block, candidates, wide, y, paired ? y + block.row_step : y, &nearest0,
                      &nearest1);
    nearest_index[visited++] = _mm256_or_si256(nearest0.index, outside);
    nearest_index[visited] = _mm256_or_si256(nearest1.index, outside);
    visited += paired;
    const __m256i distance0 = _mm256_and_si256(nearest0.distance, inside);
    const __m256i distance1 =
        paired ? _mm256_and_si256(nearest1.distance, inside) : _mm256_setzero_si256();
    residual = _mm256_add_epi64(residual, _mm256_add_epi64(_mm256_sad_epu8(distance0, zero),
                                                           _mm256_sad_epu8(distance1, zero)));
  }

  const __m256i columns =
      _mm256_setr_epi8(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21,
                       22, 23, 24, 25, 26, 27, 28, 29, 30, 31);
  __m256i index = zero;
  for (int k = 0; k < candidates.count; ++k) {
    // 16-bit lanes hold two pixels of each visited row, at most kBlockHeight * 2 * 255.
    __m256i colour0 = zero, colour1 = zero, colour2 = zero, x = zero;
    // Bytes: pixels of a column so far, and the sum of that over the rows.
    __m256i pixels = zero, steps = zero;
    const std::uint8_t* plane0 = block.plane[0] + block.first_row * block.stride;
    const std::uint8_t* plane1 = block.plane[1] + block.first_row * block.stride;
    const std::uint8_t* plane2 = block.plane[2] + block.first_row * block.stride;
    const int advance = block.row_step * block.stride;
    for (int row = 0, at = 0; row < visited; ++row, at += advance) {
      const __m256i won = _mm256_and_si256(_mm256_cmpeq_epi8(nearest_index[row], index), one);
      colour0 = _mm256_add_epi16(colour0, _mm256_maddubs_epi16(load(plane0 + at), won));
      colour1 = _mm256_add_epi16(colour1, _mm256_maddubs_epi16(load(plane1 + at), won));
      colour2 = _mm256_add_epi16(colour2, _mm256_maddubs_epi16(load(plane2 + at), won));
      x = _mm256_add_epi16(x, _mm256_maddubs_epi16(columns, won));
      steps = _mm256_add_epi8(steps, pixels);
      pixels = _mm256_add_epi8(pixels, won);
    }
    // Four sums of eight 32-bit lanes, then one of each.
    const __m256i c01 =
        _mm256_hadd_epi32(_mm256_madd_epi16(colour0, one16), _mm256_madd_epi16(colour1, one16));
    const __m256i c2x =
        _mm256_hadd_epi32(_mm256_madd_epi16(colour2, one16), _mm256_madd_epi16(x, one16));
    const __m256i halves = _mm256_hadd_epi32(c01, c2x);
    const __m128i totals =
        _mm_add_epi32(_mm256_castsi256_si128(halves), _mm256_extracti128_si256(halves, 1));
    _mm_storeu_si128(reinterpret_cast<__m128i*>(sums[k].colour), totals);
    static_assert(offsetof(SlicSums, x) == offsetof(SlicSums, colour) + 3 * sizeof(std::uint32_t),
                  "colour[3] and x are stored together");

    const __m128i counts = sumOfHalves(_mm256_add_epi64(
        _mm256_sad_epu8(pixels, zero), _mm256_slli_epi64(_mm256_sad_epu8(steps, zero), 32)));
    const auto pixel_count = static_cast<std::uint32_t>(_mm_cvtsi128_si32(counts));
    const auto step_count = static_cast<std::uint32_t>(_mm_extract_epi32(counts, 1));
    sums[k].pixels = pixel_count;
    // A pixel in visited row i is counted in `steps` by each later one: visited - 1 - i times.
    sums[k].y = pixel_count * static_cast<std::uint32_t>(block.first_row) +
                static_cast<std::uint32_t>(block.row_step) *
                    (pixel_count * static_cast<std::uint32_t>(visited - 1) - step_count);
    index = _mm256_add_epi8(index, one);
  }
  return static_cast<std::uint32_t>(_mm_cvtsi128_si32(sumOfHalves(residual)));
}

static_assert(kBlockHeight * 2 * 255 <= 32767, "sums of two columns in signed 16 bits");
static_assert(kBlockHeight * (kBlockHeight - 1) / 2 <= 255, "sums of steps in bytes");

/// 16 BGR pixels as bytes of b, g and r.
inline void deinterleave(const std::uint8_t* bgr, __m128i* b, __m128i* g, __m128i* r) {
  const __m128i v0 = _mm_loadu_si128(reinterpret_cast<const __m128i*>(bgr));
  const __m128i v1 = _mm_loadu_si128(reinterpret_cast<const __m128i*>(bgr + 16));
  const __m128i v2 = _mm_loadu_si128(reinterpret_cast<const __m128i*>(bgr + 32));
  const auto pick = [](__m128i a, __m128i m0, __m128i c, __m128i m1, __m128i d, __m128i m2) {
    return _mm_or_si128(_mm_or_si128(_mm_shuffle_epi8(a, m0), _mm_shuffle_epi8(c, m1)),
                        _mm_shuffle_epi8(d, m2));
  };
  *b = pick(v0, _mm_setr_epi8(0, 3, 6, 9, 12, 15, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1), v1,
            _mm_setr_epi8(-1, -1, -1, -1, -1, -1, 2, 5, 8, 11, 14, -1, -1, -1, -1, -1), v2,
            _mm_setr_epi8(-1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, 1, 4, 7, 10, 13));
  *g = pick(v0, _mm_setr_epi8(1, 4, 7, 10, 13, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1), v1,
            _mm_setr_epi8(-1, -1, -1, -1, -1, 0, 3, 6, 9, 12, 15, -1, -1, -1, -1, -1), v2,
            _mm_setr_epi8(-1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, 2, 5, 8, 11, 14));
  *r = pick(v0, _mm_setr_epi8(2, 5, 8, 11, 14, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1), v1,
            _mm_setr_epi8(-1, -1, -1, -1, -1, 1, 4, 7, 10, 13, -1, -1, -1, -1, -1, -1), v2,
            _mm_setr_epi8(-1, -1, -1, -1, -1, -1, -1, -1, -1, -1, 0, 3, 6, 9, 12, 15));
}

void opponentColours(const std::uint8_t* bgr, int count, std::uint8_t* const planes[3]) {
  const __m256i c128 = _mm256_set1_epi16(128), c256 = _mm256_set1_epi16(256);
  const auto narrow = [](__m256i v) {
    return _mm_packus_epi16(_mm256_castsi256_si128(v), _mm256_extracti128_si256(v, 1));
  };
  int i = 0;
  for (; i + 16 <= count; i += 16) {
    __m128i b8, g8, r8;
    deinterleave(bgr + 3 * i, &b8, &g8, &r8);
    const __m256i b = _mm256_cvtepu8_epi16(b8), r = _mm256_cvtepu8_epi16(r8);
    const __m256i g2 = _mm256_slli_epi16(_mm256_cvtepu8_epi16(g8), 1);
    const __m256i br = _mm256_add_epi16(b, r);
    const __m256i p0 = _mm256_srli_epi16(_mm256_add_epi16(br, g2), 2);
    const __m256i p1 = _mm256_add_epi16(_mm256_sub_epi16(r, b), c128);
    const __m256i p2 = _mm256_srai_epi16(_mm256_sub_epi16(_mm256_add_epi16(g2, c256), br), 1);
    _mm_storeu_si128(reinterpret_cast<__m128i*>(planes[0] + i), narrow(p0));
    _mm_storeu_si128(reinterpret_cast<__m128i*>(planes[1] + i), narrow(p1));
    _mm_storeu_si128(reinterpret_cast<__m128i*>(planes[2] + i), narrow(p2));
  }
  if (i < count) {
    std::uint8_t* const rest[3] = {planes[0] + i, planes[1] + i, planes[2] + i};
    kPlainSlicKernels.opponentColours(bgr + 3 * i, count - i, rest);
  }
}

void smooth(const std::uint8_t* a, const std::uint8_t* b, const std::uint8_t* c, int count,
            std::uint8_t* out) {
  int i = 0;
  for (; i + 32 <= count; i += 32) {
    store(out + i, _mm256_avg_epu8(_mm256_avg_epu8(load(a + i), load(c + i)), load(b + i)));
  }
  if (i < count) kPlainSlicKernels.smooth(a + i, b + i, c + i, count - i, out + i);
}

void sumRows(const std::uint8_t* const* rows, const std::uint32_t* weights, int row_count,
             int count, std::uint32_t* sums) {
  bool fit = true;  // into the signed 16 bits of a multiply-add
  for (int row = 0; row < row_count; ++row) fit = fit && weights[row] <= 32767;
  const int whole = fit ? count / 16 * 16 : 0;
  for (int i = 0; i < whole; i += 16) {
    __m256i low = _mm256_setzero_si256(), high = low;
    for (int row = 0; row < row_count; row += 2) {
      // Two rows at a time; a missing second one has weight 0.
      const bool paired = row + 1 < row_count;
      const std::uint8_t* const second = rows[paired ? row + 1 : row];
      const __m256i weight =
          _mm256_set1_epi32(static_cast<int>(weights[row] | (paired ? weights[row + 1] << 16 : 0)));
      const __m128i a = _mm_loadu_si128(reinterpret_cast<const __m128i*>(rows[row] + i));
      const __m128i b = _mm_loadu_si128(reinterpret_cast<const __m128i*>(second + i));
      const __m256i pairs_low = _mm256_cvtepu8_epi16(_mm_unpacklo_epi8(a, b));
      const __m256i pairs_high = _mm256_cvtepu8_epi16(_mm_unpackhi_epi8(a, b));
      low = _mm256_add_epi32(low, _mm256_madd_epi16(pairs_low, weight));
      high = _mm256_add_epi32(high, _mm256_madd_epi16(pairs_high, weight));
    }
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(sums + i), low);
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(sums + i + 8), high);
  }
  for (int i = whole; i < count; ++i) {
    sums[i] = 0;
    for (int row = 0; row < row_count; ++row) sums[i] += weights[row] * rows[row][i];
  }
}

/// Sums / area in single precision, cut to integers.
struct FloatQuotient {
  __m128 divisor;
  __m128i operator()(__m128i sum) const {
    return _mm_cvttps_epi32(_mm_div_ps(_mm_cvtepi32_ps(sum), divisor));
  }
};

/// The same in double precision.
struct DoubleQuotient {
  __m256d divisor;
  __m128i operator()(__m128i sum) const {
    return _mm256_cvttpd_epi32(_mm256_div_pd(_mm256_cvtepi32_pd(sum), divisor));
  }
};

template <typename Quotient>
void averageColumnsBy(const Quotient& quotient, const std::uint32_t* sums,
                      const BoxColumns& columns, std::uint8_t* out) {
  // A pixel's channels in the lower three lanes; what the fourth writes is written again by the
  // next pixel.
  const auto at = [sums](std::ptrdiff_t pixel) {
    return _mm_loadu_si128(reinterpret_cast<const __m128i*>(sums + 3 * pixel));
  };
  const auto weighted = [](__m128i value, std::uint32_t weight) {
    return _mm_mullo_epi32(value, _mm_set1_epi32(static_cast<int>(weight)));
  };
  const __m128i half = _mm_set1_epi32(columns.area / 2);
  const __m128i low_bytes =
      _mm_setr_epi8(0, 4, 8, 12, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1);
  for (int i = 0; i < columns.count; ++i, out += 3) {
    const BoxSpan& span = columns.spans[i];
    __m128i between = _mm_setzero_si128();
    for (int j = 1; j < span.count - 1; ++j) between = _mm_add_epi32(between, at(span.first + j));
    __m128i sum = half;
    if (columns.whole_weight == 1) {
      // All weights are 1, but for the last one's 0 where there is one cell only.
      sum = _mm_add_epi32(sum, _mm_add_epi32(between, at(span.first)));
      if (span.count > 1) sum = _mm_add_epi32(sum, at(span.first + span.count - 1));
    } else {
      sum = _mm_add_epi32(sum, weighted(between, columns.whole_weight));
      sum = _mm_add_epi32(sum, weighted(at(span.first), span.first_weight));
      sum = _mm_add_epi32(sum, weighted(at(span.first + span.count - 1), span.last_weight));
    }
    const int bytes = _mm_cvtsi128_si32(_mm_shuffle_epi8(quotient(sum), low_bytes));
    __builtin_memcpy(out, &bytes, sizeof(bytes));
  }
}

void averageColumns(const std::uint32_t* sums, const BoxColumns& columns, std::uint8_t* out) {
  if (columns.area < kFloatBoxArea) {
    const FloatQuotient quotient{_mm_set1_ps(static_cast<float>(columns.area))};
    averageColumnsBy(quotient, sums, columns, out);
  } else {
    const DoubleQuotient quotient{_mm256_set1_pd(static_cast<double>(columns.area))};
    averageColumnsBy(quotient, sums, columns, out);
  }
}

static_assert(2 * kMaxBoxTap * 255 <= 32767, "two weighted columns in signed 16 bits");
static_assert(kMaxNarrowArea <= 32767, "weights of rows in signed 16 bits");

/// 16 bytes from `low` on and 16 from `high` on.
inline __m256i loadHalves(const std::uint8_t* low, const std::uint8_t* high) {
  return _mm256_inserti128_si256(
      _mm256_castsi128_si256(_mm_loadu_si128(reinterpret_cast<const __m128i*>(low))),
      _mm_loadu_si128(reinterpret_cast<const __m128i*>(high)), 1);
}

/// Box i, reading no more than it covers.
void averageNarrowBox(const std::uint8_t* const* rows, const std::uint32_t* weights, int row_count,
                      const NarrowBoxes& boxes, int i, std::uint8_t* out) {
  const BoxSpan& span = boxes.spans[i];
  const std::uint8_t* const taps = boxes.taps + static_cast<std::ptrdiff_t>(i) * kBoxTapBytes;
  const auto area = static_cast<std::uint32_t>(boxes.area);
  for (int c = 0; c < 3; ++c) {
    std::uint32_t sum = area / 2;
    for (int row = 0; row < row_count; ++row) {
      const std::uint8_t* const in = rows[row] + static_cast<std::ptrdiff_t>(3) * span.first + c;
      std::uint32_t across = 0;
      for (int k = 0; k < span.count; ++k) across += std::uint32_t{taps[k]} * in[3 * k];
      sum += weights[row] * across;
    }
    out[c] = static_cast<std::uint8_t>(sum / area);
  }
}

// The mean is the sum times 1 / area, plus half a box, plus half a unit of the sum, which keeps the
// result at least 1 / (2 area) >= 2^-14 from any integer: more than the errors of three roundings
// of numbers below 256, 2^-16 each. So the part before the point is exact.
void averageNarrowBoxes(const std::uint8_t* const* rows, const std::uint32_t* weights,
                        int row_count, int ahead_count, const NarrowBoxes& boxes,
                        std::uint8_t* out) {
  static_assert(4 * kBoxTaps * 3 <= 64, "four boxes reach into each cache line");
  // A box is read as 16 bytes: those at the end of a row may not have as many.
  int whole = boxes.count;
  while (whole > 0 && 3 * boxes.spans[whole - 1].first + 16 > 3 * boxes.source_width) --whole;
  whole = whole / 4 * 4;

  // The columns of a channel side by side, which two multiply-adds turn into one 32-bit sum.
  const __m256i by_channel = _mm256_broadcastsi128_si256(
      _mm_setr_epi8(0, 3, 6, 9, 1, 4, 7, 10, 2, 5, 8, 11, -1, -1, -1, -1));
  const __m256i three_of_four = _mm256_broadcastsi128_si256(
      _mm_setr_epi8(0, 1, 2, 4, 5, 6, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1));
  const float inverse = 1.0F / static_cast<float>(boxes.area);
  const __m256 scale = _mm256_set1_ps(inverse);
  const __m256 offset =
      _mm256_set1_ps((static_cast<float>(boxes.area / 2) + 0.5F) / static_cast<float>(boxes.area));
  const auto mean = [scale, offset](__m256i sum) {
    return _mm256_cvttps_epi32(
        _mm256_add_ps(_mm256_mul_ps(_mm256_cvtepi32_ps(sum), scale), offset));
  };
  for (int i = 0; i < whole; i += 4) {
    const BoxSpan* const spans = boxes.spans + i;
    const auto at = [spans](int k) { return static_cast<std::ptrdiff_t>(3) * spans[k].first; };
    const std::ptrdiff_t at0 = at(0), at1 = at(1), at2 = at(2), at3 = at(3);
    const std::uint8_t* const taps = boxes.taps + static_cast<std::ptrdiff_t>(i) * kBoxTapBytes;
    const __m256i taps02 = loadHalves(taps, taps + 2 * kBoxTapBytes);
    const __m256i taps13 = loadHalves(taps + kBoxTapBytes, taps + 3 * kBoxTapBytes);
    for (int row = row_count; row < row_count + ahead_count; ++row) {
      _mm_prefetch(reinterpret_cast<const char*>(rows[row] + at0), _MM_HINT_T0);
    }
    __m256i sum02 = _mm256_setzero_si256(), sum13 = sum02;
    for (int row = 0; row < row_count; ++row) {
      const std::uint8_t* const in = rows[row];
      const __m256i weight = _mm256_set1_epi16(static_cast<std::int16_t>(weights[row]));
      const auto across = [&](__m256i bytes, __m256i box_taps) {
        return _mm256_madd_epi16(
            _mm256_maddubs_epi16(_mm256_shuffle_epi8(bytes, by_channel), box_taps), weight);
      };
      sum02 = _mm256_add_epi32(sum02, across(loadHalves(in + at0, in + at2), taps02));
      sum13 = _mm256_add_epi32(sum13, across(loadHalves(in + at1, in + at3), taps13));
    }
    const __m256i words = _mm256_packs_epi32(mean(sum02), mean(sum13));
    const __m256i bytes = _mm256_shuffle_epi8(_mm256_packus_epi16(words, words), three_of_four);
    std::uint8_t* const to = out + static_cast<std::ptrdiff_t>(3) * i;
    _mm_storel_epi64(reinterpret_cast<__m128i*>(to), _mm256_castsi256_si128(bytes));
    _mm_storel_epi64(reinterpret_cast<__m128i*>(to + 6), _mm256_extracti128_si256(bytes, 1));
  }
  for (int i = whole; i < boxes.count; ++i) {
    averageNarrowBox(rows, weights, row_count, boxes, i, out + static_cast<std::ptrdiff_t>(3) * i);
  }
}

void runStarts(const std::uint8_t* index, int block_count, std::uint32_t* starts) {
  for (int block = 0; block < block_count; ++block, index += kBlockWidth) {
    const __m256i here = load(index);
    // The register moved up by a byte, across the lanes; its lowest byte does not count.
    const __m256i lower = _mm256_permute2x128_si256(here, here, 0x08);
    const __m256i before = _mm256_alignr_epi8(here, lower, 15);
    const auto equal =
        static_cast<std::uint32_t>(_mm256_movemask_epi8(_mm256_cmpeq_epi8(here, before)));
    starts[block] = ~equal & ~1U;
  }
}

}  // namespace

const SlicKernels kAvx2SlicKernels = {"avx2",   assign,  accumulate,     opponentColours,
                                      smooth,   sumRows, averageColumns, averageNarrowBoxes,
                                      runStarts};

}  // namespace semantic_lidar_fusion

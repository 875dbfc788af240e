// SPDX-License-Identifier: MIT
#include "paper_mask.h"

#include <algorithm>
#include <cstddef>
#include <cstring>

namespace semantic_lidar_fusion {
namespace {

/// A point inside the image. The bits of a positive float ascend with its value.
struct Candidate {
  std::uint32_t distance_bits;
  std::uint32_t point;
  std::int16_t column, row;
};

std::uint32_t bitsOf(float value) {
  std::uint32_t bits;
  std::memcpy(&bits, &value, sizeof(bits));
  return bits;
}

/// Stable: points of equal distance keep their order.
void sortByDistance(std::vector<Candidate>* candidates) {
  if (candidates->empty()) return;
  std::uint32_t least = ~std::uint32_t{0}, most = 0;
  for (const Candidate& c : *candidates) {
    least = std::min(least, c.distance_bits);
    most = std::max(most, c.distance_bits);
  }
  // The range of distances has fewer bits than a float; 10 or so at a time keep the counts in the
  // nearest cache.
  int bits = 0;
  while (bits < 32 && (most - least) >> bits != 0) ++bits;
  const int passes = (bits + 9) / 10;
  if (passes == 0) return;
  const int digit_bits = (bits + passes - 1) / passes;
  const std::uint32_t digit_mask = (std::uint32_t{1} << digit_bits) - 1;
  std::vector<Candidate> sorted(candidates->size());
  std::uint32_t begin[1 << 10];
  for (int pass = 0; pass < passes; ++pass) {
    const int shift = pass * digit_bits;
    const auto digit = [&](const Candidate& c) {
      return (c.distance_bits - least) >> shift & digit_mask;
    };
    std::fill_n(begin, digit_mask + 1, 0u);
    for (const Candidate& c : *candidates) ++begin[digit(c)];
    std::uint32_t sum = 0;
    for (std::uint32_t d = 0; d <= digit_mask; ++d) {
      const std::uint32_t count = begin[d];
      begin[d] = sum;
      sum += count;
    }
    for (const Candidate& c : *candidates) sorted[begin[digit(c)]++] = c;
    candidates->swap(sorted);
  }
}

}  // namespace

std::vector<std::uint8_t> visibleByPaper(const ProjectedPoints& points, const CameraModel& camera,
                                         const MaskSize& mask) {
  const ImageSize& size = camera.imageSize();
  const int half_width = (mask.width - 1) / 2, half_height = (mask.height - 1) / 2;
  std::vector<std::uint8_t> visible(points.size(), 0);
  std::vector<Candidate> candidates;
  candidates.reserve(points.size());
  int first_row = size.height, last_row = -1;
  for (std::size_t i = 0; i < points.size(); ++i) {
    if (!inImage(points.u[i], points.v[i], size)) continue;
    const int row = pixelIndex(points.v[i]);
    candidates.push_back({bitsOf(points.distance[i]), static_cast<std::uint32_t>(i),
                          static_cast<std::int16_t>(pixelIndex(points.u[i])),
                          static_cast<std::int16_t>(row)});
    first_row = std::min(first_row, row);
    last_row = std::max(last_row, row);
  }
  if (candidates.empty()) return visible;
  sortByDistance(&candidates);

  // One bit a pixel, columns contiguous (masks are tall), only the rows that hold points.
  const std::size_t words = static_cast<std::size_t>(last_row - first_row) / 64 + 1;
  std::vector<std::uint64_t> masked(words * static_cast<std::size_t>(size.width), 0);
  for (const Candidate& candidate : candidates) {
    const int u = candidate.column, v = candidate.row - first_row;
    const std::uint64_t* own = masked.data() + words * static_cast<std::size_t>(u);
    if (own[v / 64] >> (v % 64) & 1u) continue;
    visible[candidate.point] = 1;
    const int top = std::max(0, v - half_height);
    const int bottom = std::min(last_row - first_row, v + half_height);
    for (int x = std::max(0, u - half_width); x <= std::min(size.width - 1, u + half_width); ++x) {
      std::uint64_t* column = masked.data() + words * static_cast<std::size_t>(x);
      for (int word = top / 64; word <= bottom / 64; ++word) {
        const int from = std::max(top - 64 * word, 0), to = std::min(bottom - 64 * word, 63);
        column[word] |= (~std::uint64_t{0} >> (63 - to + from)) << from;
      }
    }
  }
  return visible;
}

}  // namespace semantic_lidar_fusion

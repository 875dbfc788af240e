// SPDX-License-Identifier: MIT
#include "box_reduction.h"

#include <algorithm>
#include <cstddef>
#include <numeric>

namespace semantic_lidar_fusion {
namespace {

constexpr int kMaxRowsAhead = 4;  ///< as many rows of a camera's image as a first-level cache holds

}  // namespace

BoxReduction::Axis::Axis(int source_count, int target_count) {
  const int divisor = std::gcd(source_count, target_count);
  target_units = source_count / divisor;
  source_units = target_count / divisor;
}

BoxSpan BoxReduction::Axis::span(int target_index) const {
  const std::int64_t begin = target_index * target_units, end = begin + target_units;
  const std::int64_t first = begin / source_units, last = (end - 1) / source_units;
  const std::int64_t first_end = std::min(end, (first + 1) * source_units);
  return {static_cast<int>(first), static_cast<int>(last - first + 1),
          static_cast<std::uint32_t>(first_end - begin),
          static_cast<std::uint32_t>(first == last ? 0 : end - last * source_units)};
}

BoxReduction::BoxReduction(const ImageSize& source, const ImageSize& target, int channels)
    : source_(source),
      target_(target),
      channels_(channels),
      x_(source.width, target.width),
      y_(source.height, target.height) {
  for (int x = 0; x < target.width; ++x) columns_.push_back(x_.span(x));
  // Some entries more than there are, as the kernels want it.
  row_sums_.resize(static_cast<std::size_t>(source.width) * channels + 1);
  result_.resize(static_cast<std::size_t>(target.width) * channels + 4);
  fillTaps();
}

void BoxReduction::fillTaps() {
  const auto narrow = [](const BoxSpan& span) { return span.count <= kBoxTaps; };
  if (channels_ != 3 || x_.source_units > kMaxBoxTap ||
      x_.target_units * y_.target_units > kMaxNarrowArea ||
      !std::all_of(columns_.begin(), columns_.end(), narrow)) {
    return;
  }
  taps_.assign(columns_.size() * kBoxTapBytes, 0);
  std::uint8_t* taps = taps_.data();
  for (const BoxSpan& span : columns_) {
    for (int c = 0; c < channels_; ++c) {
      std::uint8_t* const of_channel = taps + static_cast<std::ptrdiff_t>(c) * kBoxTaps;
      std::fill_n(of_channel, span.count, static_cast<std::uint8_t>(x_.source_units));
      of_channel[0] = static_cast<std::uint8_t>(span.first_weight);
      if (span.count > 1) {
        of_channel[span.count - 1] = static_cast<std::uint8_t>(span.last_weight);
      }
    }
    taps += kBoxTapBytes;
  }
}

/// For any number of channels and any area.
void BoxReduction::averageAnyColumns() {
  const std::int64_t area = x_.target_units * y_.target_units;
  std::uint8_t* out = result_.data();
  for (const BoxSpan& span : columns_) {
    const std::uint32_t* in = &row_sums_[static_cast<std::size_t>(span.first) * channels_];
    const int last = (span.count - 1) * channels_;
    for (int c = 0; c < channels_; ++c) {
      std::int64_t between = 0;
      for (int i = channels_ + c; i < last; i += channels_) between += in[i];
      const std::int64_t sum = static_cast<std::int64_t>(span.first_weight) * in[c] +
                               x_.source_units * between +
                               static_cast<std::int64_t>(span.last_weight) * in[last + c];
      *out++ = static_cast<std::uint8_t>((sum + area / 2) / area);
    }
  }
}

const std::uint8_t* BoxReduction::row(const cv::Mat& image, int y, const SlicKernels& kernels) {
  if (source_ == target_) return image.ptr(y);

  const BoxSpan span = y_.span(y);
  rows_.clear();
  for (int i = 0; i < span.count; ++i) rows_.push_back(image.ptr(span.first + i));
  row_weights_.assign(span.count, static_cast<std::uint32_t>(y_.source_units));
  row_weights_.front() = span.first_weight;
  if (span.count > 1) row_weights_.back() = span.last_weight;
  const std::int64_t area = x_.target_units * y_.target_units;
  if (!taps_.empty() && kernels.averageNarrowBoxes != nullptr) {
    int ahead = 0;
    if (y + 1 < target_.height) {
      const BoxSpan next = y_.span(y + 1);
      ahead = next.first + next.count - (span.first + span.count);
      ahead = std::min(ahead, kMaxRowsAhead);
    }
    for (int i = 0; i < ahead; ++i) rows_.push_back(image.ptr(span.first + span.count + i));
    kernels.averageNarrowBoxes(
        rows_.data(), row_weights_.data(), span.count, ahead,
        {columns_.data(), taps_.data(), target_.width, source_.width, static_cast<int>(area)},
        result_.data());
    return result_.data();
  }
  kernels.sumRows(rows_.data(), row_weights_.data(), span.count, source_.width * channels_,
                  row_sums_.data());
  if (channels_ == 3 && area < kMostBoxArea) {
    kernels.averageColumns(row_sums_.data(),
                           {columns_.data(), target_.width,
                            static_cast<std::uint32_t>(x_.source_units), static_cast<int>(area)},
                           result_.data());
  } else {
    averageAnyColumns();
  }
  return result_.data();
}

}  // namespace semantic_lidar_fusion

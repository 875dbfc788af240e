// SPDX-License-Identifier: MIT
#include "box_reduction.h"

#include <algorithm>
#include <numeric>

namespace semantic_lidar_fusion {
namespace {

// Below this area of a box (in units) the quotient of two floats, cut to an integer, is exact:
// numerators stay below 2^24, and a quotient below 256 that is no integer is at least 1 / area from
// the next one, more than its rounding error of 2^-17.
constexpr std::int64_t kFloatDivisionArea = 1 << 16;

}  // namespace

BoxReduction::Axis::Axis(int source_count, int target_count) {
  const int divisor = std::gcd(source_count, target_count);
  target_units = source_count / divisor;
  source_units = target_count / divisor;
}

BoxReduction::Span BoxReduction::Axis::span(int target_index) const {
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
  row_sums_.resize(static_cast<std::size_t>(source.width) * channels);
  result_.resize(static_cast<std::size_t>(target.width) * channels);
}

template <typename Sum>
void BoxReduction::sumColumns(std::vector<Sum>* sums) const {
  sums->resize(result_.size());
  Sum* out = sums->data();
  const Sum whole = static_cast<Sum>(x_.source_units);
  for (const Span& span : columns_) {
    const std::uint32_t* in = &row_sums_[static_cast<std::size_t>(span.first) * channels_];
    const int last = (span.count - 1) * channels_;
    for (int c = 0; c < channels_; ++c) {
      Sum between = 0;
      for (int i = channels_ + c; i < last; i += channels_) between += in[i];
      *out++ = static_cast<Sum>(span.first_weight) * static_cast<Sum>(in[c]) + whole * between +
               static_cast<Sum>(span.last_weight) * static_cast<Sum>(in[last + c]);
    }
  }
}

const std::uint8_t* BoxReduction::row(const cv::Mat& image, int y, const SlicKernels& kernels) {
  if (source_ == target_) return image.ptr(y);

  const Span span = y_.span(y);
  rows_.clear();
  for (int i = 0; i < span.count; ++i) rows_.push_back(image.ptr(span.first + i));
  row_weights_.assign(span.count, static_cast<std::uint32_t>(y_.source_units));
  row_weights_.front() = span.first_weight;
  if (span.count > 1) row_weights_.back() = span.last_weight;
  kernels.sumRows(rows_.data(), row_weights_.data(), span.count, static_cast<int>(row_sums_.size()),
                  row_sums_.data());

  const std::int64_t area = x_.target_units * y_.target_units;
  if (area < kFloatDivisionArea) {
    sumColumns(&small_sums_);
    const auto half = static_cast<std::int32_t>(area / 2);
    const auto divisor = static_cast<float>(area);
    for (std::size_t i = 0; i < result_.size(); ++i) {
      result_[i] = static_cast<std::uint8_t>(
          static_cast<int>(static_cast<float>(small_sums_[i] + half) / divisor));
    }
  } else {
    sumColumns(&sums_);
    for (std::size_t i = 0; i < result_.size(); ++i) {
      result_[i] = static_cast<std::uint8_t>((sums_[i] + area / 2) / area);
    }
  }
  return result_.data();
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <opencv2/core.hpp>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"
#include "slic_kernels.h"

namespace semantic_lidar_fusion {

/// Brings 8-bit images to another size, a row at a time: each target pixel is the mean of the
/// source over its box, rounded to nearest, in exact arithmetic whatever the ratio of the sizes.
class BoxReduction {
 public:
  BoxReduction() = default;
  BoxReduction(const ImageSize& source, const ImageSize& target, int channels);

  bool fits(const ImageSize& source, const ImageSize& target, int channels) const {
    return source == source_ && target == target_ && channels == channels_;
  }
  /// Row `y` of the target, target width * channels bytes; valid until the next call. `image` has
  /// the source size and the channels that were given.
  const std::uint8_t* row(const cv::Mat& image, int y, const SlicKernels& kernels);

 private:
  /// One axis, in a unit that divides both cells: a target cell has `target_units`, a source cell
  /// `source_units`, which is also the weight of a whole one.
  struct Axis {
    Axis() = default;
    Axis(int source_count, int target_count);
    BoxSpan span(int target_index) const;
    std::int64_t target_units = 1, source_units = 1;
  };
  void fillTaps();
  void averageAnyColumns();

  ImageSize source_, target_;
  int channels_ = 0;
  Axis x_, y_;
  std::vector<BoxSpan> columns_;    ///< of each target column
  std::vector<std::uint8_t> taps_;  ///< as in NarrowBoxes; empty if some box does not fit there
  std::vector<const std::uint8_t*> rows_;
  std::vector<std::uint32_t> row_weights_, row_sums_;
  std::vector<std::uint8_t> result_;
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// What an image says of its pixels: their class distributions, and where nothing is transferred.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <opencv2/core.hpp>
#include <vector>

#include "semantic_lidar_fusion/common/cell_grid.h"
#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/fusion/semantic_projector.h"
#include "semantic_lidar_fusion/superpixel/uncertainty.h"

namespace semantic_lidar_fusion {

/// Cells of one grid under the pixel centres of another, tabulated per column and row.
class GridTable {
 public:
  GridTable(const ImageSize& source, const ImageSize& target)
      : column_(cellsUnderCentres(source.width, target.width)),
        row_(cellsUnderCentres(source.height, target.height)) {}
  /// From `source` through the grid `between`.
  GridTable(const ImageSize& source, const ImageSize& between, const ImageSize& target)
      : GridTable(source, between) {
    const GridTable next(between, target);
    for (int& column : column_) column = next.column(column);
    for (int& row : row_) row = next.row(row);
  }

  int column(int source_column) const { return column_[static_cast<std::size_t>(source_column)]; }
  int row(int source_row) const { return row_[static_cast<std::size_t>(source_row)]; }

 private:
  std::vector<int> column_, row_;
};

inline ImageSize sizeOf(const cv::Mat& image) { return {image.cols, image.rows}; }

/// Whether a pixel of the image may transfer; without a mask, all may.
class EgoMask {
 public:
  EgoMask(const cv::Mat& mask, const ImageSize& image)
      : mask_(mask), table_(mask.empty() ? ImageSize{} : image, sizeOf(mask)) {}

  bool hides(int column, int row) const {
    return !mask_.empty() && mask_.at<std::uint8_t>(table_.row(row), table_.column(column)) == 0;
  }

 private:
  cv::Mat mask_;
  GridTable table_;
};

/// The class distribution of an image pixel (paper, eq. 3 and 4).
class PixelDistribution {
 public:
  PixelDistribution(const ImageSemantics& semantics, const ImageSize& image,
                    const UncertaintyConfig& config, int class_count)
      : semantics_(semantics),
        config_(config),
        class_count_(class_count),
        lazy_(semantics.probabilities.empty()),
        to_superpixel_(image, superpixelSize()),
        to_score_(lazy_ ? image : ImageSize{}, superpixelSize(), semantics.scores.size()) {
    const ImageSize q = superpixelSize();
    cells_wide_ = q.width;
    const ImageSize scores = lazy_ ? semantics.scores.size() : q;
    cell_px_ << static_cast<double>(image.width) / std::min(q.width, scores.width),
        static_cast<double>(image.height) / std::min(q.height, scores.height);
  }

  /// Pixels of one cell have one distribution.
  std::int32_t cell(int column, int row) const {
    return to_superpixel_.row(row) * cells_wide_ + to_superpixel_.column(column);
  }
  std::size_t cellCount() const {
    const ImageSize size = superpixelSize();
    return static_cast<std::size_t>(size.width) * static_cast<std::size_t>(size.height);
  }
  /// Width and height of what has one score, px.
  Eigen::Vector2d cellPx() const { return cell_px_; }

  /// Asks the memory for what `read` will need.
  void prefetch(int column, int row) const {
    const int q_column = to_superpixel_.column(column), q_row = to_superpixel_.row(row);
    if (!lazy_) {
      prefetchCell(semantics_.probabilities.ptr<float>(q_row), q_column);
      return;
    }
    __builtin_prefetch(semantics_.share.ptr<float>(q_row) + q_column);
    const float* scores = semantics_.scores.floatRow(to_score_.row(row));
    if (scores != nullptr) prefetchCell(scores, to_score_.column(column));
  }

  /// Writes class_count values that sum to 1; false if they are uniform for want of valid input.
  /// `scratch` has room for class_count values.
  bool read(int column, int row, float* scratch, double* out) const {
    const int q_column = to_superpixel_.column(column), q_row = to_superpixel_.row(row);
    if (!lazy_) return readProbabilities(q_column, q_row, out);
    const int score_column = to_score_.column(column), score_row = to_score_.row(row);
    const float* scores = semantics_.scores.floatRow(score_row);
    if (scores != nullptr) {
      scores += static_cast<std::ptrdiff_t>(score_column) * class_count_;
    } else {
      semantics_.scores.read(score_column, score_row, scratch);
      scores = scratch;
    }
    const double share = semantics_.share.at<float>(q_row, q_column);
    return temperedSoftmax(scores, class_count_, share, config_, out);
  }

 private:
  ImageSize superpixelSize() const {
    return sizeOf(lazy_ ? semantics_.share : semantics_.probabilities);
  }

  void prefetchCell(const float* row, int column) const {
    const float* cell = row + static_cast<std::ptrdiff_t>(column) * class_count_;
    __builtin_prefetch(cell);
    __builtin_prefetch(cell + class_count_ - 1);
  }

  bool readProbabilities(int q_column, int q_row, double* out) const {
    const float* p = semantics_.probabilities.ptr<float>(q_row) +
                     static_cast<std::ptrdiff_t>(q_column) * class_count_;
    double sum = 0;
    bool valid = true;
    for (int c = 0; c < class_count_; ++c) {
      valid = valid && p[c] >= 0;
      sum += p[c];
    }
    if (!valid || !std::isfinite(sum) || !(sum > 0)) {
      std::fill(out, out + class_count_, 1.0 / class_count_);
      return false;
    }
    // What only rounding to float moved off 1 passes bit for bit.
    const double factor = std::abs(sum - 1.0) < 1e-6 ? 1.0 : 1.0 / sum;
    for (int c = 0; c < class_count_; ++c) out[c] = p[c] * factor;
    return true;
  }

  const ImageSemantics& semantics_;
  const UncertaintyConfig& config_;
  int class_count_;
  bool lazy_;
  int cells_wide_;
  Eigen::Vector2d cell_px_;
  GridTable to_superpixel_;
  GridTable to_score_;  ///< from image pixels, through superpixel pixels
};

}  // namespace semantic_lidar_fusion

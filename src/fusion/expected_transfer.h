// SPDX-License-Identifier: MIT
/// The transfer of expected distributions: P of a point is the mean over the ellipse of its pixel,
/// by sigma points. Neighbouring points read the same cells of the image, so the distribution of
/// each cell is made once.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "pixel_distribution.h"
#include "semantic_lidar_fusion/uncertainty/pixel_covariance.h"

namespace semantic_lidar_fusion {

/// The cells that the votes of one camera read, and with which weights.
class ExpectedTransfer {
 public:
  /// An axis of an ellipse shorter than this part of a cell's width has no sigma points.
  static constexpr float kNegligible = 1.0f / 3.0f;

  /// `u`, `v`, `covariances`: of the votes. Sigma points outside the image or on masked pixels are
  /// left out, and the others have their weight.
  ExpectedTransfer(const std::vector<float>& u, const std::vector<float>& v,
                   const PixelCovariances& covariances, const ImageSize& image, const EgoMask& mask,
                   const PixelDistribution& distribution, int class_count);

  /// How many cells are read.
  std::size_t cells() const { return pixel_.size(); }
  /// Makes the distributions of cells [begin, end). Shares of cells may run in parallel.
  void readCells(const PixelDistribution& distribution, std::size_t begin, std::size_t end);
  /// Writes the expected distribution of a vote, once all cells are read; false if the cell of its
  /// own pixel has a uniform one for want of valid input.
  bool expect(std::size_t vote, double* out) const;

 private:
  struct Pixel {
    int column, row;
  };

  std::size_t classes_;
  std::vector<Pixel> pixel_;            ///< by cell: one that reads it
  std::vector<double> distribution_;    ///< by cell and class
  std::vector<std::uint8_t> valid_;     ///< by cell
  std::vector<std::uint32_t> begin_;    ///< by vote, one more than votes: into the next two
  std::vector<std::uint32_t> cell_of_;  ///< the first is that of the vote's own pixel
  std::vector<float> weight_;           ///< sum 1 of each vote, to rounding
};

}  // namespace semantic_lidar_fusion

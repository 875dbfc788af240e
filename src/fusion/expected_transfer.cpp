// SPDX-License-Identifier: MIT
#include "expected_transfer.h"

#include <algorithm>

namespace semantic_lidar_fusion {

ExpectedTransfer::ExpectedTransfer(const std::vector<float>& u, const std::vector<float>& v,
                                   const PixelCovariances& covariances, const ImageSize& image,
                                   const EgoMask& mask, const PixelDistribution& distribution,
                                   int class_count)
    : classes_(static_cast<std::size_t>(class_count)) {
  constexpr std::size_t kMostPoints = 9;
  const std::size_t votes = u.size();
  const Eigen::Vector2d cell_px = distribution.cellPx();
  // Ellipses are taken apart in cells, which may be wider than high.
  const auto wide = static_cast<float>(cell_px.x()), high = static_cast<float>(cell_px.y());
  const float uu = 1.0f / (wide * wide), uv = 1.0f / (wide * high), vv = 1.0f / (high * high);
  // By cell of the image: its place among those that are read.
  constexpr std::uint32_t kUnread = 0xFFFFFFFFu;
  std::vector<std::uint32_t> number(distribution.cellCount(), kUnread);
  begin_.reserve(votes + 1);
  cell_of_.reserve(kMostPoints * votes);
  weight_.reserve(kMostPoints * votes);
  begin_.push_back(0);
  for (std::size_t k = 0; k < votes; ++k) {
    const SigmaPoints points = sigmaPoints(uu * covariances.uu[k], uv * covariances.uv[k],
                                           vv * covariances.vv[k], kNegligible);
    const std::size_t first = cell_of_.size();
    float total = 0.0f;
    for (int i = 0; i < points.count; ++i) {
      const float at_u = u[k] + wide * points.du[i], at_v = v[k] + high * points.dv[i];
      if (!inImage(at_u, at_v, image)) continue;
      const Pixel pixel{pixelIndex(at_u), pixelIndex(at_v)};
      if (mask.hides(pixel.column, pixel.row)) continue;
      std::uint32_t& cell =
          number[static_cast<std::size_t>(distribution.cell(pixel.column, pixel.row))];
      if (cell == kUnread) {
        cell = static_cast<std::uint32_t>(pixel_.size());
        pixel_.push_back(pixel);
      }
      total += points.weight[i];
      std::size_t at = first;
      while (at < cell_of_.size() && cell_of_[at] != cell) ++at;
      if (at < cell_of_.size()) {
        weight_[at] += points.weight[i];
      } else {
        cell_of_.push_back(cell);
        weight_.push_back(points.weight[i]);
      }
    }
    // A vote of one cell keeps its distribution bit for bit.
    for (std::size_t at = first; at < weight_.size(); ++at) weight_[at] /= total;
    begin_.push_back(static_cast<std::uint32_t>(cell_of_.size()));
  }
  distribution_.resize(pixel_.size() * classes_);
  valid_.resize(pixel_.size());
}

void ExpectedTransfer::readCells(const PixelDistribution& distribution, std::size_t begin,
                                 std::size_t end) {
  constexpr std::size_t kAhead = 16;  // enough to hide a trip to the memory
  std::vector<float> scratch(classes_);
  for (std::size_t k = begin; k < std::min(begin + kAhead, end); ++k) {
    distribution.prefetch(pixel_[k].column, pixel_[k].row);
  }
  for (std::size_t k = begin; k < end; ++k) {
    if (k + kAhead < end) {
      distribution.prefetch(pixel_[k + kAhead].column, pixel_[k + kAhead].row);
    }
    valid_[k] = distribution.read(pixel_[k].column, pixel_[k].row, scratch.data(),
                                  &distribution_[k * classes_])
                    ? 1
                    : 0;
  }
}

bool ExpectedTransfer::expect(std::size_t vote, double* out) const {
  const std::uint32_t begin = begin_[vote], end = begin_[vote + 1];
  const double* own = &distribution_[cell_of_[begin] * classes_];
  const double own_weight = weight_[begin];
  for (std::size_t c = 0; c < classes_; ++c) out[c] = own_weight * own[c];
  double total = own_weight;
  for (std::uint32_t k = begin + 1; k < end; ++k) {
    const double* p = &distribution_[cell_of_[k] * classes_];
    const double weight = weight_[k];
    for (std::size_t c = 0; c < classes_; ++c) out[c] += weight * p[c];
    total += weight;
  }
  if (end - begin > 1) {
    const double factor = 1.0 / total;
    for (std::size_t c = 0; c < classes_; ++c) out[c] *= factor;
  }
  return valid_[cell_of_[begin]] != 0;
}

}  // namespace semantic_lidar_fusion

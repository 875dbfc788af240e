// SPDX-License-Identifier: MIT
/// Class uncertainty from superpixels and score maps (paper, eq. 1-4).
///
/// Within a superpixel k, spp_k is the share of its most frequent label. It sets the temperature
/// tau_k = temperature / spp_k^exponent (eq. 4: 1 / spp_k^2) of the softmax over the scores
/// (eq. 3). A score cell with a non-finite score has a uniform distribution and no vote.
///
/// Grids: pixel q of the superpixel map reads the score cell under its centre (cellUnderCentre).
#pragma once

#include <cstddef>
#include <opencv2/core.hpp>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/superpixel/superpixel_map.h"

namespace semantic_lidar_fusion {

struct UncertaintyConfig {
  double temperature = 1.0;  ///< of a pure superpixel, > 0; the paper's is 1
  double exponent = 2.0;     ///< of the share, >= 0; the paper's is 2, 0 ignores the share
  double blend = 0.0;  ///< part of the superpixel's mean in the scores, 0..1; the paper's is 0
};

/// How integer score images become scores: S = scale * value + offset. Float scores ignore it.
struct ScoreFormat {
  double scale = 1.0;
  double offset = 0.0;
};

/// Unnormalised class scores S(c): rows x columns x class_count, channel = class id.
class ScoreMap {
 public:
  ScoreMap() = default;
  /// `scores`: CV_32FC(n), CV_16UC(n) or CV_8UC(n), not copied. Throws DataError on an empty image,
  /// another depth, or channels other than `class_count`.
  ScoreMap(const cv::Mat& scores, int class_count, const ScoreFormat& format);

  bool empty() const { return scores_.empty(); }
  ImageSize size() const { return {scores_.cols, scores_.rows}; }
  int classCount() const { return scores_.channels(); }
  /// Writes the scores of one cell to `out[0..classCount)`; false if one is not finite.
  bool read(int column, int row, float* out) const;
  /// The scores of a row's cells one after the other; null where they need a conversion.
  const float* floatRow(int row) const {
    return scores_.depth() == CV_32F ? scores_.ptr<float>(row) : nullptr;
  }
  /// The values of a row's cells one after the other, where they are of type `Value` and rank as
  /// their scores do, in single precision too: without equal scores of different values. Else null.
  template <typename Value>
  const Value* rankedRow(int row) const {
    return ranked_ && scores_.depth() == cv::DataType<Value>::depth ? scores_.ptr<Value>(row)
                                                                    : nullptr;
  }
  /// Whether ranked values have the higher score the lower they are.
  bool lowestIsHighest() const { return format_.scale < 0.0; }

 private:
  float scoreOf(int value) const {
    return static_cast<float>(format_.scale * value + format_.offset);
  }

  cv::Mat scores_;
  ScoreFormat format_;
  bool ranked_ = false;  ///< integers that rankedRow() gives
};

/// Share of the most frequent label per superpixel.
struct ShareMap {
  cv::Mat share;                  ///< CV_32FC1, the superpixel map's size, in (0, 1]
  std::vector<float> superpixel;  ///< spp_k
  std::size_t nonfinite_cells =
      0;  ///< superpixel-map pixels whose score cell holds a non-finite score
};

/// spp_k: pixels of the most frequent label / voting pixels (1 if none votes). The label of a pixel
/// is the argmax of its score cell, the lowest id on ties.
ShareMap computeShare(const SuperpixelMap& superpixels, const ScoreMap& scores);

/// Eq. 3 with tau = temperature / share^exponent: `probabilities[0..class_count)` in double,
/// summing to 1, stable for scores of +-1e4 and more. Non-finite scores or a share outside (0, 1]
/// give the uniform distribution and false. `probabilities` must not overlap `scores`.
bool temperedSoftmax(const float* scores, int class_count, double share,
                     const UncertaintyConfig& config, double* probabilities);

/// P(c) of every superpixel-map pixel, CV_32FC(n); the same numbers as temperedSoftmax at the
/// pixel.
cv::Mat denseProbabilities(const ScoreMap& scores, const cv::Mat& share,
                           const UncertaintyConfig& config);

/// Scores averaged with their superpixel's mean: (1 - blend) S + blend mean, CV_32FC(n) of the
/// superpixel map's size. The mean is over the superpixel's clustered pixels with finite scores; a
/// pixel without keeps what its cell holds. `blend` in 0..1. Throws DataError on an empty map.
cv::Mat blendScores(const SuperpixelMap& superpixels, const ScoreMap& scores, double blend);

/// Label-only input: P = histogram of the labels within the pixel's superpixel,
/// CV_32FC(class_count) of the superpixel map's size. `labels`: CV_8UC1, any size; ids >=
/// class_count do not vote; a superpixel without votes is uniform. Throws DataError on another
/// type.
cv::Mat histogramProbabilities(const SuperpixelMap& superpixels, const cv::Mat& labels,
                               int class_count);

}  // namespace semantic_lidar_fusion

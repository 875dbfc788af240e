// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/superpixel/uncertainty.h"

#include <algorithm>
#include <cmath>
#include <string>

#include "score_kernels.h"
#include "semantic_lidar_fusion/common/cell_grid.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/softmax_kernels.h"

namespace semantic_lidar_fusion {
namespace {

void checkClassCount(int class_count) {
  if (class_count < 1 || class_count > CV_CN_MAX) {
    throw DataError("class count is " + std::to_string(class_count) + ", must be 1.." +
                    std::to_string(CV_CN_MAX));
  }
}

/// Votes per superpixel and class, and their sums.
struct Histogram {
  Histogram(int superpixel_count, int class_count)
      : class_count(class_count),
        votes(static_cast<std::size_t>(superpixel_count) * class_count),
        totals(superpixel_count) {}

  void add(int superpixel, int label) {
    ++votes[static_cast<std::size_t>(superpixel) * class_count + label];
    ++totals[superpixel];
  }
  const int* of(int superpixel) const {
    return &votes[static_cast<std::size_t>(superpixel) * class_count];
  }

  int class_count;
  std::vector<int> votes;
  std::vector<int> totals;
};

/// Lets every pixel of the map vote. `label_row(row, labels)` writes the labels of a whole source
/// row, or kNoVote; it is asked once per needed row. Returns the votes withheld.
template <typename LabelRow>
std::size_t vote(const SuperpixelMap& superpixels, const ImageSize& source,
                 const LabelRow& label_row, Histogram* histogram) {
  const cv::Mat& ids = superpixels.ids;
  const std::vector<int> columns = cellsUnderCentres(ids.cols, source.width);
  std::vector<int> labels(source.width);
  std::size_t withheld = 0;
  int labelled_row = -1;
  for (int y = 0; y < ids.rows; ++y) {
    const int row = cellUnderCentre(y, ids.rows, source.height);
    if (row != labelled_row) label_row(row, labels.data());
    labelled_row = row;
    const int* id = ids.ptr<int>(y);
    for (int x = 0; x < ids.cols; ++x) {
      const int label = labels[columns[x]];
      if (label == kNoVote) {
        ++withheld;
      } else {
        histogram->add(id[x], label);
      }
    }
  }
  return withheld;
}

void fillUniform(int class_count, double* probabilities) {
  std::fill_n(probabilities, class_count, 1.0 / class_count);
}

/// 1 / tau (eq. 4).
double inverseTemperature(double share, const UncertaintyConfig& config) {
  const double power = config.exponent == 2.0 ? share * share : std::pow(share, config.exponent);
  return power / config.temperature;
}

}  // namespace

ScoreMap::ScoreMap(const cv::Mat& scores, int class_count, const ScoreFormat& format)
    : scores_(scores), format_(format) {
  if (scores.empty() || scores.dims != 2) {
    throw DataError("score image is empty or not two-dimensional, must be rows x columns");
  }
  if (scores.depth() != CV_32F && scores.depth() != CV_16U && scores.depth() != CV_8U) {
    throw DataError("score image has OpenCV depth " + std::to_string(scores.depth()) +
                    ", must be 32F, 16U or 8U");
  }
  if (scores.channels() != class_count) {
    throw DataError("score image has " + std::to_string(scores.channels()) +
                    " channels, must have one per class: " + std::to_string(class_count));
  }
}

bool ScoreMap::read(int column, int row, float* out) const {
  const int count = scores_.channels();
  const std::size_t first = static_cast<std::size_t>(column) * count;
  bool finite = true;
  const auto convert = [&](const auto* cell) {
    for (int c = 0; c < count; ++c) {
      out[c] = static_cast<float>(format_.scale * cell[c] + format_.offset);
      finite = finite && std::isfinite(out[c]);
    }
  };
  switch (scores_.depth()) {
    case CV_8U:
      convert(scores_.ptr<std::uint8_t>(row) + first);
      break;
    case CV_16U:
      convert(scores_.ptr<std::uint16_t>(row) + first);
      break;
    default: {
      const float* cell = scores_.ptr<float>(row) + first;
      for (int c = 0; c < count; ++c) {
        out[c] = cell[c];
        finite = finite && std::isfinite(cell[c]);
      }
    }
  }
  return finite;
}

ShareMap computeShare(const SuperpixelMap& superpixels, const ScoreMap& scores) {
  if (scores.empty()) throw DataError("score map is empty, must have at least one cell");
  const int class_count = scores.classCount();
  std::vector<float> converted(static_cast<std::size_t>(scores.size().width) * class_count);
  const LabelCells label_cells = labelCells();
  const auto label_row = [&](int row, int* labels) {
    const float* cells = scores.floatRow(row);
    if (cells == nullptr) {
      for (int x = 0; x < scores.size().width; ++x) {
        scores.read(x, row, &converted[static_cast<std::size_t>(x) * class_count]);
      }
      cells = converted.data();
    }
    label_cells(cells, scores.size().width, class_count, labels);
  };

  ShareMap result;
  Histogram histogram(superpixels.count, class_count);
  result.nonfinite_cells = vote(superpixels, scores.size(), label_row, &histogram);

  result.superpixel.resize(superpixels.count);
  for (int k = 0; k < superpixels.count; ++k) {
    const int* votes = histogram.of(k);
    const int most = *std::max_element(votes, votes + class_count);
    // A superpixel without votes has only uniform cells: any temperature leaves them so.
    result.superpixel[k] =
        histogram.totals[k] == 0
            ? 1.0F
            : static_cast<float>(static_cast<double>(most) / histogram.totals[k]);
  }

  result.share.create(superpixels.ids.size(), CV_32FC1);
  for (int y = 0; y < superpixels.ids.rows; ++y) {
    const int* id = superpixels.ids.ptr<int>(y);
    float* share = result.share.ptr<float>(y);
    for (int x = 0; x < superpixels.ids.cols; ++x) share[x] = result.superpixel[id[x]];
  }
  return result;
}

bool temperedSoftmax(const float* scores, int class_count, double share,
                     const UncertaintyConfig& config, double* probabilities) {
  if (class_count < 1) return false;
  static const SoftmaxKernels& kernels = softmaxKernels();
  if (share > 0.0 && share <= 1.0 &&
      kernels.softmax(scores, class_count, inverseTemperature(share, config), probabilities)) {
    return true;
  }
  fillUniform(class_count, probabilities);
  return false;
}

cv::Mat denseProbabilities(const ScoreMap& scores, const cv::Mat& share,
                           const UncertaintyConfig& config) {
  if (scores.empty()) throw DataError("score map is empty, must have at least one cell");
  if (share.empty() || share.type() != CV_32FC1) {
    throw DataError("share image is " + sizeText({share.cols, share.rows}) + " of OpenCV type " +
                    std::to_string(share.type()) + ", must be non-empty 32FC1");
  }
  const int class_count = scores.classCount();
  const std::vector<int> columns = cellsUnderCentres(share.cols, scores.size().width);
  const std::vector<int> rows = cellsUnderCentres(share.rows, scores.size().height);
  std::vector<float> cell(class_count);
  std::vector<double> distribution(class_count);
  cv::Mat result(share.size(), CV_32FC(class_count));
  for (int y = 0; y < share.rows; ++y) {
    const float* share_row = share.ptr<float>(y);
    float* out = result.ptr<float>(y);
    for (int x = 0; x < share.cols; ++x, out += class_count) {
      const bool repeated =
          x > 0 && columns[x] == columns[x - 1] && share_row[x] == share_row[x - 1];
      if (!repeated) {
        scores.read(columns[x], rows[y], cell.data());
        temperedSoftmax(cell.data(), class_count, share_row[x], config, distribution.data());
      }
      std::copy(distribution.begin(), distribution.end(), out);
    }
  }
  return result;
}

cv::Mat histogramProbabilities(const SuperpixelMap& superpixels, const cv::Mat& labels,
                               int class_count) {
  checkClassCount(class_count);
  if (labels.empty() || labels.type() != CV_8UC1) {
    throw DataError("label image is " + sizeText({labels.cols, labels.rows}) + " of OpenCV type " +
                    std::to_string(labels.type()) + ", must be non-empty 8UC1 (mono8)");
  }
  const auto label_row = [&](int row, int* row_labels) {
    const std::uint8_t* in = labels.ptr<std::uint8_t>(row);
    for (int x = 0; x < labels.cols; ++x) row_labels[x] = in[x] < class_count ? in[x] : kNoVote;
  };
  Histogram histogram(superpixels.count, class_count);
  vote(superpixels, {labels.cols, labels.rows}, label_row, &histogram);

  std::vector<float> probabilities(histogram.votes.size());
  for (int k = 0; k < superpixels.count; ++k) {
    const int* votes = histogram.of(k);
    float* out = &probabilities[static_cast<std::size_t>(k) * class_count];
    for (int c = 0; c < class_count; ++c) {
      out[c] = static_cast<float>(histogram.totals[k] == 0
                                      ? 1.0 / class_count
                                      : static_cast<double>(votes[c]) / histogram.totals[k]);
    }
  }
  cv::Mat result(superpixels.ids.size(), CV_32FC(class_count));
  for (int y = 0; y < result.rows; ++y) {
    const int* id = superpixels.ids.ptr<int>(y);
    float* out = result.ptr<float>(y);
    for (int x = 0; x < result.cols; ++x, out += class_count) {
      std::copy_n(&probabilities[static_cast<std::size_t>(id[x]) * class_count], class_count, out);
    }
  }
  return result;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/superpixel/uncertainty.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <numeric>
#include <string>
#include <vector>

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

  void add(int superpixel, int label, int count) {
    votes[static_cast<std::size_t>(superpixel) * class_count + label] += count;
    totals[superpixel] += count;
  }
  const int* of(int superpixel) const {
    return &votes[static_cast<std::size_t>(superpixel) * class_count];
  }

  int class_count;
  std::vector<int> votes;
  std::vector<int> totals;
};

/// The cells of a source row that the columns of a map read.
struct SampledCells {
  SampledCells(int map_width, int source_width)
      : place(cellsUnderCentres(map_width, source_width)) {
    for (int& cell : place) {
      if (cells.empty() || cells.back() != cell) cells.push_back(cell);
      cell = static_cast<int>(cells.size()) - 1;
    }
  }
  std::vector<int> cells;  ///< each once, ascending
  std::vector<int> place;  ///< of each column's cell in `cells`
};

/// The clustered rows of a map, cut into pieces of one superpixel and one label within a row, as
/// they were counted.
struct Segments {
  std::vector<int> row_first;  ///< of each clustered row, and the end
  std::vector<int> begins;     ///< columns
};

/// Lets every pixel of the map's clustered rows vote. `label_row(row, cells, labels)` writes the
/// labels of the given cells of a source row, or kNoVote; it is asked once per needed row. Returns
/// the votes withheld.
template <typename LabelRow>
std::size_t vote(const SuperpixelMap& superpixels, const ImageSize& source, LabelRow&& label_row,
                 Histogram* histogram, Segments* segments) {
  const ScoreKernels& kernels = scoreKernels();
  const cv::Mat& ids = superpixels.ids;
  const SampledCells sampled(ids.cols, source.width);
  std::vector<int> cell_labels(sampled.cells.size()), labels(ids.cols), starts(ids.cols + 8);
  std::size_t withheld = 0;
  int labelled_row = -1;
  segments->row_first.assign(1, 0);
  segments->begins.clear();
  for (int y = superpixels.firstRow(); y < superpixels.endRow(); ++y) {
    const int row = cellUnderCentre(y, ids.rows, source.height);
    if (row != labelled_row) {
      label_row(row, sampled.cells, cell_labels.data());
      for (int x = 0; x < ids.cols; ++x) labels[x] = cell_labels[sampled.place[x]];
    }
    labelled_row = row;
    const int* id = ids.ptr<int>(y);
    const int count = kernels.segmentStarts(id, labels.data(), ids.cols, starts.data());
    starts[count] = ids.cols;
    for (int i = 0; i < count; ++i) {
      const int x = starts[i], pixels = starts[i + 1] - x;
      if (labels[x] == kNoVote) {
        withheld += static_cast<std::size_t>(pixels);
      } else {
        histogram->add(id[x], labels[x], pixels);
      }
    }
    segments->begins.insert(segments->begins.end(), starts.begin(), starts.begin() + count);
    segments->row_first.push_back(static_cast<int>(segments->begins.size()));
  }
  return withheld;
}

/// An image with the value of its superpixel at each pixel.
cv::Mat paint(const SuperpixelMap& superpixels, const Segments& segments,
              const std::vector<float>& values) {
  constexpr int kStep = 8;
  cv::Mat image(superpixels.ids.size(), CV_32FC1);
  const int first = superpixels.firstRow(), end_row = superpixels.endRow();
  for (int y = first; y < end_row; ++y) {
    const int* id = superpixels.ids.ptr<int>(y);
    float* out = image.ptr<float>(y);
    // Whole steps may write beyond a segment: what comes after it is written after it.
    const bool room = y + 1 < image.rows && image.cols >= kStep;
    const int last = segments.row_first[y - first + 1] - 1;
    for (int i = segments.row_first[y - first]; i <= last; ++i) {
      const int begin = segments.begins[i], end = i < last ? segments.begins[i + 1] : image.cols;
      const float value = values[id[begin]];
      if (!room) {
        std::fill(out + begin, out + end, value);
        continue;
      }
      for (int x = begin; x < end; x += kStep) {
        for (int k = 0; k < kStep; ++k) out[x + k] = value;
      }
    }
  }
  const std::size_t bytes = sizeof(float) * static_cast<std::size_t>(image.cols);
  for (int y = 0; y < image.rows; ++y) {
    const int nearest = std::min(std::max(y, first), end_row - 1);
    if (nearest != y) std::memcpy(image.ptr(y), image.ptr(nearest), bytes);
  }
  return image;
}

/// Labels of the cells of a row, as the argmax of their scores.
class CellLabels {
 public:
  explicit CellLabels(const ScoreMap& scores) : scores_(scores) {}

  void operator()(int row, const std::vector<int>& cells, int* labels) {
    const auto count = static_cast<int>(cells.size());
    const int classes = scores_.classCount();
    if (const std::uint8_t* bytes = scores_.rankedRow<std::uint8_t>(row)) {
      const std::uint8_t flip = scores_.lowestIsHighest() ? 0xff : 0;
      kernels_.labelBytes(bytes, cells.data(), count, classes, flip, labels);
    } else if (const std::uint16_t* words = scores_.rankedRow<std::uint16_t>(row)) {
      const std::uint16_t flip = scores_.lowestIsHighest() ? 0xffff : 0;
      kernels_.labelWords(words, cells.data(), count, classes, flip, labels);
    } else if (const float* floats = scores_.floatRow(row)) {
      kernels_.labelFloats(floats, cells.data(), count, classes, labels);
    } else {
      convert(row, cells);
      kernels_.labelFloats(converted_.data(), in_order_.data(), count, classes, labels);
    }
  }

 private:
  void convert(int row, const std::vector<int>& cells) {
    const auto classes = static_cast<std::size_t>(scores_.classCount());
    converted_.resize(cells.size() * classes);
    in_order_.resize(cells.size());
    std::iota(in_order_.begin(), in_order_.end(), 0);
    for (std::size_t i = 0; i < cells.size(); ++i) {
      scores_.read(cells[i], row, &converted_[i * classes]);
    }
  }

  const ScoreMap& scores_;
  const ScoreKernels& kernels_ = scoreKernels();
  std::vector<float> converted_;
  std::vector<int> in_order_;
};

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
  if (scores.depth() == CV_32F) return;
  // Integers whose scores are two units in the last place of the largest score apart, or more, have
  // different scores once rounded to single precision.
  const double last = scores.depth() == CV_8U ? 255.0 : 65535.0;
  const double largest =
      std::max(std::abs(format.offset), std::abs(format.scale * last + format.offset));
  ranked_ = largest < std::numeric_limits<float>::max() &&
            std::abs(format.scale) > 2.0 * std::numeric_limits<float>::epsilon() * largest &&
            std::abs(format.scale) > 2.0 * std::numeric_limits<float>::denorm_min();
}

bool ScoreMap::read(int column, int row, float* out) const {
  const int count = scores_.channels();
  const std::size_t first = static_cast<std::size_t>(column) * count;
  const auto convert = [&](const auto* cell) {
    for (int c = 0; c < count; ++c) out[c] = scoreOf(cell[c]);
  };
  switch (scores_.depth()) {
    case CV_8U:
      convert(scores_.ptr<std::uint8_t>(row) + first);
      break;
    case CV_16U:
      convert(scores_.ptr<std::uint16_t>(row) + first);
      break;
    default:
      std::copy_n(scores_.ptr<float>(row) + first, count, out);
  }
  return std::all_of(out, out + count, [](float score) { return std::isfinite(score); });
}

ShareMap computeShare(const SuperpixelMap& superpixels, const ScoreMap& scores) {
  if (scores.empty()) throw DataError("score map is empty, must have at least one cell");
  const int class_count = scores.classCount();
  ShareMap result;
  Histogram histogram(superpixels.count, class_count);
  Segments segments;
  result.nonfinite_cells =
      vote(superpixels, scores.size(), CellLabels(scores), &histogram, &segments);

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

  result.share = paint(superpixels, segments, result.superpixel);
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

cv::Mat blendScores(const SuperpixelMap& superpixels, const ScoreMap& scores, double blend) {
  if (scores.empty()) throw DataError("score map is empty, must have at least one cell");
  const cv::Mat& ids = superpixels.ids;
  const auto class_count = static_cast<std::size_t>(scores.classCount());
  const std::vector<int> columns = cellsUnderCentres(ids.cols, scores.size().width);
  const std::vector<int> rows = cellsUnderCentres(ids.rows, scores.size().height);
  std::vector<double> mean(superpixels.count * class_count);
  std::vector<int> totals(superpixels.count);
  std::vector<std::uint8_t> finite(ids.total());
  cv::Mat result(ids.size(), CV_32FC(scores.classCount()));
  for (int y = 0; y < ids.rows; ++y) {
    float* cell = result.ptr<float>(y);
    std::uint8_t* is_finite = &finite[static_cast<std::size_t>(y) * ids.cols];
    const bool clustered = y >= superpixels.firstRow() && y < superpixels.endRow();
    for (int x = 0; x < ids.cols; ++x, cell += class_count) {
      is_finite[x] = scores.read(columns[x], rows[y], cell);
      if (!is_finite[x] || !clustered) continue;
      const int id = ids.at<int>(y, x);
      ++totals[id];
      for (std::size_t c = 0; c < class_count; ++c) mean[id * class_count + c] += cell[c];
    }
  }
  for (int id = 0; id < superpixels.count; ++id) {
    for (std::size_t c = 0; c < class_count; ++c) {
      mean[id * class_count + c] *= blend / std::max(1, totals[id]);
    }
  }
  for (int y = 0; y < ids.rows; ++y) {
    float* cell = result.ptr<float>(y);
    for (int x = 0; x < ids.cols; ++x, cell += class_count) {
      if (!finite[static_cast<std::size_t>(y) * ids.cols + x]) continue;
      const double* add = &mean[ids.at<int>(y, x) * class_count];
      for (std::size_t c = 0; c < class_count; ++c) {
        cell[c] = static_cast<float>((1.0 - blend) * cell[c] + add[c]);
      }
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
  const auto label_row = [&](int row, const std::vector<int>& cells, int* row_labels) {
    const std::uint8_t* in = labels.ptr<std::uint8_t>(row);
    for (const int cell : cells) *row_labels++ = in[cell] < class_count ? in[cell] : kNoVote;
  };
  Histogram histogram(superpixels.count, class_count);
  Segments segments;
  vote(superpixels, {labels.cols, labels.rows}, label_row, &histogram, &segments);

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

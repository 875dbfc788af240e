// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/superpixel/slic.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <opencv2/imgproc.hpp>
#include <string>
#include <vector>

#include "connected_regions.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

constexpr int kPixelsPerSuperpixel = 64;

/// Share of one source cell in the box of a target cell, in units of 1 / target count of a cell.
struct BoxTerm {
  int source;
  int weight;
};

/// Terms of each target cell along one axis: cell i covers [i, i + 1) * source / target.
std::vector<std::vector<BoxTerm>> boxTerms(int source_count, int target_count) {
  std::vector<std::vector<BoxTerm>> terms(target_count);
  for (std::int64_t i = 0; i < target_count; ++i) {
    const std::int64_t begin = i * source_count, end = begin + source_count;
    for (std::int64_t at = begin; at < end;) {
      const std::int64_t cell = at / target_count;
      const std::int64_t next = std::min(end, (cell + 1) * target_count);
      terms[i].push_back({static_cast<int>(cell), static_cast<int>(next - at)});
      at = next;
    }
  }
  return terms;
}

/// The mean over each target pixel's box, rounded to nearest, in exact integer arithmetic.
cv::Mat boxResized(const cv::Mat& image, const ImageSize& size) {
  if (image.cols == size.width && image.rows == size.height) return image;
  const auto columns = boxTerms(image.cols, size.width);
  const auto rows = boxTerms(image.rows, size.height);
  const int channels = image.channels();
  const std::int64_t area = static_cast<std::int64_t>(image.cols) * image.rows;
  cv::Mat result(size.height, size.width, image.type());
  for (int y = 0; y < size.height; ++y) {
    std::uint8_t* out = result.ptr(y);
    for (int x = 0; x < size.width; ++x) {
      for (int c = 0; c < channels; ++c) {
        std::int64_t sum = area / 2;
        for (const BoxTerm& row : rows[y]) {
          const std::uint8_t* in = image.ptr(row.source) + c;
          for (const BoxTerm& column : columns[x]) {
            sum += static_cast<std::int64_t>(row.weight) * column.weight *
                   in[column.source * channels];
          }
        }
        *out++ = static_cast<std::uint8_t>(sum / area);
      }
    }
  }
  return result;
}

cv::Mat toLab(const cv::Mat& image) {
  cv::Mat bgr, bgr_unit, lab;
  if (image.channels() == 1) {
    cv::cvtColor(image, bgr, cv::COLOR_GRAY2BGR);
  } else {
    bgr = image;
  }
  bgr.convertTo(bgr_unit, CV_32F, 1.0 / 255.0);
  cv::cvtColor(bgr_unit, lab, cv::COLOR_BGR2Lab);
  return lab;
}

struct Centre {
  cv::Vec3f lab;
  float x, y;
};

float squaredDistance(const cv::Vec3f& a, const cv::Vec3f& b) {
  const cv::Vec3f d = a - b;
  return d.dot(d);
}

/// Pixel in the 3x3 neighbourhood with the smallest gradient, so that no seed sits on an edge.
cv::Point calmestNeighbour(const cv::Mat& lab, const cv::Point& pixel) {
  cv::Point calmest = pixel;
  float smallest = std::numeric_limits<float>::max();
  for (int y = pixel.y - 1; y <= pixel.y + 1; ++y) {
    for (int x = pixel.x - 1; x <= pixel.x + 1; ++x) {
      if (x < 1 || y < 1 || x + 1 >= lab.cols || y + 1 >= lab.rows) continue;
      const float gradient =
          squaredDistance(lab.at<cv::Vec3f>(y, x + 1), lab.at<cv::Vec3f>(y, x - 1)) +
          squaredDistance(lab.at<cv::Vec3f>(y + 1, x), lab.at<cv::Vec3f>(y - 1, x));
      if (gradient < smallest) {
        smallest = gradient;
        calmest = {x, y};
      }
    }
  }
  return calmest;
}

struct Seeds {
  std::vector<Centre> centres;
  double reach = 0.0;  ///< a centre competes for pixels up to this far, in x and in y
};

/// Exactly `count` seeds: rows of equal height whose numbers of equal cells differ by one at most.
Seeds makeSeeds(const cv::Mat& lab, int count) {
  const int row_count =
      std::min({std::max(1, static_cast<int>(std::lround(
                                std::sqrt(static_cast<double>(count) * lab.rows / lab.cols)))),
                count, lab.rows});
  Seeds seeds;
  for (int row = 0; row < row_count; ++row) {
    const int first = static_cast<int>(static_cast<std::int64_t>(row) * count / row_count);
    const int next = static_cast<int>(static_cast<std::int64_t>(row + 1) * count / row_count);
    const int column_count = next - first;
    seeds.reach = std::max(seeds.reach, static_cast<double>(lab.cols) / column_count);
    for (int column = 0; column < column_count; ++column) {
      const cv::Point pixel =
          calmestNeighbour(lab, {cellUnderCentre(column, column_count, lab.cols),
                                 cellUnderCentre(row, row_count, lab.rows)});
      seeds.centres.push_back(
          {lab.at<cv::Vec3f>(pixel), static_cast<float>(pixel.x), static_cast<float>(pixel.y)});
    }
  }
  seeds.reach = std::max(seeds.reach, static_cast<double>(lab.rows) / row_count);
  return seeds;
}

/// Gives each pixel the nearest centre of those in reach; one out of every reach keeps its label.
void assign(const cv::Mat& lab, const Seeds& seeds, float position_weight, cv::Mat* labels) {
  cv::Mat nearest(lab.size(), CV_32FC1, cv::Scalar(std::numeric_limits<float>::max()));
  const int reach = static_cast<int>(std::ceil(seeds.reach));
  for (int k = 0; k < static_cast<int>(seeds.centres.size()); ++k) {
    const Centre& centre = seeds.centres[k];
    const int cx = pixelIndex(centre.x), cy = pixelIndex(centre.y);
    for (int y = std::max(0, cy - reach); y <= std::min(lab.rows - 1, cy + reach); ++y) {
      const cv::Vec3f* colour = lab.ptr<cv::Vec3f>(y);
      float* best = nearest.ptr<float>(y);
      int* label = labels->ptr<int>(y);
      for (int x = std::max(0, cx - reach); x <= std::min(lab.cols - 1, cx + reach); ++x) {
        const float dx = x - centre.x, dy = y - centre.y;
        const float distance =
            squaredDistance(colour[x], centre.lab) + position_weight * (dx * dx + dy * dy);
        if (distance < best[x]) {
          best[x] = distance;
          label[x] = k;
        }
      }
    }
  }
}

/// Moves each centre to the mean of its pixels; one without pixels stays.
void update(const cv::Mat& lab, const cv::Mat& labels, std::vector<Centre>* centres) {
  struct Sum {
    double l = 0, a = 0, b = 0, x = 0, y = 0;
    int pixels = 0;
  };
  std::vector<Sum> sums(centres->size());
  for (int y = 0; y < lab.rows; ++y) {
    for (int x = 0; x < lab.cols; ++x) {
      const cv::Vec3f& colour = lab.at<cv::Vec3f>(y, x);
      Sum& sum = sums[labels.at<int>(y, x)];
      sum.l += colour[0];
      sum.a += colour[1];
      sum.b += colour[2];
      sum.x += x;
      sum.y += y;
      ++sum.pixels;
    }
  }
  for (std::size_t k = 0; k < sums.size(); ++k) {
    const Sum& sum = sums[k];
    if (sum.pixels == 0) continue;
    const double n = sum.pixels;
    (*centres)[k] = {cv::Vec3f(sum.l / n, sum.a / n, sum.b / n), static_cast<float>(sum.x / n),
                     static_cast<float>(sum.y / n)};
  }
}

RunImage toRuns(const cv::Mat& labels) {
  RunImage runs;
  runs.size = {labels.cols, labels.rows};
  for (int y = 0; y < labels.rows; ++y) {
    runs.row_first.push_back(static_cast<int>(runs.begin.size()));
    const int* label = labels.ptr<int>(y);
    for (int x = 0; x < labels.cols; ++x) {
      if (x > 0 && label[x] == label[x - 1]) continue;
      runs.begin.push_back(x);
      runs.label.push_back(label[x]);
    }
  }
  runs.row_first.push_back(static_cast<int>(runs.begin.size()));
  return runs;
}

}  // namespace

int clampedSuperpixelCount(const SlicConfig& config, const ImageSize& map_size) {
  const std::int64_t pixels = static_cast<std::int64_t>(map_size.width) * map_size.height;
  const std::int64_t most = std::max<std::int64_t>(1, pixels / kPixelsPerSuperpixel);
  return static_cast<int>(std::min<std::int64_t>(std::max(1, config.count), most));
}

Slic::Slic(const SlicConfig& config) : config_(config) {
  std::vector<std::string> problems;
  if (config.count < 1) {
    problems.push_back("superpixels.count is " + std::to_string(config.count) +
                       ", must be at least 1");
  }
  if (!(config.compactness > 0.0) || !std::isfinite(config.compactness)) {
    problems.push_back("superpixels.compactness is " + std::to_string(config.compactness) +
                       ", must be finite and above 0");
  }
  if (config.iterations < 1 || config.iterations > 100) {
    problems.push_back("superpixels.iterations is " + std::to_string(config.iterations) +
                       ", must be 1..100");
  }
  if (!problems.empty()) throw ConfigError(problems);
}

SuperpixelMap Slic::cluster(const cv::Mat& image, const ImageSize& map_size) {
  if (image.empty() || (image.type() != CV_8UC1 && image.type() != CV_8UC3)) {
    throw DataError("image is " + std::to_string(image.cols) + "x" + std::to_string(image.rows) +
                    " of OpenCV type " + std::to_string(image.type()) +
                    ", must be non-empty 8UC1 or 8UC3 (BGR)");
  }
  if (map_size.width < 1 || map_size.height < 1) {
    throw DataError("superpixel map size is " + std::to_string(map_size.width) + "x" +
                    std::to_string(map_size.height) + ", must be at least 1x1");
  }
  const cv::Mat lab = toLab(boxResized(image, map_size));
  const int count = clampedSuperpixelCount(config_, map_size);
  Seeds seeds = makeSeeds(lab, count);

  // D^2 = d_c^2 + (m / S)^2 d_s^2 with S the side of a superpixel.
  const double side = std::sqrt(static_cast<double>(lab.total()) / count);
  const auto position_weight =
      static_cast<float>(config_.compactness * config_.compactness / (side * side));
  cv::Mat labels(lab.size(), CV_32SC1, cv::Scalar(0));
  for (int iteration = 0; iteration < config_.iterations; ++iteration) {
    assign(lab, seeds, position_weight, &labels);
    update(lab, labels, &seeds.centres);
  }
  assign(lab, seeds, position_weight, &labels);
  return connectedRegions(toRuns(labels), count);
}

}  // namespace semantic_lidar_fusion

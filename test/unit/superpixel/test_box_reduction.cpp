// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "map_properties.h"
#include "superpixel/box_reduction.h"

namespace semantic_lidar_fusion {
namespace {

std::vector<const SlicKernels*> usableKernels() {
  const SlicKernelList list = usableSlicKernels();
  return {list.kernels, list.kernels + list.count};
}

/// Length that [a, a + 1) * source / target and the source cell j have in common, times target.
std::int64_t overlap(std::int64_t a, std::int64_t source, std::int64_t target, std::int64_t j) {
  const std::int64_t begin = std::max(a * source, j * target);
  const std::int64_t end = std::min((a + 1) * source, (j + 1) * target);
  return std::max<std::int64_t>(0, end - begin);
}

/// Mean over the box of target pixel (x, y), rounded to nearest, half up.
int meanByDefinition(const cv::Mat& image, const ImageSize& target, int x, int y, int channel) {
  std::int64_t sum = 0;
  for (int v = 0; v < image.rows; ++v) {
    const std::int64_t height = overlap(y, image.rows, target.height, v);
    if (height == 0) continue;
    for (int u = 0; u < image.cols; ++u) {
      sum += height * overlap(x, image.cols, target.width, u) *
             image.ptr(v)[u * image.channels() + channel];
    }
  }
  const std::int64_t area = static_cast<std::int64_t>(image.cols) * image.rows;
  return static_cast<int>((2 * sum + area) / (2 * area));
}

TEST(BoxReduction, IsTheRoundedMeanOfEachBox) {
  for (const int type : {CV_8UC1, CV_8UC3}) {
    for (const ImageSize& source : {ImageSize{1, 1}, {5, 9}, {48, 36}, {64, 17}, {131, 97}}) {
      const cv::Mat image = noiseImage(source.width, source.height, type, 9);
      for (const ImageSize& target :
           {ImageSize{1, 1}, {2, 3}, {16, 12}, {24, 36}, {47, 35}, {130, 96}, {150, 20}}) {
        SCOPED_TRACE(std::to_string(source.width) + "x" + std::to_string(source.height) + " to " +
                     std::to_string(target.width) + "x" + std::to_string(target.height));
        for (const SlicKernels* kernels : usableKernels()) {
          BoxReduction reduction(source, target, image.channels());
          for (int y = 0; y < target.height; ++y) {
            const std::uint8_t* row = reduction.row(image, y, *kernels);
            for (int x = 0; x < target.width; ++x) {
              for (int c = 0; c < image.channels(); ++c) {
                ASSERT_EQ(row[x * image.channels() + c], meanByDefinition(image, target, x, y, c))
                    << kernels->name << " at " << x << ", " << y;
              }
            }
          }
        }
      }
    }
  }
}

// Areas of boxes where rounding is tightest, and the ones around the limits of the fast divisions.
TEST(BoxReduction, MeansOfTwoLevelsRoundExactly) {
  for (const int type : {CV_8UC1, CV_8UC3}) {
    const int channels = CV_MAT_CN(type);
    for (const int width : {255, 256, 4095, 65521, 65535, 65536, 70001, 999983, 8388607, 8388608}) {
      cv::Mat image(1, width, type);
      BoxReduction reduction({width, 1}, {1, 1}, channels);
      for (const SlicKernels* kernels : usableKernels()) {
        image.setTo(cv::Scalar::all(254));
        for (int bright = 0; bright <= width; ++bright) {
          if (bright > 0) {
            for (int c = 0; c < channels; ++c) image.ptr(0)[(bright - 1) * channels + c] = 255;
          }
          // Where the mean is near 254, 254.5 and 255.
          const bool telling = bright < 5 || std::abs(2 * bright - width) < 9 || bright + 5 > width;
          if (!telling) continue;
          const std::uint8_t* row = reduction.row(image, 0, *kernels);
          for (int c = 0; c < channels; ++c) {
            ASSERT_EQ(row[c], 2 * bright >= width ? 255 : 254)
                << kernels->name << ": " << bright << " of " << width;
          }
        }
      }
    }
  }
}

// The same for boxes that are narrow and high, up to the limit of their fast division.
TEST(BoxReduction, MeansOfTwoLevelsRoundExactlyInNarrowBoxes) {
  constexpr int kTargetWidth = 24;
  for (const int box_width : {1, 2, 3, 4}) {
    for (const int area : {255, 4096, 8191, 8192, 8193}) {
      const int height = std::max(1, area / box_width), pixels = box_width * height;
      cv::Mat image(height, box_width * kTargetWidth, CV_8UC3);
      BoxReduction reduction({image.cols, image.rows}, {kTargetWidth, 1}, 3);
      for (const SlicKernels* kernels : usableKernels()) {
        for (const int level : {0, 127, 254}) {
          image.setTo(cv::Scalar::all(level));
          // Target pixel x has the more pixels of the higher level, around half of them.
          std::vector<int> bright_counts;
          for (int x = 0; x < kTargetWidth; ++x) {
            const int bright = std::min(std::max(0, pixels / 2 - kTargetWidth / 2 + x), pixels);
            bright_counts.push_back(bright);
            for (int i = 0; i < bright; ++i) {
              const int column = x * box_width + i % box_width;
              image.at<cv::Vec3b>(i / box_width, column) = cv::Vec3b::all(level + 1);
            }
          }
          const std::uint8_t* row = reduction.row(image, 0, *kernels);
          for (int i = 0; i < 3 * kTargetWidth; ++i) {
            const int bright = bright_counts[i / 3];
            ASSERT_EQ(row[i], 2 * bright >= pixels ? level + 1 : level)
                << kernels->name << ": " << bright << " of " << pixels;
          }
        }
      }
    }
  }
}

/// A copy of an image at an odd address or not, whose last row ends where its memory does, with
/// bytes of another colour between the rows.
struct PaddedImage {
  PaddedImage(const cv::Mat& image, int shift, int padding)
      : stride(image.cols * image.elemSize() + padding),
        bytes(shift + stride * (image.rows - 1) + image.cols * image.elemSize(), 255),
        view(image.rows, image.cols, image.type(), bytes.data() + shift, stride) {
    image.copyTo(view);
  }
  std::size_t stride;
  std::vector<std::uint8_t> bytes;
  cv::Mat view;
};

TEST(BoxReduction, WideKernelsGiveThePlainBytes) {
  const auto compare = [](const ImageSize& source, const ImageSize& target) {
    SCOPED_TRACE(std::to_string(source.width) + "x" + std::to_string(source.height) + " to " +
                 std::to_string(target.width) + "x" + std::to_string(target.height));
    const cv::Mat image = noiseImage(source.width, source.height, CV_8UC3, 21);
    BoxReduction plain(source, target, 3);
    for (const SlicKernels* kernels : usableKernels()) {
      BoxReduction wide(source, target, 3);
      for (const int padding : {0, 1, 7}) {
        const PaddedImage padded(image, padding % 5, padding);
        for (int y = 0; y < target.height; ++y) {
          const std::uint8_t* expected = plain.row(image, y, kPlainSlicKernels);
          const std::uint8_t* row = wide.row(padded.view, y, *kernels);
          ASSERT_TRUE(std::equal(row, row + 3 * target.width, expected))
              << kernels->name << ", row " << y << ", padding " << padding;
        }
      }
    }
  };
  // A camera's size to that of the map: boxes of whole columns and parts of rows.
  compare({1920, 31}, {640, 10});
  compare({480, 302}, {160, 101});
  // Sizes without a common divisor: boxes of large areas.
  compare({1226, 37}, {817, 25});
  // Every width of a box from 1 to 6 columns, in whole and broken ratios, odd widths, single rows.
  for (int width = 1; width <= 70; ++width) {
    for (const int target_width : {1, 3, 16, 23, 32, 64}) compare({width, 1}, {target_width, 1});
    for (const int ratio : {2, 3, 4, 5}) compare({width * ratio, 7}, {width, 2});
  }
  compare({127, 63}, {64, 32});
  compare({195, 9}, {65, 4});
}

}  // namespace
}  // namespace semantic_lidar_fusion

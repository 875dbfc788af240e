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

// Areas of boxes where rounding is tightest, and the ones around the limit of the fast division.
TEST(BoxReduction, MeansOfTwoLevelsRoundExactly) {
  for (const int type : {CV_8UC1, CV_8UC3}) {
    const int channels = CV_MAT_CN(type);
    for (const int width : {255, 256, 4095, 65521, 65535, 65536, 70001}) {
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

}  // namespace
}  // namespace semantic_lidar_fusion

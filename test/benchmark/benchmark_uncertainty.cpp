// SPDX-License-Identifier: MIT
/// The tempered softmax at the pixels of 6000 points beside images of probabilities for everybody:
/// the plain formula, and our own kernels for every pixel. One thread, 12 classes, a score map of
/// 1920x1208. Compare rows of one run: absolute times depend on the machine and on its other work.
#include <benchmark/benchmark.h>

#include <algorithm>
#include <cmath>
#include <opencv2/core.hpp>
#include <opencv2/core/utility.hpp>
#include <vector>

#include "semantic_lidar_fusion/superpixel/uncertainty.h"

namespace semantic_lidar_fusion {
namespace {

constexpr int kWidth = 1920, kHeight = 1208, kClasses = 12, kPoints = 6000;

const cv::Mat& scores() {
  static const cv::Mat made = [] {
    cv::Mat image(kHeight, kWidth, CV_32FC(kClasses));
    cv::RNG(3).fill(image.reshape(1), cv::RNG::NORMAL, 0.0, 3.0);
    return image;
  }();
  return made;
}

const cv::Mat& share() {
  static const cv::Mat made = [] {
    cv::Mat image(kHeight, kWidth, CV_32FC1);
    cv::RNG(4).fill(image, cv::RNG::UNIFORM, 0.3, 1.0);
    return image;
  }();
  return made;
}

void softmaxOurs(benchmark::State& state) {
  const ScoreMap map(scores(), kClasses, {});
  cv::RNG random(5);
  std::vector<cv::Point> points;
  for (int i = 0; i < kPoints; ++i) {
    points.emplace_back(random.uniform(0, kWidth), random.uniform(0, kHeight));
  }
  double probabilities[kClasses];
  for (auto _ : state) {
    for (const cv::Point& point : points) {
      temperedSoftmax(map.floatRow(point.y) + point.x * kClasses, kClasses,
                      share().at<float>(point), {}, probabilities);
      benchmark::DoNotOptimize(probabilities);
    }
  }
}
BENCHMARK(softmaxOurs)->Name("softmax/ours_lazy")->Unit(benchmark::kMicrosecond);

void softmaxDense(benchmark::State& state) {
  const ScoreMap map(scores(), kClasses, {});
  for (auto _ : state) benchmark::DoNotOptimize(denseProbabilities(map, share(), {}).data);
}
BENCHMARK(softmaxDense)->Name("softmax/dense_kernels")->Unit(benchmark::kMicrosecond);

/// What one writes down first, in single precision.
void softmaxNaive(benchmark::State& state) {
  cv::Mat result(kHeight, kWidth, CV_32FC(kClasses));
  for (auto _ : state) {
    for (int y = 0; y < kHeight; ++y) {
      const float* s = scores().ptr<float>(y);
      const float* spp = share().ptr<float>(y);
      float* p = result.ptr<float>(y);
      for (int x = 0; x < kWidth; ++x, s += kClasses, p += kClasses) {
        const float highest = *std::max_element(s, s + kClasses);
        float sum = 0.0f;
        for (int c = 0; c < kClasses; ++c)
          sum += p[c] = std::exp((s[c] - highest) * spp[x] * spp[x]);
        for (int c = 0; c < kClasses; ++c) p[c] /= sum;
      }
    }
    benchmark::DoNotOptimize(result.data);
  }
}
BENCHMARK(softmaxNaive)->Name("softmax/dense_naive")->Unit(benchmark::kMicrosecond);

/// OpenCV's vectorised exponential, plane by plane.
void softmaxOpencv(benchmark::State& state) {
  std::vector<cv::Mat> planes;
  cv::split(scores(), planes);
  std::vector<cv::Mat> p(planes.size());
  cv::Mat inverse_tau, sum, result;
  for (auto _ : state) {
    cv::multiply(share(), share(), inverse_tau);
    sum = cv::Mat::zeros(share().size(), CV_32FC1);
    for (std::size_t c = 0; c < planes.size(); ++c) {
      cv::multiply(planes[c], inverse_tau, p[c]);
      cv::exp(p[c], p[c]);
      sum += p[c];
    }
    for (cv::Mat& plane : p) cv::divide(plane, sum, plane);
    cv::merge(p, result);
    benchmark::DoNotOptimize(result.data);
  }
}
BENCHMARK(softmaxOpencv)->Name("softmax/dense_cv::exp")->Unit(benchmark::kMicrosecond);

/// Superpixels as blocks of 16 x 16 pixels, of a map of 640x402.
const SuperpixelMap& blocks() {
  static const SuperpixelMap made = [] {
    SuperpixelMap map;
    map.ids.create(402, 640, CV_32SC1);
    for (int y = 0; y < map.ids.rows; ++y) {
      for (int x = 0; x < map.ids.cols; ++x) map.ids.at<int>(y, x) = y / 16 * 40 + x / 16;
    }
    map.count = 26 * 40;
    return map;
  }();
  return made;
}

/// Scores of `type` whose labels come in patches, as a network gives them.
cv::Mat patchyScores(int width, int height, int class_count, int depth) {
  cv::RNG random(6);
  cv::Mat image(height, width, CV_MAKETYPE(depth, class_count)),
      patches(height / 20 + 1, width / 20 + 1, CV_8U);
  random.fill(image.reshape(1), cv::RNG::UNIFORM, 0, 100);
  random.fill(patches, cv::RNG::UNIFORM, 0, class_count);
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const int at = x * class_count + patches.at<std::uint8_t>(y / 20, x / 20);
      if (depth == CV_8U) image.ptr<std::uint8_t>(y)[at] = 200;
      if (depth == CV_16U) image.ptr<std::uint16_t>(y)[at] = 200;
      if (depth == CV_32F) image.ptr<float>(y)[at] = 200.0F;
    }
  }
  return image;
}

/// Arguments: width of the scores, classes.
void share(benchmark::State& state, int depth) {
  const int width = static_cast<int>(state.range(0)), classes = static_cast<int>(state.range(1));
  const ScoreMap map(patchyScores(width, width * 1208 / 1920, classes, depth), classes,
                     {0.1, -12.0});
  for (auto _ : state) benchmark::DoNotOptimize(computeShare(blocks(), map).share.data);
}
void shareArguments(benchmark::internal::Benchmark* row) {
  row->Args({240, 12})->Args({640, 12})->Args({1920, 12})->Args({240, 150});
  row->Unit(benchmark::kMicrosecond);
}
BENCHMARK_CAPTURE(share, float, CV_32F)->Name("share/float")->Apply(shareArguments);
BENCHMARK_CAPTURE(share, u8, CV_8U)->Name("share/u8")->Apply(shareArguments);
BENCHMARK_CAPTURE(share, u16, CV_16U)->Name("share/u16")->Apply(shareArguments);

}  // namespace
}  // namespace semantic_lidar_fusion

int main(int argc, char** argv) {
  cv::setNumThreads(1);
  benchmark::Initialize(&argc, argv);
  if (benchmark::ReportUnrecognizedArguments(argc, argv)) return 1;
  benchmark::RunSpecifiedBenchmarks();
  return 0;
}

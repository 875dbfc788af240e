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

}  // namespace
}  // namespace semantic_lidar_fusion

int main(int argc, char** argv) {
  cv::setNumThreads(1);
  benchmark::Initialize(&argc, argv);
  if (benchmark::ReportUnrecognizedArguments(argc, argv)) return 1;
  benchmark::RunSpecifiedBenchmarks();
  return 0;
}

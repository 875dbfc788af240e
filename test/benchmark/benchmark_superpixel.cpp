// SPDX-License-Identifier: MIT
/// Superpixels beside OpenCV's, one thread, on a made-up street (or the image named by the
/// environment variable SLF_BENCHMARK_IMAGE). Compare rows of one run with each other: absolute
/// times depend on the machine and on its other work.
#include <benchmark/benchmark.h>

#include <cmath>
#include <cstdlib>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/superpixel/slic.h"
#include "semantic_lidar_fusion/superpixel/uncertainty.h"
#ifdef SLF_BENCHMARK_XIMGPROC
#include <opencv2/ximgproc/seeds.hpp>
#include <opencv2/ximgproc/slic.hpp>
#endif

namespace semantic_lidar_fusion {
namespace {

constexpr int kFrames = 8;
constexpr int kShift = 3;  // pixels from frame to frame, about that of a street at 10 Hz

/// Sky, facades, trees, road and cars as boxes and discs with texture and noise.
cv::Mat madeUpStreet(int width, int height) {
  cv::RNG random(7);
  cv::Mat image(height, width, CV_8UC3, cv::Scalar(220, 190, 160));
  cv::rectangle(image, {0, height / 2, width, height}, cv::Scalar(95, 95, 100), cv::FILLED);
  for (int i = 0; i < 90; ++i) {
    const cv::Scalar colour(random.uniform(20, 230), random.uniform(20, 230),
                            random.uniform(20, 230));
    const cv::Point centre(random.uniform(0, width), random.uniform(height / 4, 3 * height / 4));
    const int side = random.uniform(height / 60, height / 6);
    if (i % 3 == 0) {
      cv::circle(image, centre, side / 2, colour, cv::FILLED);
    } else {
      cv::rectangle(image, {centre.x, centre.y, side, side * (1 + i % 2)}, colour, cv::FILLED);
    }
  }
  cv::Mat noise(image.size(), CV_16SC3), noisy;
  random.fill(noise, cv::RNG::NORMAL, 0, 12);
  cv::GaussianBlur(noise, noise, {3, 3}, 0.8);
  image.convertTo(noisy, CV_16SC3);
  cv::Mat(noisy + noise).convertTo(image, CV_8UC3);
  return image;
}

/// A view that moves over the picture, forth and back, so that any number of frames is smooth.
const std::vector<cv::Mat>& frames(int width, int height) {
  static std::vector<cv::Mat> made;
  if (!made.empty() && made[0].cols == width && made[0].rows == height) return made;
  made.clear();
  const cv::Size whole(width + kShift * kFrames, height);
  const char* given = std::getenv("SLF_BENCHMARK_IMAGE");
  cv::Mat world = given ? cv::imread(given) : madeUpStreet(whole.width, whole.height);
  if (world.size() != whole) cv::resize(world, world, whole, 0, 0, cv::INTER_CUBIC);
  for (int i = 0; i < kFrames; ++i) {
    made.push_back(world(cv::Rect(kShift * i, 0, width, height)).clone());
  }
  return made;
}

const cv::Mat& frame(int width, int height, std::int64_t index) {
  const std::int64_t step = index % (2 * kFrames - 2);
  return frames(width, height)[step < kFrames ? step : 2 * kFrames - 2 - step];
}

void runSlic(benchmark::State& state, const ImageSize& image_size, bool warm) {
  SlicConfig config;
  config.count = static_cast<int>(state.range(2));
  config.warm_start = warm;
  Slic slic(config);
  const ImageSize map_size{static_cast<int>(state.range(0)), static_cast<int>(state.range(1))};
  slic.cluster(frame(image_size.width, image_size.height, 0), map_size);
  std::int64_t index = 0;
  int count = 0;
  for (auto _ : state) {
    count = slic.cluster(frame(image_size.width, image_size.height, ++index), map_size).count;
  }
  state.counters["superpixels"] = count;
}

void BM_SlicCold(benchmark::State& state) {
  runSlic(state, {static_cast<int>(state.range(0)), static_cast<int>(state.range(1))}, false);
}

void BM_SlicWarm(benchmark::State& state) {
  runSlic(state, {static_cast<int>(state.range(0)), static_cast<int>(state.range(1))}, true);
}

void BM_SlicWarmOfFullImage(benchmark::State& state) { runSlic(state, {1920, 1208}, true); }

#ifdef SLF_BENCHMARK_XIMGPROC
void runOpenCv(benchmark::State& state, int algorithm) {
  const int width = static_cast<int>(state.range(0)), height = static_cast<int>(state.range(1));
  const int side = cvRound(std::sqrt(width * height / static_cast<double>(state.range(2))));
  std::int64_t index = 0;
  cv::Mat lab, labels;
  int count = 0;
  for (auto _ : state) {
    cv::cvtColor(frame(width, height, ++index), lab, cv::COLOR_BGR2Lab);
    const auto slic = cv::ximgproc::createSuperpixelSLIC(lab, algorithm, side, 10.0F);
    slic->iterate(10);
    slic->enforceLabelConnectivity(25);
    slic->getLabels(labels);
    count = slic->getNumberOfSuperpixels();
  }
  state.counters["superpixels"] = count;
}

void BM_OpenCvSlic(benchmark::State& state) { runOpenCv(state, cv::ximgproc::SLIC); }
void BM_OpenCvSlico(benchmark::State& state) { runOpenCv(state, cv::ximgproc::SLICO); }

void BM_OpenCvSeeds(benchmark::State& state) {
  const int width = static_cast<int>(state.range(0)), height = static_cast<int>(state.range(1));
  const auto seeds =
      cv::ximgproc::createSuperpixelSEEDS(width, height, 3, static_cast<int>(state.range(2)), 4);
  std::int64_t index = 0;
  cv::Mat labels;
  for (auto _ : state) {
    seeds->iterate(frame(width, height, ++index), 4);
    seeds->getLabels(labels);
  }
  state.counters["superpixels"] = seeds->getNumberOfSuperpixels();
}
#endif

cv::Mat randomScores(int width, int height, int class_count) {
  cv::Mat scores(height, width, CV_32FC(class_count));
  cv::RNG(3).fill(scores.reshape(1), cv::RNG::NORMAL, 0.0, 3.0);
  return scores;
}

void BM_Share(benchmark::State& state) {
  const int width = static_cast<int>(state.range(0)), height = static_cast<int>(state.range(1));
  const SuperpixelMap map = Slic(SlicConfig{}).cluster(frame(width, height, 0), {width, height});
  const ScoreMap scores(randomScores(width, height, 12), 12, {});
  for (auto _ : state) benchmark::DoNotOptimize(computeShare(map, scores).share.data);
}

void BM_SoftmaxDense(benchmark::State& state) {
  const int width = static_cast<int>(state.range(0)), height = static_cast<int>(state.range(1));
  const ScoreMap scores(randomScores(width, height, 12), 12, {});
  cv::Mat share(height, width, CV_32FC1);
  cv::RNG(4).fill(share, cv::RNG::UNIFORM, 0.3, 1.0);
  for (auto _ : state) benchmark::DoNotOptimize(denseProbabilities(scores, share, {}).data);
}

/// At the pixels of 6000 points only.
void BM_SoftmaxAtPoints(benchmark::State& state) {
  const int width = static_cast<int>(state.range(0)), height = static_cast<int>(state.range(1));
  const ScoreMap scores(randomScores(width, height, 12), 12, {});
  cv::RNG random(5);
  std::vector<cv::Point> points;
  for (int i = 0; i < 6000; ++i) {
    points.emplace_back(random.uniform(0, width), random.uniform(0, height));
  }
  float cell[12];
  double probabilities[12];
  for (auto _ : state) {
    for (const cv::Point& point : points) {
      scores.read(point.x, point.y, cell);
      temperedSoftmax(cell, 12, 0.8, {}, probabilities);
      benchmark::DoNotOptimize(probabilities);
    }
  }
}

void sizes(benchmark::internal::Benchmark* benchmark) {
  benchmark->Args({640, 403, 1000})->Args({960, 604, 1000})->Args({1920, 1208, 2000});
  benchmark->Unit(benchmark::kMillisecond);
}

BENCHMARK(BM_SlicCold)->Apply(sizes);
BENCHMARK(BM_SlicWarm)->Apply(sizes);
BENCHMARK(BM_SlicWarmOfFullImage)
    ->Args({640, 402, 1000})
    ->Args({960, 604, 1000})
    ->Unit(benchmark::kMillisecond);
#ifdef SLF_BENCHMARK_XIMGPROC
BENCHMARK(BM_OpenCvSlic)->Apply(sizes);
BENCHMARK(BM_OpenCvSlico)->Apply(sizes);
BENCHMARK(BM_OpenCvSeeds)->Apply(sizes);
#endif
BENCHMARK(BM_Share)->Args({640, 402})->Unit(benchmark::kMillisecond);
BENCHMARK(BM_SoftmaxDense)->Args({1920, 1208})->Unit(benchmark::kMillisecond);
BENCHMARK(BM_SoftmaxAtPoints)->Args({1920, 1208})->Unit(benchmark::kMillisecond);

}  // namespace
}  // namespace semantic_lidar_fusion

int main(int argc, char** argv) {
  cv::setNumThreads(1);
  benchmark::Initialize(&argc, argv);
  if (benchmark::ReportUnrecognizedArguments(argc, argv)) return 1;
  benchmark::RunSpecifiedBenchmarks();
  return 0;
}

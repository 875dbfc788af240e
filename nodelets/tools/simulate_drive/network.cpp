// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/network.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <opencv2/imgproc.hpp>
#include <vector>

#include "tools/simulate_drive/noise.h"
#include "tools/simulate_drive/world.h"

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

// In cells of the score grid.
constexpr float kBorderShift = 1.6F;      ///< standard size of the borders' displacement
constexpr float kBorderPatch = 5.0F;      ///< over which it stays alike
constexpr double kBlurSigma = 0.7;        ///< of the borders
constexpr float kConfusionPatch = 14.0F;  ///< size of patches of a wrong class
constexpr float kGain = 10.5F;            ///< logit of a class that is all there is
constexpr float kFineNoise = 0.7F, kPatchNoise = 1.6F;
constexpr int kSamples = 2;  ///< along each side of a cell
/// Things this narrow keep their place within a fraction of their width.
constexpr int kThinCells = 4;
constexpr float kThinShift = 0.3F;  ///< of kBorderShift, for what is no wider than a cell

/// A class whose examples are few and small weighs more in training: the network sees it fatter
/// than it is, and where it is not.
struct ThinClass {
  Class kind;
  float weight;
};
constexpr ThinClass kThinClasses[] = {
    {Class::kPole, 1.6F},
    {Class::kSign, 1.2F},
    {Class::kPedestrian, 1.3F},
    {Class::kRider, 1.1F},
};

/// How often a patch of the first class is taken for the second.
struct Confusion {
  Class truth, other;
  float share;
};
constexpr Confusion kConfusions[] = {
    {Class::kBuilding, Class::kFence, 0.04F},
    {Class::kBuilding, Class::kVegetation, 0.06F},
    {Class::kBuilding, Class::kVehicle, 0.02F},
    {Class::kBuilding, Class::kSign, 0.02F},
    {Class::kBuilding, Class::kPole, 0.01F},
    {Class::kBuilding, Class::kPedestrian, 0.01F},
    {Class::kPole, Class::kBuilding, 0.22F},
    {Class::kPole, Class::kSign, 0.08F},
    {Class::kPole, Class::kVegetation, 0.12F},
    {Class::kRoad, Class::kUndrivableRoad, 0.02F},
    {Class::kUndrivableRoad, Class::kRoad, 0.11F},
    {Class::kUndrivableRoad, Class::kVegetation, 0.04F},
    {Class::kVegetation, Class::kBuilding, 0.10F},
    {Class::kVegetation, Class::kUndrivableRoad, 0.03F},
    {Class::kSign, Class::kBuilding, 0.33F},
    {Class::kSign, Class::kPole, 0.08F},
    {Class::kFence, Class::kBuilding, 0.15F},
    {Class::kFence, Class::kVegetation, 0.15F},
    {Class::kVehicle, Class::kBuilding, 0.05F},
    {Class::kVehicle, Class::kRoad, 0.015F},
    {Class::kPedestrian, Class::kRider, 0.12F},
    {Class::kPedestrian, Class::kBuilding, 0.10F},
    {Class::kRider, Class::kPedestrian, 0.19F},
    {Class::kRider, Class::kVehicle, 0.06F},
    {Class::kUnlabeled, Class::kVehicle, 0.2F},
    {Class::kUnlabeled, Class::kBuilding, 0.3F},
};

/// About normal, with patches of `size` cells.
float patchNoise(float x, float y, float size, std::uint32_t key) {
  const float sum = smoothNoise(x / size, y / size, key) +
                    smoothNoise(x / size + 31.7F, y / size + 17.3F, key + 1U) - 1.0F;
  return sum * 3.3F;  // the standard deviation of the sum is about 0.3
}

/// The class ids that the network looks at: kSamples along each side of every cell.
cv::Mat sampleLabels(const cv::Mat& labels, const ImageSize& size) {
  cv::Mat samples(size.height * kSamples, size.width * kSamples, CV_8UC1);
  for (int row = 0; row < samples.rows; ++row) {
    const int v = static_cast<int>((row + 0.5) * labels.rows / samples.rows);
    for (int column = 0; column < samples.cols; ++column) {
      const int u = static_cast<int>((column + 0.5) * labels.cols / samples.cols);
      samples.at<std::uint8_t>(row, column) = labels.at<std::uint8_t>(v, u);
    }
  }
  return samples;
}

/// By how much of kBorderShift borders move: less on and around thin things. CV_32FC1, by sample.
cv::Mat shiftShare(const cv::Mat& samples) {
  cv::Mat share(samples.size(), CV_32FC1, cv::Scalar(1.0));
  for (const ThinClass& thin : kThinClasses) {
    const cv::Mat region = samples == static_cast<int>(thin.kind);
    for (int cells = kThinCells; cells >= 1; --cells) {
      // What an opening takes away is narrower than its square.
      cv::Mat wide;
      cv::morphologyEx(region, wide, cv::MORPH_OPEN,
                       cv::Mat::ones(cells * kSamples, cells * kSamples, CV_8UC1));
      const float narrow = static_cast<float>(cells - 1) / kThinCells;
      share.setTo(kThinShift + (1.0F - kThinShift) * narrow, region & ~wide);
    }
  }
  constexpr int kReach = 2 * 2 * kSamples + 1;  // two cells to each side
  cv::erode(share, share, cv::Mat::ones(kReach, kReach, CV_8UC1));
  cv::blur(share, share, cv::Size(2 * kSamples + 1, 2 * kSamples + 1));
  return share;
}

/// Uniform in [0, 1], with patches of `size` cells.
float patchQuantile(float x, float y, float size, std::uint32_t key) {
  return 0.5F + 0.5F * std::erf(patchNoise(x, y, size, key) / 1.414F);
}

/// The class that a patch of a class is taken for, at a cell.
int confused(int kind, float x, float y, std::uint32_t seed) {
  float all = 0.0F;
  for (const Confusion& confusion : kConfusions) {
    if (static_cast<int>(confusion.truth) == kind) all += confusion.share;
  }
  // One number tells where the network errs, another, of larger patches, for what.
  const auto patch = seed + 101U * static_cast<std::uint32_t>(kind);
  if (patchQuantile(x, y, kConfusionPatch, patch) >= all) return kind;
  float left = all * patchQuantile(x, y, 2.0F * kConfusionPatch, patch + 57U);
  int other = kind;
  for (const Confusion& confusion : kConfusions) {
    if (static_cast<int>(confusion.truth) != kind) continue;
    other = static_cast<int>(confusion.other);
    if (left < confusion.share) break;
    left -= confusion.share;
  }
  return other;
}

}  // namespace

cv::Mat imitateNetwork(const cv::Mat& labels, const ImageSize& size, std::uint64_t key) {
  const auto seed = static_cast<std::uint32_t>(mixBits(key));
  const int cells = size.width * size.height;
  const cv::Mat samples = sampleLabels(labels, size);
  const cv::Mat share = shiftShare(samples);
  float weights[kClassCount];
  std::fill(std::begin(weights), std::end(weights), 1.0F / (kSamples * kSamples));
  for (const ThinClass& thin : kThinClasses) weights[static_cast<int>(thin.kind)] *= thin.weight;
  std::vector<cv::Mat> evidence;
  for (int c = 0; c < kClassCount; ++c)
    evidence.push_back(cv::Mat::zeros(size.height, size.width, CV_32FC1));
  for (int row = 0; row < size.height; ++row) {
    for (int column = 0; column < size.width; ++column) {
      const float x = static_cast<float>(column), y = static_cast<float>(row);
      const float shift = kBorderShift * share.at<float>(row * kSamples + 1, column * kSamples + 1);
      const float shift_x = shift * patchNoise(x, y, kBorderPatch, seed + 11U);
      const float shift_y = shift * patchNoise(x, y, kBorderPatch, seed + 13U);
      for (int k = 0; k < kSamples * kSamples; ++k) {
        const float sx = (x + shift_x) * kSamples + static_cast<float>(k % kSamples) + 0.5F;
        const float sy = (y + shift_y) * kSamples + static_cast<float>(k / kSamples) + 0.5F;
        const int u = std::min(std::max(static_cast<int>(sx), 0), samples.cols - 1);
        const int v = std::min(std::max(static_cast<int>(sy), 0), samples.rows - 1);
        const int kind = confused(samples.at<std::uint8_t>(v, u), x, y, seed);
        evidence[static_cast<std::size_t>(kind)].at<float>(row, column) += weights[kind];
      }
    }
  }
  cv::Mat scores(size.height, size.width, CV_32FC(kClassCount));
  for (int c = 0; c < kClassCount; ++c) {
    const cv::Mat raw = evidence[static_cast<std::size_t>(c)].clone();
    cv::GaussianBlur(raw, evidence[static_cast<std::size_t>(c)], cv::Size(5, 5), kBlurSigma,
                     kBlurSigma, cv::BORDER_REPLICATE);
  }
  auto* score = scores.ptr<float>();
  for (int cell = 0; cell < cells; ++cell) {
    const int row = cell / size.width, column = cell % size.width;
    const float x = static_cast<float>(column), y = static_cast<float>(row);
    for (int c = 0; c < kClassCount; ++c) {
      const float seen = evidence[static_cast<std::size_t>(c)].at<float>(row, column);
      const auto channel = seed + 997U * static_cast<std::uint32_t>(c);
      const float noise = kPatchNoise * patchNoise(x, y, 4.0F, channel) +
                          kFineNoise * (latticeNoise(column, row, channel + 7U) - 0.5F) * 3.46F;
      // In steps of 1/64: no less plausible, and the bag is smaller.
      *score++ = std::round(64.0F * (kGain * std::sqrt(seen) + noise - 1.0F)) / 64.0F;
    }
  }
  return scores;
}

cv::Mat perfectScores(const cv::Mat& labels) {
  cv::Mat scores(labels.rows, labels.cols, CV_32FC(kClassCount));
  for (int row = 0; row < labels.rows; ++row) {
    auto* score = scores.ptr<float>(row);
    const auto* label = labels.ptr<std::uint8_t>(row);
    for (int column = 0; column < labels.cols; ++column, score += kClassCount) {
      std::fill(score, score + kClassCount, 0.0F);
      score[label[column]] = 10.0F;
    }
  }
  return scores;
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

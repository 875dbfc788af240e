// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/network.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <opencv2/imgproc.hpp>
#include <vector>

#include "tools/simulate_drive/materials.h"
#include "tools/simulate_drive/noise.h"
#include "tools/simulate_drive/world.h"

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

// In cells of the score grid.
constexpr float kBorderShift = 1.25F;     ///< standard size of the borders' displacement
constexpr float kBorderPatch = 5.0F;      ///< over which it stays alike
constexpr float kBlurSigma = 0.7F;        ///< of the borders
constexpr float kConfusionPatch = 20.0F;  ///< size of patches of a wrong class
constexpr float kNoisePatch = 4.0F;       ///< of logits
constexpr float kGain = 10.5F;            ///< logit of a class that is all there is
constexpr float kPatchNoise = 1.6F, kFineNoise = 0.1F;  ///< of logits; the second by image
constexpr float kDoubt = 0.35F;       ///< over which a patch's class fades, standard deviations
constexpr float kImageShare = 0.05F;  ///< of the errors' standard size: drawn for each image
constexpr float kSizeBlend = 0.2F;    ///< of the step from one size of patches to the next
constexpr int kSamples = 2;           ///< along each side of a cell
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

/// About normal, with patches of size 1.
float normalNoise(const Eigen::Vector3f& p, std::uint32_t key) {
  const float sum =
      smoothNoise(p, key) + smoothNoise(p + Eigen::Vector3f(31.7F, 17.3F, 53.9F), key + 1U) - 1.0F;
  return sum * 3.82F;  // the sum's standard deviation is 0.262
}

/// What all errors hang on: places on things, so that whoever sees a place again, later or with
/// another camera, errs there again; and, for a small part, the image.
class ErrorField {
 public:
  ErrorField(const Picture& picture, const ImageSize& size, double radians_per_pixel,
             const NetworkKeys& keys)
      : picture_(picture),
        columns_per_cell_(static_cast<float>(picture.labels.cols) / static_cast<float>(size.width)),
        rows_per_cell_(static_cast<float>(picture.labels.rows) / static_cast<float>(size.height)),
        radians_per_cell_(static_cast<float>(radians_per_pixel) * columns_per_cell_),
        drive_(static_cast<std::uint32_t>(mixBits(keys.drive))),
        image_(static_cast<std::uint32_t>(mixBits(keys.image))) {}

  /// About normal, with patches of `cells` as seen from here; (x, y) in cells, of the picture.
  float at(float x, float y, float cells, std::uint32_t channel) const {
    const float of_image =
        normalNoise(Eigen::Vector3f(x / cells, y / cells, 0.5F), image_ + channel);
    return kImageShare * of_image +
           std::sqrt(1.0F - kImageShare * kImageShare) * ofPlace(x, y, cells, channel);
  }
  /// Uniform in [-1.73, 1.73] (standard deviation 1), by cell and image.
  float fine(int column, int row, std::uint32_t channel) const {
    return 3.46F * (latticeNoise(column, row, image_ + channel) - 0.5F);
  }

 private:
  const Sight& sight(float x, float y) const {
    const int u = static_cast<int>((x + 0.5F) * columns_per_cell_);
    const int v = static_cast<int>((y + 0.5F) * rows_per_cell_);
    const int column = std::min(std::max(u, 0), picture_.labels.cols - 1);
    const int row = std::min(std::max(v, 0), picture_.labels.rows - 1);
    return picture_
        .sights[static_cast<std::size_t>(row) * static_cast<std::size_t>(picture_.labels.cols) +
                static_cast<std::size_t>(column)];
  }

  /// Patches have sizes of powers of sixteen metres, and a place keeps its errors until the camera
  /// is so much closer that the next size fits better; between the two they are blended.
  float ofPlace(float x, float y, float cells, std::uint32_t channel) const {
    const Sight& seen = sight(x, y);
    const float size = 0.25F * std::log2(cells * radians_per_cell_ * seen.m_per_rad);
    const float whole = std::floor(size);
    const float part = smoothStep(0.5F - kSizeBlend, 0.5F + kSizeBlend, size - whole);
    const std::uint32_t key =
        drive_ + channel + 0x9E3779B9U * static_cast<std::uint32_t>(seen.object);
    float sum = 0.0F;
    for (const int next : {0, 1}) {
      const float weight = next == 0 ? 1.0F - part : part;
      if (weight == 0.0F) continue;
      const int octave = static_cast<int>(whole) + next;
      sum += weight * normalNoise(seen.place * std::exp2(-4.0F * static_cast<float>(octave)),
                                  key + 4099U * static_cast<std::uint32_t>(octave));
    }
    return sum / std::hypot(1.0F - part, part);
  }

  const Picture& picture_;
  float columns_per_cell_, rows_per_cell_, radians_per_cell_;
  std::uint32_t drive_, image_;
};

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

/// Distribution function of the normal distribution, and its inverse by bisection.
float normalShare(float x) { return 0.5F + 0.5F * std::erf(x / 1.41421356F); }
float normalQuantile(float share) {
  float low = -6.0F, high = 6.0F;
  for (int i = 0; i < 30; ++i) {
    const float middle = 0.5F * (low + high);
    (normalShare(middle) < share ? low : high) = middle;
  }
  return 0.5F * (low + high);
}

/// For each class how often it is mistaken, as the quantile of its noise.
std::array<float, kClassCount> confusionQuantiles() {
  std::array<float, kClassCount> shares{};
  for (const Confusion& confusion : kConfusions) {
    shares[static_cast<std::size_t>(confusion.truth)] += confusion.share;
  }
  for (float& share : shares) share = share > 0.0F ? normalQuantile(share) : -9.0F;
  return shares;
}

struct Mistake {
  int other;
  float belief;  ///< in the other class; below a half the truth still leads
};

/// What a class is taken for at a cell.
Mistake mistakeOf(int kind, float x, float y, float quantile, const ErrorField& field) {
  // One number tells where the network errs, another, of larger patches, for what.
  const auto channel = 101U * static_cast<std::uint32_t>(kind);
  const float inside = (quantile - field.at(x, y, kConfusionPatch, channel)) / kDoubt;
  if (inside < -4.0F) return {kind, 0.0F};
  float all = 0.0F;
  for (const Confusion& confusion : kConfusions) {
    if (static_cast<int>(confusion.truth) == kind) all += confusion.share;
  }
  float left = all * normalShare(field.at(x, y, 2.0F * kConfusionPatch, channel + 57U));
  Mistake mistake{kind, 1.0F / (1.0F + std::exp(-inside))};
  for (const Confusion& confusion : kConfusions) {
    if (static_cast<int>(confusion.truth) != kind) continue;
    mistake.other = static_cast<int>(confusion.other);
    if (left < confusion.share) break;
    left -= confusion.share;
  }
  return mistake;
}

/// What speaks for each class in each cell, CV_32FC1 by class: shares of about 1.
std::vector<cv::Mat> evidenceOf(const cv::Mat& samples, const ImageSize& size,
                                const ErrorField& field) {
  static const std::array<float, kClassCount> quantiles = confusionQuantiles();
  const cv::Mat share = shiftShare(samples);
  float weights[kClassCount];
  std::fill(std::begin(weights), std::end(weights), 1.0F / (kSamples * kSamples));
  for (const ThinClass& thin : kThinClasses) weights[static_cast<int>(thin.kind)] *= thin.weight;
  std::vector<cv::Mat> evidence;
  for (int c = 0; c < kClassCount; ++c) {
    evidence.push_back(cv::Mat::zeros(size.height, size.width, CV_32FC1));
  }
  for (int row = 0; row < size.height; ++row) {
    for (int column = 0; column < size.width; ++column) {
      const float x = static_cast<float>(column), y = static_cast<float>(row);
      const float shift = kBorderShift * share.at<float>(row * kSamples + 1, column * kSamples + 1);
      const float from_x = x + shift * field.at(x, y, kBorderPatch, 11U);
      const float from_y = y + shift * field.at(x, y, kBorderPatch, 13U);
      const auto add = [&](int kind, float part) {
        evidence[static_cast<std::size_t>(kind)].at<float>(row, column) += part * weights[kind];
      };
      int last = -1;
      Mistake mistake{};
      for (int k = 0; k < kSamples * kSamples; ++k) {
        const float sx = from_x * kSamples + static_cast<float>(k % kSamples) + 0.5F;
        const float sy = from_y * kSamples + static_cast<float>(k / kSamples) + 0.5F;
        const int u = std::min(std::max(static_cast<int>(sx), 0), samples.cols - 1);
        const int v = std::min(std::max(static_cast<int>(sy), 0), samples.rows - 1);
        const int kind = samples.at<std::uint8_t>(v, u);
        if (kind != last) {
          mistake =
              mistakeOf(kind, from_x, from_y, quantiles[static_cast<std::size_t>(kind)], field);
          last = kind;
        }
        add(kind, 1.0F - mistake.belief);
        add(mistake.other, mistake.belief);
      }
    }
  }
  for (cv::Mat& seen : evidence) {
    cv::GaussianBlur(seen, seen, cv::Size(5, 5), kBlurSigma, kBlurSigma, cv::BORDER_REPLICATE);
  }
  return evidence;
}

}  // namespace

cv::Mat imitateNetwork(const Picture& picture, const ImageSize& size, double radians_per_pixel,
                       const NetworkKeys& keys) {
  const ErrorField field(picture, size, radians_per_pixel, keys);
  const std::vector<cv::Mat> evidence = evidenceOf(sampleLabels(picture.labels, size), size, field);
  cv::Mat scores(size.height, size.width, CV_32FC(kClassCount));
  for (int row = 0; row < size.height; ++row) {
    auto* score = scores.ptr<float>(row);
    for (int column = 0; column < size.width; ++column) {
      const float x = static_cast<float>(column), y = static_cast<float>(row);
      for (int c = 0; c < kClassCount; ++c) {
        const float seen = evidence[static_cast<std::size_t>(c)].at<float>(row, column);
        const auto channel = 2000U + 997U * static_cast<std::uint32_t>(c);
        const float noise = kPatchNoise * field.at(x, y, kNoisePatch, channel) +
                            kFineNoise * field.fine(column, row, channel);
        // In steps of 1/64: no less plausible, and the bag is smaller.
        *score++ = std::round(64.0F * (kGain * std::sqrt(seen) + noise - 1.0F)) / 64.0F;
      }
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

// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/smoothing/surface_smoother.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <string>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/thread_pool.h"
#include "smoothing_kernels.h"

namespace semantic_lidar_fusion {
namespace {

/// A class of less is not told from an impossible one: networks that say 1e-9 are as often wrong as
/// those that say 1e-4, and one such neighbour would decide alone.
constexpr float kLeastProbability = 1e-4f;
/// Points that one thread takes at once.
constexpr int kShare = 2048;

const SmoothingKernels& widestKernels() {
  static const SmoothingKernelList list = usableSmoothingKernels();
  return *list.kernels[list.count - 1];
}

int roundedUp(int count) {
  return (count + kSmoothingLanes - 1) / kSmoothingLanes * kSmoothingLanes;
}

/// The fused points of a cloud and their links to each other. A point's *slot* is its place among
/// them.
class Smoother {
 public:
  Smoother(const BeamGrid& grid, const SmoothingConfig& config, SemanticCloud* cloud,
           ThreadPool* pool)
      : grid_(grid),
        cloud_(cloud),
        pool_(pool),
        kernels_(widestKernels()),
        classes_(cloud->class_count),
        stride_(roundedUp(classes_)),
        per_distance_(static_cast<float>(1.0 / config.distance_m)),
        per_intensity_(config.intensity > 0.0 ? intensityFactor(cloud->points.intensity) /
                                                    static_cast<float>(config.intensity)
                                              : 0.0f) {
    slot_of_.assign(cloud->size(), BeamGrid::kNoLink);
    for (std::size_t i = 0; i < cloud->size(); ++i) {
      if (cloud->points.status[i] != static_cast<std::uint8_t>(PointStatus::kFused)) continue;
      slot_of_[i] = static_cast<std::int32_t>(point_.size());
      point_.push_back(static_cast<std::uint32_t>(i));
    }
    const std::size_t n = point_.size();
    slots_.resize(n * kSmoothingLinks);
    weights_.resize(n * kSmoothingLinks + kSmoothingLanes);
    inverse_.resize(n);
    // Written before they are read: zeros would only take time.
    rows_.reset(new float[n * static_cast<std::size_t>(stride_)]);
    next_.reset(new float[n * static_cast<std::size_t>(stride_)]);
  }

  void smooth(int iterations) {
    forShares([this](int begin, int end) { weigh(begin, end); });
    forShares([this](int begin, int end) { takeLogarithms(begin, end); });
    for (int k = 0; k < iterations; ++k) {
      forShares([this](int begin, int end) {
        kernels_.average(rows_.get(), slots_.data(), weights_.data(), inverse_.data(), stride_,
                         begin, end, next_.get());
      });
      rows_.swap(next_);
    }
    forShares([this](int begin, int end) { write(begin, end); });
  }

 private:
  template <typename Work>
  void forShares(const Work& work) {
    const int count = static_cast<int>(point_.size());
    forEach(pool_, (count + kShare - 1) / kShare,
            [&](int share) { work(share * kShare, std::min(count, (share + 1) * kShare)); });
  }

  float* row(int slot) { return rows_.get() + static_cast<std::ptrdiff_t>(slot) * stride_; }

  /// Minus the exponent of w_ij.
  float distanceOf(std::uint32_t i, std::uint32_t j) const {
    const Cloud& cloud = cloud_->points;
    const float dx = (cloud.x[i] - cloud.x[j]) * per_distance_;
    const float dy = (cloud.y[i] - cloud.y[j]) * per_distance_;
    const float dz = (cloud.z[i] - cloud.z[j]) * per_distance_;
    const float di = (cloud.intensity[i] - cloud.intensity[j]) * per_intensity_;
    const float square = dx * dx + dy * dy + dz * dz;
    // An intensity that is no number says nothing.
    return di * di >= 0.0f ? square + di * di : square;
  }

  void weigh(int begin, int end) {
    constexpr float kNever = -1e3f;  // whose exponential is 0
    for (int slot = begin; slot < end; ++slot) {
      const std::uint32_t i = point_[slot];
      const BeamGrid::Links& links = grid_.links[i];
      const std::int32_t of[kSmoothingLinks] = {links.left, links.right, links.up, links.down};
      for (int n = 0; n < kSmoothingLinks; ++n) {
        const std::int32_t other = of[n] == BeamGrid::kNoLink ? of[n] : slot_of_[of[n]];
        const bool linked = other != BeamGrid::kNoLink;
        slots_[kSmoothingLinks * slot + n] = linked ? other : slot;
        weights_[kSmoothingLinks * slot + n] =
            linked ? std::max(kNever, -distanceOf(i, static_cast<std::uint32_t>(of[n]))) : kNever;
      }
    }
    float* weights = weights_.data() + kSmoothingLinks * static_cast<std::ptrdiff_t>(begin);
    const int count = kSmoothingLinks * (end - begin);
    // The last share's register may reach beyond its end, into room that nothing else uses.
    kernels_.exponentials(weights, roundedUp(count));
    for (int k = 0; k < end - begin; ++k) {
      const float* w = weights + kSmoothingLinks * k;
      inverse_[begin + k] = 1.0f / (1.0f + ((w[0] + w[1]) + (w[2] + w[3])));
    }
  }

  void takeLogarithms(int begin, int end) {
    for (int slot = begin; slot < end; ++slot) {
      const float* p = probabilities(point_[slot]);
      float* a = row(slot);
      for (int c = 0; c < classes_; ++c) a[c] = std::max(p[c], kLeastProbability);
      std::fill(a + classes_, a + stride_, 1.0f);
    }
    kernels_.logarithms(row(begin), (end - begin) * stride_);
    for (int slot = begin; slot < end; ++slot) {
      std::fill(row(slot) + classes_, row(slot) + stride_, kPaddedLog);
    }
  }

  void write(int begin, int end) {
    std::vector<float> entropy(static_cast<std::size_t>(end - begin));
    kernels_.softmax(row(begin), stride_, end - begin, entropy.data());
    const float per_log = classes_ > 1 ? static_cast<float>(1.0 / std::log(classes_)) : 0.0f;
    for (int slot = begin; slot < end; ++slot) {
      const std::uint32_t i = point_[slot];
      const float* p = row(slot);
      std::copy_n(p, classes_, probabilities(i));
      const float* highest = p;
      for (int c = 1; c < classes_; ++c) highest = p[c] > *highest ? p + c : highest;
      const auto label = highest - p;  // the lowest of equal ones
      cloud_->label[i] = static_cast<std::uint8_t>(label);
      cloud_->confidence[i] = p[label];
      cloud_->entropy[i] = std::min(1.0f, std::max(0.0f, entropy[slot - begin] * per_log));
    }
  }

  float* probabilities(std::uint32_t i) {
    return &cloud_->probabilities[i * static_cast<std::size_t>(classes_)];
  }

  const BeamGrid& grid_;
  SemanticCloud* cloud_;
  ThreadPool* pool_;
  const SmoothingKernels& kernels_;
  int classes_, stride_;
  float per_distance_, per_intensity_;
  std::vector<std::int32_t> slot_of_;     ///< by cloud index, kNoLink = not fused
  std::vector<std::uint32_t> point_;      ///< by slot: cloud index
  std::vector<std::int32_t> slots_;       ///< of the neighbours; its own where there is none
  std::vector<float> weights_;            ///< of the neighbours; 0 where there is none
  std::vector<float> inverse_;            ///< 1 / (1 + sum of weights)
  std::unique_ptr<float[]> rows_, next_;  ///< A, `stride_` numbers a slot
};

}  // namespace

float intensityFactor(const std::vector<float>& intensity) {
  constexpr std::size_t kSample = 1024;
  constexpr float kFull = 255.0f;
  std::vector<float> sample;
  const std::size_t step = 1 + intensity.size() / kSample;
  for (std::size_t i = 0; i < intensity.size(); i += step) {
    if (std::isfinite(intensity[i])) sample.push_back(intensity[i]);
  }
  if (sample.empty()) return 1.0f;
  const auto high = sample.begin() + static_cast<std::ptrdiff_t>((sample.size() - 1) * 99 / 100);
  std::nth_element(sample.begin(), high, sample.end());
  if (*high <= 0.0f) return 1.0f;
  if (*high <= 1.0f) return kFull;
  return *high <= kFull ? 1.0f : kFull / *high;
}

void smoothAlongSurfaces(const BeamGrid& grid, const SmoothingConfig& config, SemanticCloud* cloud,
                         ThreadPool* pool) {
  if (config.iterations == 0 || cloud->size() == 0) return;
  if (grid.links.size() != cloud->size()) {
    throw DataError("beam grid of " + std::to_string(grid.links.size()) + " points for " +
                    std::to_string(cloud->size()) + ": must be that of the same cloud");
  }
  Smoother(grid, config, cloud, pool).smooth(config.iterations);
}

}  // namespace semantic_lidar_fusion

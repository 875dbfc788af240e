// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/fusion/camera_merger.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <string>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/softmax_kernels.h"
#include "semantic_lidar_fusion/common/thread_pool.h"

namespace semantic_lidar_fusion {
namespace {

/// One camera's vote for the point at hand.
struct Vote {
  const double* probabilities = nullptr;
  std::int64_t time_difference_ns = 0;
  float theta = 0;
  int rig_index = 0;
};

/// The votes of one point, in order of camera name.
struct PointVotes {
  std::array<Vote, kMaxCameras> votes;
  int count = 0;
};

void checkVotes(const std::vector<CameraVotes>& votes, OverlapRule rule, std::size_t points,
                int class_count) {
  if (class_count < 1) {
    throw DataError("class_count " + std::to_string(class_count) + ": must be at least 1");
  }
  if (votes.size() > kMaxCameras) {
    throw DataError("votes of " + std::to_string(votes.size()) + " cameras: at most " +
                    std::to_string(kMaxCameras));
  }
  for (const CameraVotes& camera : votes) {
    const std::string name = "votes of camera " + std::to_string(camera.rig_index) + ": ";
    if (camera.rig_index < 0 || camera.rig_index >= kMaxCameras) {
      throw DataError(name + "rig_index must be in 0.." + std::to_string(kMaxCameras - 1));
    }
    const std::size_t n = camera.index.size();
    const bool without_times =
        camera.time_difference_ns.empty() && rule != OverlapRule::kNearestInTime;
    if (camera.probabilities.size() != n * static_cast<std::size_t>(class_count) ||
        (camera.time_difference_ns.size() != n && !without_times) || camera.theta.size() != n) {
      throw DataError(name + "arrays must have one entry for each of " + std::to_string(n) +
                      " points");
    }
    for (std::size_t i = 0; i < n; ++i) {
      if (camera.index[i] >= points || (i > 0 && camera.index[i] <= camera.index[i - 1])) {
        throw DataError(name + "index " + std::to_string(camera.index[i]) +
                        " must ascend and be below " + std::to_string(points));
      }
    }
  }
}

template <typename Key>
void keepLeast(PointVotes* point, const Key& key) {
  auto least = key(point->votes[0]);
  for (int k = 1; k < point->count; ++k) least = std::min(least, key(point->votes[k]));
  int kept = 0;
  for (int k = 0; k < point->count; ++k) {
    if (key(point->votes[k]) == least) point->votes[kept++] = point->votes[k];
  }
  point->count = kept;
}

void mean(const PointVotes& point, int class_count, double* out) {
  for (int c = 0; c < class_count; ++c) {
    double sum = 0;
    for (int k = 0; k < point.count; ++k) sum += point.votes[k].probabilities[c];
    out[c] = sum / point.count;
  }
}

/// Products of two probabilities above this are exact to far more than single precision, and what
/// underflows beside them is 0 there.
constexpr double kSafeProduct = 1e-200;

/// The normalised product of two distributions, or its square root; false, with `out` undefined, if
/// it is too small everywhere to be formed without logarithms.
bool productOfTwo(const PointVotes& point, int class_count, bool root, double* out) {
  const double* a = point.votes[0].probabilities;
  const double* b = point.votes[1].probabilities;
  double largest = 0;
  for (int c = 0; c < class_count; ++c) {
    out[c] = a[c] * b[c];
    largest = std::max(largest, out[c]);
  }
  if (!(largest >= kSafeProduct)) return false;
  double sum = 0;
  for (int c = 0; c < class_count; ++c) {
    if (root) out[c] = std::sqrt(out[c]);
    sum += out[c];
  }
  for (int c = 0; c < class_count; ++c) out[c] /= sum;
  return true;
}

/// The product of the distributions, or its root of their number, normalised.
void product(const PointVotes& point, int class_count, bool root, double* out) {
  if (point.count == 2 && productOfTwo(point, class_count, root, out)) return;
  const double exponent = root ? 1.0 / point.count : 1.0;
  double largest = -std::numeric_limits<double>::infinity();
  for (int c = 0; c < class_count; ++c) {
    out[c] = 0;
    for (int k = 0; k < point.count; ++k) out[c] += std::log(point.votes[k].probabilities[c]);
    out[c] *= exponent;
    largest = std::max(largest, out[c]);
  }
  if (!(largest > -std::numeric_limits<double>::infinity())) {
    mean(point, class_count, out);
    return;
  }
  double sum = 0;
  for (int c = 0; c < class_count; ++c) {
    out[c] = std::exp(out[c] - largest);
    sum += out[c];
  }
  for (int c = 0; c < class_count; ++c) out[c] /= sum;
}

/// `per_log_class_count`: null = without the entropy.
void write(const double* distribution, const PointVotes& point, std::size_t i,
           const double* per_log_class_count, const SoftmaxKernels& kernels, SemanticCloud* cloud) {
  const int class_count = cloud->class_count;
  float* out = &cloud->probabilities[i * static_cast<std::size_t>(class_count)];
  const int label = kernels.narrow(distribution, class_count, out);
  cloud->points.status[i] = static_cast<std::uint8_t>(PointStatus::kFused);
  cloud->label[i] = static_cast<std::uint8_t>(label);
  cloud->confidence[i] = out[label];
  if (per_log_class_count) {
    const double entropy = kernels.entropy(distribution, class_count) * *per_log_class_count;
    cloud->entropy[i] = static_cast<float>(std::min(1.0, std::max(0.0, entropy)));
  }
  std::uint16_t cameras = 0;
  for (int k = 0; k < point.count; ++k) {
    cameras = static_cast<std::uint16_t>(cameras | (1u << point.votes[k].rig_index));
  }
  cloud->cameras[i] = cameras;
}

/// Merges points [begin, end).
void mergeRange(const std::vector<CameraVotes>& votes, OverlapRule rule, std::size_t begin,
                std::size_t end, bool with_entropy, SemanticCloud* cloud) {
  const int class_count = cloud->class_count;
  const double per_log_class_count = class_count > 1 ? 1.0 / std::log(class_count) : 0.0;
  const SoftmaxKernels& kernels = softmaxKernels();
  std::vector<double> merged(static_cast<std::size_t>(class_count));
  std::array<std::size_t, kMaxCameras> next{};
  for (std::size_t k = 0; k < votes.size(); ++k) {
    const std::vector<std::uint32_t>& index = votes[k].index;
    next[k] = static_cast<std::size_t>(std::lower_bound(index.begin(), index.end(), begin) -
                                       index.begin());
  }
  PointVotes point;
  for (std::size_t i = begin; i < end; ++i) {
    point.count = 0;
    for (std::size_t k = 0; k < votes.size(); ++k) {
      const CameraVotes& camera = votes[k];
      const std::size_t row = next[k];
      if (row == camera.index.size() || camera.index[row] != i) continue;
      point.votes[point.count++] = {
          &camera.probabilities[row * static_cast<std::size_t>(class_count)],
          camera.time_difference_ns.empty() ? 0 : camera.time_difference_ns[row], camera.theta[row],
          camera.rig_index};
      ++next[k];
    }
    if (point.count == 0) continue;
    if (rule == OverlapRule::kNearestInTime) {
      keepLeast(&point, [](const Vote& vote) { return vote.time_difference_ns; });
    } else if (rule == OverlapRule::kMostCentral) {
      keepLeast(&point, [](const Vote& vote) { return vote.theta; });
    }
    const double* distribution = point.votes[0].probabilities;
    if (point.count > 1) {
      if (rule == OverlapRule::kProduct) {
        product(point, class_count, false, merged.data());
      } else if (rule == OverlapRule::kGeometricMean) {
        product(point, class_count, true, merged.data());
      } else {
        mean(point, class_count, merged.data());
      }
      distribution = merged.data();
    }
    write(distribution, point, i, with_entropy ? &per_log_class_count : nullptr, kernels, cloud);
  }
}

}  // namespace

void mergeVotes(const std::vector<CameraVotes>& votes, OverlapRule rule, SemanticCloud* cloud,
                ThreadPool* pool, bool with_entropy) {
  const std::size_t points = cloud->points.size();
  checkVotes(votes, rule, points, cloud->class_count);
  cloud->label.assign(points, kNoLabel);
  cloud->confidence.assign(points, 0.0f);
  cloud->entropy.assign(points, 1.0f);
  cloud->cameras.assign(points, 0);
  cloud->probabilities.assign(points * static_cast<std::size_t>(cloud->class_count), 0.0f);

  constexpr std::size_t kShare = 4096;
  forEach(pool, static_cast<int>((points + kShare - 1) / kShare), [&](int share) {
    const std::size_t begin = kShare * static_cast<std::size_t>(share);
    mergeRange(votes, rule, begin, std::min(points, begin + kShare), with_entropy, cloud);
  });
}

}  // namespace semantic_lidar_fusion

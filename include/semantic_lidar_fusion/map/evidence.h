// SPDX-License-Identifier: MIT
/// What one observed class distribution adds to a voxel, in whole numbers.
///
/// Evidence is fixed point with kEvidenceBits fractional bits, so that sums do not depend on order,
/// and maps can be cut and merged without rounding:
///   log:       w (ln max(P, floor) - ln prior)   per class, in nats
///   dirichlet: w P                               per class, in counts
/// The logarithm is a polynomial in single precision without fused operations: every processor, and
/// the plain numpy version in scripts/, gives the same integer. It lies within 1.2 units in the
/// last place of the exact value for w = 1.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace semantic_lidar_fusion {

constexpr int kEvidenceBits = 20;
struct EvidenceConstants;  // of the kernels

enum class EvidenceKind { kLog, kDirichlet };

struct EvidenceConfig {
  EvidenceKind kind = EvidenceKind::kLog;
  double weight = 1.0;        ///< w, (0, 1]
  double floor = 1e-2;        ///< eps, [1e-6, 1): the least probability that is believed
  std::vector<double> prior;  ///< one per class, each in [1e-6, 1], sum 1
};

/// Turns distributions into evidence.
class EvidenceModel {
 public:
  /// Throws ConfigError naming every value that breaks its rule.
  explicit EvidenceModel(const EvidenceConfig& config);

  int classCount() const { return class_count_; }
  /// Rows of one call of `compute` at most.
  static constexpr int kMaxRows = 64;
  /// evidence[i] of the `rows` x classCount() probabilities, row-major. Values that are not numbers
  /// count as 0, those above 1 as 1.
  void compute(const float* probabilities, int rows, std::int32_t* evidence) const;

 private:
  using Kernel = void (*)(const float*, std::size_t, const EvidenceConstants&, const std::int32_t*,
                          std::int32_t*);
  int class_count_ = 0;
  EvidenceKind kind_ = EvidenceKind::kLog;
  float floor_ = 0.0f;
  float scale_ = 0.0f;               ///< w in units of the result (dirichlet) or finer (log)
  std::int32_t octave_ = 0;          ///< w ln 2, finer
  std::vector<std::int32_t> prior_;  ///< w ln prior, finer, kMaxRows rows
  Kernel kernel_ = nullptr;
};

}  // namespace semantic_lidar_fusion

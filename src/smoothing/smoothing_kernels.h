// SPDX-License-Identifier: MIT
/// The inner loops of smoothing. One body (smoothing_kernels_body.h) is compiled for every machine
/// and for wider registers: each operation is rounded alone, in the same order, so both give the
/// same bytes. Chosen at run time; see superpixel/slic_kernels.h for why wide versions have files
/// of their own and what may not be in them.
#pragma once

#include <cstdint>

namespace semantic_lidar_fusion {

/// Rows of classes are padded to a multiple of this.
constexpr int kSmoothingLanes = 8;
/// Left, right, up, down.
constexpr int kSmoothingLinks = 4;
/// The A of a class that pads a row: far below any logarithm, so that its probability is 0.
constexpr float kPaddedLog = -1e30f;

struct SmoothingKernels {
  const char* name;

  /// values[k] = ln(values[k]), to 1e-6, for `count` numbers, a multiple of kSmoothingLanes, that
  /// are normal and positive.
  void (*logarithms)(float* values, int count);

  /// values[k] = exp(values[k]), to 2e-7 of it, for `count` numbers, a multiple of
  /// kSmoothingLanes, that are at most 0; exactly 0 below -87.
  void (*exponentials)(float* values, int count);

  /// Rows [begin, end) of `out`: (row + sum of weight * neighbour's row) * inverse. `slots` and
  /// `weights` hold kSmoothingLinks numbers a row, `inverse` one; `stride` floats a row.
  void (*average)(const float* rows, const std::int32_t* slots, const float* weights,
                  const float* inverse, int stride, int begin, int end, float* out);

  /// Turns `count` rows of A into probabilities; entropy[k] in nats.
  void (*softmax)(float* rows, int stride, int count, float* entropy);
};

extern const SmoothingKernels kPlainSmoothingKernels;
extern const SmoothingKernels kAvx2SmoothingKernels;  ///< where SLF_HAVE_AVX2

/// What the machine can run, the widest last: at least the plain ones.
struct SmoothingKernelList {
  int count;
  const SmoothingKernels* kernels[2];
};
SmoothingKernelList usableSmoothingKernels();

}  // namespace semantic_lidar_fusion

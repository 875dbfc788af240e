// SPDX-License-Identifier: MIT
/// The inner loops of motion compensation: plain C++ for every machine, and a version for wider
/// registers that gives the same bytes (each operation is rounded alone, in the same order). Chosen
/// at run time; see superpixel/slic_kernels.h for why wide versions have files of their own and
/// what may not be in them.
#pragma once

#include <cstdint>

namespace semantic_lidar_fusion {

/// A transform that is linear in time; rows of 3x4 matrices.
struct LinearMotion {
  float start[12];        ///< at ns = 0
  float rate_per_ns[12];  ///< its change
};

struct MotionKernels {
  const char* name;

  /// ns[i] = times[i] - begin for the leading times that lie in begin .. begin + length; returns
  /// how many. `length` < 2^31; all `count` entries of `ns` may be written.
  int (*timesWithin)(const std::int64_t* times, int count, std::int64_t begin, std::uint32_t length,
                     float* ns);

  /// Moves each point as the motion is at its own time.
  void (*move)(const LinearMotion& motion, const float* ns, int count, float* x, float* y,
               float* z);

  /// seconds[i] = times[i] - reference in s, for differences that fit 32 bits in ns.
  void (*secondsSince)(std::int64_t reference, const std::int64_t* times, int count,
                       float* seconds);
};

extern const MotionKernels kPlainMotionKernels;
extern const MotionKernels kAvx2MotionKernels;  ///< where SLF_HAVE_AVX2

/// What the machine can run, the widest last: at least the plain ones.
struct MotionKernelList {
  int count;
  const MotionKernels* kernels[2];
};
MotionKernelList usableMotionKernels();

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The inner loop over the times of a cloud: plain C++ for every machine, and a version for wider
/// registers with the same result. Chosen at run time; see superpixel/slic_kernels.h for why wide
/// versions have files of their own and what may not be in them.
#pragma once

#include <cstdint>

namespace semantic_lidar_fusion {

struct TimeKernels {
  const char* name;

  /// The earliest and the latest of `count` >= 1 times.
  void (*span)(const std::int64_t* times, int count, std::int64_t* first, std::int64_t* last);
};

extern const TimeKernels kPlainTimeKernels;
extern const TimeKernels kAvx2TimeKernels;  ///< where SLF_HAVE_AVX2

/// What the machine can run, the widest last: at least the plain ones.
struct TimeKernelList {
  int count;
  const TimeKernels* kernels[2];
};
TimeKernelList usableTimeKernels();

}  // namespace semantic_lidar_fusion

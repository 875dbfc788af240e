// SPDX-License-Identifier: MIT
#include "smoothing_kernels.h"

#include "smoothing_kernels_body.h"

namespace semantic_lidar_fusion {

const SmoothingKernels kPlainSmoothingKernels{"plain", logarithms, exponentials, average, softmax};

SmoothingKernelList usableSmoothingKernels() {
  SmoothingKernelList list{1, {&kPlainSmoothingKernels, nullptr}};
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) list.kernels[list.count++] = &kAvx2SmoothingKernels;
#endif
  return list;
}

}  // namespace semantic_lidar_fusion

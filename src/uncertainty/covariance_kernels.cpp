// SPDX-License-Identifier: MIT
#include "covariance_kernels.h"

#include "covariance_kernels_body.h"

namespace semantic_lidar_fusion {

const CovarianceKernels kPlainCovarianceKernels{"plain", equidistant, covariances};

CovarianceKernelList usableCovarianceKernels() {
  CovarianceKernelList list{1, {&kPlainCovarianceKernels, nullptr}};
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) list.kernels[list.count++] = &kAvx2CovarianceKernels;
#endif
  return list;
}

}  // namespace semantic_lidar_fusion

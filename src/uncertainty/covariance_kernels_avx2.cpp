// SPDX-License-Identifier: MIT
#include "covariance_kernels_body.h"

namespace semantic_lidar_fusion {

const CovarianceKernels kAvx2CovarianceKernels{"AVX2", equidistant, covariances};

}  // namespace semantic_lidar_fusion

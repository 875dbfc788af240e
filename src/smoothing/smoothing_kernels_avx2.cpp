// SPDX-License-Identifier: MIT
#include "smoothing_kernels_body.h"

namespace semantic_lidar_fusion {

const SmoothingKernels kAvx2SmoothingKernels{"AVX2", logarithms, exponentials, average, softmax};

}  // namespace semantic_lidar_fusion

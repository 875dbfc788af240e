// SPDX-License-Identifier: MIT
#pragma once

#include <pybind11/numpy.h>

#include "semantic_lidar_fusion/common/cloud_bytes.h"

namespace semantic_lidar_fusion {

/// A structured array (N,) that takes the bytes over: those of the message that would be published.
pybind11::array structuredArray(CloudBytes&& bytes);

}  // namespace semantic_lidar_fusion

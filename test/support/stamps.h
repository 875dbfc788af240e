// SPDX-License-Identifier: MIT
#pragma once

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

constexpr StampNs kMs = 1000000;
/// A stamp of our days: sums of such stamps overflow, differences must not.
constexpr StampNs kStart = 1500000000 * kNsPerSecond;
/// The same with a digit in every place.
constexpr StampNs kUnroundStart = 1673400472138016708;

}  // namespace semantic_lidar_fusion

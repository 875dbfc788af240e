// SPDX-License-Identifier: MIT
/// What the plain and the wide kernels share. Everything here is local to the file that includes
/// it, so that each compiles its own copy.
#pragma once

#include "map_kernels.h"

namespace semantic_lidar_fusion {
namespace {

// ln(1 + f) = f - f^2/2 + f^3 (k0 + f (k1 + ...)) on [sqrt(1/2) - 1, sqrt(2) - 1] (Cephes, logf).
constexpr float kLog[9] = {3.3333331174e-1f,  -2.4999993993e-1f, 2.0000714765e-1f,
                           -1.6668057665e-1f, 1.4249322787e-1f,  -1.2420140846e-1f,
                           1.1676998740e-1f,  -1.1514610310e-1f, 7.0376836292e-2f};
// The bits of sqrt(1/2), and those of a significand.
constexpr int kRootHalfBits = 0x3f3504f3;
constexpr int kSignificand = 0x007fffff;

// z shares 32 bits with the layer.
constexpr double kMaxIndex = 536870912.0;
constexpr double kPositionUnit = 1048576.0;

}  // namespace
}  // namespace semantic_lidar_fusion

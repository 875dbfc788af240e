// SPDX-License-Identifier: MIT
#pragma once

namespace semantic_lidar_fusion {

/// floor() of a value within the range of `Int`; the library's is a call on processors before
/// SSE 4.1.
template <typename Int>
inline Int floorTo(double value) {
  const Int whole = static_cast<Int>(value);
  return whole - (value < static_cast<double>(whole) ? 1 : 0);
}

}  // namespace semantic_lidar_fusion

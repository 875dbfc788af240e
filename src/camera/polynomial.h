// SPDX-License-Identifier: MIT
#pragma once

#include <limits>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

/// Polynomial, lowest power first.
using Polynomial = std::vector<double>;

double evaluate(const Polynomial& polynomial, double x);
Polynomial derivative(const Polynomial& polynomial);
Polynomial product(const Polynomial& a, const Polynomial& b);

/// Root of `f` between lo and hi, where its signs differ.
template <typename Function>
double bisect(const Function& f, double lo, double hi) {
  const bool rising = f(lo) < 0.0;
  for (;;) {
    const double middle = 0.5 * (lo + hi);
    if (middle <= lo || middle >= hi) return middle;
    ((f(middle) < 0.0) == rising ? lo : hi) = middle;
  }
}

/// First sign change in (lo, hi); infinite if there is none.
double firstRoot(const Polynomial& polynomial, double lo, double hi);

}  // namespace semantic_lidar_fusion

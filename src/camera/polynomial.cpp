// SPDX-License-Identifier: MIT
#include "polynomial.h"

#include <cstddef>

namespace semantic_lidar_fusion {
namespace {

/// The sign changes of a polynomial in (lo, hi), ascending. Between two neighbouring extrema there
/// is at most one, so that none is missed however close they lie.
std::vector<double> signChanges(Polynomial polynomial, double lo, double hi) {
  while (!polynomial.empty() && polynomial.back() == 0.0) polynomial.pop_back();
  if (polynomial.size() < 2) return {};
  std::vector<double> borders = signChanges(derivative(polynomial), lo, hi);
  borders.push_back(hi);
  std::vector<double> result;
  double left = lo;
  for (const double right : borders) {
    const double at_left = evaluate(polynomial, left);
    const double at_right = evaluate(polynomial, right);
    if ((at_left < 0.0) != (at_right < 0.0)) {
      result.push_back(bisect([&](double x) { return evaluate(polynomial, x); }, left, right));
    }
    left = right;
  }
  return result;
}

}  // namespace

double evaluate(const Polynomial& polynomial, double x) {
  double sum = 0.0;
  for (auto c = polynomial.rbegin(); c != polynomial.rend(); ++c) sum = sum * x + *c;
  return sum;
}

Polynomial derivative(const Polynomial& polynomial) {
  Polynomial result;
  for (std::size_t i = 1; i < polynomial.size(); ++i) {
    result.push_back(static_cast<double>(i) * polynomial[i]);
  }
  return result;
}

Polynomial product(const Polynomial& a, const Polynomial& b) {
  if (a.empty() || b.empty()) return {};
  Polynomial result(a.size() + b.size() - 1, 0.0);
  for (std::size_t i = 0; i < a.size(); ++i) {
    for (std::size_t j = 0; j < b.size(); ++j) result[i + j] += a[i] * b[j];
  }
  return result;
}

double firstRoot(const Polynomial& polynomial, double lo, double hi) {
  const std::vector<double> roots = signChanges(polynomial, lo, hi);
  return roots.empty() ? kInfinity : roots.front();
}

}  // namespace semantic_lidar_fusion

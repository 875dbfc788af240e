// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/common/softmax_kernels.h"

#include <cmath>
#include <cstdint>
#include <cstring>

namespace semantic_lidar_fusion {
namespace {

std::uint64_t bitsOf(double value) {
  std::uint64_t bits;
  std::memcpy(&bits, &value, sizeof(bits));
  return bits;
}

double fromBits(std::uint64_t bits) {
  double value;
  std::memcpy(&value, &bits, sizeof(value));
  return value;
}

/// exp(x) for x <= 0.
double exponential(double x) {
  if (!(x >= kLeastExponent)) return 0.0;
  const double rounded = x * kLog2E + kRounder;
  const double k = rounded - kRounder;
  const double r = (x - k * kLn2High) - k * kLn2Low;
  const double r2 = r * r, r4 = r2 * r2, r8 = r4 * r4;
  double s[3];
  for (int i = 0; i < 3; ++i) {
    const double* c = kExp + 4 * i;
    s[i] = (c[0] + c[1] * r) + (c[2] + c[3] * r) * r2;
  }
  const double series = (s[0] + s[1] * r4) + (s[2] + kExp[12] * r4) * r8;
  return fromBits(bitsOf(series) + (bitsOf(rounded) << 52));
}

double logarithm(double x) {
  const std::uint64_t bits = bitsOf(x);
  double exponent = static_cast<double>(static_cast<std::int64_t>(bits >> 52)) - 1023.0;
  double mantissa = fromBits((bits & 0xfffffffffffffULL) | 0x3ff0000000000000ULL);
  if (mantissa > kSqrt2) {
    mantissa = mantissa * 0.5;
    exponent = exponent + 1.0;
  }
  const double f = (mantissa - 1.0) / (mantissa + 1.0);
  const double s = f * f;
  double series = kLn[0];
  for (int i = 1; i < 7; ++i) series = kLn[i] + s * series;
  return exponent * kLn2 + f * series;
}

double sumOfLanes(const double* lanes) { return (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]); }

bool softmax(const float* scores, int count, double inverse_tau, double* out) {
  float highest = scores[0];
  bool finite = true;
  for (int c = 0; c < count; ++c) {
    finite = finite && std::isfinite(scores[c]);
    highest = scores[c] > highest ? scores[c] : highest;
  }
  if (!finite) return false;
  double lanes[4] = {0.0, 0.0, 0.0, 0.0};
  for (int c = 0; c < count; ++c) {
    const double below = static_cast<double>(scores[c]) - static_cast<double>(highest);
    // The highest has exponent 0 whatever the temperature, also where 1 / tau is infinite.
    out[c] = below == 0.0 ? 1.0 : exponential(below * inverse_tau);
    lanes[c % 4] += out[c];
  }
  const double sum = sumOfLanes(lanes);
  for (int c = 0; c < count; ++c) out[c] = out[c] / sum;
  return true;
}

double entropy(const double* p, int count) {
  double lanes[4] = {0.0, 0.0, 0.0, 0.0};
  for (int c = 0; c < count; ++c) lanes[c % 4] += p[c] > 0.0 ? p[c] * logarithm(p[c]) : 0.0;
  return -sumOfLanes(lanes);
}

int narrow(const double* p, int count, float* out) {
  int label = 0;
  for (int c = 0; c < count; ++c) {
    out[c] = static_cast<float>(p[c]);
    if (out[c] > out[label]) label = c;
  }
  return label;
}

}  // namespace

const SoftmaxKernels kPlainSoftmaxKernels = {"plain", softmax, entropy, narrow};

const SoftmaxKernels& softmaxKernels() {
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) return kAvx2SoftmaxKernels;
#endif
  return kPlainSoftmaxKernels;
}

}  // namespace semantic_lidar_fusion

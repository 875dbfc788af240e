// SPDX-License-Identifier: MIT
/// Exponentials and logarithms of class distributions in double precision: plain C++ and a version
/// for wider registers that gives the same bytes, in a file of its own. Both are polynomials, so
/// that results do not depend on the machine's mathematics library.
#pragma once

namespace semantic_lidar_fusion {

struct SoftmaxKernels {
  const char* name;

  /// out[c] = exp((scores[c] - highest) * inverse_tau), normalised, for c in 0..count - 1, to
  /// 1e-15 of each; false, with `out` undefined, if a score is not finite. `inverse_tau` >= 0, may
  /// be infinite. `out` does not overlap `scores`.
  bool (*softmax)(const float* scores, int count, double inverse_tau, double* out);

  /// -sum of p ln p in nats, to 1e-11; 0 ln 0 = 0. Each p is in 0..1.
  double (*entropy)(const double* p, int count);

  /// out[c] = p[c] in single precision; returns the index of the largest, the lowest of equal ones.
  int (*narrow)(const double* p, int count, float* out);
};

extern const SoftmaxKernels kPlainSoftmaxKernels;
extern const SoftmaxKernels kAvx2SoftmaxKernels;  ///< where SLF_HAVE_AVX2

/// The fastest that the machine has.
const SoftmaxKernels& softmaxKernels();

// --- What plain and wide versions share. Sums run in four lanes, number c in lane c % 4, which are
// added as (0 + 1) + (2 + 3).

constexpr double kLog2E = 1.4426950408889634074;
constexpr double kLn2High = 6.93145751953125e-1;  ///< 15 bits: exact times any exponent
constexpr double kLn2Low = 1.42860682030941723212e-6;
constexpr double kLn2 = 0.69314718055994530942;
constexpr double kSqrt2 = 1.41421356237309504880;
/// Added and subtracted it rounds a double to an integer, which then is in the low bits.
constexpr double kRounder = 6755399441055744.0;
/// Exponents below give 0: the power of 2 would leave the range of normal numbers.
constexpr double kLeastExponent = -708.0;
/// 1 / 0! ... 1 / 12!, summed in pairs of ever higher powers:
/// s0 = (c0 + c1 r) + (c2 + c3 r) r^2, s1 and s2 likewise, (s0 + s1 r^4) + (s2 + c12 r^4) r^8.
constexpr double kExp[13] = {1.0,
                             1.0,
                             0.5,
                             1.0 / 6.0,
                             1.0 / 24.0,
                             1.0 / 120.0,
                             1.0 / 720.0,
                             1.0 / 5040.0,
                             1.0 / 40320.0,
                             1.0 / 362880.0,
                             1.0 / 3628800.0,
                             1.0 / 39916800.0,
                             1.0 / 479001600.0};
/// ln((1 + f) / (1 - f)) = f * (2 + 2 / 3 f^2 + ... + 2 / 13 f^12), highest power first.
constexpr double kLn[7] = {2.0 / 13.0, 2.0 / 11.0, 2.0 / 9.0, 2.0 / 7.0, 2.0 / 5.0, 2.0 / 3.0, 2.0};

}  // namespace semantic_lidar_fusion

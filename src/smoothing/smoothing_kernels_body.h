// SPDX-License-Identifier: MIT
// The body of both versions of the kernels, in registers of eight lanes that the compiler splits
// where the machine has narrower ones. Vectors pass by reference: their calling convention differs
// between the versions.

#include <cstdint>
#include <cstring>

#include "smoothing_kernels.h"

namespace semantic_lidar_fusion {
namespace {

typedef float Lanes __attribute__((vector_size(4 * kSmoothingLanes)));
typedef std::int32_t IntLanes __attribute__((vector_size(4 * kSmoothingLanes)));
typedef std::uint32_t BitLanes __attribute__((vector_size(4 * kSmoothingLanes)));

constexpr float kLog2EFloat = 1.44269504088896341f;
constexpr float kLn2HighFloat = 0.693359375f;  ///< ten bits: exact times any exponent
constexpr float kLn2LowFloat = -2.12194440e-4f;
/// Added and subtracted it rounds a float to an integer, which then is in the low bits.
constexpr float kFloatRounder = 12582912.0f;
/// Powers of 2 below this exponent are no normal numbers.
constexpr float kLeastFloatExponent = -87.0f;

inline void load(const float* from, Lanes* to) { std::memcpy(to, from, sizeof(Lanes)); }
inline void store(const Lanes& from, float* to) { std::memcpy(to, &from, sizeof(Lanes)); }

inline void bitsOf(const Lanes& value, BitLanes* bits) { std::memcpy(bits, &value, sizeof(Lanes)); }
inline void fromBits(const BitLanes& bits, Lanes* value) {
  std::memcpy(value, &bits, sizeof(Lanes));
}

/// Coefficients of Cephes' expf (S. Moshier), |r| <= ln(2) / 2.
inline void exponential(const Lanes& x, Lanes* out) {
  const Lanes clamped = x < kLeastFloatExponent ? x * 0.0f + kLeastFloatExponent : x;
  const Lanes rounded = clamped * kLog2EFloat + kFloatRounder;
  const Lanes k = rounded - kFloatRounder;
  const Lanes r = (clamped - k * kLn2HighFloat) - k * kLn2LowFloat;
  Lanes series = r * 1.9875691500e-4f + 1.3981999507e-3f;
  series = series * r + 8.3334519073e-3f;
  series = series * r + 4.1665795894e-2f;
  series = series * r + 1.6666665459e-1f;
  series = series * r + 5.0000001201e-1f;
  series = series * (r * r) + r + 1.0f;
  BitLanes exponent, bits;
  bitsOf(rounded, &exponent);
  bitsOf(series, &bits);
  Lanes value;
  fromBits(bits + (exponent << 23), &value);
  *out = x < kLeastFloatExponent ? x * 0.0f : value;
}

/// Coefficients of Cephes' logf (S. Moshier), mantissa in sqrt(1/2)..sqrt(2).
inline void logarithm(const Lanes& x, Lanes* out) {
  BitLanes bits;
  bitsOf(x, &bits);
  // The exponent counted from sqrt(1/2); an arithmetic shift keeps its sign.
  const BitLanes from_root = bits - 0x3f3504f3u;
  IntLanes octaves;
  std::memcpy(&octaves, &from_root, sizeof(octaves));
  octaves = octaves >> 23;
  BitLanes octave_bits;
  std::memcpy(&octave_bits, &octaves, sizeof(octaves));
  Lanes mantissa;
  fromBits(bits - (octave_bits << 23), &mantissa);
  const Lanes e = __builtin_convertvector(octaves, Lanes);
  const Lanes f = mantissa - 1.0f, square = f * f;
  Lanes series = f * 7.0376836292e-2f - 1.1514610310e-1f;
  series = series * f + 1.1676998740e-1f;
  series = series * f - 1.2420140846e-1f;
  series = series * f + 1.4249322787e-1f;
  series = series * f - 1.6668057665e-1f;
  series = series * f + 2.0000714765e-1f;
  series = series * f - 2.4999993993e-1f;
  series = series * f + 3.3333331174e-1f;
  series = series * f * square + e * kLn2LowFloat - 0.5f * square;
  *out = f + series + e * kLn2HighFloat;
}

void logarithms(float* values, int count) {
  for (int k = 0; k < count; k += kSmoothingLanes) {
    Lanes x;
    load(values + k, &x);
    logarithm(x, &x);
    store(x, values + k);
  }
}

void exponentials(float* values, int count) {
  for (int k = 0; k < count; k += kSmoothingLanes) {
    Lanes x;
    load(values + k, &x);
    exponential(x, &x);
    store(x, values + k);
  }
}

void average(const float* rows, const std::int32_t* slots, const float* weights,
             const float* inverse, int stride, int begin, int end, float* out) {
  for (int i = begin; i < end; ++i) {
    const float* own = rows + static_cast<std::int64_t>(i) * stride;
    const float* of[kSmoothingLinks];
    for (int n = 0; n < kSmoothingLinks; ++n) {
      of[n] = rows + static_cast<std::int64_t>(slots[kSmoothingLinks * i + n]) * stride;
    }
    const float* w = weights + kSmoothingLinks * static_cast<std::int64_t>(i);
    for (int c = 0; c < stride; c += kSmoothingLanes) {
      Lanes sum;
      load(own + c, &sum);
      for (int n = 0; n < kSmoothingLinks; ++n) {
        Lanes neighbour;
        load(of[n] + c, &neighbour);
        sum = sum + w[n] * neighbour;
      }
      store(sum * inverse[i], out + static_cast<std::int64_t>(i) * stride + c);
    }
  }
}

inline float highestOf(const Lanes& lanes) {
  float highest = lanes[0];
  for (int k = 1; k < kSmoothingLanes; ++k) highest = lanes[k] > highest ? lanes[k] : highest;
  return highest;
}

inline float sumOf(const Lanes& lanes) {
  return ((lanes[0] + lanes[4]) + (lanes[2] + lanes[6])) +
         ((lanes[1] + lanes[5]) + (lanes[3] + lanes[7]));
}

void softmax(float* rows, int stride, int count, float* entropy) {
  for (int i = 0; i < count; ++i) {
    float* row = rows + static_cast<std::int64_t>(i) * stride;
    Lanes most;
    load(row, &most);
    for (int c = kSmoothingLanes; c < stride; c += kSmoothingLanes) {
      Lanes a;
      load(row + c, &a);
      most = a > most ? a : most;
    }
    const float highest = highestOf(most);
    Lanes sums = most * 0.0f, weighted = sums;
    for (int c = 0; c < stride; c += kSmoothingLanes) {
      Lanes a, e;
      load(row + c, &a);
      a = a - highest;
      exponential(a, &e);
      sums = sums + e;
      weighted = weighted + e * a;
      store(e, row + c);
    }
    // H = -sum p (a - ln sum e) = ln sum e - sum e a / sum e
    const float sum = sumOf(sums), inverse = 1.0f / sum;
    Lanes total = most * 0.0f + sum, logarithm_of_total;
    logarithm(total, &logarithm_of_total);
    entropy[i] = logarithm_of_total[0] - sumOf(weighted) * inverse;
    for (int c = 0; c < stride; c += kSmoothingLanes) {
      Lanes e;
      load(row + c, &e);
      store(e * inverse, row + c);
    }
  }
}

}  // namespace
}  // namespace semantic_lidar_fusion

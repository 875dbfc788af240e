// SPDX-License-Identifier: MIT
/// Random numbers that depend on their keys alone, so that nothing depends on threads or order.
#pragma once

#include <Eigen/Core>
#include <cmath>
#include <cstdint>

namespace semantic_lidar_fusion {
namespace simulator {

inline std::uint64_t mixBits(std::uint64_t x) {
  x += 0x9E3779B97F4A7C15ULL;
  x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9ULL;
  x = (x ^ (x >> 27)) * 0x94D049BB133111EBULL;
  return x ^ (x >> 31);
}

inline std::uint64_t mixKeys(std::uint64_t a, std::uint64_t b, std::uint64_t c = 0) {
  return mixBits(mixBits(mixBits(a) ^ b) ^ c);
}

/// A stream of numbers that begins at a key.
class Random {
 public:
  explicit Random(std::uint64_t key) : state_(mixBits(key)) {}
  /// In [0, 1).
  double uniform() {
    state_ += 0x9E3779B97F4A7C15ULL;
    return static_cast<double>(mixBits(state_) >> 11) * 0x1.0p-53;
  }
  double uniform(double least, double most) { return least + (most - least) * uniform(); }
  /// Standard normal (Box-Muller).
  double normal() {
    const double radius = std::sqrt(-2.0 * std::log(1.0 - uniform()));
    return radius * std::cos(6.283185307179586 * uniform());
  }

 private:
  std::uint64_t state_;
};

/// Of a lattice point, in [0, 1).
inline float latticeNoise(int x, int y, std::uint32_t key) {
  std::uint32_t h = static_cast<std::uint32_t>(x) * 0x8DA6B343U ^
                    static_cast<std::uint32_t>(y) * 0xD8163841U ^ key * 0xCB1AB31FU;
  h = (h ^ (h >> 15)) * 0x2C1B3C6DU;
  h = (h ^ (h >> 12)) * 0x297A2D39U;
  return static_cast<float>((h ^ (h >> 15)) >> 8) * 0x1.0p-24F;
}

/// Smooth noise with features of size 1, in [0, 1).
inline float smoothNoise(float x, float y, std::uint32_t key) {
  const float fx = std::floor(x), fy = std::floor(y);
  const int ix = static_cast<int>(fx), iy = static_cast<int>(fy);
  float u = x - fx, v = y - fy;
  u = u * u * (3.0F - 2.0F * u);
  v = v * v * (3.0F - 2.0F * v);
  const float top = latticeNoise(ix, iy, key) * (1.0F - u) + latticeNoise(ix + 1, iy, key) * u;
  const float bottom =
      latticeNoise(ix, iy + 1, key) * (1.0F - u) + latticeNoise(ix + 1, iy + 1, key) * u;
  return top * (1.0F - v) + bottom * v;
}

/// The same in three dimensions.
inline float smoothNoise(const Eigen::Vector3f& p, std::uint32_t key) {
  // A plane of whole z is a lattice of its own.
  const float fz = std::floor(p.z());
  const auto plane = [key](float z) {
    return key ^ (static_cast<std::uint32_t>(static_cast<int>(z)) * 0x9E3779B1U);
  };
  float w = p.z() - fz;
  w = w * w * (3.0F - 2.0F * w);
  return smoothNoise(p.x(), p.y(), plane(fz)) * (1.0F - w) +
         smoothNoise(p.x(), p.y(), plane(fz + 1.0F)) * w;
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

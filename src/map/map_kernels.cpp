// SPDX-License-Identifier: MIT
#include "map_kernels.h"

#include <cstring>

#include "map_kernels_local.h"

namespace semantic_lidar_fusion {

void logEvidencePlain(const float* probabilities, std::size_t count,
                      const EvidenceConstants& constants, const std::int32_t* prior,
                      std::int32_t* evidence) {
  for (std::size_t i = 0; i < count; ++i) {
    // Comparisons in this order make a NaN the floor.
    float p = probabilities[i] > constants.floor ? probabilities[i] : constants.floor;
    p = p < 1.0f ? p : 1.0f;
    std::int32_t bits;
    std::memcpy(&bits, &p, sizeof bits);
    const std::int32_t above = bits - kRootHalfBits;
    const std::int32_t exponent = above >> 23;
    bits = (above & kSignificand) + kRootHalfBits;
    float f;
    std::memcpy(&f, &bits, sizeof f);
    f -= 1.0f;
    float y = kLog[8];
    for (int k = 7; k >= 0; --k) y = y * f + kLog[k];
    const float square = f * f;
    y = f * square * y;
    y = y - 0.5f * square;
    const float logarithm = f + y;
    const std::int32_t fine = static_cast<std::int32_t>(logarithm * constants.scale);
    evidence[i] =
        (exponent * constants.octave + fine - prior[i] + (1 << (kGuardBits - 1))) >> kGuardBits;
  }
}

void countEvidencePlain(const float* probabilities, std::size_t count,
                        const EvidenceConstants& constants, const std::int32_t* /*prior*/,
                        std::int32_t* evidence) {
  for (std::size_t i = 0; i < count; ++i) {
    float p = probabilities[i] > 0.0f ? probabilities[i] : 0.0f;
    p = p < 1.0f ? p : 1.0f;
    evidence[i] = static_cast<std::int32_t>(p * constants.scale + 0.5f);
  }
}

void addEvidencePlain(const std::int32_t* evidence, int class_count, std::int64_t* sums) {
  for (int c = 0; c < class_count; ++c) sums[c] += evidence[c];
}

void placePointsPlain(const PlacementConstants& constants, PlacedPoints* points) {
  constexpr int kCount = PlacedPoints::kMaxPoints;
  const double size = constants.voxel_size_m;
  double inside[kCount];
  for (int i = 0; i < kCount; ++i) inside[i] = 1.0;
  for (int axis = 0; axis < 3; ++axis) {
    const double a = constants.rows[axis][0], b = constants.rows[axis][1];
    const double c = constants.rows[axis][2], d = constants.rows[axis][3];
    std::int32_t* const index = points->index[axis];
    std::int32_t* const offset = points->offset[axis];
    for (int i = 0; i < kCount; ++i) {
      const double at = a * static_cast<double>(points->x[i]) +
                        b * static_cast<double>(points->y[i]) +
                        c * static_cast<double>(points->z[i]) + d;
      double cell = at / size;
      const bool far = !(cell < kMaxIndex) | !(cell > -kMaxIndex);
      inside[i] = far ? 0.0 : inside[i];
      cell = far ? 0.0 : cell;
      double whole = static_cast<double>(static_cast<std::int32_t>(cell));
      whole -= cell < whole ? 1.0 : 0.0;
      index[i] = static_cast<std::int32_t>(whole);
      // Not negative by more than a rounding error, so that the cast rounds down.
      double within = (at - whole * size) * kPositionUnit + 0.5;
      within = far ? 0.0 : within;
      offset[i] = static_cast<std::int32_t>(within);
    }
  }
  for (int i = 0; i < kCount; ++i) points->inside[i] = inside[i] > 0.0 ? 1 : 0;
}

EvidenceKernel logEvidence() {
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) return logEvidenceAvx2;
#endif
  return logEvidencePlain;
}

EvidenceKernel countEvidence() {
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) return countEvidenceAvx2;
#endif
  return countEvidencePlain;
}

AddEvidence addEvidence() {
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) return addEvidenceAvx2;
#endif
  return addEvidencePlain;
}

PlacePoints placePoints() {
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) return placePointsAvx2;
#endif
  return placePointsPlain;
}

}  // namespace semantic_lidar_fusion

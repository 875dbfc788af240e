// SPDX-License-Identifier: MIT
/// The inner loops of the voxel map, plain and for wider registers (see slic_kernels.h for why the
/// wide ones have a file of their own). All give the same integers.
#pragma once

#include <cstddef>
#include <cstdint>

namespace semantic_lidar_fusion {

/// Fractional bits below those of the result, with which the logarithm is added up.
constexpr int kGuardBits = 6;

struct EvidenceConstants {
  float floor = 0.0f;
  float scale = 0.0f;
  std::int32_t octave = 0;
};

/// evidence[i] = round(octave * e + scale * ln(m) - prior[i]), P = m 2^e, m in [sqrt(1/2),
/// sqrt(2)); the arguments have kGuardBits more fractional bits than the result.
using EvidenceKernel = void (*)(const float* probabilities, std::size_t count,
                                const EvidenceConstants& constants, const std::int32_t* prior,
                                std::int32_t* evidence);

void logEvidencePlain(const float* probabilities, std::size_t count,
                      const EvidenceConstants& constants, const std::int32_t* prior,
                      std::int32_t* evidence);
void logEvidenceAvx2(const float* probabilities, std::size_t count,
                     const EvidenceConstants& constants, const std::int32_t* prior,
                     std::int32_t* evidence);
/// evidence[i] = round(scale * P).
void countEvidencePlain(const float* probabilities, std::size_t count,
                        const EvidenceConstants& constants, const std::int32_t* prior,
                        std::int32_t* evidence);
void countEvidenceAvx2(const float* probabilities, std::size_t count,
                       const EvidenceConstants& constants, const std::int32_t* prior,
                       std::int32_t* evidence);

/// sums[c] += evidence[c]
using AddEvidence = void (*)(const std::int32_t* evidence, int class_count, std::int64_t* sums);
void addEvidencePlain(const std::int32_t* evidence, int class_count, std::int64_t* sums);
void addEvidenceAvx2(const std::int32_t* evidence, int class_count, std::int64_t* sums);

/// Where a batch of points lies.
struct PlacedPoints {
  static constexpr int kMaxPoints = 64;
  float x[kMaxPoints], y[kMaxPoints], z[kMaxPoints];  ///< lidar frame, m
  std::int32_t index[3][kMaxPoints];                  ///< voxel in the map frame
  std::int32_t offset[3][kMaxPoints];                 ///< from the voxel's corner, 2^-20 m
  std::uint8_t inside[kMaxPoints];                    ///< 0: beyond 2^29 voxels, or not finite
};

struct PlacementConstants {
  double rows[3][4];  ///< T_map_lidar
  double voxel_size_m;
};

/// Fills index, offset and inside of all kMaxPoints points (unused ones must hold numbers).
using PlacePoints = void (*)(const PlacementConstants& constants, PlacedPoints* points);
void placePointsPlain(const PlacementConstants& constants, PlacedPoints* points);
void placePointsAvx2(const PlacementConstants& constants, PlacedPoints* points);

/// The fastest that the machine has.
EvidenceKernel logEvidence();
EvidenceKernel countEvidence();
AddEvidence addEvidence();
PlacePoints placePoints();

}  // namespace semantic_lidar_fusion

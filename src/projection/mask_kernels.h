// SPDX-License-Identifier: MIT
/// The inner loops of the masks of surfaces: plain C++ for every machine, and a version for wider
/// registers that gives the same bytes (each operation is rounded alone, in the same order). Chosen
/// at run time; see superpixel/slic_kernels.h for why wide versions have files of their own and
/// what may not be in them.
#pragma once

#include <cstdint>

namespace semantic_lidar_fusion {

/// Masks that are made together.
constexpr int kMaskBlock = 128;
/// px around each mask, so that twisted neighbours leave no cracks.
constexpr float kMaskSlack_px = 0.5f;

enum MaskSide { kMaskLeft, kMaskRight, kMaskUp, kMaskDown, kMaskSides };

/// Points in the lidar's frame, and where the camera sees them.
struct ArmTargets {
  float x[kMaskSides * kMaskBlock], y[kMaskSides * kMaskBlock], z[kMaskSides * kMaskBlock];  ///< m
  float u[kMaskSides * kMaskBlock], v[kMaskSides * kMaskBlock];  ///< px; u is NaN: no pixel
  float nearness[kMaskSides * kMaskBlock];  ///< 1 / distance to the camera, at most 1000
};

/// Equidistant lens (paper, eq. 6-11) in double precision.
struct ExactLens {
  double matrix[12];  ///< rows of the transform from the lidar to the axes of the image
  double focal_x, focal_y, skew, centre_x, centre_y;  ///< px; skew as a part of focal_x
  double k[4];
  double theta_end;  ///< rad, larger angles have no pixel
};

/// The points that cast, and the ends of their masks as seen from them.
struct MaskCasters {
  float u[kMaskBlock], v[kMaskBlock];  ///< px
  float nearness[kMaskBlock];
  float arm_u[kMaskSides][kMaskBlock], arm_v[kMaskSides][kMaskBlock];  ///< px, from the point
  float arm_nearness[kMaskSides][kMaskBlock];
};

/// The points in the image, sorted by tiles, row by row.
struct TiledPoints {
  float per_px;  ///< tiles
  int columns, rows;
  const std::uint32_t* begin;  ///< first point of each tile, one more than tiles
  const float* far;            ///< farthest of each tile, m
  const float* far_of_four;    ///< of each tile and those right, below, and right below it
  const float *u, *v, *distance;
  const std::uint32_t* place;    ///< in the projected points
  float margin_m, margin_ratio;  ///< that a hidden point is behind a mask
};

/// The parallelogram from the left to the right arm's end, swept along the arm up or down:
/// pixel = centre + s across + along t, s in -1..1, t in 0..1; its inverse distance is linear.
struct HalfMask {
  float centre_u, centre_v;  ///< px
  float s_u, s_v, t_u, t_v;  ///< s = s_u du + s_v dv, with du and dv from the centre
  float s_most, t_slack;
  float nearness, s_gain, t_gain, least, most;  ///< of the mask, and its bounds
  float nearest;                                ///< m, it hides nothing up to there
  std::int32_t tile_left, tile_right, tile_top, tile_bottom;
};

struct MaskKernels {
  const char* name;

  /// Projects the first `count` targets; the pixels are right to 1e-12 of the focal length.
  void (*projectTargets)(const ExactLens& lens, int count, ArmTargets* targets);

  /// The halves of the masks of the first `count` casters in whose tiles something is farther than
  /// they hide up to. `halves` has room for 2 * kMaskBlock. Returns how many.
  int (*castHalves)(const MaskCasters& casters, int count, const TiledPoints& points,
                    HalfMask* halves);

  /// Clears visible[place] of the points in the mask's tiles that it hides.
  void (*hide)(const HalfMask& mask, const TiledPoints& points, std::uint8_t* visible);
};

extern const MaskKernels kPlainMaskKernels;
extern const MaskKernels kAvx2MaskKernels;  ///< where SLF_HAVE_AVX2

/// The fastest that the machine has.
const MaskKernels& maskKernels();

// --- What plain and wide versions share

/// The plain loops from number `first` on: what is left of a block that is no multiple of a
/// register.
void projectTargetsFrom(const ExactLens& lens, int first, int count, ArmTargets* targets);
int castHalvesFrom(const MaskCasters& casters, int first, int count, const TiledPoints& points,
                   int found, HalfMask* halves);
/// The plain test of points [first, end).
void hideFrom(const HalfMask& mask, const TiledPoints& points, std::uint32_t first,
              std::uint32_t end, std::uint8_t* visible);
/// Whether something in the tiles of the mask is farther than it hides up to.
bool anythingBehind(const HalfMask& mask, const TiledPoints& points);

/// atan(x) = x + x z P(z) / Q(z), z = x^2, for |x| <= 0.66, to 2e-16 (Cephes, S. Moshier); highest
/// power first. Q begins with 1.
constexpr double kAtanP[5] = {-8.750608600031904122785e-1, -1.615753718733365076637e1,
                              -7.500855792314704667340e1, -1.228866684490136173410e2,
                              -6.485021904942025371773e1};
constexpr double kAtanQ[5] = {2.485846490142306297962e1, 1.650270098316988542046e2,
                              4.328810604912902668951e2, 4.853903996359136964868e2,
                              1.945506571482613964425e2};
constexpr double kAtanTurned = 0.66;  ///< beyond: atan(x) = pi / 4 + atan((x - 1) / (x + 1))
constexpr double kAtanQuarter = 0.78539816339744830962;
constexpr double kAtanHalf = 1.57079632679489661923;
constexpr double kAtanWhole = 3.14159265358979323846;
/// The arms along which the two halves of a mask are swept.
constexpr MaskSide kHalfSides[2] = {kMaskUp, kMaskDown};
constexpr double kLeastMaskDistance = 1e-3;  ///< m
/// Masks whose area is smaller than this part of their extent, px, are seen edge-on and hide
/// nothing: they would be all slack, and that runs far beyond their acute corners.
constexpr float kEdgeOn = 0.1f;

}  // namespace semantic_lidar_fusion

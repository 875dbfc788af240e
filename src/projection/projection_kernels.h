// SPDX-License-Identifier: MIT
/// The inner loops of projection: plain C++ for every machine, and a version for wider registers
/// that gives the same bytes (each operation is rounded alone, in the same order). Chosen at run
/// time; see superpixel/slic_kernels.h for why wide versions have files of their own and what may
/// not be in them.
#pragma once

#include <cstdint>

namespace semantic_lidar_fusion {

/// Points that are worked on together.
constexpr int kProjectionBlock = 512;
/// Length of arrays that kernels write a block to: wide versions write whole registers.
constexpr int kProjectionRoom = kProjectionBlock + 8;

/// A cone about the optical axis that holds every point which may have a pixel, with slack for
/// single precision.
struct SightCone {
  float matrix[12];  ///< rows of the transform from the lidar to the axes of the image
  float cosine;      ///< of the half angle
  float reach_m;     ///< what the translation may lose to rounding
};

/// Points of a block, and where in the block they come from.
struct SelectedPoints {
  float x[kProjectionRoom], y[kProjectionRoom], z[kProjectionRoom];
  std::uint32_t place[kProjectionRoom];
};

/// Equidistant lens (paper, eq. 6-11) and the bounds of its image.
struct EquidistantLens {
  double matrix[12];  ///< rows of the transform from the lidar to the axes of the image
  float focal_x, focal_y, skew, centre_x, centre_y;  ///< px; skew as a part of focal_x
  float k[4];
  float theta_sure;                      ///< rad, smaller angles have a pixel
  float theta_never;                     ///< rad, larger angles have none
  float u_begin, u_end, v_begin, v_end;  ///< px
};

/// Pixels of those points of a block that lie within the bounds. The points in `doubtful` (indices
/// into the other arrays) are there too, with numbers that mean nothing: their angle is at the
/// limit, or they lie on the axis, in the camera's centre or beyond all measure.
struct PixelBlock {
  float u[kProjectionRoom], v[kProjectionRoom];  ///< px
  float distance[kProjectionRoom];               ///< m
  float theta[kProjectionRoom];                  ///< rad
  std::uint32_t place[kProjectionRoom];          ///< as in SelectedPoints
  std::uint32_t doubtful[kProjectionRoom];
  int doubtful_count;
};

/// A Twist in single precision.
struct Flow {
  float velocity[3];  ///< m/s
  float turn[3];      ///< rad/s
};

/// Rows of a rolling shutter behind an equidistant lens. Single precision suffices for times.
struct RollingRows {
  float matrix[12];  ///< rows of the transform from the lidar to the image's axes
  float k[5];        ///< 1, and the coefficients of the lens (eq. 9)
  float per_right, per_down, at_centre;  ///< px: the row of a direction (a, b) on the image plane
  float begin, end;                      ///< px; rows beyond count as these
  float at_zero_s, per_px_s;             ///< when rows are exposed
  float theta_sure, theta_never;         ///< rad, as in EquidistantLens, with slack for the matrix
  float least_squared_m2;                ///< of points whose angle is right within that slack
  Flow in_image, in_lidar;               ///< of what stands still, in both axes
};

struct ProjectionKernels {
  const char* name;

  /// Copies the points in the cone whose status is not `excluded`; returns how many.
  /// `count` <= kProjectionBlock.
  int (*select)(const SightCone& cone, const float* x, const float* y, const float* z,
                const std::uint8_t* status, std::uint8_t excluded, int count, SelectedPoints* out);

  /// Projects the first `count` points; returns how many have a pixel or are doubtful. Where they
  /// are not doubtful, the angle is right to 5e-7 rad.
  int (*equidistant)(const EquidistantLens& lens, const SelectedPoints& points, int count,
                     PixelBlock* out);

  /// Moves the first `count` points to where they are when their rows are exposed: two rounds, of
  /// which the second follows the secant. Returns how many have a pixel in both; of a point that is
  /// doubtful in either x is NaN, so that `equidistant` doubts it too.
  int (*roll)(const RollingRows& rows, const SelectedPoints& points, int count,
              SelectedPoints* out);
};

extern const ProjectionKernels kPlainProjectionKernels;
extern const ProjectionKernels kAvx2ProjectionKernels;  ///< where SLF_HAVE_AVX2

/// What the machine can run, the widest last: at least the plain ones.
struct ProjectionKernelList {
  int count;
  const ProjectionKernels* kernels[2];
};
ProjectionKernelList usableProjectionKernels();

// --- What plain and wide versions share

/// atan(q) = q * (kAtan[0] + q^2 * (kAtan[1] + ...)) for q in 0..1, to 1.2e-8.
constexpr float kAtan[9] = {1.000000000e+00f,  -3.333306611e-01f, 1.999248415e-01f,
                            -1.420257092e-01f, 1.063675433e-01f,  -7.495445758e-02f,
                            4.258760810e-02f,  -1.600502990e-02f, 2.834064187e-03f};
/// The same to 1.2e-5 (Abramowitz and Stegun, 4.4.49): 0.02 px, which a row needs 0.3 us for.
constexpr float kRoughAtan[5] = {0.9998660f, -0.3302995f, 0.1801410f, -0.0851330f, 0.0208351f};
constexpr float kHalfTurn = 3.14159274f;
constexpr float kQuarterTurn = 1.57079637f;
/// Within these bounds single precision has the accuracy that is promised.
constexpr double kLeastSquaredDistance = 1e-12;
constexpr double kMostSquaredDistance = 1e24;
constexpr float kLeastFromAxis = 1e-15f;
constexpr float kMostSelectable = 1e18f;

/// The plain loops from point `first` on, appending to `selected` or `kept` points: what is left
/// of a block that is no multiple of a register.
int selectFrom(const SightCone& cone, const float* x, const float* y, const float* z,
               const std::uint8_t* status, std::uint8_t excluded, int first, int count,
               int selected, SelectedPoints* out);
int equidistantFrom(const EquidistantLens& lens, const SelectedPoints& points, int first, int count,
                    int kept, PixelBlock* out);
int rollFrom(const RollingRows& rows, const SelectedPoints& points, int first, int count, int kept,
             SelectedPoints* out);

}  // namespace semantic_lidar_fusion

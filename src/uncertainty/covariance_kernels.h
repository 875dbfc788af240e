// SPDX-License-Identifier: MIT
/// The inner loops of pixel covariances. One body (covariance_kernels_body.h) is compiled for every
/// machine and for wider registers: each operation is rounded alone, in the same order, so both
/// give the same bytes. Chosen at run time; see superpixel/slic_kernels.h for why wide versions
/// have files of their own and what may not be in them.
#pragma once

namespace semantic_lidar_fusion {

/// Points that are worked on together.
constexpr int kCovarianceBlock = 256;
/// Numbers of a symmetric matrix of six: its upper triangle, row by row.
constexpr int kSymmetric6 = 21;

/// Points of a block. Axes of the image: those in which the lens maps, x right, y down, z forward.
struct CovarianceBlock {
  float x[kCovarianceBlock], y[kCovarianceBlock], z[kCovarianceBlock];  ///< m, axes of the image
  float theta[kCovarianceBlock];                                        ///< rad, from the axis
  /// From where the beam began to the point: lidar's axes, m; its length, and that of (x, y).
  float beam_x[kCovarianceBlock], beam_y[kCovarianceBlock], beam_z[kCovarianceBlock];
  float range[kCovarianceBlock], flat_range[kCovarianceBlock];
  float motion_s2[kCovarianceBlock];  ///< motionVariance of the time to the image
  float ju[3][kCovarianceBlock], jv[3][kCovarianceBlock];  ///< the lens's Jacobian, px/m
  float uu[kCovarianceBlock], uv[kCovarianceBlock], vv[kCovarianceBlock];  ///< the result, px^2
};

/// radius(theta) = theta (1 + k1 theta^2 + ... + k4 theta^8), and its slope.
struct RadialFit {
  float focal_x, focal_y, skew;  ///< px; skew as a part of focal_x
  float k[4];
};

struct CovarianceConstants {
  float common[kSymmetric6], odometry[kSymmetric6];  ///< of motions in the axes of the image
  float rotation[9];  ///< rows of the rotation from the lidar's axes to the image's
  float range_m2, side_rad2, up_rad2;  ///< variances of the beam
  float own_uu, own_vv;                ///< px^2, of each pixel alone
};

struct CovarianceKernels {
  const char* name;

  /// Fills ju and jv of `count` points.
  void (*equidistant)(const RadialFit& lens, int count, CovarianceBlock* block);

  /// Fills uu, uv and vv of `count` points from ju and jv.
  void (*covariances)(const CovarianceConstants& constants, bool odometry, bool beam, int count,
                      CovarianceBlock* block);
};

extern const CovarianceKernels kPlainCovarianceKernels;
extern const CovarianceKernels kAvx2CovarianceKernels;  ///< where SLF_HAVE_AVX2

/// What the machine can run, the widest last: at least the plain ones.
struct CovarianceKernelList {
  int count;
  const CovarianceKernels* kernels[2];
};
CovarianceKernelList usableCovarianceKernels();

}  // namespace semantic_lidar_fusion

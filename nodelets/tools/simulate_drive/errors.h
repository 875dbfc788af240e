// SPDX-License-Identifier: MIT
/// By how much what the bag says of the rig is wrong. Drawn by the seed, and told.
#pragma once

#include <cstdint>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {
namespace simulator {

/// Standard deviations; 0 = exact.
struct ErrorSizes {
  double rotation_deg = 0.0, translation_m = 0.0;  ///< of each camera's pose, around and along
                                                   ///< each axis
  double stamp_s = 0.0;                            ///< of each image's exposure
  double focal_share = 0.0, centre_px = 0.0;       ///< of each camera; px of full-size images
  /// Of the body's velocity (m/s) and rate (deg/s) along and around each of its axes, with this
  /// correlation time (s): in place of the errors of wheels and gyroscope.
  double velocity_mps = 0.0, rate_dps = 0.0, correlation_s = 1.0;

  bool ofOdometry() const { return velocity_mps > 0.0 || rate_dps > 0.0; }
};

/// What of a lens is told wrong, px.
struct Intrinsics {
  double fx = 1.0, fy = 1.0, cx = 0.0, cy = 0.0;
};

class DrawnErrors {
 public:
  DrawnErrors(const ErrorSizes& sizes, std::uint64_t seed) : sizes_(sizes), seed_(seed) {}

  /// T_said_real of a camera: where it really is, in the frame that tf gives it. A pose's error is
  /// [translation; rotation vector] in that frame.
  Transform ofPose(std::size_t camera) const;
  /// A lens as it really is, px of images `scale` times full size.
  Intrinsics real(const Intrinsics& said, std::size_t camera, double scale) const;
  /// How much later than its stamp an image is exposed, s.
  double ofStamp(StampNs stamp, std::size_t camera) const;

  const ErrorSizes& sizes() const { return sizes_; }
  std::uint64_t seed() const { return seed_; }

 private:
  ErrorSizes sizes_;
  std::uint64_t seed_;
};

}  // namespace simulator
}  // namespace semantic_lidar_fusion

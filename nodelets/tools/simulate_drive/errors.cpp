// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/errors.h"

#include "tools/simulate_drive/noise.h"

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

// What a key is for.
constexpr std::uint64_t kPoses = 0xE81, kLenses = 0xE82, kStamps = 0xE83;

}  // namespace

Transform DrawnErrors::ofPose(std::size_t camera) const {
  Transform T = Transform::Identity();
  if (sizes_.rotation_deg <= 0.0 && sizes_.translation_m <= 0.0) return T;
  Random random(mixKeys(seed_, kPoses, camera));
  Eigen::Vector3d translation, rotation;
  for (double& value : translation) value = sizes_.translation_m * random.normal();
  for (double& value : rotation) value = sizes_.rotation_deg * kRadPerDeg * random.normal();
  T.translation() = translation;
  if (!rotation.isZero(0.0)) {
    T.linear() = Eigen::AngleAxisd(rotation.norm(), rotation.normalized()).toRotationMatrix();
  }
  return T;
}

Intrinsics DrawnErrors::real(const Intrinsics& said, std::size_t camera, double scale) const {
  Intrinsics lens = said;
  if (sizes_.focal_share <= 0.0 && sizes_.centre_px <= 0.0) return lens;
  Random random(mixKeys(seed_, kLenses, camera));
  const double stretch = 1.0 + sizes_.focal_share * random.normal();
  const double right = sizes_.centre_px * scale * random.normal();
  const double down = sizes_.centre_px * scale * random.normal();
  lens.fx *= stretch;
  lens.fy *= stretch;
  lens.cx += right;
  lens.cy += down;
  return lens;
}

double DrawnErrors::ofStamp(StampNs stamp, std::size_t camera) const {
  if (sizes_.stamp_s <= 0.0) return 0.0;
  Random random(mixKeys(seed_ ^ kStamps, static_cast<std::uint64_t>(stamp), camera));
  return sizes_.stamp_s * random.normal();
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

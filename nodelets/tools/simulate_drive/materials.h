// SPDX-License-Identifier: MIT
/// What materials look like to a camera and to a lidar.
#pragma once

#include <Eigen/Core>

#include "tools/simulate_drive/world.h"

namespace semantic_lidar_fusion {
namespace simulator {

struct Surface {
  Eigen::Vector3f albedo = Eigen::Vector3f::Zero();
  float gloss = 0.0F;  ///< of a mirror for the sky
  float shine = 0.0F;  ///< of the sun's highlight
  float glow = 0.0F;   ///< own light
  bool thin = false;   ///< lets light through from behind
};

/// The place on an object that a camera looks at.
struct Place {
  const Eigen::Vector3f& tint;
  const Eigen::Vector3f& p;   ///< object coordinates, m
  const Eigen::Vector3f& n;   ///< the normal in them
  const Eigen::Vector2f& uv;  ///< texture
  float distance;             ///< from the camera, m
};
Surface surfaceOf(Material material, const Place& place);

/// What a lidar sees of a material: the share of light that comes back, and the share of pulses
/// that are lost in glass and the like.
struct LidarResponse {
  float reflectivity = 0.3F;
  float lost = 0.0F;
};
LidarResponse lidarResponse(Material material, const Eigen::Vector3f& tint);

/// From 0 at `from` to 1 at `to`.
float smoothStep(float from, float to, float x);

}  // namespace simulator
}  // namespace semantic_lidar_fusion

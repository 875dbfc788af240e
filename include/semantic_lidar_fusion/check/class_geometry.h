// SPDX-License-Identifier: MIT
/// Classes against geometry that no network mistakes: what lies on the ground has a class of
/// ground, what stands high above it has not, and no return of a lidar is sky.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/label_set.h"
#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

/// The fullest horizontal plane within 20 m, in the vehicle's frame.
struct GroundPlane {
  double height_m = 0.0;
  double share = 0.0;           ///< of the points within 20 m that lie on it
  double above_lidar_m = 0.0;   ///< negative for an upright lidar
  bool has_other_side = false;  ///< a plane at least half as full lies on the lidar's other side
};
/// Empty with fewer than 200 points within 20 m.
std::optional<GroundPlane> groundPlane(const Cloud& cloud, const Transform& T_vehicle_lidar);

/// The labels of one camera's own points, by where they lie.
class ClassGeometry {
 public:
  using Histogram = std::array<std::uint64_t, 256>;

  /// Adds the points of `cloud` that camera `camera` alone gave a class.
  void add(const SemanticCloud& cloud, int camera, const Transform& T_vehicle_lidar,
           const GroundPlane& ground);

  enum class Verdict : std::uint8_t {
    kFine,
    kTooFew,         ///< points, or no class of the set is known as ground or sky
    kIdsTooHigh,     ///< ids one lower fit the geometry
    kIdsTooLow,      ///< ids one higher fit the geometry
    kGroundIsOther,  ///< most of the ground has another class
    kGroundIsHigh,   ///< ground is seen high above the ground
    kSky,            ///< points are sky
  };
  /// The verdict and the sentence on it, which is empty if all is well.
  struct Answer {
    Verdict verdict = Verdict::kTooFew;
    std::string text;
  };
  Answer judge(const LabelSet& classes) const;

 private:
  Histogram on_ground_{}, high_{}, all_{};
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The lidar's own range image: its returns in rows of one laser each, sorted by azimuth.
#pragma once

#include <cstdint>
#include <vector>

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/projection/occlusion_config.h"

namespace semantic_lidar_fusion {

class ThreadPool;

constexpr float kTwoPi = 6.28318530717958647692f;

inline double radians(double degrees) { return degrees * kPi / 180.0; }

/// A cloud as rows of returns sorted by azimuth. A return's *place* is its index in these arrays.
struct RangeImage {
  std::vector<float> x, y, z;            ///< m
  std::vector<float> azimuth;            ///< rad, -pi..pi, ascending in each row
  std::vector<float> range;              ///< m
  std::vector<std::uint32_t> index;      ///< into the cloud
  std::vector<std::uint32_t> row_begin;  ///< places, one more than rows
  std::vector<std::uint16_t> row_of;     ///< by cloud index; kNoRing = not used

  int rows() const { return static_cast<int>(row_begin.size()) - 1; }
  std::uint32_t count(int row) const { return row_begin[row + 1] - row_begin[row]; }
  /// Above the horizontal, rad.
  float elevation(std::uint32_t place) const;
};

/// Points without odometry and those in the lidar's origin are left out. The rows are the rings; a
/// cloud without rings is cut at every `vertical_step_deg` of elevation. Throws DataError when
/// neither is there. The result does not depend on `pool`.
RangeImage rangeImage(const Cloud& cloud, const OcclusionConfig& config, ThreadPool* pool);

}  // namespace semantic_lidar_fusion

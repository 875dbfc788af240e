// SPDX-License-Identifier: MIT
/// The lidar's own range image: its returns in rows of one laser each, sorted by azimuth.
#pragma once

#include <cstdint>
#include <string>
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
  int turns = 1;                         ///< each has rows() / turns rows, one after the other
  double step_rad = 0;                   ///< height of rows that were cut by angle; 0: of others
  bool scattered = false;                ///< no pattern in azimuth either: steps of step_rad there
  std::string note;                      ///< what to tell a user; mostly empty

  int rows() const { return static_cast<int>(row_begin.size()) - 1; }
  std::uint32_t count(int row) const { return row_begin[row + 1] - row_begin[row]; }
  /// Above the horizontal, rad.
  float elevation(std::uint32_t place) const;
};

/// Points without odometry and those in the lidar's origin are left out. The rows are the rings of
/// each turn. A cloud without rings, or whose rings are no cones, is cut by elevation at every
/// `vertical_step_deg`, or else as finely as its points are dense. Throws DataError where a mode of
/// occlusion needs rings and neither they nor that step are there. The result does not depend on
/// `pool`.
RangeImage rangeImage(const Cloud& cloud, const OcclusionConfig& config, ThreadPool* pool);

}  // namespace semantic_lidar_fusion

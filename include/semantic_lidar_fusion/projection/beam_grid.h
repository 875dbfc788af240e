// SPDX-License-Identifier: MIT
/// The lidar's own range image: the steps between its beams, and which neighbouring returns lie on
/// one surface.
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/projection/occlusion_config.h"

namespace semantic_lidar_fusion {

class ThreadPool;

/// What the lidar's own range image says of each beam; independent of the camera.
struct BeamGrid {
  struct Ring {
    double elevation_rad = 0;  ///< median
    double half_up_rad = 0;    ///< half-way to the next ring up
    double half_down_rad = 0;
    double half_azimuth_rad = 0;  ///< half the median azimuth step
    bool lowest = false;          ///< nothing is measured below it
  };
  /// The ground as a plane: height above it = normal . p + offset.
  struct Ground {
    Eigen::Vector3f normal = Eigen::Vector3f::UnitZ();  ///< unit, up
    float offset_m = 0;
  };
  /// Cloud indices of the neighbouring returns on the same surface; kNoLink = the surface ends.
  struct Links {
    std::int32_t left, right, up, down;
  };
  static constexpr std::int32_t kNoLink = -1;

  /// By row. The rows of a turn are its rings, by number; each further turn of the lidar in the
  /// scan has rows of its own. All zero for rows without points. Empty where only the steps are
  /// needed and `config` gives both.
  std::vector<Ring> rings;
  double vertical_step_rad = 0;  ///< median over rings
  double horizontal_step_rad = 0;
  /// Where links are wanted, by cloud index: the row (kNoRing for points that cast no mask) and the
  /// links.
  std::vector<std::uint16_t> ring;
  std::vector<Links> links;
  std::optional<Ground> ground;  ///< with links, where the lowest rings show one
  std::string note;              ///< what to tell a user, once; mostly empty
};

/// A scan of several turns of the lidar (more than a turn and a quarter, or a part of a turn again)
/// is taken turn by turn. Rings in which neighbours differ in elevation (rosette patterns, whose
/// field counts lasers) are none: rows of equal height then serve instead, as high as the points
/// are dense, and `note` says so.
///
/// Steps given in `config` override the data. Throws DataError when the vertical step is needed and
/// neither the cloud (no ring field) nor `config` gives it. The rings are shared out among the
/// threads of `pool`, if there is one; the result does not depend on it.
///
/// `with_links`: make the links even if the mode needs none; a cloud without rings then needs no
/// step.
BeamGrid beamGrid(const Cloud& cloud, const OcclusionConfig& config, ThreadPool* pool = nullptr,
                  bool with_links = false);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Whether the lidar's edges lie on the image's: the score of check_rig.py, for the rig as it is.
///
/// Edges of the lidar are depth steps within a ring; edges of an image are Canny's at 640 px width.
/// Each projected lidar edge has the value exp(-d / 3 px), d being the distance to the nearest edge
/// of the image. The lift compares the mean value with that of the surroundings: 0 = no better than
/// chance, 1 = every lidar edge lies on an image edge. A right rig reaches 0.3 to 0.5 on streets.
#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <opencv2/core.hpp>
#include <vector>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

/// A depth step between two neighbouring beams of one ring.
struct LidarEdge {
  Eigen::Vector3d p = Eigen::Vector3d::Zero();  ///< frame of the cloud, m
  double weight = 0.0;                          ///< sqrt of the step in m, at most sqrt(5)
};

/// Steps above 0.5 m and a tenth of the range, of points nearer than 40 m. An edge is the nearer
/// point turned half a beam towards the farther one. Points without a ring or without odometry have
/// none.
std::vector<LidarEdge> lidarEdges(const Cloud& cloud);

/// Weighted sums over projected edges; scores of several images add up.
struct EdgeScore {
  std::size_t edges = 0;  ///< within the image
  double weight = 0.0;
  double hit = 0.0;     ///< weighted sum of the values at the edges
  double chance = 0.0;  ///< the same of the mean values around them

  void add(const EdgeScore& other);
  /// (hit - chance) / (weight - chance); 0 without edges.
  double lift() const;
  /// Mean value around the edges, 0..1; 1 without edges. Grass has an edge everywhere.
  double meanChance() const { return weight > 0.0 ? chance / weight : 1.0; }
};

/// `image`: CV_8UC1 or CV_8UC3, of the model's size.
EdgeScore scoreEdges(const std::vector<LidarEdge>& edges, const CameraModel& model,
                     const Transform& T_camera_lidar, const cv::Mat& image);

}  // namespace semantic_lidar_fusion

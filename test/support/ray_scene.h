// SPDX-License-Identifier: MIT
/// A small analytic ray caster: scenes of planes, boxes, poles and leaves, a spinning lidar in them
/// and the truth of which of its points a camera sees.
#pragma once

#include <Eigen/Geometry>
#include <cmath>
#include <cstdint>
#include <functional>
#include <limits>
#include <random>
#include <vector>

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

inline double radians(double degrees) { return degrees * 3.14159265358979323846 / 180.0; }

/// Opaque surfaces in a world frame, z up.
class RayScene {
 public:
  struct Hit {
    double distance = std::numeric_limits<double>::infinity();  ///< m
    int object = -1;
  };

  /// Horizontal plane.
  int addGround(double z) {
    return add(
        [z](const Eigen::Vector3d& o, const Eigen::Vector3d& d) { return (z - o.z()) / d.z(); });
  }

  /// Parallelogram corner + a * edge_a + b * edge_b, a and b in 0..1.
  int addRectangle(const Eigen::Vector3d& corner, const Eigen::Vector3d& edge_a,
                   const Eigen::Vector3d& edge_b) {
    return add(rectangle(corner, edge_a, edge_b));
  }

  /// Upright panel from (x0, y0) to (x1, y1), z from bottom to top.
  int addPanel(double x0, double y0, double x1, double y1, double bottom, double top) {
    return addRectangle({x0, y0, bottom}, {x1 - x0, y1 - y0, 0.0}, {0.0, 0.0, top - bottom});
  }

  /// Upright box, one object.
  int addBox(const Eigen::Vector3d& centre, const Eigen::Vector3d& size, double yaw_rad) {
    const Eigen::Matrix3d r =
        Eigen::AngleAxisd(yaw_rad, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    const Eigen::Vector3d half = 0.5 * size;
    return add([=](const Eigen::Vector3d& o, const Eigen::Vector3d& d) {
      const Eigen::Vector3d origin = r.transpose() * (o - centre);
      const Eigen::Vector3d direction = r.transpose() * d;
      double near = -kNone, far = kNone;
      for (int axis = 0; axis < 3; ++axis) {
        const double a = (-half[axis] - origin[axis]) / direction[axis];
        const double b = (half[axis] - origin[axis]) / direction[axis];
        near = std::max(near, std::min(a, b));
        far = std::min(far, std::max(a, b));
      }
      return near <= far ? near : kNone;
    });
  }

  /// Upright cylinder without caps.
  int addPole(double x, double y, double radius, double bottom, double top) {
    return add([=](const Eigen::Vector3d& o, const Eigen::Vector3d& d) {
      const double ox = o.x() - x, oy = o.y() - y;
      const double a = d.x() * d.x() + d.y() * d.y();
      const double b = ox * d.x() + oy * d.y();
      const double c = ox * ox + oy * oy - radius * radius;
      const double root = b * b - a * c;
      if (root < 0.0) return kNone;
      const double t = (-b - std::sqrt(root)) / a;
      const double z = o.z() + t * d.z();
      return z >= bottom && z <= top ? t : kNone;
    });
  }

  /// Tree crown: `count` round leaves of random attitude inside a sphere; one object.
  int addCrown(const Eigen::Vector3d& centre, double radius, double leaf_radius, int count,
               std::uint32_t seed) {
    struct Leaf {
      Eigen::Vector3d centre, normal;
    };
    std::mt19937 random(seed);
    std::normal_distribution<double> normal;
    std::uniform_real_distribution<double> unit(0.0, 1.0);
    std::vector<Leaf> leaves;
    for (int i = 0; i < count; ++i) {
      const auto direction = [&] {
        return Eigen::Vector3d(normal(random), normal(random), normal(random)).normalized();
      };
      leaves.push_back({centre + radius * std::cbrt(unit(random)) * direction(), direction()});
    }
    return add([=](const Eigen::Vector3d& o, const Eigen::Vector3d& d) {
      const double along = d.dot(centre - o);
      if ((o + along * d - centre).squaredNorm() > std::pow(radius + leaf_radius, 2)) return kNone;
      double best = kNone;
      for (const Leaf& leaf : leaves) {
        const double t = leaf.normal.dot(leaf.centre - o) / leaf.normal.dot(d);
        if (t > 0.0 && t < best &&
            (o + t * d - leaf.centre).squaredNorm() < leaf_radius * leaf_radius) {
          best = t;
        }
      }
      return best;
    });
  }

  /// First surface along a ray of unit direction.
  Hit cast(const Eigen::Vector3d& origin, const Eigen::Vector3d& direction) const {
    Hit best;
    for (std::size_t i = 0; i < surfaces_.size(); ++i) {
      const double t = surfaces_[i](origin, direction);
      if (t > 1e-6 && t < best.distance) best = {t, static_cast<int>(i)};
    }
    return best;
  }

 private:
  using Surface = std::function<double(const Eigen::Vector3d&, const Eigen::Vector3d&)>;
  static constexpr double kNone = std::numeric_limits<double>::infinity();

  int add(Surface surface) {
    surfaces_.push_back(std::move(surface));
    return static_cast<int>(surfaces_.size()) - 1;
  }

  static Surface rectangle(const Eigen::Vector3d& corner, const Eigen::Vector3d& edge_a,
                           const Eigen::Vector3d& edge_b) {
    const Eigen::Vector3d normal = edge_a.cross(edge_b);
    const Eigen::Vector3d a = edge_b.cross(normal) / edge_a.dot(edge_b.cross(normal));
    const Eigen::Vector3d b = edge_a.cross(normal) / edge_b.dot(edge_a.cross(normal));
    return [=](const Eigen::Vector3d& o, const Eigen::Vector3d& d) {
      const double t = normal.dot(corner - o) / normal.dot(d);
      const Eigen::Vector3d in_plane = o + t * d - corner;
      const double s = a.dot(in_plane), u = b.dot(in_plane);
      return s >= 0.0 && s <= 1.0 && u >= 0.0 && u <= 1.0 ? t : kNone;
    };
  }

  std::vector<Surface> surfaces_;
};

struct LidarPattern {
  std::vector<double> elevation_deg;  ///< per ring, lowest first
  double azimuth_step_deg = 0.2;
  double azimuth_begin_deg = -180.0, azimuth_end_deg = 180.0;
  /// The lasers of one firing follow each other: each is this part of a step further.
  double laser_shift = 1.0 / 24.0;
  double max_range_m = 100.0;
  double range_noise_m = 0.02;
  double dropout = 0.0;

  static LidarPattern vlp16(double azimuth_step_deg) {
    LidarPattern pattern;
    for (int i = 0; i < 16; ++i) pattern.elevation_deg.push_back(-15.0 + 2.0 * i);
    pattern.azimuth_step_deg = azimuth_step_deg;
    return pattern;
  }
};

struct LidarScan {
  Cloud cloud;                             ///< in the lidar frame, with noise
  std::vector<Eigen::Vector3d> truth;      ///< world, without noise
  std::vector<int> object;                 ///< of the scene
  std::vector<double> azimuth, elevation;  ///< of the beams, rad
};

inline LidarScan scanScene(const RayScene& scene, const Transform& T_world_lidar,
                           const LidarPattern& pattern, std::uint32_t seed) {
  std::mt19937 random(seed);
  std::normal_distribution<double> noise(0.0, pattern.range_noise_m);
  std::uniform_real_distribution<double> unit(0.0, 1.0);
  LidarScan scan;
  const int columns = static_cast<int>(std::lround(
      (pattern.azimuth_end_deg - pattern.azimuth_begin_deg) / pattern.azimuth_step_deg));
  for (int column = 0; column < columns; ++column) {
    for (std::size_t ring = 0; ring < pattern.elevation_deg.size(); ++ring) {
      // Clockwise, as the sensor turns.
      const double azimuth =
          radians(pattern.azimuth_end_deg -
                  (column + pattern.laser_shift * ring + 0.37) * pattern.azimuth_step_deg);
      const double elevation = radians(pattern.elevation_deg[ring]);
      const Eigen::Vector3d beam(std::cos(elevation) * std::cos(azimuth),
                                 std::cos(elevation) * std::sin(azimuth), std::sin(elevation));
      const RayScene::Hit hit =
          scene.cast(T_world_lidar.translation(), T_world_lidar.linear() * beam);
      const double error = noise(random);
      if (!(hit.distance < pattern.max_range_m) || unit(random) < pattern.dropout) continue;
      const Eigen::Vector3f p = ((hit.distance + error) * beam).cast<float>();
      scan.cloud.x.push_back(p.x());
      scan.cloud.y.push_back(p.y());
      scan.cloud.z.push_back(p.z());
      scan.cloud.intensity.push_back(0.0f);
      scan.cloud.ring.push_back(static_cast<std::uint16_t>(ring));
      scan.cloud.dt.push_back(0.0f);
      scan.cloud.status.push_back(0);
      scan.truth.push_back(T_world_lidar * (hit.distance * beam));
      scan.object.push_back(hit.object);
      scan.azimuth.push_back(azimuth);
      scan.elevation.push_back(elevation);
    }
  }
  return scan;
}

/// Body axes (x forward, y left, z up) seen from optical axes (x right, y down, z forward).
inline Eigen::Matrix3d bodyFromOptical() {
  Eigen::Matrix3d r;
  r << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  return r;
}

}  // namespace semantic_lidar_fusion

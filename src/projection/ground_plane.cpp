// SPDX-License-Identifier: MIT
#include "ground_plane.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <vector>

#include "beam_steps.h"

namespace semantic_lidar_fusion {
namespace {

constexpr double kAboveLowest_rad = 5.0 * kPi / 180.0;
constexpr double kMostLean_rad = 15.0 * kPi / 180.0;
/// Between two rings the ground rises by less than this in the lidar's frame, its lean included.
constexpr float kLevelSlope = 0.47f;  // 25 deg
/// The ground near a vehicle is even to this.
constexpr double kEven_m = 0.2;
constexpr std::size_t kLeastPoints = 50;
constexpr std::uint32_t kSampleOfRow = 500;
/// From round to round the points that count lie nearer to the last plane, by half.
constexpr int kRounds = 5;

/// Returns of row `a` (of which some are looked at) from which the surface goes on level to those
/// of the same azimuth in row `b` above it; walls do not.
void addLevelReturns(const RangeImage& image, int a, int b, std::vector<Eigen::Vector3f>* points) {
  const std::uint32_t stride = 1 + image.count(a) / kSampleOfRow;
  std::uint32_t above = image.row_begin[b];
  const std::uint32_t end = image.row_begin[b + 1];
  for (std::uint32_t i = image.row_begin[a]; i < image.row_begin[a + 1]; i += stride) {
    while (above + 1 < end && image.azimuth[above] < image.azimuth[i]) ++above;
    const Eigen::Vector3f p(image.x[i], image.y[i], image.z[i]);
    const Eigen::Vector3f q(image.x[above], image.y[above], image.z[above]);
    if (std::abs(q.z() - p.z()) <= kLevelSlope * (q - p).head<2>().norm()) points->push_back(p);
  }
}

/// Of the rings within 5 deg of the lowest one.
std::vector<Eigen::Vector3f> levelReturns(const RangeImage& image, const BeamGrid& grid) {
  std::vector<Eigen::Vector3f> points;
  for (const std::vector<int>& rows : rowsUpwards(image, grid)) {
    for (std::size_t k = 0; k + 1 < rows.size(); ++k) {
      const double above_lowest =
          grid.rings[rows[k]].elevation_rad - grid.rings[rows[0]].elevation_rad;
      if (above_lowest <= kAboveLowest_rad) addLevelReturns(image, rows[k], rows[k + 1], &points);
    }
  }
  return points;
}

}  // namespace

std::optional<BeamGrid::Ground> groundPlane(const RangeImage& image, const BeamGrid& grid) {
  const std::vector<Eigen::Vector3f> points = levelReturns(image, grid);
  Eigen::Vector3d plane = Eigen::Vector3d::Zero();  // z = plane . (x, y, 1)
  std::size_t count = 0;
  for (int round = 0; round <= kRounds; ++round) {
    const double near_m = std::ldexp(kEven_m, kRounds - round);
    Eigen::Matrix3d normal_matrix = Eigen::Matrix3d::Zero();
    Eigen::Vector3d right = Eigen::Vector3d::Zero();
    count = 0;
    for (const Eigen::Vector3f& p : points) {
      const Eigen::Vector3d at(p.x(), p.y(), 1.0);
      if (round > 0 && !(std::abs(p.z() - plane.dot(at)) <= near_m)) continue;
      normal_matrix += at * at.transpose();
      right += p.z() * at;
      ++count;
    }
    if (count < kLeastPoints) return std::nullopt;
    // A square metre of a level plane: returns in a line leave the lean across it open.
    normal_matrix.topLeftCorner<2, 2>() += Eigen::Matrix2d::Identity();
    plane = normal_matrix.ldlt().solve(right);
  }
  const double lean = std::atan(plane.head<2>().norm());
  if (3 * count < points.size() || !(lean <= kMostLean_rad) || !(plane.z() < 0.0)) {
    return std::nullopt;
  }
  const Eigen::Vector3d up(-plane.x(), -plane.y(), 1.0);
  return BeamGrid::Ground{(up / up.norm()).cast<float>(),
                          static_cast<float>(-plane.z() / up.norm())};
}

}  // namespace semantic_lidar_fusion

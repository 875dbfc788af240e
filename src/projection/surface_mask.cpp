// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/projection/surface_mask.h"

#include <algorithm>
#include <cmath>
#include <optional>

namespace semantic_lidar_fusion {

namespace {

/// How far a mask reaches where its surface ends, as a part of the way to the next beam. The end is
/// somewhere in between: with r, (1 - r)^2 / 2 of a beam's hidden points slip through and r^2 / 2
/// of its visible ones are lost, and a wrong label is worse than none.
constexpr double kEdgeReach = 0.75;
/// The same, up and down, for a return that continues on neither side: often a level surface seen
/// edge-on (a roof), of which a tall mask would be wrong.
constexpr double kLoneReach = 0.5;

/// Masks of mode `adaptive`: a buffer of the nearest mask on each pixel. Where the masks are tall
/// the buffer holds one cell for several pixels along them.
class SurfaceMasks {
 public:
  SurfaceMasks(const Cloud& cloud, const ProjectedPoints& points, const Transform& T_camera_lidar,
               const CameraModel& camera, const BeamGrid& grid, const OcclusionConfig& config)
      : cloud_(cloud),
        points_(points),
        T_camera_lidar_(T_camera_lidar),
        camera_(camera),
        grid_(grid),
        config_(config),
        slot_(cloud.size(), -1) {
    constexpr double kCellsPerStep = 10.0;
    constexpr int kLargestCell_px = 8;
    const Eigen::Vector3d up = T_camera_lidar.linear().col(2);
    const auto cell = [&](double upright, double focal_px) {
      const double px = focal_px * grid.vertical_step_rad / kCellsPerStep;
      return upright < 0.8 ? 1
                           : std::max(1, static_cast<int>(std::min<double>(px, kLargestCell_px)));
    };
    cell_x_ = cell(std::abs(up.x()), camera.fx());
    cell_y_ = cell(std::abs(up.y()), camera.fy());
    columns_ = (camera.imageSize().width + cell_x_ - 1) / cell_x_;
    rows_ = (camera.imageSize().height + cell_y_ - 1) / cell_y_;
    nearness_.assign(static_cast<std::size_t>(columns_) * static_cast<std::size_t>(rows_), 0.0f);
    for (std::size_t i = 0; i < points.size(); ++i) {
      slot_[points.index[i]] = static_cast<std::int32_t>(i);
    }
  }

  std::vector<std::uint8_t> visible() {
    for (std::size_t i = 0; i < points_.size(); ++i) cast(i);
    std::vector<std::uint8_t> result(points_.size(), 0);
    for (std::size_t i = 0; i < points_.size(); ++i) {
      if (!inImage(points_.u[i], points_.v[i], camera_.imageSize())) continue;
      const int x = pixelIndex(points_.u[i]) / cell_x_, y = pixelIndex(points_.v[i]) / cell_y_;
      const float nearness = column(x)[y];
      const double near = 1.0 / static_cast<double>(nearness);
      const double margin = std::max(config_.depth_margin_m, config_.depth_margin_ratio * near);
      result[i] = nearness > 0.0f && points_.distance[i] > near + margin ? 0 : 1;
    }
    return result;
  }

 private:
  struct Sample {
    Eigen::Vector2f pixel;
    float nearness = 0;  ///< 1 / distance to the camera
  };
  /// End of a mask in one direction.
  struct Arm {
    Eigen::Vector2f offset = Eigen::Vector2f::Zero();  ///< px, from the point
    float nearness = 0;
  };

  float* column(int x) {
    return nearness_.data() + static_cast<std::size_t>(x) * static_cast<std::size_t>(rows_);
  }

  Sample sampleOf(std::size_t i) const {
    return {{points_.u[i], points_.v[i]}, 1.0f / std::max(points_.distance[i], 1e-3f)};
  }

  std::optional<Sample> sampleAt(const Eigen::Vector3d& p_lidar) const {
    const Eigen::Vector3d p_camera = T_camera_lidar_ * p_lidar;
    const auto pixel = camera_.project(p_camera);
    if (!pixel) return std::nullopt;
    const double distance = (p_camera - camera_.opticalCentre()).norm();
    return Sample{pixel->cast<float>(), static_cast<float>(1.0 / std::max(distance, 1e-3))};
  }

  Eigen::Vector3d point(std::int32_t i) const {
    const auto k = static_cast<std::size_t>(i);
    return {cloud_.x[k], cloud_.y[k], cloud_.z[k]};
  }

  /// Half-way to a neighbour on the same surface. Inverse distance is linear in the image on a
  /// plane.
  Arm armTo(const Sample& own, std::int32_t link) const {
    const std::int32_t slot = slot_[static_cast<std::size_t>(link)];
    const std::optional<Sample> other =
        slot >= 0 ? sampleOf(static_cast<std::size_t>(slot)) : sampleAt(point(link));
    if (!other) return {Eigen::Vector2f::Zero(), own.nearness};
    return {0.5f * (other->pixel - own.pixel), 0.5f * (other->nearness + own.nearness)};
  }

  /// To where the surface may end, turned from the beam by the given angles (one of them is 0). It
  /// goes on straight from the neighbour `opposite`, or else at the same range.
  Arm armToEdge(const Sample& own, std::int32_t self, std::int32_t opposite, double azimuth_rad,
                double elevation_rad) const {
    const Eigen::Vector3d p = point(self);
    const double range = p.norm(), flat = std::hypot(p.x(), p.y());
    const double azimuth = std::atan2(p.y(), p.x()) + azimuth_rad;
    const double elevation = std::atan2(p.z(), flat) + elevation_rad;
    double inverse = 1.0 / range;
    if (opposite != BeamGrid::kNoLink) {
      const Eigen::Vector3d q = point(opposite);
      const double between = std::atan2(p.cross(q).norm(), p.dot(q));
      const double reach = std::hypot(azimuth_rad * flat / range, elevation_rad);
      // No nearer than the margin, so that noise makes no near mask; no farther than four times.
      const double margin = std::max(config_.depth_margin_m, config_.depth_margin_ratio * range);
      const double most = 1.0 / std::max(0.5 * range, range - margin);
      if (between > 1e-6) inverse += (1.0 / range - 1.0 / q.norm()) * reach / between;
      inverse = std::min(std::max(inverse, 0.25 / range), most);
    }
    const auto end =
        sampleAt(Eigen::Vector3d(std::cos(elevation) * std::cos(azimuth),
                                 std::cos(elevation) * std::sin(azimuth), std::sin(elevation)) /
                 inverse);
    if (!end) return {Eigen::Vector2f::Zero(), own.nearness};
    return {end->pixel - own.pixel, end->nearness};
  }

  void cast(std::size_t i) {
    constexpr std::int32_t kNone = BeamGrid::kNoLink;
    const std::uint32_t index = points_.index[i];
    if (grid_.ring[index] == kNoRing) return;
    const BeamGrid::Ring& ring = grid_.rings[grid_.ring[index]];
    const BeamGrid::Links& links = grid_.links[index];
    const auto self = static_cast<std::int32_t>(index);
    const bool lone = links.up == kNone && links.down == kNone;
    const bool alone = lone && links.left == kNone && links.right == kNone;
    const double tall = 2.0 * (lone ? kLoneReach : kEdgeReach);
    const double wide = 2.0 * (alone ? kLoneReach : kEdgeReach) * ring.half_azimuth_rad;
    const Sample own = sampleOf(i);
    const Arm left =
        links.left != kNone ? armTo(own, links.left) : armToEdge(own, self, links.right, wide, 0.0);
    const Arm right = links.right != kNone ? armTo(own, links.right)
                                           : armToEdge(own, self, links.left, -wide, 0.0);
    const Arm up = links.up != kNone
                       ? armTo(own, links.up)
                       : armToEdge(own, self, links.down, 0.0, tall * ring.half_up_rad);
    const Arm down = links.down != kNone
                         ? armTo(own, links.down)
                         : armToEdge(own, self, links.up, 0.0, -tall * ring.half_down_rad);
    castHalf(own, left, right, up);
    castHalf(own, left, right, down);
  }

  /// Enters the parallelogram from the left to the right arm's end, swept along the arm `along`,
  /// rounded outwards by half a pixel.
  void castHalf(const Sample& own, const Arm& left, const Arm& right, const Arm& along) {
    const Eigen::Vector2f across = 0.5f * (right.offset - left.offset);
    const Eigen::Vector2f centre = own.pixel + 0.5f * (right.offset + left.offset);
    // Pixel = centre + s * across + t * along, s in -1..1, t in 0..1
    const float det = across.x() * along.offset.y() - across.y() * along.offset.x();
    if (!(std::abs(det) >= 1e-3f * (across.norm() + along.offset.norm()))) return;  // edge-on
    const float s_x = along.offset.y() / det, s_y = -along.offset.x() / det;
    const float t_x = -across.y() / det, t_y = across.x() / det;
    const float s_slack = 0.5f * (std::abs(s_x) + std::abs(s_y));
    const float t_slack = 0.5f * (std::abs(t_x) + std::abs(t_y));

    const float s_gain = 0.5f * (right.nearness - left.nearness);
    const float t_gain = along.nearness - own.nearness;
    const float gain_y = s_gain * s_y + t_gain * t_y;
    const float least = std::min(own.nearness, along.nearness) - std::abs(s_gain);
    const float most = std::max(own.nearness, along.nearness) + std::abs(s_gain);

    // A cell stands for its middle.
    const float cell_x = static_cast<float>(cell_x_), cell_y = static_cast<float>(cell_y_);
    const float middle_x = 0.5f * (cell_x - 1.0f), middle_y = 0.5f * (cell_y - 1.0f);
    const float x_low = centre.x() - std::abs(across.x()) + std::min(0.0f, along.offset.x()) - 1.0f;
    const float x_high =
        centre.x() + std::abs(across.x()) + std::max(0.0f, along.offset.x()) + 1.0f;
    const int x_begin = toCell((x_low - middle_x) / cell_x, columns_);
    const int x_end = toCell((x_high - middle_x) / cell_x + 1.0f, columns_);
    for (int x = x_begin; x < x_end; ++x) {
      const float dx = static_cast<float>(x) * cell_x + middle_x - centre.x();
      float low = -1e6f, high = 1e6f;
      clip(s_x * dx, s_y, -1.0f - s_slack, 1.0f + s_slack, &low, &high);
      clip(t_x * dx, t_y, -t_slack, 1.0f + t_slack, &low, &high);
      const float zero = centre.y() - middle_y;
      const int y_begin = toCell(std::ceil((zero + low) / cell_y), rows_);
      const int y_end = toCell(std::floor((zero + high) / cell_y) + 1.0f, rows_);
      const float at_zero = own.nearness + s_gain * s_x * dx + t_gain * t_x * dx - gain_y * zero;
      float* cells = column(x);
      for (int y = y_begin; y < y_end; ++y) {
        const float nearness = at_zero + gain_y * cell_y * static_cast<float>(y);
        cells[y] = std::max(cells[y], std::min(most, std::max(least, nearness)));
      }
    }
  }

  static int toCell(float at, int count) {
    return static_cast<int>(std::max(0.0f, std::min(at, static_cast<float>(count))));
  }

  /// Narrows low..high to the y at which start + slope * y lies in least..most.
  static void clip(float start, float slope, float least, float most, float* low, float* high) {
    if (std::abs(slope) < 1e-9f) {
      if (!(start >= least && start <= most)) *high = *low - 1.0f;
      return;
    }
    const float a = (least - start) / slope, b = (most - start) / slope;
    *low = std::max(*low, std::min(a, b));
    *high = std::min(*high, std::max(a, b));
  }

  const Cloud& cloud_;
  const ProjectedPoints& points_;
  const Transform& T_camera_lidar_;
  const CameraModel& camera_;
  const BeamGrid& grid_;
  const OcclusionConfig& config_;
  std::vector<std::int32_t> slot_;  ///< by cloud index: place in `points_`, -1 = none
  int cell_x_ = 1, cell_y_ = 1;     ///< px
  int columns_ = 0, rows_ = 0;
  std::vector<float> nearness_;  ///< largest 1 / distance of a mask per cell, columns contiguous
};

}  // namespace

std::vector<std::uint8_t> visibleBySurfaces(const Cloud& cloud, const ProjectedPoints& points,
                                            const Transform& T_camera_lidar,
                                            const CameraModel& camera, const BeamGrid& grid,
                                            const OcclusionConfig& config) {
  return SurfaceMasks(cloud, points, T_camera_lidar, camera, grid, config).visible();
}

}  // namespace semantic_lidar_fusion

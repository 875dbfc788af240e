// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/projection/surface_mask.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "semantic_lidar_fusion/projection/rolling_shutter.h"

namespace semantic_lidar_fusion {

namespace {

/// How far a mask reaches where its surface ends, as a part of the way to the next beam. The end is
/// somewhere in between: with r, (1 - r)^2 / 2 of a beam's hidden points slip through and r^2 / 2
/// of its visible ones are lost, and a wrong label is worse than none.
constexpr float kEdgeReach = 0.75f;
/// The same, up and down, for a return that continues on neither side: often a level surface seen
/// edge-on (a roof), of which a tall mask would be wrong; and to all sides for one on no surface.
constexpr float kLoneReach = 0.5f;
/// px around each mask, so that twisted neighbours leave no cracks.
constexpr float kSlack_px = 0.5f;

/// The points in the image, tile by tile, with the farthest of each tile: most surfaces have
/// nothing behind them.
class Tiles {
 public:
  Tiles(const ProjectedPoints& points, const ImageSize& size, float tile_px)
      : per_px_(1.0f / tile_px),
        columns_(1 + static_cast<int>(static_cast<float>(size.width) * per_px_)),
        rows_(1 + static_cast<int>(static_cast<float>(size.height) * per_px_)),
        begin_(static_cast<std::size_t>(columns_) * static_cast<std::size_t>(rows_) + 1, 0),
        far_(begin_.size(), 0.0f) {
    constexpr std::uint32_t kOutside = 0xFFFFFFFFu;
    std::vector<std::uint32_t> tile(points.size(), kOutside);
    for (std::size_t i = 0; i < points.size(); ++i) {
      if (!inImage(points.u[i], points.v[i], size)) continue;
      tile[i] = static_cast<std::uint32_t>(row(points.v[i]) * columns_ + column(points.u[i]));
      ++begin_[tile[i] + 1];
      far_[tile[i]] = std::max(far_[tile[i]], points.distance[i]);
    }
    std::partial_sum(begin_.begin(), begin_.end(), begin_.begin());
    std::vector<std::uint32_t> next(begin_.begin(), begin_.end() - 1);
    points_.resize(begin_.back());
    for (std::size_t i = 0; i < points.size(); ++i) {
      if (tile[i] == kOutside) continue;
      points_[next[tile[i]]++] = {points.u[i], points.v[i], points.distance[i],
                                  static_cast<std::uint32_t>(i)};
    }
  }

  struct Point {
    float u, v, distance;
    std::uint32_t place;  ///< in the projected points
  };

  /// Calls visit(Point) for the points of all tiles that a box touches and in which something is
  /// farther than `nearest`.
  template <typename Visit>
  void visit(float u_low, float u_high, float v_low, float v_high, float nearest,
             const Visit& visit) const {
    const int x_begin = column(u_low), x_end = column(u_high);
    for (int y = row(v_low), y_end = row(v_high); y <= y_end; ++y) {
      for (int x = x_begin; x <= x_end; ++x) {
        const auto tile = static_cast<std::size_t>(y * columns_ + x);
        if (!(far_[tile] > nearest)) continue;
        for (std::uint32_t k = begin_[tile]; k < begin_[tile + 1]; ++k) visit(points_[k]);
      }
    }
  }

 private:
  int column(float u) const { return clamped((u + 0.5f) * per_px_, columns_); }
  int row(float v) const { return clamped((v + 0.5f) * per_px_, rows_); }
  static int clamped(float at, int count) {
    return static_cast<int>(std::max(0.0f, std::min(at, static_cast<float>(count - 1))));
  }

  float per_px_;
  int columns_, rows_;
  std::vector<std::uint32_t> begin_;  ///< into points_, one more than tiles
  std::vector<float> far_;            ///< m
  std::vector<Point> points_;
};

class SurfaceMasks {
 public:
  explicit SurfaceMasks(const MaskInput& input)
      : cloud_(input.cloud),
        points_(input.points),
        T_camera_lidar_(input.T_camera_lidar),
        camera_(input.camera),
        motion_(input.motion),
        grid_(input.grid),
        margin_m_(static_cast<float>(input.config.depth_margin_m)),
        margin_ratio_(static_cast<float>(input.config.depth_margin_ratio)),
        tiles_(points_, camera_.imageSize(),
               std::max(4.0f,
                        static_cast<float>(0.5 * camera_.axialFocalY() * grid_.vertical_step_rad))),
        slot_(cloud_.size(), -1) {
    for (std::size_t i = 0; i < points_.size(); ++i) {
      slot_[points_.index[i]] = static_cast<std::int32_t>(i);
    }
  }

  std::vector<std::uint8_t> visible() {
    visible_.assign(points_.size(), 1);
    for (std::size_t i = 0; i < points_.size(); ++i) cast(i);
    for (std::size_t i = 0; i < points_.size(); ++i) {
      if (!inImage(points_.u[i], points_.v[i], camera_.imageSize())) visible_[i] = 0;
    }
    return std::move(visible_);
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

  Sample sampleOf(std::size_t i) const {
    return {{points_.u[i], points_.v[i]}, 1.0f / std::max(points_.distance[i], 1e-3f)};
  }

  Eigen::Vector3f point(std::int32_t i) const {
    const auto k = static_cast<std::size_t>(i);
    return {cloud_.x[k], cloud_.y[k], cloud_.z[k]};
  }

  /// An arm to a point in the lidar's frame, of which `part` is taken; none if it has no pixel.
  /// Inverse distance is linear in the image on a plane.
  Arm armToPoint(const Sample& own, const Eigen::Vector3f& p_lidar, float part) const {
    const auto seen = seePoint(camera_, motion_, T_camera_lidar_ * p_lidar.cast<double>());
    if (!seen) return {Eigen::Vector2f::Zero(), own.nearness};
    const double distance = std::max((seen->p_camera - camera_.opticalCentre()).norm(), 1e-3);
    const float nearness = static_cast<float>(1.0 / distance);
    return {part * (seen->pixel.cast<float>() - own.pixel),
            own.nearness + part * (nearness - own.nearness)};
  }

  /// Half-way to a neighbour on the same surface.
  Arm armToLink(const Sample& own, std::int32_t link) const {
    const std::int32_t slot = slot_[static_cast<std::size_t>(link)];
    if (slot < 0) return armToPoint(own, point(link), 0.5f);
    const Sample other = sampleOf(static_cast<std::size_t>(slot));
    return {0.5f * (other.pixel - own.pixel), 0.5f * (other.nearness + own.nearness)};
  }

  /// To where the surface may end, turned from the beam by the given angles (one of them is 0). It
  /// goes on straight from the neighbour `opposite`, or else at the same range.
  Arm armToEdge(const Sample& own, std::int32_t self, std::int32_t opposite, float azimuth_rad,
                float elevation_rad) const {
    const Eigen::Vector3f p = point(self);
    const float range = p.norm(), flat = std::max(p.head<2>().norm(), 1e-6f);
    float scale = 1.0f;  // of the range
    if (opposite != BeamGrid::kNoLink) {
      const Eigen::Vector3f q = point(opposite);
      const float range_q = q.norm();
      const float between = p.cross(q).norm() / (range * range_q);
      const float reach = std::abs(azimuth_rad) * flat / range + std::abs(elevation_rad);
      // No nearer than the margin, so that noise makes no near mask; no farther than four times.
      const float margin = std::max(margin_m_, margin_ratio_ * range);
      const float most = range / std::max(0.5f * range, range - margin);
      float inverse = 1.0f;
      if (between > 1e-6f) inverse += (1.0f - range / range_q) * reach / between;
      scale = 1.0f / std::min(std::max(inverse, 0.25f), most);
    }
    // Angles of a beam: two terms of sine and cosine are exact to 1e-5.
    const float a = azimuth_rad * (1.0f - azimuth_rad * azimuth_rad / 6.0f);
    const float e = elevation_rad * (1.0f - elevation_rad * elevation_rad / 6.0f);
    const float cos_a = 1.0f - 0.5f * azimuth_rad * azimuth_rad;
    const float cos_e = 1.0f - 0.5f * elevation_rad * elevation_rad;
    const Eigen::Vector3f turned(cos_a * p.x() - a * p.y(), cos_a * p.y() + a * p.x(), p.z());
    const Eigen::Vector3f up(-p.z() * p.x() / flat, -p.z() * p.y() / flat, flat);
    return armToPoint(own, scale * (cos_e * turned + e * up), 1.0f);
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
    const float wide =
        2.0f * (alone ? kLoneReach : kEdgeReach) * static_cast<float>(ring.half_azimuth_rad);
    const float tall = 2.0f * (lone ? kLoneReach : kEdgeReach);
    const float high = tall * static_cast<float>(ring.half_up_rad);
    const float low = tall * static_cast<float>(ring.half_down_rad);
    const Sample own = sampleOf(i);
    const Arm left = links.left != kNone ? armToLink(own, links.left)
                                         : armToEdge(own, self, links.right, wide, 0.0f);
    const Arm right = links.right != kNone ? armToLink(own, links.right)
                                           : armToEdge(own, self, links.left, -wide, 0.0f);
    const Arm up =
        links.up != kNone ? armToLink(own, links.up) : armToEdge(own, self, links.down, 0.0f, high);
    const Arm down = links.down != kNone ? armToLink(own, links.down)
                                         : armToEdge(own, self, links.up, 0.0f, -low);
    castHalf(own, left, right, up);
    castHalf(own, left, right, down);
  }

  /// Hides what lies behind the parallelogram from the left to the right arm's end, swept along the
  /// arm `along`.
  void castHalf(const Sample& own, const Arm& left, const Arm& right, const Arm& along) {
    const Eigen::Vector2f across = 0.5f * (right.offset - left.offset);
    const Eigen::Vector2f centre = own.pixel + 0.5f * (right.offset + left.offset);
    const float s_gain = 0.5f * (right.nearness - left.nearness);
    const float t_gain = along.nearness - own.nearness;
    const float least = std::min(own.nearness, along.nearness) - std::abs(s_gain);
    const float most = std::max(own.nearness, along.nearness) + std::abs(s_gain);
    const float nearest = hiddenBeyond(most);

    // Pixel = centre + s * across + t * along, s in -1..1, t in 0..1
    const float det = across.x() * along.offset.y() - across.y() * along.offset.x();
    if (!(std::abs(det) >= 1e-3f * (across.norm() + along.offset.norm()))) return;  // edge-on
    const float s_x = along.offset.y() / det, s_y = -along.offset.x() / det;
    const float t_x = -across.y() / det, t_y = across.x() / det;
    const float s_most = 1.0f + kSlack_px * (std::abs(s_x) + std::abs(s_y));
    const float t_slack = kSlack_px * (std::abs(t_x) + std::abs(t_y));

    const float wide = std::abs(across.x()) + 2.0f * kSlack_px;
    const float high = std::abs(across.y()) + 2.0f * kSlack_px;
    tiles_.visit(centre.x() - wide + std::min(0.0f, along.offset.x()),
                 centre.x() + wide + std::max(0.0f, along.offset.x()),
                 centre.y() - high + std::min(0.0f, along.offset.y()),
                 centre.y() + high + std::max(0.0f, along.offset.y()), nearest,
                 [&](const Tiles::Point& point) {
                   if (!(point.distance > nearest)) return;
                   const float du = point.u - centre.x(), dv = point.v - centre.y();
                   const float s = s_x * du + s_y * dv, t = t_x * du + t_y * dv;
                   if (std::abs(s) > s_most || t < -t_slack || t > 1.0f + t_slack) return;
                   const float nearness =
                       std::min(most, std::max(least, own.nearness + s_gain * s + t_gain * t));
                   if (point.distance > hiddenBeyond(nearness)) visible_[point.place] = 0;
                 });
  }

  /// Distance from which a mask of 1 / distance `nearness` hides; never if that is not positive.
  float hiddenBeyond(float nearness) const {
    if (!(nearness > 0.0f)) return std::numeric_limits<float>::max();
    const float near = 1.0f / nearness;
    return near + std::max(margin_m_, margin_ratio_ * near);
  }

  const Cloud& cloud_;
  const ProjectedPoints& points_;
  const Transform& T_camera_lidar_;
  const CameraModel& camera_;
  const Twist* motion_;
  const BeamGrid& grid_;
  float margin_m_, margin_ratio_;
  Tiles tiles_;
  std::vector<std::int32_t> slot_;  ///< by cloud index: place in `points_`, -1 = none
  std::vector<std::uint8_t> visible_;
};

}  // namespace

std::vector<std::uint8_t> visibleBySurfaces(const MaskInput& input) {
  return SurfaceMasks(input).visible();
}

double surfaceMaskMarginPx(const CameraModel& camera, const BeamGrid& grid) {
  double step = std::max(grid.horizontal_step_rad, grid.vertical_step_rad);
  for (const BeamGrid::Ring& ring : grid.rings) {
    step = std::max({step, 2.0 * ring.half_up_rad, 2.0 * ring.half_down_rad});
  }
  return std::max(camera.axialFocalX(), camera.axialFocalY()) * step;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/projection/surface_mask.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>
#include <optional>

#include "mask_kernels.h"
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
/// A return of the lowest ring that is higher above the ground than this (m) is no ground: twice
/// what uneven ground and range noise add up to.
constexpr float kStands_m = 0.3f;

/// The points in the image, tile by tile, with the farthest of each tile: most surfaces have
/// nothing behind them.
class Tiles {
 public:
  Tiles(const ProjectedPoints& points, const ImageSize& size, float tile_px,
        const OcclusionConfig& config) {
    tiled_.per_px = 1.0f / tile_px;
    tiled_.columns = 1 + static_cast<int>(static_cast<float>(size.width) * tiled_.per_px);
    tiled_.rows = 1 + static_cast<int>(static_cast<float>(size.height) * tiled_.per_px);
    tiled_.margin_m = static_cast<float>(config.depth_margin_m);
    tiled_.margin_ratio = static_cast<float>(config.depth_margin_ratio);
    sort(points, size);
    spreadFarthest();
    tiled_.begin = begin_.data();
    tiled_.far = far_.data();
    tiled_.far_of_four = far_of_four_.data();
    tiled_.u = u_.data();
    tiled_.v = v_.data();
    tiled_.distance = distance_.data();
    tiled_.place = place_.data();
  }
  Tiles(const Tiles&) = delete;
  Tiles& operator=(const Tiles&) = delete;

  const TiledPoints& points() const { return tiled_; }

 private:
  void sort(const ProjectedPoints& points, const ImageSize& size) {
    constexpr std::uint32_t kOutside = 0xFFFFFFFFu;
    constexpr std::size_t kRoom = 8;  // wide kernels read whole registers
    begin_.assign(static_cast<std::size_t>(tiled_.columns) * tiled_.rows + 1, 0);
    far_.assign(begin_.size(), 0.0f);
    std::vector<std::uint32_t> tile(points.size(), kOutside);
    for (std::size_t i = 0; i < points.size(); ++i) {
      if (!inImage(points.u[i], points.v[i], size)) continue;
      tile[i] = static_cast<std::uint32_t>(at(points.v[i], tiled_.rows) * tiled_.columns +
                                           at(points.u[i], tiled_.columns));
      ++begin_[tile[i] + 1];
      far_[tile[i]] = std::max(far_[tile[i]], points.distance[i]);
    }
    std::partial_sum(begin_.begin(), begin_.end(), begin_.begin());
    std::vector<std::uint32_t> next(begin_.begin(), begin_.end() - 1);
    for (std::vector<float>* values : {&u_, &v_, &distance_}) values->resize(begin_.back() + kRoom);
    place_.resize(begin_.back());
    for (std::size_t i = 0; i < points.size(); ++i) {
      if (tile[i] == kOutside) continue;
      const std::uint32_t to = next[tile[i]]++;
      u_[to] = points.u[i];
      v_[to] = points.v[i];
      distance_[to] = points.distance[i];
      place_[to] = static_cast<std::uint32_t>(i);
    }
  }

  void spreadFarthest() {
    const int columns = tiled_.columns, rows = tiled_.rows;
    far_of_four_.resize(far_.size());
    for (int y = 0; y < rows; ++y) {
      const float* here = &far_[static_cast<std::size_t>(y) * columns];
      const float* below = y + 1 < rows ? here + columns : here;
      float* out = &far_of_four_[static_cast<std::size_t>(y) * columns];
      for (int x = 0; x < columns; ++x) {
        const int right = std::min(x + 1, columns - 1);
        out[x] = std::max(std::max(here[x], here[right]), std::max(below[x], below[right]));
      }
    }
  }

  int at(float px, int count) const {
    const float tile = (px + 0.5f) * tiled_.per_px;
    return static_cast<int>(std::max(0.0f, std::min(tile, static_cast<float>(count - 1))));
  }

  TiledPoints tiled_;
  std::vector<std::uint32_t> begin_, place_;
  std::vector<float> far_, far_of_four_;  ///< m
  std::vector<float> u_, v_, distance_;
};

/// Where the camera sees points that are not among the projected ones.
class TargetProjector {
 public:
  explicit TargetProjector(const MaskInput& input) : input_(input) {
    const CameraModel& camera = input.camera;
    const std::array<double, 4>* k = camera.lens().kannalaBrandt();
    const bool rolls = input.motion != nullptr && camera.rollingShutter();
    if (k == nullptr || rolls) return;
    exact_.emplace();
    Eigen::Map<Eigen::Matrix<double, 3, 4, Eigen::RowMajor>> matrix(exact_->matrix);
    const Transform& T = input.T_camera_lidar;
    matrix.leftCols<3>() = camera.R_raw_camera() * T.linear();
    matrix.col(3) = camera.R_raw_camera() * (T.translation() - camera.opticalCentre());
    exact_->focal_x = camera.fx();
    exact_->focal_y = camera.fy();
    exact_->skew = camera.skew();
    exact_->centre_x = camera.cx();
    exact_->centre_y = camera.cy();
    std::copy(k->begin(), k->end(), exact_->k);
    exact_->theta_end = camera.maxThetaRad();
  }

  void project(int count, ArmTargets* targets) const {
    if (exact_) {
      maskKernels().projectTargets(*exact_, count, targets);
      return;
    }
    for (int i = 0; i < count; ++i) {
      const Eigen::Vector3d p(targets->x[i], targets->y[i], targets->z[i]);
      const auto seen = seePoint(input_.camera, input_.motion, input_.T_camera_lidar * p);
      targets->u[i] = std::numeric_limits<float>::quiet_NaN();
      if (!seen) continue;
      const double distance = (seen->p_camera - input_.camera.opticalCentre()).norm();
      targets->u[i] = static_cast<float>(seen->pixel.x());
      targets->v[i] = static_cast<float>(seen->pixel.y());
      targets->nearness[i] = static_cast<float>(1.0 / std::max(distance, kLeastMaskDistance));
    }
  }

 private:
  const MaskInput& input_;
  std::optional<ExactLens> exact_;  ///< empty: the lens has no kernel, or rows of their own time
};

class SurfaceMasks {
 public:
  explicit SurfaceMasks(const MaskInput& input)
      : cloud_(input.cloud),
        points_(input.points),
        camera_(input.camera),
        grid_(input.grid),
        projector_(input),
        margin_m_(static_cast<float>(input.config.depth_margin_m)),
        margin_ratio_(static_cast<float>(input.config.depth_margin_ratio)),
        tiles_(points_, camera_.imageSize(),
               std::max(4.0f,
                        static_cast<float>(0.5 * camera_.axialFocalY() * grid_.vertical_step_rad)),
               input.config),
        slot_(cloud_.size(), -1),
        nearness_(points_.size()) {
    for (std::size_t i = 0; i < points_.size(); ++i) {
      slot_[points_.index[i]] = static_cast<std::int32_t>(i);
      nearness_[i] = 1.0f / std::max(points_.distance[i], 1e-3f);
    }
  }

  std::vector<std::uint8_t> visible() {
    visible_.assign(points_.size(), 1);
    for (std::size_t i = 0; i < points_.size(); ++i) {
      addCaster(i);
      if (casters_ == kMaskBlock) castAll();
    }
    castAll();
    for (std::size_t i = 0; i < points_.size(); ++i) {
      if (!inImage(points_.u[i], points_.v[i], camera_.imageSize())) visible_[i] = 0;
    }
    return std::move(visible_);
  }

 private:
  /// An arm of the block whose target is still to be projected: of the way there, `part` is taken.
  struct OpenArm {
    int caster;
    MaskSide side;
    float part;
  };

  Eigen::Vector3f point(std::int32_t i) const {
    const auto k = static_cast<std::size_t>(i);
    return {cloud_.x[k], cloud_.y[k], cloud_.z[k]};
  }

  void addCaster(std::size_t i) {
    constexpr std::int32_t kNone = BeamGrid::kNoLink;
    const std::uint32_t index = points_.index[i];
    if (grid_.ring[index] == kNoRing) return;
    const BeamGrid::Links& links = grid_.links[index];
    const auto self = static_cast<std::int32_t>(index);
    block_.u[casters_] = points_.u[i];
    block_.v[casters_] = points_.v[i];
    block_.nearness[casters_] = nearness_[i];
    const bool whole =
        links.left != kNone && links.right != kNone && links.up != kNone && links.down != kNone;
    if (whole) {
      addLink(links.left, kMaskLeft);
      addLink(links.right, kMaskRight);
      addLink(links.up, kMaskUp);
      addLink(links.down, kMaskDown);
    } else {
      addArms(self, links, grid_.rings[grid_.ring[index]]);
    }
    ++casters_;
  }

  /// The arms of a return whose surface ends on some side.
  void addArms(std::int32_t self, const BeamGrid::Links& links, const BeamGrid::Ring& ring) {
    constexpr std::int32_t kNone = BeamGrid::kNoLink;
    const bool lone = links.up == kNone && links.down == kNone;
    const bool alone = lone && links.left == kNone && links.right == kNone;
    const float wide =
        2.0f * (alone ? kLoneReach : kEdgeReach) * static_cast<float>(ring.half_azimuth_rad);
    const float tall = 2.0f * (lone ? kLoneReach : kEdgeReach);
    const float high = tall * static_cast<float>(ring.half_up_rad);
    const float low = tall * static_cast<float>(ring.half_down_rad);
    const auto add = [&](std::int32_t link, std::int32_t opposite, MaskSide side, float azimuth_rad,
                         float elevation_rad) {
      if (link != kNone) {
        addLink(link, side);
      } else {
        openArm(edge(self, opposite, azimuth_rad, elevation_rad), side, 1.0f);
      }
    };
    add(links.left, links.right, kMaskLeft, wide, 0.0f);
    add(links.right, links.left, kMaskRight, -wide, 0.0f);
    add(links.up, links.down, kMaskUp, 0.0f, high);
    if (links.down == kNone && standsOnGround(self, ring)) {
      openArm(point(self) - heightAboveGround(self) * grid_.ground->normal, kMaskDown, 1.0f);
    } else {
      add(links.down, links.up, kMaskDown, 0.0f, -low);
    }
  }

  float heightAboveGround(std::int32_t self) const {
    return grid_.ground->normal.dot(point(self)) + grid_.ground->offset_m;
  }

  /// Whether what the lowest ring hits reaches down to the ground, unseen by the lidar.
  bool standsOnGround(std::int32_t self, const BeamGrid::Ring& ring) const {
    return ring.lowest && grid_.ground && heightAboveGround(self) > kStands_m;
  }

  /// Half-way to a neighbour on the same surface.
  void addLink(std::int32_t link, MaskSide side) {
    const std::int32_t slot = slot_[static_cast<std::size_t>(link)];
    if (slot < 0) {
      openArm(point(link), side, 0.5f);
      return;
    }
    const auto other = static_cast<std::size_t>(slot);
    block_.arm_u[side][casters_] = 0.5f * (points_.u[other] - block_.u[casters_]);
    block_.arm_v[side][casters_] = 0.5f * (points_.v[other] - block_.v[casters_]);
    block_.arm_nearness[side][casters_] = 0.5f * (nearness_[other] + block_.nearness[casters_]);
  }

  void openArm(const Eigen::Vector3f& target, MaskSide side, float part) {
    targets_.x[open_] = target.x();
    targets_.y[open_] = target.y();
    targets_.z[open_] = target.z();
    arms_[open_] = {casters_, side, part};
    ++open_;
  }

  /// Where the surface may end, turned from the beam by the given angles (one of them is 0). It
  /// goes on straight from the neighbour `opposite`, or else at the same range.
  Eigen::Vector3f edge(std::int32_t self, std::int32_t opposite, float azimuth_rad,
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
    return scale * (cos_e * turned + e * up);
  }

  /// Ends the open arms at what the camera sees of their targets, at the point itself where that is
  /// nothing. Inverse distance is linear in the image on a plane.
  void closeArms() {
    projector_.project(open_, &targets_);
    for (int k = 0; k < open_; ++k) {
      const OpenArm& arm = arms_[k];
      const float own = block_.nearness[arm.caster];
      float u = 0.0f, v = 0.0f, nearness = own;
      if (!std::isnan(targets_.u[k])) {
        u = arm.part * (targets_.u[k] - block_.u[arm.caster]);
        v = arm.part * (targets_.v[k] - block_.v[arm.caster]);
        nearness = own + arm.part * (targets_.nearness[k] - own);
      }
      block_.arm_u[arm.side][arm.caster] = u;
      block_.arm_v[arm.side][arm.caster] = v;
      block_.arm_nearness[arm.side][arm.caster] = nearness;
    }
    open_ = 0;
  }

  void castAll() {
    closeArms();
    const MaskKernels& kernels = maskKernels();
    const int count = kernels.castHalves(block_, casters_, tiles_.points(), halves_);
    for (int k = 0; k < count; ++k) kernels.hide(halves_[k], tiles_.points(), visible_.data());
    casters_ = 0;
  }

  const Cloud& cloud_;
  const ProjectedPoints& points_;
  const CameraModel& camera_;
  const BeamGrid& grid_;
  TargetProjector projector_;
  float margin_m_, margin_ratio_;
  Tiles tiles_;
  std::vector<std::int32_t> slot_;  ///< by cloud index: place in `points_`, -1 = none
  std::vector<float> nearness_;     ///< 1 / distance to the camera, of `points_`
  std::vector<std::uint8_t> visible_;

  // The block at hand.
  MaskCasters block_;
  int casters_ = 0;
  ArmTargets targets_;
  OpenArm arms_[kMaskSides * kMaskBlock];
  int open_ = 0;
  HalfMask halves_[2 * kMaskBlock];
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

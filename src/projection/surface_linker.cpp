// SPDX-License-Identifier: MIT
#include "surface_linker.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "beam_steps.h"
#include "semantic_lidar_fusion/common/thread_pool.h"

namespace semantic_lidar_fusion {
namespace {

constexpr std::int32_t kNone = BeamGrid::kNoLink;

// --- Where neighbours are looked for

/// Returns nearer than this part of a step are second returns of one beam, not neighbours.
constexpr float kSameAzimuth = 0.3f;
/// Missing returns (glass, dark paint) are bridged in a row: eight steps, and what jitter adds.
constexpr float kBridge = 8.6f;
/// Between rows a neighbour stands at most kOver steps aside (half a step is the most where both
/// rows are complete, the rest is for what motion shifts), or kAside if none is there: two missing
/// returns. Leaning links leave cracks between masks, so the nearer window goes first.
constexpr float kOver = 0.75f;
constexpr float kAside = 2.6f;
/// Windows end before they meet at the back (rad).
constexpr float kNearlyHalfTurn = 3.0f;

// --- When two neighbours lie on one surface

/// Neighbours closer in range than this do: it is three times the scatter of a difference of two
/// ranges with 2 to 3 cm of noise.
constexpr float kFlatRange_m = 0.1f;
/// So do those whose range changes by less than this part of their distance across the beam: a
/// surface that faces the lidar to within 27 deg.
constexpr float kFlatSlope = 0.5f;
/// A surface at a grazing angle goes on straight if it bends by no more than this ...
constexpr float kStraight_rad = static_cast<float>(5.0 * kPi / 180.0);
/// ... and by what two ranges' noise may add to that over the shorter chord ...
constexpr float kRangeNoise_m = 0.06f;
/// ... but never by more than this (29 deg), which noise reaches where beams are 14 cm apart.
constexpr float kLargestBend_rad = 0.5f;
/// No surface is so steep that its range grows by more than this factor from a beam to the next one
/// beside it, or to the next ring: between noisy returns at 1 m, 5 mm apart, everything behind
/// looks straight on. A ring's step is up to ten times an azimuth step, so the ground may grow
/// faster.
constexpr float kMostBeside = 1.3f;
constexpr float kMostAcross = 2.0f;

// --- When a link is taken over from the column beside

/// Neighbours that must have such a link, one after the other: about 1 deg of a VLP-16's turn.
constexpr int kCarryRun = 5;
/// How far the jump in range may differ from the neighbour's: twice kFlatRange_m, or this part.
constexpr float kAlike_m = 0.2f;
constexpr float kAlikeRatio = 0.25f;

/// Finds for each return its neighbours and whether they lie on its surface, by places.
class Linker {
 public:
  using Links = BeamGrid::Links;
  using Side = std::int32_t Links::*;

  Linker(const RangeImage& image, const OcclusionConfig& config, const BeamGrid& grid)
      : image_(image), config_(config), grid_(grid) {}

  void link(ThreadPool* pool) {
    near_.assign(image_.index.size(), {kNone, kNone, kNone, kNone});
    links_ = near_;
    for (const std::vector<int>& rows : rowsUpwards(image_, grid_)) linkTurn(rows, pool);
  }

  std::vector<Links> takeLinks() { return std::move(links_); }

 private:
  void linkTurn(const std::vector<int>& rows, ThreadPool* pool) {
    const auto count = static_cast<int>(rows.size());
    forEach(pool, count, [&](int k) {
      findBeside(rows[k]);
      if (k > 0) findAcross(rows[k], rows[k - 1], &Links::down);
      if (k + 1 < count) findAcross(rows[k], rows[k + 1], &Links::up);
    });
    // Links depend on the neighbours of both ends, thus on the rows beside, but on no other link
    // than those of their own row.
    forEach(pool, count, [&](int k) {
      const int row = rows[k];
      const auto end = static_cast<std::int32_t>(image_.row_begin[row + 1]);
      for (auto i = static_cast<std::int32_t>(image_.row_begin[row]); i < end; ++i) {
        keepSameSurface(i, &Links::left, &Links::right, true);
        keepSameSurface(i, &Links::right, &Links::left, true);
        keepSameSurface(i, &Links::up, &Links::down, false);
        keepSameSurface(i, &Links::down, &Links::up, false);
      }
      for (const bool to_left : {true, false}) {
        carryAlong(row, to_left, &Links::up);
        carryAlong(row, to_left, &Links::down);
      }
    });
  }

  float stepOf(int row) const {
    return static_cast<float>(image_.scattered ? image_.step_rad
                                               : 2.0 * grid_.rings[row].half_azimuth_rad);
  }

  /// Difference of azimuths counter-clockwise, 0..2 pi.
  static float turn(float from, float to) {
    const float d = to - from;
    return d < 0.0f ? d + kTwoPi : d;
  }

  /// The next return left (counter-clockwise seen from above) and right in the same row; of several
  /// at one azimuth (second returns) the closest in range.
  void findBeside(int row) {
    const std::uint32_t begin = image_.row_begin[row], count = image_.count(row);
    const float most = kBridge * stepOf(row);
    const float same = kSameAzimuth * stepOf(row), least = same;
    const auto gap = [&](std::uint32_t k) {  // from the k-th return to the next
      return image_.azimuth[begin + k + 1] - image_.azimuth[begin + k];
    };
    for (std::uint32_t k = 0; k < count; ++k) {
      const std::uint32_t i = begin + k;
      for (const bool to_left : {true, false}) {
        // Nearly always the next return is the only one at its azimuth.
        if (to_left && k + 2 < count && gap(k) >= least && gap(k + 1) > same) {
          if (gap(k) <= most) near_[i].left = static_cast<std::int32_t>(i + 1);
          continue;
        }
        if (!to_left && k >= 2 && gap(k - 1) >= least && gap(k - 2) > same) {
          if (gap(k - 1) <= most) near_[i].right = static_cast<std::int32_t>(i - 1);
          continue;
        }
        float best = std::numeric_limits<float>::max();
        float first = most;
        for (std::uint32_t hop = 1; hop < count; ++hop) {
          const std::uint32_t place = to_left ? k + hop : k + count - hop;
          const std::uint32_t j = begin + (place < count ? place : place - count);
          const float d = to_left ? turn(image_.azimuth[i], image_.azimuth[j])
                                  : turn(image_.azimuth[j], image_.azimuth[i]);
          if (d > std::min(most, first + same)) break;
          if (d < least) continue;
          first = std::min(first, d);
          const float difference = std::abs(image_.range[j] - image_.range[i]);
          if (difference < best) {
            best = difference;
            (to_left ? near_[i].left : near_[i].right) = static_cast<std::int32_t>(j);
          }
        }
      }
    }
  }

  /// The return of the row `other` over or under each of `row`, or else a few steps aside; of
  /// several the closest in range.
  void findAcross(int row, int other, Side side) {
    const std::uint32_t other_begin = image_.row_begin[other], count = image_.count(other);
    const float step = std::max(stepOf(row), stepOf(other));
    const float over = std::min(kOver * step, kNearlyHalfTurn);
    const float aside = std::min(kAside * step, kNearlyHalfTurn);
    const float* azimuths = image_.azimuth.data() + other_begin;
    const float* ranges = image_.range.data() + other_begin;
    std::uint32_t start_over = 0, start_aside = 0;
    for (std::uint32_t i = image_.row_begin[row]; i < image_.row_begin[row + 1]; ++i) {
      const float azimuth = image_.azimuth[i], range = image_.range[i];
      std::uint32_t found = count;
      const auto look = [&](float window, std::uint32_t* start) {
        float best = std::numeric_limits<float>::max();
        const auto consider = [&](std::uint32_t m) {
          const float difference = std::abs(ranges[m] - range);
          if (difference < best) {
            best = difference;
            found = m;
          }
        };
        while (*start < count && azimuths[*start] < azimuth - window) ++*start;
        for (std::uint32_t m = *start; m < count && azimuths[m] <= azimuth + window; ++m) {
          consider(m);
        }
        // Across the jump of the azimuth at the back.
        for (std::uint32_t m = 0; m < count && azimuths[m] + kTwoPi <= azimuth + window; ++m) {
          consider(m);
        }
        for (std::uint32_t m = count; m > 0 && azimuths[m - 1] - kTwoPi >= azimuth - window; --m) {
          consider(m - 1);
        }
      };
      look(over, &start_over);
      if (found == count) look(aside, &start_aside);
      if (found < count) near_[i].*side = static_cast<std::int32_t>(other_begin + found);
    }
  }

  void keepSameSurface(std::int32_t i, Side side, Side opposite, bool beside) {
    const std::int32_t j = near_[i].*side;
    if (j != kNone && sameSurface(i, j, near_[i].*opposite, near_[j].*side, beside)) {
      links_[i].*side = j;
    }
  }

  Eigen::Vector3f point(std::int32_t i) const { return {image_.x[i], image_.y[i], image_.z[i]}; }

  static bool straight(const Eigen::Vector3f& a, const Eigen::Vector3f& b) {
    const float length_a = a.norm(), length_b = b.norm();
    const float noise = kRangeNoise_m / std::max(1e-3f, std::min(length_a, length_b));
    const float bend = std::min(kStraight_rad + noise, kLargestBend_rad), square = bend * bend;
    const float cosine = 1.0f - 0.5f * square + square * square / 24.0f;  // to 3e-5
    return a.dot(b) >= cosine * length_a * length_b;
  }

  /// Whether neighbours a and b lie on one surface; `before` is a's neighbour away from b, `after`
  /// is b's away from a.
  bool sameSurface(std::int32_t a, std::int32_t b, std::int32_t before, std::int32_t after,
                   bool beside) const {
    const float range_a = image_.range[a], range_b = image_.range[b];
    const float jump = std::abs(range_a - range_b), nearest = std::min(range_a, range_b);
    if (jump <= kFlatRange_m) return true;
    if (jump > ((beside ? kMostBeside : kMostAcross) - 1.0f) * nearest) return false;
    // Beside each other the beams are so close that a slanted link hides nothing wrongly; between
    // rings it would cut off the corner of a box.
    if (beside && static_cast<double>(jump) <=
                      std::max(config_.depth_margin_m, config_.depth_margin_ratio * nearest)) {
      return true;
    }
    const Eigen::Vector3f step = point(b) - point(a);
    // Chord^2 = jump^2 + range_a * range_b * angle^2; across the beam, they are nearest * angle
    // apart.
    const float angle_square = (step.squaredNorm() - jump * jump) / (range_a * range_b);
    if (jump * jump <= kFlatSlope * kFlatSlope * nearest * nearest * angle_square) return true;
    // A plane at a grazing angle goes on straight. The nearer point's side of the link is the
    // witness: a farther surface seen over an edge may happen to lie in line with it.
    const bool from_before = range_a <= range_b ? before != kNone : after == kNone;
    if (from_before) return before != kNone && straight(point(a) - point(before), step);
    return after != kNone && straight(step, point(after) - point(b));
  }

  /// Where only two rings meet the ground in front of an object nothing tells whether their link is
  /// straight: then it is like its neighbour's, if a run of neighbours has one.
  void carryAlong(int row, bool to_left, Side side) {
    const std::uint32_t begin = image_.row_begin[row], count = image_.count(row);
    int run = 0;
    std::int32_t last = kNone, last_across = kNone;
    const auto slope = [&](std::int32_t i, std::int32_t j) {
      const Eigen::Vector3f step = point(j) - point(i);
      return std::atan2(step.z(), step.head<2>().norm());
    };
    const auto jump = [&](std::int32_t i, std::int32_t j) {
      return image_.range[j] - image_.range[i];
    };
    const auto alike = [&](std::int32_t i, std::int32_t j) {
      const float before = jump(last, last_across);
      return std::abs(jump(i, j) - before) <= std::max(kAlike_m, kAlikeRatio * std::abs(before)) &&
             std::abs(slope(i, j) - slope(last, last_across)) <= kStraight_rad;
    };
    // Twice around, so that the start has a run too; from where it once had one, all is the same.
    std::uint32_t end = 2 * count;
    for (std::uint32_t n = 0; n < end; ++n) {
      const std::uint32_t k = n < count ? n : n - count;
      const auto i = static_cast<std::int32_t>(begin + (to_left ? k : count - 1 - k));
      Links& own = links_[i];
      if (last == kNone || (to_left ? own.right : own.left) != last) run = 0;
      const std::int32_t j = near_[i].*side;
      if (own.*side == kNone && j != kNone && run >= kCarryRun && alike(i, j)) own.*side = j;
      run = own.*side != kNone ? run + 1 : 0;
      if (run == kCarryRun && n < count) end = std::min(end, count + n + 1);
      last = i;
      last_across = j;
    }
  }

  const RangeImage& image_;
  const OcclusionConfig& config_;
  const BeamGrid& grid_;
  std::vector<Links> near_;   ///< neighbours, of whatever surface
  std::vector<Links> links_;  ///< those of the same surface
};

}  // namespace

std::vector<BeamGrid::Links> linkSurfaces(const RangeImage& image, const OcclusionConfig& config,
                                          const BeamGrid& grid, ThreadPool* pool) {
  Linker linker(image, config, grid);
  linker.link(pool);
  return linker.takeLinks();
}

}  // namespace semantic_lidar_fusion

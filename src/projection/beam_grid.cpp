// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/projection/beam_grid.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <numeric>

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {

namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr float kTwoPi = 6.28318530717958647692f;

/// Neighbours closer in range than this, or than this part of their distance across the beam, lie
/// on one surface.
constexpr float kFlatRange_m = 0.1f;
constexpr float kFlatSlope = 0.5f;
/// Largest bend of a surface that goes on straight, and what range noise may add to it.
constexpr double kStraight_rad = 5.0 * kPi / 180.0;
constexpr float kRangeNoise_m = 0.06f;
constexpr float kLargestBend_rad = 0.5f;
/// Neighbours that must agree before a link is taken over from the column beside.
constexpr int kCarryRun = 5;

double radians(double degrees) { return degrees * kPi / 180.0; }

double median(std::vector<float>* values) {
  if (values->empty()) return 0.0;
  const auto middle = values->begin() + static_cast<std::ptrdiff_t>(values->size() / 2);
  std::nth_element(values->begin(), middle, values->end());
  return *middle;
}

/// A cloud as rows of returns sorted by azimuth.
struct RangeImage {
  std::vector<float> azimuth, elevation, range;  ///< by cloud index
  std::vector<std::uint16_t> row;                ///< by cloud index; kNoRing = not used
  std::vector<std::uint32_t> order;              ///< cloud indices, row by row, azimuth ascending
  std::vector<std::uint32_t> row_begin;          ///< into `order`, one more than rows
  int rows() const { return static_cast<int>(row_begin.size()) - 1; }
};

RangeImage rangeImage(const Cloud& cloud, const OcclusionConfig& config) {
  const std::size_t n = cloud.size();
  RangeImage image;
  image.azimuth.resize(n);
  image.elevation.resize(n);
  image.range.resize(n);
  image.row.assign(n, kNoRing);
  const auto no_odometry = static_cast<std::uint8_t>(PointStatus::kNoOdometry);
  bool has_ring = false;
  float lowest = std::numeric_limits<float>::max();
  for (std::size_t i = 0; i < n; ++i) {
    const float flat = std::sqrt(cloud.x[i] * cloud.x[i] + cloud.y[i] * cloud.y[i]);
    image.azimuth[i] = std::atan2(cloud.y[i], cloud.x[i]);
    image.elevation[i] = std::atan2(cloud.z[i], flat);
    image.range[i] = std::sqrt(flat * flat + cloud.z[i] * cloud.z[i]);
    if (cloud.status[i] == no_odometry || !(image.range[i] > 0.0f) ||
        !std::isfinite(image.range[i])) {
      image.range[i] = 0.0f;
      continue;
    }
    has_ring = has_ring || cloud.ring[i] != kNoRing;
    lowest = std::min(lowest, image.elevation[i]);
  }
  if (!has_ring && lowest < 4.0f && config.vertical_step_deg <= 0.0) {
    throw DataError(
        "field 'ring' is absent from the cloud and occlusion.vertical_step_deg = 0: masks need the "
        "angle between rings; set occlusion.vertical_step_deg to it");
  }
  int rows = 0;
  for (std::size_t i = 0; i < n; ++i) {
    if (image.range[i] == 0.0f) continue;
    if (has_ring) {
      image.row[i] = cloud.ring[i];
    } else {
      const double step = radians(config.vertical_step_deg);
      image.row[i] = static_cast<std::uint16_t>(
          std::min(65534.0, std::floor((image.elevation[i] - lowest) / step + 0.5)));
    }
    if (image.row[i] != kNoRing) rows = std::max(rows, image.row[i] + 1);
  }

  image.row_begin.assign(static_cast<std::size_t>(rows) + 1, 0);
  for (std::size_t i = 0; i < n; ++i) {
    if (image.row[i] != kNoRing) ++image.row_begin[image.row[i] + 1u];
  }
  std::partial_sum(image.row_begin.begin(), image.row_begin.end(), image.row_begin.begin());
  image.order.resize(image.row_begin.back());
  std::vector<std::uint32_t> next(image.row_begin.begin(), image.row_begin.end() - 1);
  for (std::size_t i = 0; i < n; ++i) {
    if (image.row[i] != kNoRing) image.order[next[image.row[i]]++] = static_cast<std::uint32_t>(i);
  }
  for (int row = 0; row < rows; ++row) {
    std::sort(
        image.order.begin() + image.row_begin[row], image.order.begin() + image.row_begin[row + 1],
        [&](std::uint32_t a, std::uint32_t b) {
          return image.azimuth[a] != image.azimuth[b] ? image.azimuth[a] < image.azimuth[b] : a < b;
        });
  }
  return image;
}

/// The most frequent step between sorted azimuths: gaps and dropouts make multiples of it, second
/// returns make zeros.
double azimuthStep(std::vector<float>* steps) {
  // The exponent and the first three bits of the mantissa of a float: eight bins per octave.
  const auto bin = [](float value) {
    std::uint32_t bits;
    std::memcpy(&bits, &value, sizeof(bits));
    return static_cast<int>(bits >> 20);
  };
  constexpr float kSmallest = 3e-4f, kLargest = 1.0f;  // 0.017 deg .. 57 deg
  const int first = bin(kSmallest) - 1;
  std::vector<int> count(static_cast<std::size_t>(bin(kLargest) - first) + 2, 0);
  std::vector<double> sum(count.size(), 0.0);
  for (const float step : *steps) {
    if (!(step >= kSmallest && step < kLargest)) continue;
    const auto place = static_cast<std::size_t>(bin(step) - first);
    ++count[place];
    sum[place] += step;
  }
  int most = 0;
  double mode = 0.0;
  for (std::size_t k = 1; k + 1 < count.size(); ++k) {
    const int near = count[k - 1] + 2 * count[k] + count[k + 1];
    if (near > most && count[k] > 0) {
      most = near;
      mode = sum[k] / count[k];
    }
  }
  if (most == 0) return 0.0;
  steps->erase(std::remove_if(steps->begin(), steps->end(),
                              [&](float s) { return s < 0.6 * mode || s > 1.5 * mode; }),
               steps->end());
  return median(steps);
}

void measureSteps(const RangeImage& image, const OcclusionConfig& config, BeamGrid* grid) {
  constexpr std::size_t kEnough = 50;
  const int rows = image.rows();
  grid->rings.assign(static_cast<std::size_t>(rows), {});
  std::vector<float> all, values;
  std::vector<int> present;
  for (int row = 0; row < rows; ++row) {
    const std::uint32_t begin = image.row_begin[row], end = image.row_begin[row + 1];
    if (begin == end) continue;
    present.push_back(row);
    values.clear();
    for (std::uint32_t i = begin; i < end; ++i) values.push_back(image.elevation[image.order[i]]);
    grid->rings[row].elevation_rad = median(&values);
    values.clear();
    for (std::uint32_t i = begin + 1; i < end; ++i) {
      values.push_back(image.azimuth[image.order[i]] - image.azimuth[image.order[i - 1]]);
    }
    all.insert(all.end(), values.begin(), values.end());
    if (values.size() >= kEnough) grid->rings[row].half_azimuth_rad = 0.5 * azimuthStep(&values);
  }
  if (present.empty()) return;

  grid->horizontal_step_rad =
      config.horizontal_step_deg > 0.0 ? radians(config.horizontal_step_deg) : azimuthStep(&all);
  // Rings by elevation; ring numbers of some drivers are not in that order.
  std::stable_sort(present.begin(), present.end(), [&](int a, int b) {
    return grid->rings[a].elevation_rad < grid->rings[b].elevation_rad;
  });
  std::vector<float> gaps;
  for (std::size_t i = 1; i < present.size(); ++i) {
    const int missing = std::max(1, std::abs(present[i] - present[i - 1]));
    const double gap =
        grid->rings[present[i]].elevation_rad - grid->rings[present[i - 1]].elevation_rad;
    gaps.push_back(static_cast<float>(gap / missing));
  }
  const std::vector<float> gap_above = gaps;
  grid->vertical_step_rad =
      config.vertical_step_deg > 0.0 ? radians(config.vertical_step_deg) : median(&gaps);
  for (std::size_t i = 0; i < present.size(); ++i) {
    BeamGrid::Ring& ring = grid->rings[present[i]];
    if (config.horizontal_step_deg > 0.0 || ring.half_azimuth_rad <= 0.0) {
      ring.half_azimuth_rad = 0.5 * grid->horizontal_step_rad;
    }
    const auto gap = [&](std::size_t g) {
      return config.vertical_step_deg > 0.0 ? grid->vertical_step_rad
                                            : static_cast<double>(gap_above[g]);
    };
    const bool lowest = i == 0, highest = i + 1 == present.size();
    if (lowest && highest) {
      ring.half_up_rad = ring.half_down_rad = 0.5 * grid->vertical_step_rad;
    } else {
      ring.half_up_rad = 0.5 * gap(highest ? i - 1 : i);
      ring.half_down_rad = 0.5 * gap(lowest ? 0 : i - 1);
    }
  }
}

/// Finds for each return its neighbours and whether they lie on its surface.
class Linker {
 public:
  Linker(const Cloud& cloud, const RangeImage& image, const OcclusionConfig& config,
         const BeamGrid& grid)
      : cloud_(cloud), image_(image), config_(config), grid_(grid) {}

  std::vector<BeamGrid::Links> link() {
    const std::size_t n = cloud_.size();
    near_.assign(n, {kNone, kNone, kNone, kNone});
    links_ = near_;
    std::vector<int> rows;
    for (int row = 0; row < image_.rows(); ++row) {
      if (image_.row_begin[row] != image_.row_begin[row + 1]) rows.push_back(row);
    }
    std::stable_sort(rows.begin(), rows.end(), [&](int a, int b) {
      return grid_.rings[a].elevation_rad < grid_.rings[b].elevation_rad;
    });
    for (std::size_t k = 0; k < rows.size(); ++k) {
      findBeside(rows[k]);
      if (k > 0) findAcross(rows[k], rows[k - 1], &Links::down);
      if (k + 1 < rows.size()) findAcross(rows[k], rows[k + 1], &Links::up);
    }
    for (const std::uint32_t i : image_.order) {
      keepSameSurface(i, &Links::left, &Links::right);
      keepSameSurface(i, &Links::right, &Links::left);
      keepSameSurface(i, &Links::up, &Links::down);
      keepSameSurface(i, &Links::down, &Links::up);
    }
    for (const int row : rows) {
      for (const bool to_left : {true, false}) {
        carryAlong(row, to_left, &Links::up);
        carryAlong(row, to_left, &Links::down);
      }
    }
    return std::move(links_);
  }

 private:
  using Links = BeamGrid::Links;
  using Side = std::int32_t Links::*;
  static constexpr std::int32_t kNone = BeamGrid::kNoLink;

  float stepOf(int row) const {
    return static_cast<float>(2.0 * grid_.rings[row].half_azimuth_rad);
  }

  /// Difference of azimuths counter-clockwise, 0..2 pi.
  static float turn(float from, float to) {
    const float d = to - from;
    return d < 0.0f ? d + kTwoPi : d;
  }

  /// The next return left (counter-clockwise seen from above) and right in the same row, over a gap
  /// of one missing return; of several at one azimuth (second returns) the closest in range.
  void findBeside(int row) {
    const std::uint32_t begin = image_.row_begin[row];
    const std::uint32_t count = image_.row_begin[row + 1] - begin;
    const float least = 0.3f * stepOf(row), most = 2.6f * stepOf(row), same = 0.3f * stepOf(row);
    for (std::uint32_t k = 0; k < count; ++k) {
      const std::uint32_t i = image_.order[begin + k];
      for (const bool to_left : {true, false}) {
        float best = std::numeric_limits<float>::max();
        float first = most;
        for (std::uint32_t hop = 1; hop < count; ++hop) {
          const std::uint32_t place = to_left ? k + hop : k + count - hop;
          const std::uint32_t j = image_.order[begin + (place < count ? place : place - count)];
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

  /// The return of the row `other` that lies over or under each of `row`; of several the closest in
  /// range.
  void findAcross(int row, int other, Side side) {
    const std::uint32_t other_begin = image_.row_begin[other];
    const std::uint32_t count = image_.row_begin[other + 1] - other_begin;
    const float window = std::min(0.75f * std::max(stepOf(row), stepOf(other)), 3.0f);
    const auto at = [&](std::uint32_t k) { return image_.order[other_begin + k]; };
    std::uint32_t start = 0;
    for (std::uint32_t k = image_.row_begin[row]; k < image_.row_begin[row + 1]; ++k) {
      const std::uint32_t i = image_.order[k];
      const float azimuth = image_.azimuth[i];
      float best = std::numeric_limits<float>::max();
      const auto consider = [&](std::uint32_t j) {
        const float difference = std::abs(image_.range[j] - image_.range[i]);
        if (difference < best) {
          best = difference;
          near_[i].*side = static_cast<std::int32_t>(j);
        }
      };
      while (start < count && image_.azimuth[at(start)] < azimuth - window) ++start;
      for (std::uint32_t m = start; m < count && image_.azimuth[at(m)] <= azimuth + window; ++m) {
        consider(at(m));
      }
      // Across the jump of the azimuth at the back.
      for (std::uint32_t m = 0; m < count && image_.azimuth[at(m)] + kTwoPi <= azimuth + window;
           ++m) {
        consider(at(m));
      }
      for (std::uint32_t m = count; m > 0 && image_.azimuth[at(m - 1)] - kTwoPi >= azimuth - window;
           --m) {
        consider(at(m - 1));
      }
    }
  }

  void keepSameSurface(std::uint32_t i, Side side, Side opposite) {
    const std::int32_t j = near_[i].*side;
    if (j != kNone && sameSurface(static_cast<std::int32_t>(i), j, near_[i].*opposite,
                                  near_[static_cast<std::size_t>(j)].*side)) {
      links_[i].*side = j;
    }
  }

  Eigen::Vector3f point(std::int32_t i) const {
    const auto k = static_cast<std::size_t>(i);
    return {cloud_.x[k], cloud_.y[k], cloud_.z[k]};
  }

  static bool straight(const Eigen::Vector3f& a, const Eigen::Vector3f& b) {
    const float length_a = a.norm(), length_b = b.norm();
    const float noise = kRangeNoise_m / std::max(1e-3f, std::min(length_a, length_b));
    const float bend = std::min(static_cast<float>(kStraight_rad) + noise, kLargestBend_rad);
    return a.dot(b) >= std::cos(bend) * length_a * length_b;
  }

  /// Whether neighbours a and b lie on one surface; `before` is a's neighbour away from b, `after`
  /// is b's away from a.
  bool sameSurface(std::int32_t a, std::int32_t b, std::int32_t before, std::int32_t after) const {
    const float range_a = image_.range[a], range_b = image_.range[b];
    const float jump = std::abs(range_a - range_b), nearest = std::min(range_a, range_b);
    const float across = (point(a) / range_a - point(b) / range_b).norm() * nearest;
    if (jump <= std::max(kFlatRange_m, kFlatSlope * across)) return true;
    // Beside each other the beams are so close that a slanted link hides nothing wrongly; between
    // rings it would cut off the corner of a box.
    if (image_.row[a] == image_.row[b] &&
        jump <= std::max(config_.depth_margin_m, config_.depth_margin_ratio * nearest)) {
      return true;
    }
    // A plane at a grazing angle goes on straight. The nearer point's side of the link is the
    // witness: a farther surface seen over an edge may happen to lie in line with it.
    const Eigen::Vector3f step = point(b) - point(a);
    const bool from_before = range_a <= range_b ? before != kNone : after == kNone;
    if (from_before) return before != kNone && straight(point(a) - point(before), step);
    return after != kNone && straight(step, point(after) - point(b));
  }

  /// Where only two rings meet the ground in front of an object nothing tells whether their link is
  /// straight: then it is like its neighbour's, if a run of neighbours has one.
  void carryAlong(int row, bool to_left, Side side) {
    const std::uint32_t begin = image_.row_begin[row];
    const std::uint32_t count = image_.row_begin[row + 1] - begin;
    int run = 0;
    std::int32_t last = kNone, last_across = kNone;
    const auto slope = [&](std::int32_t i, std::int32_t j) {
      const Eigen::Vector3f step = point(j) - point(i);
      return std::atan2(step.z(), step.head<2>().norm());
    };
    const auto jump = [&](std::int32_t i, std::int32_t j) {
      return image_.range[static_cast<std::size_t>(j)] - image_.range[static_cast<std::size_t>(i)];
    };
    const auto alike = [&](std::int32_t i, std::int32_t j) {
      const float before = jump(last, last_across);
      return std::abs(jump(i, j) - before) <= std::max(0.2f, 0.25f * std::abs(before)) &&
             std::abs(slope(i, j) - slope(last, last_across)) <= static_cast<float>(kStraight_rad);
    };
    for (std::uint32_t n = 0; n < 2 * count; ++n) {  // twice around: the start has a run too
      const std::uint32_t k = n < count ? n : n - count;
      const auto i = static_cast<std::int32_t>(image_.order[begin + (to_left ? k : count - 1 - k)]);
      Links& own = links_[static_cast<std::size_t>(i)];
      if (last == kNone || (to_left ? own.right : own.left) != last) run = 0;
      const std::int32_t j = near_[static_cast<std::size_t>(i)].*side;
      if (own.*side == kNone && j != kNone && run >= kCarryRun && alike(i, j)) own.*side = j;
      run = own.*side != kNone ? run + 1 : 0;
      last = i;
      last_across = j;
    }
  }

  const Cloud& cloud_;
  const RangeImage& image_;
  const OcclusionConfig& config_;
  const BeamGrid& grid_;
  std::vector<Links> near_;   ///< neighbours, of whatever surface
  std::vector<Links> links_;  ///< those of the same surface
};

}  // namespace

BeamGrid beamGrid(const Cloud& cloud, const OcclusionConfig& config) {
  BeamGrid grid;
  if (config.mode == OcclusionMode::kOff) return grid;
  RangeImage image = rangeImage(cloud, config);
  measureSteps(image, config, &grid);
  if (config.vertical_step_deg > 0.0) grid.vertical_step_rad = radians(config.vertical_step_deg);
  if (config.horizontal_step_deg > 0.0) {
    grid.horizontal_step_rad = radians(config.horizontal_step_deg);
  }
  if (config.mode == OcclusionMode::kAdaptive) {
    grid.links = Linker(cloud, image, config, grid).link();
    grid.ring = std::move(image.row);
  }
  return grid;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/projection/beam_grid.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <numeric>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/thread_pool.h"

namespace semantic_lidar_fusion {

namespace {

constexpr float kTwoPi = 6.28318530717958647692f;

/// Neighbours closer in range than this, or than this part of their distance across the beam, lie
/// on one surface.
constexpr float kFlatRange_m = 0.1f;
constexpr float kFlatSlope = 0.5f;
/// Largest bend of a surface that goes on straight, and what range noise may add to it.
constexpr float kStraight_rad = static_cast<float>(5.0 * kPi / 180.0);
constexpr float kRangeNoise_m = 0.06f;
constexpr float kLargestBend_rad = 0.5f;
/// No surface is so steep that its range grows by more than this from a beam to the next one beside
/// it, or to the next ring: between noisy returns at 1 m, 5 mm apart, everything behind looks
/// straight on.
constexpr float kMostBeside = 1.3f;
constexpr float kMostAcross = 2.0f;
/// Neighbours that must agree before a link is taken over from the column beside.
constexpr int kCarryRun = 5;
/// Missing returns (glass, dark paint) up to this many steps wide are bridged in a row. Between
/// rows a neighbour stands at most kOver steps aside, or kAside if none is there: leaning links
/// leave cracks between masks.
constexpr float kBridge = 8.6f;
constexpr float kOver = 0.75f;
constexpr float kAside = 2.6f;

constexpr std::int32_t kNone = BeamGrid::kNoLink;

double radians(double degrees) { return degrees * kPi / 180.0; }

double median(std::vector<float>* values) {
  if (values->empty()) return 0.0;
  const auto middle = values->begin() + static_cast<std::ptrdiff_t>(values->size() / 2);
  std::nth_element(values->begin(), middle, values->end());
  return *middle;
}

/// atan2 to 1e-6 rad, without branches (Abramowitz and Stegun 4.4.49).
float quickAtan2(float y, float x) {
  const float ax = std::abs(x), ay = std::abs(y);
  const float a = std::min(ax, ay) / std::max(std::max(ax, ay), 1e-30f), s = a * a;
  float r = 0.0028662257f;
  r = r * s - 0.0161657367f;
  r = r * s + 0.0429096138f;
  r = r * s - 0.0752896400f;
  r = r * s + 0.1065626393f;
  r = r * s - 0.1420889944f;
  r = r * s + 0.1999355085f;
  r = r * s - 0.3333314528f;
  r = r * s * a + a;
  r = ay > ax ? 0.25f * kTwoPi - r : r;
  r = x < 0.0f ? 0.5f * kTwoPi - r : r;
  return y < 0.0f ? -r : r;
}

/// A cloud as rows of returns sorted by azimuth. A return's *place* is its index in these arrays.
struct RangeImage {
  std::vector<float> x, y, z, azimuth, range;
  std::vector<std::uint32_t> index;      ///< into the cloud
  std::vector<std::uint32_t> row_begin;  ///< places, one more than rows
  int rows() const { return static_cast<int>(row_begin.size()) - 1; }
  std::uint32_t count(int row) const { return row_begin[row + 1] - row_begin[row]; }
  float elevation(std::uint32_t place) const {
    return std::atan2(z[place], std::hypot(x[place], y[place]));
  }
};

struct Key {
  float azimuth;
  std::uint32_t index;
  bool operator<(const Key& other) const {
    return azimuth != other.azimuth ? azimuth < other.azimuth : index < other.index;
  }
};

/// A turning lidar's row comes sorted but for the jump at +-pi, its sense, and what motion has
/// shifted: then a few moves are enough.
void sortRow(Key* keys, std::uint32_t count) {
  if (count < 2) return;
  std::uint32_t rising = 0;
  for (std::uint32_t k = 1; k < count; ++k) rising += keys[k - 1] < keys[k];
  if (2 * rising < count) std::reverse(keys, keys + count);
  std::uint32_t jump = 0;
  for (std::uint32_t k = 1; k < count && jump == 0; ++k) {
    if (keys[k].azimuth < keys[k - 1].azimuth - 0.5f * kTwoPi) jump = k;
  }
  std::rotate(keys, keys + jump, keys + count);
  std::uint32_t moves = 0;
  for (std::uint32_t k = 1; k < count; ++k) {
    const Key key = keys[k];
    std::uint32_t to = k;
    for (; to > 0 && key < keys[to - 1]; --to) keys[to] = keys[to - 1];
    keys[to] = key;
    moves += k - to;
    if (moves > 8 * count) {
      std::sort(keys, keys + count);
      return;
    }
  }
}

/// `rows` gets the row of each point, kNoRing = not used.
RangeImage rangeImage(const Cloud& cloud, const OcclusionConfig& config, ThreadPool* pool,
                      std::vector<std::uint16_t>* rows) {
  const std::size_t n = cloud.size();
  std::vector<float> azimuth(n), range(n);
  for (std::size_t i = 0; i < n; ++i) {
    azimuth[i] = quickAtan2(cloud.y[i], cloud.x[i]);
    range[i] =
        std::sqrt(cloud.x[i] * cloud.x[i] + cloud.y[i] * cloud.y[i] + cloud.z[i] * cloud.z[i]);
  }
  const auto no_odometry = static_cast<std::uint8_t>(PointStatus::kNoOdometry);
  const auto used = [&](std::size_t i) {
    return cloud.status[i] != no_odometry && range[i] > 0.0f &&
           range[i] <= std::numeric_limits<float>::max();
  };
  bool has_ring = false, any = false;
  int row_count = 0;
  rows->assign(n, kNoRing);
  for (std::size_t i = 0; i < n; ++i) {
    if (!used(i)) continue;
    any = true;
    if (cloud.ring[i] == kNoRing) continue;
    has_ring = true;
    (*rows)[i] = cloud.ring[i];
    row_count = std::max(row_count, cloud.ring[i] + 1);
  }
  if (any && !has_ring) {
    if (config.vertical_step_deg <= 0.0) {
      throw DataError(
          "field 'ring' is absent from the cloud and occlusion.vertical_step_deg = 0: masks need "
          "the angle between rings; set occlusion.vertical_step_deg to it");
    }
    std::vector<float> elevation(n);
    float lowest = std::numeric_limits<float>::max();
    for (std::size_t i = 0; i < n; ++i) {
      elevation[i] = std::atan2(cloud.z[i], std::hypot(cloud.x[i], cloud.y[i]));
      if (used(i)) lowest = std::min(lowest, elevation[i]);
    }
    const double step = radians(config.vertical_step_deg);
    for (std::size_t i = 0; i < n; ++i) {
      if (!used(i)) continue;
      (*rows)[i] = static_cast<std::uint16_t>(
          std::min(65534.0, std::floor((elevation[i] - lowest) / step + 0.5)));
      row_count = std::max(row_count, (*rows)[i] + 1);
    }
  }

  RangeImage image;
  image.row_begin.assign(static_cast<std::size_t>(row_count) + 1, 0);
  for (const std::uint16_t row : *rows) {
    if (row != kNoRing) ++image.row_begin[row + 1u];
  }
  std::partial_sum(image.row_begin.begin(), image.row_begin.end(), image.row_begin.begin());
  std::vector<Key> keys(image.row_begin.back());
  std::vector<std::uint32_t> next(image.row_begin.begin(), image.row_begin.end() - 1);
  for (std::size_t i = 0; i < n; ++i) {
    if ((*rows)[i] == kNoRing) continue;
    keys[next[(*rows)[i]]++] = {azimuth[i], static_cast<std::uint32_t>(i)};
  }
  for (std::vector<float>* values : {&image.x, &image.y, &image.z, &image.azimuth, &image.range}) {
    values->resize(keys.size());
  }
  image.index.resize(keys.size());
  forEach(pool, row_count, [&](int row) {
    sortRow(keys.data() + image.row_begin[row], image.count(row));
    for (std::uint32_t place = image.row_begin[row]; place < image.row_begin[row + 1]; ++place) {
      const std::uint32_t i = keys[place].index;
      image.index[place] = i;
      image.azimuth[place] = keys[place].azimuth;
      image.range[place] = range[i];
      image.x[place] = cloud.x[i];
      image.y[place] = cloud.y[i];
      image.z[place] = cloud.z[i];
    }
  });
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

void measureSteps(const RangeImage& image, const OcclusionConfig& config, ThreadPool* pool,
                  BeamGrid* grid) {
  constexpr std::size_t kEnough = 50;
  constexpr std::uint32_t kElevations = 256;  // a sample is enough for a median
  const auto rows = static_cast<std::size_t>(image.rows());
  grid->rings.assign(rows, {});
  std::vector<std::vector<float>> few(rows);  // the steps of rows that are too short for a median
  forEach(pool, image.rows(), [&](int row) {
    const std::uint32_t begin = image.row_begin[row], end = image.row_begin[row + 1];
    if (begin == end) return;
    std::vector<float> values;
    values.reserve(end - begin);
    for (std::uint32_t i = begin; i < end; i += 1 + (end - begin) / kElevations) {
      values.push_back(image.elevation(i));
    }
    grid->rings[row].elevation_rad = median(&values);
    values.clear();
    for (std::uint32_t i = begin + 1; i < end; ++i) {
      values.push_back(image.azimuth[i] - image.azimuth[i - 1]);
    }
    if (values.size() >= kEnough) {
      grid->rings[row].half_azimuth_rad = 0.5 * azimuthStep(&values);
    } else {
      few[row] = std::move(values);
    }
  });
  std::vector<float> all, steps_of_rings;
  std::vector<int> present;
  for (int row = 0; row < image.rows(); ++row) {
    if (image.count(row) == 0) continue;
    present.push_back(row);
    all.insert(all.end(), few[row].begin(), few[row].end());
    const double half_step = grid->rings[row].half_azimuth_rad;
    if (half_step > 0.0) steps_of_rings.push_back(static_cast<float>(2.0 * half_step));
  }
  if (present.empty()) return;

  grid->horizontal_step_rad = config.horizontal_step_deg > 0.0 ? radians(config.horizontal_step_deg)
                              : steps_of_rings.empty()         ? azimuthStep(&all)
                                                               : median(&steps_of_rings);
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
    for (int row = 0; row < image_.rows(); ++row) {
      if (image_.count(row) > 0) rows_.push_back(row);
    }
    std::stable_sort(rows_.begin(), rows_.end(), [&](int a, int b) {
      return grid_.rings[a].elevation_rad < grid_.rings[b].elevation_rad;
    });
    const auto count = static_cast<int>(rows_.size());
    forEach(pool, count, [&](int k) {
      findBeside(rows_[k]);
      if (k > 0) findAcross(rows_[k], rows_[k - 1], &Links::down);
      if (k + 1 < count) findAcross(rows_[k], rows_[k + 1], &Links::up);
    });
    // Links depend on the neighbours of both ends, thus on the rows beside, but on no other link
    // than those of their own row.
    forEach(pool, count, [&](int k) {
      const int row = rows_[k];
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

  const std::vector<Links>& links() const { return links_; }

 private:
  float stepOf(int row) const {
    return static_cast<float>(2.0 * grid_.rings[row].half_azimuth_rad);
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
    const float least = 0.3f * stepOf(row), most = kBridge * stepOf(row), same = 0.3f * stepOf(row);
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
    const float over = std::min(kOver * step, 3.0f), aside = std::min(kAside * step, 3.0f);
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
      return std::abs(jump(i, j) - before) <= std::max(0.2f, 0.25f * std::abs(before)) &&
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
  std::vector<int> rows_;     ///< those with returns, by elevation
  std::vector<Links> near_;   ///< neighbours, of whatever surface
  std::vector<Links> links_;  ///< those of the same surface
};

}  // namespace

BeamGrid beamGrid(const Cloud& cloud, const OcclusionConfig& config, ThreadPool* pool) {
  BeamGrid grid;
  if (config.mode == OcclusionMode::kOff) return grid;
  const bool vertical_given = config.vertical_step_deg > 0.0;
  const bool horizontal_given = config.horizontal_step_deg > 0.0;
  std::vector<std::uint16_t> rows;
  RangeImage image;
  if (config.mode == OcclusionMode::kAdaptive || !vertical_given || !horizontal_given) {
    image = rangeImage(cloud, config, pool, &rows);
    measureSteps(image, config, pool, &grid);
  }
  if (vertical_given) grid.vertical_step_rad = radians(config.vertical_step_deg);
  if (horizontal_given) grid.horizontal_step_rad = radians(config.horizontal_step_deg);
  if (config.mode != OcclusionMode::kAdaptive) return grid;

  Linker linker(image, config, grid);
  linker.link(pool);
  grid.ring = std::move(rows);
  grid.links.assign(cloud.size(), {kNone, kNone, kNone, kNone});
  const auto indexOf = [&](std::int32_t place) {
    return place == kNone ? kNone : static_cast<std::int32_t>(image.index[place]);
  };
  forEach(pool, image.rows(), [&](int row) {
    for (std::uint32_t place = image.row_begin[row]; place < image.row_begin[row + 1]; ++place) {
      const BeamGrid::Links& links = linker.links()[place];
      const std::uint32_t i = image.index[place];
      grid.links[i] = {indexOf(links.left), indexOf(links.right), indexOf(links.up),
                       indexOf(links.down)};
    }
  });
  return grid;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "range_image.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/thread_pool.h"
#include "turn_splitter.h"

namespace semantic_lidar_fusion {
namespace {

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

/// By cloud index.
struct Polar {
  std::vector<float> azimuth, range;
  std::vector<std::uint8_t> used;
};

Polar polarOf(const Cloud& cloud) {
  const std::size_t n = cloud.size();
  const auto no_odometry = static_cast<std::uint8_t>(PointStatus::kNoOdometry);
  Polar polar{std::vector<float>(n), std::vector<float>(n), std::vector<std::uint8_t>(n)};
  for (std::size_t i = 0; i < n; ++i) {
    polar.azimuth[i] = quickAtan2(cloud.y[i], cloud.x[i]);
    const float range =
        std::sqrt(cloud.x[i] * cloud.x[i] + cloud.y[i] * cloud.y[i] + cloud.z[i] * cloud.z[i]);
    polar.range[i] = range;
    polar.used[i] = cloud.status[i] != no_odometry && range > 0.0f &&
                    range <= std::numeric_limits<float>::max();
  }
  return polar;
}

/// The ring of each used point, kNoRing for the others.
std::vector<std::uint16_t> rowsByRing(const Cloud& cloud, const std::vector<std::uint8_t>& used) {
  std::vector<std::uint16_t> rows(cloud.size(), kNoRing);
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    if (used[i]) rows[i] = cloud.ring[i];
  }
  return rows;
}

float elevationOf(const Cloud& cloud, std::size_t i) {
  return std::atan2(cloud.z[i], std::hypot(cloud.x[i], cloud.y[i]));
}

/// Rows of equal height, `step_rad` each, the lowest used point in the middle of the first.
std::vector<std::uint16_t> rowsByElevation(const Cloud& cloud,
                                           const std::vector<std::uint8_t>& used, double step_rad) {
  constexpr double kLastRow = kNoRing - 1;
  std::vector<float> elevation(cloud.size());
  float lowest = std::numeric_limits<float>::max();
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    elevation[i] = elevationOf(cloud, i);
    if (used[i]) lowest = std::min(lowest, elevation[i]);
  }
  std::vector<std::uint16_t> rows(cloud.size(), kNoRing);
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    if (!used[i]) continue;
    const double row = std::floor((elevation[i] - lowest) / step_rad + 0.5);
    rows[i] = static_cast<std::uint16_t>(std::min(kLastRow, row));
  }
  return rows;
}

/// The height of rows (rad) that hold one point in every square of their own height, on average
/// over the cells of 1 deg in which there are points.
double stepOfDensity(const Cloud& cloud, const Polar& polar) {
  constexpr int kColumns = 360, kRows = 180;
  constexpr double kCell = kPi / 180.0;
  constexpr double kLeast = 0.05 * kPi / 180.0, kMost = 5.0 * kPi / 180.0;
  std::vector<std::uint8_t> occupied(kColumns * kRows, 0);
  std::size_t count = 0;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    if (!polar.used[i]) continue;
    const auto column = static_cast<int>((polar.azimuth[i] + kPi) / kCell);
    const auto row = static_cast<int>((elevationOf(cloud, i) + 0.5 * kPi) / kCell);
    occupied[static_cast<std::size_t>(std::min(row, kRows - 1) * kColumns +
                                      std::min(std::max(column, 0), kColumns - 1))] = 1;
    ++count;
  }
  double area = 0.0;  // rad^2
  for (int row = 0; row < kRows; ++row) {
    const double height = std::cos((row + 0.5) * kCell - 0.5 * kPi);
    for (int column = 0; column < kColumns; ++column) {
      area += occupied[static_cast<std::size_t>(row * kColumns + column)] * height * kCell * kCell;
    }
  }
  const double step = std::sqrt(area / static_cast<double>(std::max<std::size_t>(1, count)));
  return std::min(kMost, std::max(kLeast, step));
}

int rowCount(const std::vector<std::uint16_t>& rows) {
  int count = 0;
  for (const std::uint16_t row : rows) {
    if (row != kNoRing) count = std::max(count, row + 1);
  }
  return count;
}

/// Sorts the points into `image->row_of`, which is given, and `row_count` rows.
void fillRows(const Cloud& cloud, const Polar& polar, int row_count, ThreadPool* pool,
              RangeImage* image) {
  image->row_begin.assign(static_cast<std::size_t>(row_count) + 1, 0);
  for (const std::uint16_t row : image->row_of) {
    if (row != kNoRing) ++image->row_begin[row + 1u];
  }
  std::partial_sum(image->row_begin.begin(), image->row_begin.end(), image->row_begin.begin());
  std::vector<Key> keys(image->row_begin.back());
  std::vector<std::uint32_t> next(image->row_begin.begin(), image->row_begin.end() - 1);
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const std::uint16_t row = image->row_of[i];
    if (row != kNoRing) keys[next[row]++] = {polar.azimuth[i], static_cast<std::uint32_t>(i)};
  }
  for (std::vector<float>* values :
       {&image->x, &image->y, &image->z, &image->azimuth, &image->range}) {
    values->resize(keys.size());
  }
  image->index.resize(keys.size());
  forEach(pool, row_count, [&](int row) {
    sortRow(keys.data() + image->row_begin[row], image->count(row));
    for (std::uint32_t place = image->row_begin[row]; place < image->row_begin[row + 1]; ++place) {
      const std::uint32_t i = keys[place].index;
      image->index[place] = i;
      image->azimuth[place] = keys[place].azimuth;
      image->range[place] = polar.range[i];
      image->x[place] = cloud.x[i];
      image->y[place] = cloud.y[i];
      image->z[place] = cloud.z[i];
    }
  });
}

/// By how much neighbours in a row differ in elevation, rad: the median of a sample. Next to 0 for
/// a laser that turns, whatever the attitude of the lidar.
float unevenness(const RangeImage& image) {
  constexpr std::size_t kSample = 2048;
  std::vector<float> differences;
  const std::size_t step = 1 + image.index.size() / kSample;
  for (int row = 0; row < image.rows(); ++row) {
    for (std::size_t k = image.row_begin[row] + 1; k < image.row_begin[row + 1]; k += step) {
      const auto place = static_cast<std::uint32_t>(k);
      differences.push_back(std::abs(image.elevation(place) - image.elevation(place - 1)));
    }
  }
  if (differences.empty()) return 0.0f;
  const auto middle = differences.begin() + static_cast<std::ptrdiff_t>(differences.size() / 2);
  std::nth_element(differences.begin(), middle, differences.end());
  return *middle;
}

/// Above what a ring that is a cone shows: motion of 1 m within a scan moves the ground 8 m away by
/// 1.5 deg. Rosettes of a field of view of 16 deg show 5 deg.
constexpr float kUneven_rad = static_cast<float>(2.0 * kPi / 180.0);

void cutByAngle(const Cloud& cloud, const OcclusionConfig& config, const Polar& polar,
                ThreadPool* pool, RangeImage* image) {
  image->step_rad = config.vertical_step_deg > 0.0 ? radians(config.vertical_step_deg)
                                                   : stepOfDensity(cloud, polar);
  image->row_of = rowsByElevation(cloud, polar.used, image->step_rad);
  fillRows(cloud, polar, rowCount(image->row_of), pool, image);
}

}  // namespace

float RangeImage::elevation(std::uint32_t place) const {
  return std::atan2(z[place], std::hypot(x[place], y[place]));
}

RangeImage rangeImage(const Cloud& cloud, const OcclusionConfig& config, ThreadPool* pool) {
  const Polar polar = polarOf(cloud);
  RangeImage image;
  image.row_of = rowsByRing(cloud, polar.used);
  const int ring_count = rowCount(image.row_of);
  const bool any_used =
      std::any_of(polar.used.begin(), polar.used.end(), [](std::uint8_t u) { return u != 0; });
  if (any_used && ring_count == 0) {
    if (config.mode->needs != OcclusionMode::Needs::kNothing && config.vertical_step_deg <= 0.0) {
      throw DataError(
          "field 'ring' is absent from the cloud and occlusion.vertical_step_deg = 0: masks need "
          "the angle between rings; set occlusion.vertical_step_deg to it");
    }
    image.scattered = config.vertical_step_deg <= 0.0;
    cutByAngle(cloud, config, polar, pool, &image);
    return image;
  }
  fillRows(cloud, polar, ring_count, pool, &image);
  if (unevenness(image) > kUneven_rad) {
    image.scattered = true;
    cutByAngle(cloud, config, polar, pool, &image);
    image.note =
        "the lidar's rings are no cones (neighbours in a ring differ in elevation): neighbouring "
        "points are found by angle; occlusion.vertical_step_deg sets the angle, 0 takes it from "
        "the data";
    return image;
  }
  image.turns = splitTurns(cloud, polar.azimuth, ring_count, &image.row_of);
  if (image.turns > 1) fillRows(cloud, polar, image.turns * ring_count, pool, &image);
  return image;
}

}  // namespace semantic_lidar_fusion

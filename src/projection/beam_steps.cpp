// SPDX-License-Identifier: MIT
#include "beam_steps.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <utility>

#include "semantic_lidar_fusion/common/thread_pool.h"

namespace semantic_lidar_fusion {
namespace {

/// Rows with fewer steps than this borrow the median of the other rows: their most frequent step
/// may be chance.
constexpr std::size_t kEnoughSteps = 50;
/// Elevations that are read of a row: the median of 256 is within an eighth of a row's spread.
constexpr std::uint32_t kElevations = 256;
/// Steps that a lidar can have, rad: 0.017 deg (a fifth of the finest resolution on the market, a
/// VLS-128 at 5 Hz) to 57 deg.
constexpr float kSmallestStep = 3e-4f, kLargestStep = 1.0f;
/// Steps that count as one step, as a part of the most frequent one: the halves of dual returns and
/// the doubles of missing returns stay out.
constexpr double kLeastOfStep = 0.6, kMostOfStep = 1.5;

double median(std::vector<float>* values) {
  if (values->empty()) return 0.0;
  const auto middle = values->begin() + static_cast<std::ptrdiff_t>(values->size() / 2);
  std::nth_element(values->begin(), middle, values->end());
  return *middle;
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
  const int first = bin(kSmallestStep) - 1;
  std::vector<int> count(static_cast<std::size_t>(bin(kLargestStep) - first) + 2, 0);
  std::vector<double> sum(count.size(), 0.0);
  for (const float step : *steps) {
    if (!(step >= kSmallestStep && step < kLargestStep)) continue;
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
  const auto other = [&](float s) { return s < kLeastOfStep * mode || s > kMostOfStep * mode; };
  steps->erase(std::remove_if(steps->begin(), steps->end(), other), steps->end());
  return median(steps);
}

/// Elevation and, where a row has enough returns, the azimuth step of each ring. Returns the
/// azimuth steps of the other rows.
std::vector<float> measureRows(const RangeImage& image, ThreadPool* pool, BeamGrid* grid) {
  std::vector<std::vector<float>> few(grid->rings.size());
  forEach(pool, image.rows(), [&](int row) {
    const std::uint32_t begin = image.row_begin[row], end = image.row_begin[row + 1];
    if (begin == end) return;
    BeamGrid::Ring& ring = grid->rings[row];
    std::vector<float> values;
    values.reserve(end - begin);
    for (std::uint32_t i = begin; i < end; i += 1 + (end - begin) / kElevations) {
      values.push_back(image.elevation(i));
    }
    ring.elevation_rad = median(&values);
    values.clear();
    for (std::uint32_t i = begin + 1; i < end; ++i) {
      values.push_back(image.azimuth[i] - image.azimuth[i - 1]);
    }
    if (values.size() >= kEnoughSteps) {
      ring.half_azimuth_rad = 0.5 * azimuthStep(&values);
    } else {
      few[row] = std::move(values);
    }
  });
  std::vector<float> all;
  for (const std::vector<float>& steps : few) all.insert(all.end(), steps.begin(), steps.end());
  return all;
}

/// From each row of a turn to the one above, rad.
std::vector<float> gapsOf(const std::vector<int>& upwards, const BeamGrid& grid) {
  std::vector<float> gaps;
  for (std::size_t i = 1; i < upwards.size(); ++i) {
    const int missing = std::max(1, std::abs(upwards[i] - upwards[i - 1]));
    const double gap =
        grid.rings[upwards[i]].elevation_rad - grid.rings[upwards[i - 1]].elevation_rad;
    gaps.push_back(static_cast<float>(gap / missing));
  }
  return gaps;
}

/// Half-way up and down to the next rings, from their elevations or the given step.
void measureGaps(const std::vector<std::vector<int>>& turns, double given_step_rad,
                 BeamGrid* grid) {
  std::vector<float> all;
  for (const std::vector<int>& upwards : turns) {
    const std::vector<float> gaps = gapsOf(upwards, *grid);
    all.insert(all.end(), gaps.begin(), gaps.end());
  }
  grid->vertical_step_rad = given_step_rad > 0.0 ? given_step_rad : median(&all);
  for (const std::vector<int>& upwards : turns) {
    const std::vector<float> gaps = gapsOf(upwards, *grid);
    const auto half_gap = [&](std::size_t k) {
      return 0.5 * (given_step_rad > 0.0 ? given_step_rad : static_cast<double>(gaps[k]));
    };
    for (std::size_t i = 0; i < upwards.size(); ++i) {
      BeamGrid::Ring& ring = grid->rings[upwards[i]];
      const bool lowest = i == 0, highest = i + 1 == upwards.size();
      ring.lowest = lowest;
      if (lowest && highest) {
        ring.half_up_rad = ring.half_down_rad = 0.5 * grid->vertical_step_rad;
      } else {
        ring.half_up_rad = half_gap(highest ? i - 1 : i);
        ring.half_down_rad = half_gap(lowest ? 0 : i - 1);
      }
    }
  }
}

/// Mean angle to the nearest return of scattered ones, of which there is one in a square of the
/// rows' height: half of that height (Clark and Evans, 1954).
double nearestNeighbour(const RangeImage& image) { return 0.5 * image.step_rad; }

}  // namespace

std::vector<std::vector<int>> rowsUpwards(const RangeImage& image, const BeamGrid& grid) {
  std::vector<std::vector<int>> turns(static_cast<std::size_t>(image.turns));
  const int rows_of_turn = image.rows() / image.turns;
  for (int row = 0; row < image.rows(); ++row) {
    if (image.count(row) > 0) turns[static_cast<std::size_t>(row / rows_of_turn)].push_back(row);
  }
  for (std::vector<int>& rows : turns) {
    std::stable_sort(rows.begin(), rows.end(), [&](int a, int b) {
      return grid.rings[a].elevation_rad < grid.rings[b].elevation_rad;
    });
  }
  return turns;
}

void measureSteps(const RangeImage& image, const OcclusionConfig& config, ThreadPool* pool,
                  BeamGrid* grid) {
  grid->rings.assign(static_cast<std::size_t>(image.rows()), {});
  std::vector<float> steps_of_short_rows = measureRows(image, pool, grid);
  if (image.index.empty()) return;

  std::vector<float> steps_of_rings;
  for (const BeamGrid::Ring& ring : grid->rings) {
    if (ring.half_azimuth_rad > 0.0) {
      steps_of_rings.push_back(static_cast<float>(2.0 * ring.half_azimuth_rad));
    }
  }
  const double given = config.horizontal_step_deg > 0.0 ? radians(config.horizontal_step_deg)
                       : image.scattered                ? nearestNeighbour(image)
                                                        : 0.0;
  grid->horizontal_step_rad = given > 0.0              ? given
                              : steps_of_rings.empty() ? azimuthStep(&steps_of_short_rows)
                                                       : median(&steps_of_rings);
  for (int row = 0; row < image.rows(); ++row) {
    BeamGrid::Ring& ring = grid->rings[row];
    if (image.count(row) > 0 && (given > 0.0 || ring.half_azimuth_rad <= 0.0)) {
      ring.half_azimuth_rad = 0.5 * grid->horizontal_step_rad;
    }
  }
  measureGaps(rowsUpwards(image, *grid),
              image.scattered ? nearestNeighbour(image) : radians(config.vertical_step_deg), grid);
}

}  // namespace semantic_lidar_fusion

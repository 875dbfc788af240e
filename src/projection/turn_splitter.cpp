// SPDX-License-Identifier: MIT
#include "turn_splitter.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "range_image.h"

namespace semantic_lidar_fusion {
namespace {

/// Scans of one turn overlap by a few packets, and a turning vehicle adds some degrees.
constexpr float kOneTurn = 1.25f * kTwoPi;
/// How far azimuths step back within a turn: motion shifts a near return against a far one.
constexpr float kStepBack = 0.5f;
/// No step back takes this long (s): the motor went on through a gap of 7 deg, at 10 turns a
/// second.
constexpr float kPause_s = 0.002f;
/// A larger step is a jump; a scan in order of azimuth has few: the reduced field of view of each
/// turn, and what is not hit.
constexpr float kJump = 0.5f;
constexpr std::size_t kOneInSteps = 8;

/// Used points of each ring in order of time.
std::vector<std::vector<std::uint32_t>> ringsInTime(const Cloud& cloud, int ring_count,
                                                    const std::vector<std::uint16_t>& rows) {
  std::vector<std::vector<std::uint32_t>> rings(static_cast<std::size_t>(ring_count));
  for (std::size_t i = 0; i < rows.size(); ++i) {
    if (rows[i] != kNoRing) rings[rows[i]].push_back(static_cast<std::uint32_t>(i));
  }
  const auto earlier = [&](std::uint32_t a, std::uint32_t b) { return cloud.dt[a] < cloud.dt[b]; };
  for (std::vector<std::uint32_t>& ring : rings) {
    if (!std::is_sorted(ring.begin(), ring.end(), earlier)) {
      std::stable_sort(ring.begin(), ring.end(), earlier);
    }
  }
  return rings;
}

/// From one azimuth to another in the sense of rotation, in -kStepBack..2 pi.
float stepForward(float from, float to, float sense, float duration_s) {
  const float back = duration_s > kPause_s ? 0.0f : kStepBack;
  float step = sense * (to - from);
  if (step < -back) step += kTwoPi;
  if (step >= kTwoPi - back) step -= kTwoPi;
  return step;
}

/// +1 counter-clockwise, -1 clockwise; 0 if the points are in no order of azimuth.
float senseOf(const std::vector<std::vector<std::uint32_t>>& rings,
              const std::vector<float>& azimuth) {
  std::size_t rising = 0, falling = 0, jumps = 0;
  for (const std::vector<std::uint32_t>& ring : rings) {
    for (std::size_t k = 1; k < ring.size(); ++k) {
      float step = azimuth[ring[k]] - azimuth[ring[k - 1]];
      if (std::abs(step) > 0.5f * kTwoPi) step -= std::copysign(kTwoPi, step);
      if (std::abs(step) > kJump) {
        ++jumps;
      } else {
        (step > 0.0f ? rising : falling) += step != 0.0f;
      }
    }
  }
  if (kOneInSteps * jumps > rising + falling + jumps) return 0.0f;
  return rising >= falling ? 1.0f : -1.0f;
}

/// Where turns begin: in the middle of the widest gap of the field of view, or else where the scan
/// does.
float seamOf(const std::vector<std::vector<std::uint32_t>>& rings,
             const std::vector<float>& azimuth, float first_azimuth) {
  constexpr int kBins = 360;
  constexpr float kPerBin = kTwoPi / kBins;
  std::vector<std::uint8_t> seen(kBins, 0);
  for (const std::vector<std::uint32_t>& ring : rings) {
    for (const std::uint32_t i : ring) {
      const auto bin = static_cast<int>((azimuth[i] + 0.5f * kTwoPi) / kPerBin);
      seen[static_cast<std::size_t>(std::min(std::max(bin, 0), kBins - 1))] = 1;
    }
  }
  constexpr int kWide = 5;  // narrower ones are what is not hit
  int widest = kWide, seam = -1;
  for (int k = 0, run = 0; k < 2 * kBins; ++k) {
    run = seen[static_cast<std::size_t>(k % kBins)] != 0 ? 0 : run + 1;
    if (run > widest) {
      widest = run;
      seam = k - run / 2;
    }
  }
  if (seam < 0) return first_azimuth;
  return (static_cast<float>(seam % kBins) + 0.5f) * kPerBin - 0.5f * kTwoPi;
}

}  // namespace

int splitTurns(const Cloud& cloud, const std::vector<float>& azimuth, int ring_count,
               std::vector<std::uint16_t>* rows) {
  // Without times, second returns that follow the first ones would look like a turn.
  if (cloud.dt.size() != cloud.size()) return 1;
  const auto [earliest, latest] = std::minmax_element(cloud.dt.begin(), cloud.dt.end());
  if (earliest == latest || !(*earliest < *latest)) return 1;

  const std::vector<std::vector<std::uint32_t>> rings = ringsInTime(cloud, ring_count, *rows);
  const float sense = senseOf(rings, azimuth);
  if (sense == 0.0f) return 1;

  float widest = 0.0f;
  std::uint32_t first = 0;
  float first_dt = std::numeric_limits<float>::max();
  for (const std::vector<std::uint32_t>& ring : rings) {
    float sweep = 0.0f;
    for (std::size_t k = 1; k < ring.size(); ++k) {
      sweep += stepForward(azimuth[ring[k - 1]], azimuth[ring[k]], sense,
                           cloud.dt[ring[k]] - cloud.dt[ring[k - 1]]);
    }
    widest = std::max(widest, sweep);
    if (ring.empty()) continue;
    const float dt = cloud.dt[ring[0]];
    if (dt < first_dt || (dt == first_dt && ring[0] < first)) {
      first = ring[0];
      first_dt = dt;
    }
  }
  if (widest <= kOneTurn) return 1;

  const float seam = seamOf(rings, azimuth, azimuth[first]);
  const int most_turns = std::max(1, (kNoRing - 1) / std::max(1, ring_count));
  int turns = 1;
  for (const std::vector<std::uint32_t>& ring : rings) {
    float sweep = 0.0f;
    for (std::size_t k = 0; k < ring.size(); ++k) {
      const float from = k == 0 ? seam : azimuth[ring[k - 1]];
      const float duration_s = k == 0 ? 0.0f : cloud.dt[ring[k]] - cloud.dt[ring[k - 1]];
      sweep += stepForward(from, azimuth[ring[k]], sense, duration_s);
      const int turn = std::min(most_turns - 1, std::max(0, static_cast<int>(sweep / kTwoPi)));
      turns = std::max(turns, turn + 1);
      std::uint16_t& row = (*rows)[ring[k]];
      row = static_cast<std::uint16_t>(turn * ring_count + row);
    }
  }
  return turns;
}

}  // namespace semantic_lidar_fusion

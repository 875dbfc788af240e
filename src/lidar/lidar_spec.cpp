// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/lidar/lidar_spec.h"

#include <algorithm>
#include <cctype>
#include <utility>

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

constexpr StampNs kPuckLaserNs = 2304;
constexpr StampNs kPuckFiringNs = 55296;
constexpr StampNs kHdlLaserNs = 1152;
constexpr StampNs kHdlFiringNs = 46080;
constexpr StampNs kAlphaGroupNs = 2665;
constexpr StampNs kAlphaFiringNs = 53300;

// VLP-32C: elevation and azimuth offset by laser id.
constexpr double kVlp32cElevationDeg[32] = {
    -25.0,  -1.0,   -1.667, -15.639, -11.31, 0.0,    -0.667, -8.843, -7.254, 0.333,  -0.333,
    -6.148, -5.333, 1.333,  0.667,   -4.0,   -4.667, 1.667,  1.0,    -3.667, -3.333, 3.333,
    2.333,  -2.667, -3.0,   7.0,     4.667,  -2.333, -2.0,   15.0,   10.333, -1.333};
constexpr double kVlp32cAzimuthOffsetDeg[32] = {
    1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 4.2, -1.4,
    1.4, -4.2, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4, 1.4, -1.4, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4};

// VLS-128: elevation by laser id; the azimuth offset by the place in its group of eight.
constexpr double kVls128ElevationDeg[128] = {
    -11.742, -1.99,   3.4,    -5.29,  -0.78, 4.61,    -4.08,   1.31,     //
    -6.5,    -1.11,   4.28,   -4.41,  0.1,   6.48,    -3.2,    2.19,     //
    -3.86,   1.53,    -9.244, -1.77,  2.74,  -5.95,   -0.56,   4.83,     //
    -2.98,   2.41,    -6.28,  -0.89,  3.62,  -5.07,   0.32,    7.58,     //
    -0.34,   5.18,    -3.64,  1.75,   -25.0, -2.43,   2.96,    -5.73,    //
    0.54,    9.7,     -2.76,  2.63,   -7.65, -1.55,   3.84,    -4.85,    //
    3.18,    -5.51,   -0.12,  5.73,   -4.3,  1.09,    -16.042, -2.21,    //
    4.06,    -4.63,   0.76,   15.0,   -3.42, 1.97,    -6.85,   -1.33,    //
    -5.62,   -0.23,   5.43,   -3.53,  0.98,  -19.582, -2.32,   3.07,     //
    -4.74,   0.65,    11.75,  -2.65,  1.86,  -7.15,   -1.44,   3.95,     //
    -2.1,    3.29,    -5.4,   -0.01,  4.5,   -4.19,   1.2,     -13.565,  //
    -1.22,   4.17,    -4.52,  0.87,   6.08,  -3.31,   2.08,    -6.65,    //
    1.42,    -10.346, -1.88,  3.51,   -6.06, -0.67,   4.72,    -3.97,    //
    2.3,     -6.39,   -1.0,   4.39,   -5.18, 0.21,    6.98,    -3.09,    //
    4.98,    -3.75,   1.64,   -8.352, -2.54, 2.85,    -5.84,   -0.45,    //
    8.43,    -2.87,   2.52,   -6.17,  -1.66, 3.73,    -4.96,   0.43};
constexpr double kVls128AzimuthOffsetDeg[8] = {6.354,  4.548,  2.732,  0.911,
                                               -0.911, -2.732, -4.548, -6.354};

/// 16 lasers `step_deg` apart and symmetric to the horizon, fired alternately from the lower and
/// the upper half, lowest first.
std::vector<Laser> puckLasers(double step_deg) {
  std::vector<Laser> lasers(16);
  for (int i = 0; i < 16; ++i) {
    const int ring = i / 2 + (i % 2 == 0 ? 0 : 8);
    lasers[i].elevation_rad = (ring - 7.5) * step_deg * kRadPerDeg;
    lasers[i].time_ns = i * kPuckLaserNs;
  }
  return lasers;
}

/// 32 lasers in pairs that fire together.
std::vector<Laser> vlp32cLasers() {
  std::vector<Laser> lasers(32);
  for (int i = 0; i < 32; ++i) {
    lasers[i].elevation_rad = kVlp32cElevationDeg[i] * kRadPerDeg;
    lasers[i].azimuth_offset_rad = kVlp32cAzimuthOffsetDeg[i] * kRadPerDeg;
    lasers[i].time_ns = i / 2 * kPuckLaserNs;
  }
  return lasers;
}

/// 32 lasers 4/3 deg apart from -30.67 to 10.67 deg (the manual's angles have two decimals), fired
/// alternately from the lower and the upper half, lowest first.
std::vector<Laser> hdl32eLasers() {
  constexpr double kLowerDeg[16] = {-30.67, -29.33, -28.0,  -26.67, -25.33, -24.0,  -22.67, -21.33,
                                    -20.0,  -18.67, -17.33, -16.0,  -14.67, -13.33, -12.0,  -10.67};
  constexpr double kUpperDeg[16] = {-9.33, -8.0, -6.67, -5.33, -4.0, -2.67, -1.33, 0.0,
                                    1.33,  2.67, 4.0,   5.33,  6.67, 8.0,   9.33,  10.67};
  std::vector<Laser> lasers(32);
  for (int i = 0; i < 32; ++i) {
    const double elevation_deg = i % 2 == 0 ? kLowerDeg[i / 2] : kUpperDeg[i / 2];
    lasers[i].elevation_rad = elevation_deg * kRadPerDeg;
    lasers[i].time_ns = i * kHdlLaserNs;
  }
  return lasers;
}

/// 128 lasers in groups of eight that fire together, with a pause as long as a group behind the
/// eighth.
std::vector<Laser> vls128Lasers() {
  std::vector<Laser> lasers(128);
  for (int i = 0; i < 128; ++i) {
    const int group = i / 8;
    lasers[i].elevation_rad = kVls128ElevationDeg[i] * kRadPerDeg;
    lasers[i].azimuth_offset_rad = kVls128AzimuthOffsetDeg[i % 8] * kRadPerDeg;
    lasers[i].time_ns = (group + group / 8) * kAlphaGroupNs;
  }
  return lasers;
}

/// Lower case, without what does not count in a name.
std::string plain(const std::string& name) {
  std::string result;
  for (const char c : name) {
    if (c == '-' || c == '_' || c == ' ') continue;
    result += static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  }
  return result;
}

std::vector<LidarSpec> makeLidarSpecs() {
  const std::vector<std::uint16_t> one_bank = {0xEEFF};
  const std::vector<std::uint16_t> four_banks = {0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF};
  const std::vector<LidarSpec> rows = {
      {"VLP16", {"Puck", "PuckLite"}, 0x22, 0.002, kPuckFiringNs, one_bank, puckLasers(2.0)},
      {"PuckHiRes",
       {"VLP16HiRes", "HiRes"},
       0x24,
       0.002,
       kPuckFiringNs,
       one_bank,
       puckLasers(4.0 / 3.0)},
      {"VLP32C", {"UltraPuck"}, 0x28, 0.004, kPuckFiringNs, one_bank, vlp32cLasers()},
      {"HDL32E", {"HDL32"}, 0x21, 0.002, kHdlFiringNs, one_bank, hdl32eLasers()},
      {"VLS128", {"AlphaPrime"}, 0xA1, 0.004, kAlphaFiringNs, four_banks, vls128Lasers()},
  };
  std::vector<LidarSpec> specs;
  for (const LidarSpec& row : rows) specs.push_back(makeLidarSpec(row));
  return specs;
}

}  // namespace

LidarSpec makeLidarSpec(LidarSpec row) {
  const int lasers = row.laserCount();
  const int banks = row.bankCount();
  const bool fits =
      lasers > 0 && banks >= 1 && banks <= kMostBanks &&
      (banks == 1 ? kReturnsPerBlock % lasers == 0 : lasers == kReturnsPerBlock * banks);
  if (!fits || row.firing_ns <= 0 || !(row.distance_unit_m > 0.0)) {
    throw ConfigError({"lidar model " + row.name + " has " + std::to_string(lasers) +
                       " lasers in " + std::to_string(banks) +
                       " banks, must have a divisor of 32 in one or 32 in each of up to 4, and a "
                       "firing time and a unit of distance above 0"});
  }
  for (Laser& laser : row.lasers) {
    laser.ring = static_cast<std::uint16_t>(std::count_if(
        row.lasers.begin(), row.lasers.end(),
        [&](const Laser& other) { return other.elevation_rad < laser.elevation_rad; }));
  }
  return row;
}

const std::vector<LidarSpec>& lidarSpecs() {
  static const std::vector<LidarSpec> specs = makeLidarSpecs();
  return specs;
}

const LidarSpec* findLidarSpec(const std::string& name, const std::vector<LidarSpec>& specs) {
  const std::string wanted = plain(name);
  for (const LidarSpec& spec : specs) {
    if (plain(spec.name) == wanted) return &spec;
    for (const std::string& alias : spec.aliases) {
      if (plain(alias) == wanted) return &spec;
    }
  }
  return nullptr;
}

const LidarSpec* findLidarSpec(std::uint8_t factory_byte, const std::vector<LidarSpec>& specs) {
  for (const LidarSpec& spec : specs) {
    if (spec.factory_byte == factory_byte) return &spec;
  }
  return nullptr;
}

std::string lidarSpecNames(const std::vector<LidarSpec>& specs) {
  std::string names;
  for (const LidarSpec& spec : specs) names += (names.empty() ? "" : ", ") + spec.name;
  return names;
}

}  // namespace semantic_lidar_fusion

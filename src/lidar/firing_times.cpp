// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/lidar/firing_times.h"

#include <algorithm>

namespace semantic_lidar_fusion {
namespace {

constexpr double kRadPerDeg = kPi / 180.0;

constexpr StampNs kPuckLaserNs = 2304;
constexpr StampNs kPuckFiringNs = 55296;
constexpr StampNs kHdlLaserNs = 1152;
constexpr StampNs kHdlFiringNs = 46080;

// VLP-32C: elevation and azimuth offset by laser id.
constexpr double kVlp32cElevationDeg[32] = {
    -25.0,  -1.0,   -1.667, -15.639, -11.31, 0.0,    -0.667, -8.843, -7.254, 0.333,  -0.333,
    -6.148, -5.333, 1.333,  0.667,   -4.0,   -4.667, 1.667,  1.0,    -3.667, -3.333, 3.333,
    2.333,  -2.667, -3.0,   7.0,     4.667,  -2.333, -2.0,   15.0,   10.333, -1.333};
constexpr double kVlp32cAzimuthOffsetDeg[32] = {
    1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 4.2, -1.4,
    1.4, -4.2, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4, 1.4, -1.4, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4};

void numberRings(FiringTimes& times) {
  for (int i = 0; i < times.laser_count; ++i) {
    times.lasers[i].ring = static_cast<std::uint16_t>(std::count_if(
        times.lasers.begin(), times.lasers.begin() + times.laser_count,
        [&](const Laser& other) { return other.elevation_rad < times.lasers[i].elevation_rad; }));
  }
}

/// 16 lasers `step_deg` apart and symmetric to the horizon, fired alternately from the lower and
/// the upper half, lowest first.
FiringTimes puck(const std::string& name, double step_deg) {
  FiringTimes times;
  times.model_name = name;
  times.laser_count = 16;
  times.firings_per_block = 2;
  times.firing_ns = kPuckFiringNs;
  times.distance_unit_m = 0.002;
  for (int i = 0; i < 16; ++i) {
    const int ring = i / 2 + (i % 2 == 0 ? 0 : 8);
    times.lasers[i].elevation_rad = (ring - 7.5) * step_deg * kRadPerDeg;
    times.lasers[i].time_ns = i * kPuckLaserNs;
  }
  numberRings(times);
  return times;
}

/// 32 lasers in pairs that fire together.
FiringTimes vlp32c() {
  FiringTimes times;
  times.model_name = "VLP32C";
  times.laser_count = 32;
  times.firings_per_block = 1;
  times.firing_ns = kPuckFiringNs;
  times.distance_unit_m = 0.004;
  for (int i = 0; i < 32; ++i) {
    times.lasers[i].elevation_rad = kVlp32cElevationDeg[i] * kRadPerDeg;
    times.lasers[i].azimuth_offset_rad = kVlp32cAzimuthOffsetDeg[i] * kRadPerDeg;
    times.lasers[i].time_ns = i / 2 * kPuckLaserNs;
  }
  numberRings(times);
  return times;
}

/// 32 lasers 4/3 deg apart from -30.67 to 10.67 deg (the manual's angles have two decimals), fired
/// alternately from the lower and the upper half, lowest first.
FiringTimes hdl32e() {
  constexpr double kLowerDeg[16] = {-30.67, -29.33, -28.0,  -26.67, -25.33, -24.0,  -22.67, -21.33,
                                    -20.0,  -18.67, -17.33, -16.0,  -14.67, -13.33, -12.0,  -10.67};
  constexpr double kUpperDeg[16] = {-9.33, -8.0, -6.67, -5.33, -4.0, -2.67, -1.33, 0.0,
                                    1.33,  2.67, 4.0,   5.33,  6.67, 8.0,   9.33,  10.67};
  FiringTimes times;
  times.model_name = "HDL32E";
  times.laser_count = 32;
  times.firings_per_block = 1;
  times.firing_ns = kHdlFiringNs;
  times.distance_unit_m = 0.002;
  for (int i = 0; i < 32; ++i) {
    const double elevation_deg = i % 2 == 0 ? kLowerDeg[i / 2] : kUpperDeg[i / 2];
    times.lasers[i].elevation_rad = elevation_deg * kRadPerDeg;
    times.lasers[i].time_ns = i * kHdlLaserNs;
  }
  numberRings(times);
  return times;
}

}  // namespace

const FiringTimes& firingTimes(LidarModel model) {
  static const FiringTimes vlp16 = puck("VLP16", 2.0);
  static const FiringTimes hi_res = puck("PuckHiRes", 4.0 / 3.0);
  static const FiringTimes vlp32 = vlp32c();
  static const FiringTimes hdl32 = hdl32e();
  switch (model) {
    case LidarModel::kPuckHiRes:
      return hi_res;
    case LidarModel::kVlp32c:
      return vlp32;
    case LidarModel::kHdl32e:
      return hdl32;
    case LidarModel::kVlp16:
      break;
  }
  return vlp16;
}

}  // namespace semantic_lidar_fusion

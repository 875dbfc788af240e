// SPDX-License-Identifier: MIT
/// Velodyne data packets of an imagined world: the opposite of PacketDecoder, from the manuals'
/// tables alone (VLP-16 63-9243, VLP-32C 63-9325, HDL-32E 63-9113) and without the decoder's.
///
/// The sensor turns at a constant rate. Each laser shoots at its own time, into the azimuth of that
/// time plus its own offset; the world answers with up to two echoes.
#pragma once

#include <cmath>
#include <cstdint>
#include <functional>
#include <stdexcept>
#include <vector>

#include "semantic_lidar_fusion/lidar/packet.h"

namespace semantic_lidar_fusion {

/// One laser pulse.
struct Shot {
  StampNs time_ns = 0;
  int laser = 0;             ///< order of firing and of the packet's data
  int ring = 0;              ///< 0 = lowest
  double azimuth_rad = 0.0;  ///< clockwise from x, seen from above
  double elevation_rad = 0.0;
  double direction_x() const { return std::cos(elevation_rad) * std::cos(azimuth_rad); }
  double direction_y() const { return -std::cos(elevation_rad) * std::sin(azimuth_rad); }
  double direction_z() const { return std::sin(elevation_rad); }
};

struct Echo {
  double range_m = 0.0;  ///< 0 = none
  std::uint8_t intensity = 0;
};

/// What comes back. In single return mode the first counts; in dual return mode a missing second
/// is sent as a copy of the first, as the sensors do.
struct Echoes {
  Echo first;
  Echo second;
};

using World = std::function<Echoes(const Shot&)>;

class PacketEncoder {
 public:
  struct Config {
    LidarModel model = LidarModel::kVlp16;
    bool dual_return = false;
    bool last_return = false;  ///< in single return mode: 0x38 in place of 0x37
    double rotation_hz = 10.0;
    double start_azimuth_deg = 0.0;
    StampNs start_ns = 0;
  };

  explicit PacketEncoder(const Config& config) : config_(config), time_ns_(config.start_ns) {
    const double puck_first = config.model == LidarModel::kPuckHiRes ? -10.0 : -15.0;
    const double puck_step = config.model == LidarModel::kPuckHiRes ? 20.0 / 15.0 : 2.0;
    switch (config.model) {
      case LidarModel::kVlp16:
      case LidarModel::kPuckHiRes:
        lasers_ = 16;
        laser_ns_ = 2304;
        firing_ns_ = 55296;
        unit_m_ = 0.002;
        for (const int ring : {0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15}) {
          elevation_deg_.push_back(puck_first + puck_step * ring);
        }
        break;
      case LidarModel::kVlp32c:
        lasers_ = 32;
        fired_together_ = 2;
        laser_ns_ = 2304;
        firing_ns_ = 55296;
        unit_m_ = 0.004;
        elevation_deg_ = {-25.0,  -1.0,  -1.667, -15.639, -11.310, 0.0,   -0.667, -8.843,
                          -7.254, 0.333, -0.333, -6.148,  -5.333,  1.333, 0.667,  -4.0,
                          -4.667, 1.667, 1.0,    -3.667,  -3.333,  3.333, 2.333,  -2.667,
                          -3.0,   7.0,   4.667,  -2.333,  -2.0,    15.0,  10.333, -1.333};
        // Columns of table 9-6; all others of the odd lasers -1.4 and of the even ones +1.4.
        for (int laser = 0; laser < 32; ++laser) {
          offset_deg_.push_back(laser % 2 == 0 ? 1.4 : -1.4);
        }
        for (const int laser : {6, 12, 14, 20, 28}) offset_deg_[laser] = 4.2;
        for (const int laser : {1, 9, 17, 19, 27}) offset_deg_[laser] = -4.2;
        break;
      case LidarModel::kHdl32e:
        lasers_ = 32;
        laser_ns_ = 1152;
        firing_ns_ = 46080;
        unit_m_ = 0.002;
        elevation_deg_ = {-30.67, -9.33, -29.33, -8.00, -28.00, -6.67, -26.67, -5.33,
                          -25.33, -4.00, -24.00, -2.67, -22.67, -1.33, -21.33, 0.00,
                          -20.00, 1.33,  -18.67, 2.67,  -17.33, 4.00,  -16.00, 5.33,
                          -14.67, 6.67,  -13.33, 8.00,  -12.00, 9.33,  -10.67, 10.67};
        break;
    }
    offset_deg_.resize(elevation_deg_.size(), 0.0);
    for (const double elevation : elevation_deg_) {
      int lower = 0;
      for (const double other : elevation_deg_) lower += other < elevation ? 1 : 0;
      ring_.push_back(lower);
    }
  }

  int lasers() const { return lasers_; }
  /// Of the raw distances.
  double unitM() const { return unit_m_; }
  /// From one packet's first firing to the next one's.
  StampNs packetNs() const { return firingsPerPacket() * firing_ns_; }
  /// Begin of the next packet's first firing.
  StampNs nextNs() const { return time_ns_; }

  /// Azimuth of the sensor at a time, without lasers' offsets; not wrapped.
  double azimuthDegAt(StampNs time_ns) const {
    return config_.start_azimuth_deg +
           360.0 * config_.rotation_hz * toSeconds(time_ns - config_.start_ns);
  }

  Shot shotAt(StampNs firing_begin_ns, int laser) const {
    Shot shot;
    shot.time_ns = firing_begin_ns + laser / fired_together_ * laser_ns_;
    shot.laser = laser;
    shot.ring = ring_[laser];
    shot.azimuth_rad = (azimuthDegAt(shot.time_ns) + offset_deg_[laser]) * kRadPerDeg;
    shot.elevation_rad = elevation_deg_[laser] * kRadPerDeg;
    return shot;
  }

  /// The next packet, stamped with the begin of its first firing.
  Packet next(const World& world) {
    Packet packet;
    packet.stamp = time_ns_;
    const int firings_per_block = 32 / lasers_;
    const int blocks_per_time = config_.dual_return ? 2 : 1;
    for (int block = 0; block < 12; block += blocks_per_time) {
      for (int b = block; b < block + blocks_per_time; ++b) {
        put16(packet, b * 100, 0xEEFF);
        long azimuth = std::lround(100.0 * azimuthDegAt(time_ns_)) % 36000;
        if (azimuth < 0) azimuth += 36000;
        put16(packet, b * 100 + 2, static_cast<unsigned>(azimuth));
      }
      for (int firing = 0; firing < firings_per_block; ++firing) {
        for (int laser = 0; laser < lasers_; ++laser) {
          const Echoes echoes = world(shotAt(time_ns_, laser));
          const int at = 4 + 3 * (firing * lasers_ + laser);
          putEcho(packet, block * 100 + at, echoes.first);
          if (config_.dual_return) {
            putEcho(packet, (block + 1) * 100 + at,
                    echoes.second.range_m > 0.0 ? echoes.second : echoes.first);
          }
        }
        time_ns_ += firing_ns_;
      }
    }
    const std::uint64_t hour_us = 3600000000ULL;
    const std::uint64_t us = static_cast<std::uint64_t>(packet.stamp / 1000) % hour_us;
    for (int byte = 0; byte < 4; ++byte) {
      packet.data[1200 + byte] = static_cast<std::uint8_t>(us >> (8 * byte));
    }
    packet.data[1204] = config_.dual_return ? 0x39 : config_.last_return ? 0x38 : 0x37;
    packet.data[1205] = factoryByte();
    return packet;
  }

  std::vector<Packet> packets(int count, const World& world) {
    std::vector<Packet> result;
    for (int i = 0; i < count; ++i) result.push_back(next(world));
    return result;
  }

 private:
  static constexpr double kRadPerDeg = 3.14159265358979323846 / 180.0;

  int firingsPerPacket() const { return 12 / (config_.dual_return ? 2 : 1) * (32 / lasers_); }

  std::uint8_t factoryByte() const {
    switch (config_.model) {
      case LidarModel::kVlp16:
        return 0x22;
      case LidarModel::kPuckHiRes:
        return 0x24;
      case LidarModel::kVlp32c:
        return 0x28;
      case LidarModel::kHdl32e:
        return 0x21;
    }
    return 0;
  }

  static void put16(Packet& packet, int at, unsigned value) {
    packet.data[at] = static_cast<std::uint8_t>(value & 0xFF);
    packet.data[at + 1] = static_cast<std::uint8_t>(value >> 8);
  }

  void putEcho(Packet& packet, int at, const Echo& echo) const {
    const long raw = std::lround(echo.range_m / unit_m_);
    if (raw < 0 || raw > 65535) throw std::out_of_range("range does not fit a packet");
    put16(packet, at, static_cast<unsigned>(raw));
    packet.data[at + 2] = echo.intensity;
  }

  Config config_;
  int lasers_ = 0;
  int fired_together_ = 1;
  StampNs laser_ns_ = 0;
  StampNs firing_ns_ = 0;
  double unit_m_ = 0.0;
  std::vector<double> elevation_deg_;
  std::vector<double> offset_deg_;
  std::vector<int> ring_;
  StampNs time_ns_ = 0;
};

}  // namespace semantic_lidar_fusion

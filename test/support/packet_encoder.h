// SPDX-License-Identifier: MIT
/// Velodyne data packets of an imagined world: the opposite of PacketDecoder, from the manuals'
/// tables alone (VLP-16 63-9243, VLP-32C 63-9325, HDL-32E 63-9113, VLS-128 63-9483) and without the
/// decoder's, but for the 128 angles of the VLS-128, which a real capture proves.
///
/// The sensor turns at a constant rate. Each laser shoots at its own time, into the azimuth of that
/// time plus its own offset; the world answers with up to two echoes.
#pragma once

#include <cmath>
#include <cstdint>
#include <functional>
#include <stdexcept>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/lidar/lidar_spec.h"
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
    std::string model = "VLP16";  ///< as LidarSpec::name
    bool dual_return = false;
    bool last_return = false;  ///< in single return mode: 0x38 in place of 0x37
    double rotation_hz = 10.0;
    double start_azimuth_deg = 0.0;
    StampNs start_ns = 0;
    /// The sensor sends nothing outside of begin..end (clockwise, through 0 where begin > end), and
    /// packs what it sends without a break; equal = it sends all.
    double view_begin_deg = 0.0;
    double view_end_deg = 0.0;
  };

  explicit PacketEncoder(const Config& config) : config_(config), time_ns_(config.start_ns) {
    if (config.model == "VLP16" || config.model == "PuckHiRes") {
      makePuck();
    } else if (config.model == "VLP32C") {
      makeVlp32c();
    } else if (config.model == "HDL32E") {
      makeHdl32e();
    } else if (config.model == "VLS128") {
      makeVls128();
    } else {
      throw std::invalid_argument("no table of " + config.model);
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
  /// From one azimuth that is sent to the next.
  StampNs slotNs() const { return packetNs() / slots(); }
  /// Begin of the next packet's first firing.
  StampNs nextNs() const { return time_ns_; }

  /// Azimuth of the sensor at a time, without lasers' offsets; not wrapped.
  double azimuthDegAt(StampNs time_ns) const {
    return config_.start_azimuth_deg +
           360.0 * config_.rotation_hz * toSeconds(time_ns - config_.start_ns);
  }

  Shot shotAt(StampNs firing_begin_ns, int laser) const {
    Shot shot;
    const int group = laser / fired_together_;
    shot.time_ns =
        firing_begin_ns + (group + (pause_behind_ > 0 ? group / pause_behind_ : 0)) * laser_ns_;
    shot.laser = laser;
    shot.ring = ring_[laser];
    shot.azimuth_rad = (azimuthDegAt(shot.time_ns) + offset_deg_[laser]) * kRadPerDeg;
    shot.elevation_rad = elevation_deg_[laser] * kRadPerDeg;
    return shot;
  }

  /// The next packet, stamped with the begin of its first firing.
  Packet next(const World& world) {
    Packet packet;
    skipToView();
    packet.stamp = time_ns_;
    const int returns = config_.dual_return ? 2 : 1;
    for (int slot = 0; slot < slots(); ++slot) {
      skipToView();
      const StampNs slot_ns = time_ns_;
      for (int i = 0; i < 32 * banks(); ++i) {
        const int bank = i / 32;
        const int block = (slot * banks() + bank) * returns;
        if (i % 32 == 0) {
          for (int b = block; b < block + returns; ++b) putHeader(packet, b, bank, slot_ns);
        }
        const Echoes echoes = world(shotAt(time_ns_, i % lasers_));
        const int at = 4 + 3 * (i % 32);
        putEcho(packet, block * 100 + at, echoes.first);
        if (config_.dual_return) {
          putEcho(packet, (block + 1) * 100 + at,
                  echoes.second.range_m > 0.0 ? echoes.second : echoes.first);
        }
        if (i % lasers_ == lasers_ - 1) time_ns_ += firing_ns_;
      }
    }
    const std::uint64_t hour_us = 3600000000ULL;
    const std::uint64_t us = static_cast<std::uint64_t>(packet.stamp / 1000) % hour_us;
    for (int byte = 0; byte < 4; ++byte) {
      packet.data[1200 + byte] = static_cast<std::uint8_t>(us >> (8 * byte));
    }
    packet.data[1204] = config_.dual_return ? 0x39 : config_.last_return ? 0x38 : 0x37;
    packet.data[1205] = factory_byte_;
    return packet;
  }

  std::vector<Packet> packets(int count, const World& world) {
    std::vector<Packet> result;
    for (int i = 0; i < count; ++i) result.push_back(next(world));
    return result;
  }

 private:
  static constexpr double kRadPerDeg = 3.14159265358979323846 / 180.0;

  int banks() const { return (lasers_ + 31) / 32; }
  int slots() const { return 12 / (banks() * (config_.dual_return ? 2 : 1)); }
  int firingsPerPacket() const { return slots() * 32 * banks() / lasers_; }

  bool inView(double azimuth_deg) const {
    const double begin = config_.view_begin_deg, end = config_.view_end_deg;
    const double azimuth = azimuth_deg - 360.0 * std::floor(azimuth_deg / 360.0);
    if (begin == end) return true;
    return begin < end ? azimuth >= begin && azimuth < end : azimuth >= begin || azimuth < end;
  }

  void skipToView() {
    while (!inView(azimuthDegAt(time_ns_))) time_ns_ += slotNs();
  }

  void makePuck() {
    const bool hi_res = config_.model == "PuckHiRes";
    const double first_deg = hi_res ? -10.0 : -15.0;
    const double step_deg = hi_res ? 20.0 / 15.0 : 2.0;
    factory_byte_ = hi_res ? 0x24 : 0x22;
    lasers_ = 16;
    laser_ns_ = 2304;
    firing_ns_ = 55296;
    unit_m_ = 0.002;
    for (const int ring : {0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15}) {
      elevation_deg_.push_back(first_deg + step_deg * ring);
    }
  }

  void makeVlp32c() {
    factory_byte_ = 0x28;
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
  }

  void makeHdl32e() {
    factory_byte_ = 0x21;
    lasers_ = 32;
    laser_ns_ = 1152;
    firing_ns_ = 46080;
    unit_m_ = 0.002;
    elevation_deg_ = {-30.67, -9.33, -29.33, -8.00, -28.00, -6.67, -26.67, -5.33,
                      -25.33, -4.00, -24.00, -2.67, -22.67, -1.33, -21.33, 0.00,
                      -20.00, 1.33,  -18.67, 2.67,  -17.33, 4.00,  -16.00, 5.33,
                      -14.67, 6.67,  -13.33, 8.00,  -12.00, 9.33,  -10.67, 10.67};
  }

  /// Eight lasers fire together; behind the eighth group there is a pause as long as a group.
  void makeVls128() {
    factory_byte_ = 0xA1;
    lasers_ = 128;
    fired_together_ = 8;
    pause_behind_ = 8;
    laser_ns_ = 2665;
    firing_ns_ = 53300;
    unit_m_ = 0.004;
    const double offsets_deg[8] = {6.354, 4.548, 2.732, 0.911, -0.911, -2.732, -4.548, -6.354};
    for (int laser = 0; laser < 128; ++laser) {
      elevation_deg_.push_back(findLidarSpec("VLS128")->lasers.at(laser).elevation_rad /
                               kRadPerDeg);
      offset_deg_.push_back(offsets_deg[laser % 8]);
    }
  }

  void putHeader(Packet& packet, int block, int bank, StampNs time_ns) const {
    const unsigned flags[] = {0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF};
    put16(packet, block * 100, flags[bank]);
    long azimuth = std::lround(100.0 * azimuthDegAt(time_ns)) % 36000;
    if (azimuth < 0) azimuth += 36000;
    put16(packet, block * 100 + 2, static_cast<unsigned>(azimuth));
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
  int pause_behind_ = 0;  ///< groups, of one group each; 0 = none
  std::uint8_t factory_byte_ = 0;
  StampNs laser_ns_ = 0;
  StampNs firing_ns_ = 0;
  double unit_m_ = 0.0;
  std::vector<double> elevation_deg_;
  std::vector<double> offset_deg_;
  std::vector<int> ring_;
  StampNs time_ns_ = 0;
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/lidar.h"

#include <algorithm>
#include <cmath>
#include <thread>

#include "semantic_lidar_fusion/lidar/lidar_spec.h"
#include "tools/simulate_drive/materials.h"
#include "tools/simulate_drive/noise.h"

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

constexpr double kStartAzimuthRad = kPi;  // the seam is behind the vehicle
constexpr double kMaxRangeM = 100.0;
constexpr double kMinRangeM = 0.5;
constexpr double kRangeSigmaM = 0.02;
/// Of a white wall seen at a right angle: half of the shots at this range come back.
constexpr double kReachM = 130.0;

void put16(Packet* packet, int at, unsigned value) {
  packet->data[static_cast<std::size_t>(at)] = static_cast<std::uint8_t>(value & 0xFFU);
  packet->data[static_cast<std::size_t>(at) + 1] = static_cast<std::uint8_t>(value >> 8U);
}

const LidarSpec& simulatedLidar() { return *findLidarSpec("VLP16"); }

}  // namespace

StampNs packetPeriodNs() { return simulatedLidar().packetNs(false); }

int firstPacketOfScan(int index) {
  return static_cast<int>(std::floor(index / kLidarTurnsPerS / toSeconds(packetPeriodNs()) + 0.5));
}

namespace {

void simulatePacket(const DrivePath& path, const LidarOptions& options, int number,
                    const World& world, Packet* packet, std::vector<Echo>* echoes) {
  const LidarSpec& spec = simulatedLidar();
  const StampNs begin_ns = number * packetPeriodNs();  // since time 0
  const auto azimuthAt = [](StampNs ns) {
    return kStartAzimuthRad + 2.0 * kPi * kLidarTurnsPerS * toSeconds(ns);
  };
  packet->stamp = options.start_ns + begin_ns;
  for (int block = 0; block < kBlocksPerPacket; ++block) {
    const StampNs block_ns = begin_ns + block * spec.slotNs();
    put16(packet, 100 * block, 0xEEFFU);
    const long centidegrees = std::lround(azimuthAt(block_ns) * 18000.0 / kPi) % 36000;
    put16(packet, 100 * block + 2, static_cast<unsigned>(centidegrees));
    for (int firing = 0; firing < spec.firingsPerSlot(); ++firing) {
      const StampNs firing_ns = block_ns + firing * spec.firing_ns;
      for (int l = 0; l < spec.laserCount(); ++l) {
        const Laser& laser = spec.lasers[static_cast<std::size_t>(l)];
        const StampNs shot_ns = firing_ns + laser.time_ns;
        const double t = toSeconds(shot_ns);
        const double azimuth = azimuthAt(shot_ns) + laser.azimuth_offset_rad;
        const Eigen::Vector3d way_lidar(std::cos(laser.elevation_rad) * std::cos(azimuth),
                                        -std::cos(laser.elevation_rad) * std::sin(azimuth),
                                        std::sin(laser.elevation_rad));
        const Transform T_world_lidar = path.pose(t) * options.T_base_lidar;
        const Eigen::Vector3d origin = T_world_lidar.translation();
        const Eigen::Vector3d way = T_world_lidar.linear() * way_lidar;
        const Hit hit = world.cast(origin, way, t);
        if (hit.range < kMinRangeM || hit.range > kMaxRangeM) continue;
        Random random(mixKeys(options.seed ^ 0x11DA2ULL, static_cast<std::uint64_t>(shot_ns),
                              static_cast<std::uint64_t>(l)));
        const LidarResponse response = lidarResponse(world.materialOf(hit), world.tintOf(hit));
        const double cosine = std::abs(hit.normal.cast<double>().dot(way));
        // The return fades with the square of the range; around the threshold luck decides.
        const double signal = response.reflectivity * (0.15 + 0.85 * cosine) *
                              (kReachM / hit.range) * (kReachM / hit.range);
        if (random.uniform() < response.lost) continue;
        if (signal < 1.0 + 0.3 * random.normal()) continue;
        const double noise = options.range_noise ? kRangeSigmaM * random.normal() : 0.0;
        const unsigned raw = static_cast<unsigned>(
            std::lround(std::max(hit.range + noise, kMinRangeM) / spec.distance_unit_m));
        const double brightness = 100.0 * response.reflectivity * (0.4 + 0.6 * cosine) +
                                  (response.reflectivity >= 1.0F ? 120.0 : 0.0) +
                                  2.0 * random.normal();
        const int at = 100 * block + 4 + 3 * (firing * spec.laserCount() + l);
        put16(packet, at, raw);
        packet->data[static_cast<std::size_t>(at) + 2] =
            static_cast<std::uint8_t>(std::min(std::max(brightness, 0.0), 255.0));
        Echo echo;
        echo.time_ns = options.start_ns + shot_ns;
        echo.object = hit.object;
        echo.kind = world.classOf(hit);
        echo.surface = world.surfaceOf(hit);
        echo.p_lidar = static_cast<double>(hit.range) * way_lidar;
        echo.p_object =
            world.toObject(hit.object, origin + static_cast<double>(hit.range) * way, t);
        echoes->push_back(echo);
      }
    }
  }
  const std::uint64_t us = static_cast<std::uint64_t>(packet->stamp / 1000) % 3600000000ULL;
  for (int byte = 0; byte < 4; ++byte) {
    packet->data[1200 + static_cast<std::size_t>(byte)] =
        static_cast<std::uint8_t>(us >> (8 * byte));
  }
  packet->data[1204] = 0x37;  // strongest return
  packet->data[1205] = 0x22;  // VLP-16
}

}  // namespace

SimulatedScan simulateScan(const DrivePath& path, const LidarOptions& options, int first, int last,
                           World* world) {
  world->setSweep(toSeconds(first * packetPeriodNs()), toSeconds(last * packetPeriodNs()));
  const int count = last - first;
  SimulatedScan scan;
  scan.packets.resize(static_cast<std::size_t>(count));
  std::vector<std::vector<Echo>> echoes(static_cast<std::size_t>(count));
  const auto work = [&](int remainder) {
    for (int i = remainder; i < count; i += options.threads) {
      simulatePacket(path, options, first + i, *world, &scan.packets[static_cast<std::size_t>(i)],
                     &echoes[static_cast<std::size_t>(i)]);
    }
  };
  std::vector<std::thread> pool;
  for (int i = 1; i < options.threads; ++i) pool.emplace_back(work, i);
  work(0);
  for (std::thread& thread : pool) thread.join();
  for (const std::vector<Echo>& part : echoes) {
    scan.echoes.insert(scan.echoes.end(), part.begin(), part.end());
  }
  return scan;
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

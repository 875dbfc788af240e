// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <set>
#include <vector>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/lidar/lidar_spec.h"
#include "semantic_lidar_fusion/lidar/packet_decoder.h"

namespace semantic_lidar_fusion {
namespace {

constexpr double kDegPerRad = 180.0 / 3.14159265358979323846;

TEST(LidarSpec, EveryRowFillsItsPackets) {
  std::set<int> factory_bytes;
  for (const LidarSpec& spec : lidarSpecs()) {
    SCOPED_TRACE(spec.name);
    EXPECT_TRUE(factory_bytes.insert(spec.factory_byte).second);
    EXPECT_EQ(spec.laserCount() * spec.firingsPerSlot(), kReturnsPerBlock * spec.bankCount());
    // The last laser fires before the next firing begins.
    EXPECT_LT(spec.lasers.back().time_ns, spec.firing_ns);
    EXPECT_EQ(findLidarSpec(spec.factory_byte), &spec);
    EXPECT_EQ(findLidarSpec(spec.name), &spec);
    for (const std::string& alias : spec.aliases) EXPECT_EQ(findLidarSpec(alias), &spec) << alias;
  }
  // The manuals' 754 packets a second of the VLP-16, and twice as many in dual return mode.
  EXPECT_EQ(findLidarSpec("VLP16")->packetNs(false), 1327104);
  EXPECT_EQ(findLidarSpec("VLP16")->packetNs(true), 663552);
  EXPECT_EQ(findLidarSpec("VLP32C")->packetNs(false), 663552);
  EXPECT_EQ(findLidarSpec("HDL32E")->packetNs(false), 552960);
  // Three firings of 128 lasers fill a packet; with two returns one does, and four blocks are left.
  EXPECT_EQ(findLidarSpec("VLS128")->packetNs(false), 159900);
  EXPECT_EQ(findLidarSpec("VLS128")->packetNs(true), 53300);
  EXPECT_EQ(findLidarSpec("OS1"), nullptr);
  EXPECT_EQ(findLidarSpec(0x77), nullptr);
}

TEST(LidarSpec, RingsAreNumberedFromTheLowestLaserUp) {
  for (const LidarSpec& spec : lidarSpecs()) {
    SCOPED_TRACE(spec.name);
    std::vector<double> elevation_of_ring(spec.lasers.size(), 1e9);
    for (const Laser& laser : spec.lasers) {
      ASSERT_LT(laser.ring, spec.laserCount());
      elevation_of_ring[laser.ring] = laser.elevation_rad;
    }
    EXPECT_TRUE(std::is_sorted(elevation_of_ring.begin(), elevation_of_ring.end()));
    EXPECT_LT(elevation_of_ring.back(), 1.0) << "every ring is somebody's";
  }
}

TEST(LidarSpec, SpansTheManualsFieldsOfView) {
  const auto expectSpan = [](const char* name, double lowest_deg, double highest_deg) {
    const auto [lowest, highest] = std::minmax_element(
        findLidarSpec(name)->lasers.begin(), findLidarSpec(name)->lasers.end(),
        [](const Laser& a, const Laser& b) { return a.elevation_rad < b.elevation_rad; });
    EXPECT_NEAR(lowest->elevation_rad * kDegPerRad, lowest_deg, 1e-9) << name;
    EXPECT_NEAR(highest->elevation_rad * kDegPerRad, highest_deg, 1e-9) << name;
  };
  expectSpan("VLP16", -15.0, 15.0);
  expectSpan("PuckHiRes", -10.0, 10.0);
  expectSpan("VLP32C", -25.0, 15.0);
  expectSpan("HDL32E", -30.67, 10.67);
  expectSpan("VLS128", -25.0, 15.0);
}

/// A model that does not exist: 64 lasers in two banks, one every 500 ns.
LidarSpec dummy() {
  std::vector<Laser> lasers(64);
  for (int i = 0; i < 64; ++i) lasers[i] = {(32 - i) * 0.01, 0.0, i * 500, 0};
  return makeLidarSpec({"Dummy64", {"Dummy"}, 0x77, 0.01, 40000, {0x1234, 0x5678}, lasers});
}

TEST(LidarSpec, OneRowIsAllThatANewModelTakes) {
  std::vector<LidarSpec> specs = lidarSpecs();
  specs.push_back(dummy());
  EXPECT_EQ(findLidarSpec("dummy-64", specs), &specs.back());
  EXPECT_EQ(findLidarSpec(0x77, specs), &specs.back());
  EXPECT_EQ(lidarSpecNames(specs), lidarSpecNames() + ", Dummy64");

  Packet packet;
  packet.stamp = 1000000000;
  for (int b = 0; b < kBlocksPerPacket; ++b) {
    std::uint8_t* const block = packet.data.data() + 100 * b;
    block[0] = b % 2 == 0 ? 0x34 : 0x78;
    block[1] = b % 2 == 0 ? 0x12 : 0x56;
    block[2] = static_cast<std::uint8_t>(10 * (b / 2));  // 0.1 deg a firing
    for (int l = 0; l < kReturnsPerBlock; ++l) {
      block[4 + 3 * l] = 0xE8;  // 1000 units, 10 m
      block[5 + 3 * l] = 0x03;
      block[6 + 3 * l] = static_cast<std::uint8_t>(l);
    }
  }
  packet.data[1204] = 0x37;
  PacketDecoderConfig config;
  config.model = &specs.back();
  const DecodedScan scan = PacketDecoder(config).decode({packet}, 0, "lidar");
  ASSERT_EQ(scan.cloud.size(), 384u);
  EXPECT_EQ(scan.counters.bad_blocks, 0u);
  EXPECT_EQ(scan.cloud.firings.size(), 6u);
  for (std::size_t i = 0; i < scan.cloud.size(); ++i) {
    const int laser = static_cast<int>(i % 64), firing = static_cast<int>(i / 64);
    const double elevation = (32 - laser) * 0.01;
    const double azimuth = (0.1 * firing + 0.1 * laser * 500 / 40000) / kDegPerRad;
    EXPECT_EQ(scan.cloud.ring[i], 63 - laser);
    EXPECT_EQ(scan.cloud.time_ns[i], packet.stamp + firing * 40000 + laser * 500);
    EXPECT_NEAR(scan.cloud.x[i], 10.0 * std::cos(elevation) * std::cos(azimuth), 2e-6);
    EXPECT_NEAR(scan.cloud.y[i], -10.0 * std::cos(elevation) * std::sin(azimuth), 2e-6);
    EXPECT_NEAR(scan.cloud.z[i], 10.0 * std::sin(elevation), 2e-6);
  }
}

TEST(LidarSpec, ARowThatFillsNoPacketsIsRefused) {
  LidarSpec spec = dummy();
  spec.bank_flags.pop_back();
  EXPECT_THROW(makeLidarSpec(spec), ConfigError);
  spec = dummy();
  spec.lasers.clear();
  EXPECT_THROW(makeLidarSpec(spec), ConfigError);
  spec = dummy();
  spec.bank_flags.resize(5);
  spec.lasers.resize(160);
  EXPECT_THROW(makeLidarSpec(spec), ConfigError);
}

}  // namespace
}  // namespace semantic_lidar_fusion

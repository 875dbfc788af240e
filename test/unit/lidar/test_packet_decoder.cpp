// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <fstream>
#include <iostream>
#include <iterator>
#include <map>
#include <random>
#include <string>
#include <vector>

#include "npz.h"
#include "optional_data.h"
#include "packet_encoder.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/lidar/packet_decoder.h"
#include "stamps.h"

namespace semantic_lidar_fusion {
namespace {

struct Point {
  double x = 0.0, y = 0.0, z = 0.0;
  int intensity = 0;
  int ring = 0;
  StampNs time_ns = 0;
};

Point at(const TimedCloud& cloud, std::size_t i) {
  return {cloud.x[i],    cloud.y[i],      cloud.z[i], static_cast<int>(cloud.intensity[i]),
          cloud.ring[i], cloud.time_ns[i]};
}

double distance(const Point& a, const Point& b) {
  return std::sqrt((a.x - b.x) * (a.x - b.x) + (a.y - b.y) * (a.y - b.y) +
                   (a.z - b.z) * (a.z - b.z));
}

/// A world of random echoes on the raw distance grid, and what must come out of it, in order.
struct RandomWorld {
  RandomWorld(const PacketEncoder& encoder, bool dual, unsigned seed)
      : unit_m(encoder.unitM()), dual_return(dual), random(seed) {}

  Echoes operator()(const Shot& shot) {
    std::uniform_int_distribution<int> raw(250, 12500);
    std::uniform_int_distribution<int> intensity(0, 255);
    std::uniform_int_distribution<int> kind(0, 9);
    Echoes echoes;
    const int k = kind(random);
    if (k > 0) echoes.first = {raw(random) * unit_m, static_cast<std::uint8_t>(intensity(random))};
    if (k > 5) echoes.second = {raw(random) * unit_m, static_cast<std::uint8_t>(intensity(random))};
    if (k > 0) first.push_back(pointOf(shot, echoes.first));
    if (k > 5) second.push_back(pointOf(shot, echoes.second));
    return echoes;
  }
  /// Points of one block pair, in the order packet, block, firing, laser.
  std::vector<Point> take() {
    std::vector<Point> points = std::move(first);
    if (dual_return) points.insert(points.end(), second.begin(), second.end());
    first.clear();
    second.clear();
    return points;
  }
  static Point pointOf(const Shot& shot, const Echo& echo) {
    return {echo.range_m * shot.direction_x(),
            echo.range_m * shot.direction_y(),
            echo.range_m * shot.direction_z(),
            echo.intensity,
            shot.ring,
            shot.time_ns};
  }

  double unit_m;
  bool dual_return;
  std::mt19937 random;
  std::vector<Point> first;
  std::vector<Point> second;
};

struct Scan {
  std::vector<Packet> packets;
  std::vector<Point> truth;
};

Scan makeScan(const PacketEncoder::Config& config, int packet_count, unsigned seed = 1) {
  PacketEncoder encoder(config);
  RandomWorld world(encoder, config.dual_return, seed);
  // Block by block the order of points differs from the order of shots only with dual returns.
  Scan scan;
  const auto flush = [&] {
    const std::vector<Point> points = world.take();
    scan.truth.insert(scan.truth.end(), points.begin(), points.end());
  };
  const int shots_per_block = 32;
  int shots = 0;
  for (int i = 0; i < packet_count; ++i) {
    scan.packets.push_back(encoder.next([&](const Shot& shot) {
      if (shots++ % shots_per_block == 0) flush();
      return world(shot);
    }));
  }
  flush();
  return scan;
}

/// Rotation by whole hundredths of a degree from block to block, so that azimuths are sent exactly.
double exactRotationHz(const std::string& model, bool dual) {
  PacketEncoder::Config config;
  config.model = model;
  config.dual_return = dual;
  const PacketEncoder encoder(config);
  return 0.4 / 360.0 / toSeconds(encoder.slotNs());
}

void expectSame(const TimedCloud& cloud, const std::vector<Point>& truth, double angle_rad) {
  ASSERT_EQ(cloud.size(), truth.size());
  for (std::size_t i = 0; i < truth.size(); ++i) {
    const Point point = at(cloud, i);
    const double range = distance(truth[i], Point());
    ASSERT_LT(distance(point, truth[i]), range * angle_rad + 1e-5) << "point " << i;
    ASSERT_EQ(point.intensity, truth[i].intensity) << i;
    ASSERT_EQ(point.ring, truth[i].ring) << i;
    ASSERT_EQ(point.time_ns, truth[i].time_ns) << i;
  }
}

class EveryModel : public ::testing::TestWithParam<std::tuple<std::string, bool>> {
 protected:
  PacketEncoder::Config config() const {
    PacketEncoder::Config config;
    config.model = std::get<0>(GetParam());
    config.dual_return = std::get<1>(GetParam());
    config.start_ns = kUnroundStart;
    return config;
  }
};

INSTANTIATE_TEST_SUITE_P(PacketDecoder, EveryModel,
                         ::testing::Combine(::testing::Values("VLP16", "PuckHiRes", "VLP32C",
                                                              "HDL32E", "VLS128"),
                                            ::testing::Bool()));

TEST_P(EveryModel, GivesBackTheWorldAcrossTheFullTurn) {
  // Float coordinates at 50 m have steps of 4e-6 m: within 1e-5 m.
  PacketEncoder::Config config = this->config();
  config.rotation_hz = exactRotationHz(config.model, config.dual_return);
  config.start_azimuth_deg = 340.0;
  const Scan scan = makeScan(config, 20);
  const DecodedScan decoded = PacketDecoder({}).decode(scan.packets, kUnroundStart + 7, "velodyne");
  EXPECT_EQ(decoded.cloud.frame_id, "velodyne");
  EXPECT_EQ(decoded.cloud.header_stamp, kUnroundStart + 7);
  EXPECT_EQ(decoded.counters.packets, 20u);
  EXPECT_EQ(decoded.counters.bad_blocks, 0u);
  EXPECT_TRUE(decoded.counters.unknown_packets.empty());
  expectSame(decoded.cloud, scan.truth, 0.0);
}

TEST_P(EveryModel, StaysWithinTheAzimuthsResolutionAtAnySpeed) {
  // A block's azimuth is off by up to 0.005 deg; behind the last block the previous difference adds
  // up to 0.01 deg.
  PacketEncoder::Config config = this->config();
  for (const double hz : {5.0, 10.0, 20.0}) {
    config.rotation_hz = hz;
    config.start_azimuth_deg = 123.456;
    const Scan scan = makeScan(config, 20);
    const DecodedScan decoded = PacketDecoder({}).decode(scan.packets, kUnroundStart, "velodyne");
    expectSame(decoded.cloud, scan.truth, 0.0151 * kPi / 180.0);
  }
}

TEST_P(EveryModel, GroupsPointsToTheirFirings) {
  PacketEncoder::Config config = this->config();
  const Scan scan = makeScan(config, 5);
  const TimedCloud cloud = PacketDecoder({}).decode(scan.packets, kUnroundStart, "velodyne").cloud;
  ASSERT_FALSE(cloud.firings.empty());
  std::vector<Firing> seen = cloud.firings;
  for (Firing& firing : seen) std::swap(firing.begin_ns, firing.end_ns);
  const PacketEncoder encoder(config);
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    ASSERT_LT(cloud.firing[i], cloud.firings.size());
    const Firing& firing = cloud.firings[cloud.firing[i]];
    ASSERT_LE(firing.begin_ns, cloud.time_ns[i]);
    ASSERT_GE(firing.end_ns, cloud.time_ns[i]);
    ASSERT_LT(firing.end_ns - firing.begin_ns, findLidarSpec(config.model)->firing_ns);
    ASSERT_EQ(static_cast<StampNs>(firing.packet),
              (cloud.time_ns[i] - kUnroundStart) / encoder.packetNs());
    Firing& mine = seen[cloud.firing[i]];
    mine.begin_ns = std::min(mine.begin_ns, cloud.time_ns[i]);
    mine.end_ns = std::max(mine.end_ns, cloud.time_ns[i]);
  }
  for (std::size_t k = 0; k < seen.size(); ++k) {
    ASSERT_EQ(seen[k].begin_ns, cloud.firings[k].begin_ns);
    ASSERT_EQ(seen[k].end_ns, cloud.firings[k].end_ns);
  }
}

/// A packet written byte by byte from the manual's figures, without the encoder.
Packet vlp16Packet(std::uint8_t mode = 0x37, std::uint8_t factory = 0x22) {
  Packet packet;
  packet.stamp = kUnroundStart;
  for (int b = 0; b < 12; ++b) {
    std::uint8_t* const block = packet.data.data() + 100 * b;
    block[0] = 0xFF;
    block[1] = 0xEE;
    const int azimuth = (35900 + 40 * b) % 36000;
    block[2] = static_cast<std::uint8_t>(azimuth & 0xFF);
    block[3] = static_cast<std::uint8_t>(azimuth >> 8);
  }
  packet.data[1204] = mode;
  packet.data[1205] = factory;
  return packet;
}

void setReturn(Packet& packet, int block, int index, int raw, std::uint8_t intensity) {
  std::uint8_t* const data = packet.data.data() + 100 * block + 4 + 3 * index;
  data[0] = static_cast<std::uint8_t>(raw & 0xFF);
  data[1] = static_cast<std::uint8_t>(raw >> 8);
  data[2] = intensity;
}

TEST(PacketDecoder, ReadsAPacketWrittenByHand) {
  Packet packet = vlp16Packet();
  setReturn(packet, 0, 0, 5000, 11);        // laser 0, -15 deg, 10 m
  setReturn(packet, 2, 16 + 3, 10000, 22);  // second firing, laser 3, +3 deg, 20 m, 359.8 deg
  setReturn(packet, 11, 31, 500, 33);       // the last one, laser 15, +15 deg, 1 m
  const TimedCloud cloud = PacketDecoder({}).decode({packet}, kUnroundStart, "velodyne").cloud;
  ASSERT_EQ(cloud.size(), 3u);
  const auto expect = [&](std::size_t i, double d, double azimuth_deg, double elevation_deg,
                          int ring, int intensity, double time_us) {
    const double az = azimuth_deg * kPi / 180.0;
    const double el = elevation_deg * kPi / 180.0;
    EXPECT_NEAR(cloud.x[i], d * std::cos(el) * std::cos(az), 2e-6);
    EXPECT_NEAR(cloud.y[i], -d * std::cos(el) * std::sin(az), 2e-6);
    EXPECT_NEAR(cloud.z[i], d * std::sin(el), 2e-6);
    EXPECT_EQ(cloud.ring[i], ring);
    EXPECT_EQ(cloud.intensity[i], static_cast<float>(intensity));
    EXPECT_EQ(cloud.time_ns[i] - kUnroundStart, std::llround(time_us * 1e3));
  };
  expect(0, 10.0, 359.0, -15.0, 0, 11, 0.0);
  expect(1, 20.0, 359.8 + 0.4 * (55.296 + 3 * 2.304) / 110.592, 3.0, 9, 22, 5 * 55.296 + 3 * 2.304);
  expect(2, 1.0, 3.4 + 0.4 * (55.296 + 15 * 2.304) / 110.592, 15.0, 15, 33,
         23 * 55.296 + 15 * 2.304);
}

TEST(PacketDecoder, DropsASecondReturnThatEqualsTheFirst) {
  Packet packet = vlp16Packet(0x39);
  for (int b = 1; b < 12; b += 2) {  // pairs share an azimuth
    packet.data[100 * b + 2] = packet.data[100 * (b - 1) + 2];
    packet.data[100 * b + 3] = packet.data[100 * (b - 1) + 3];
  }
  setReturn(packet, 2, 5, 4000, 50);
  setReturn(packet, 3, 5, 4000, 50);  // equal
  setReturn(packet, 2, 6, 4000, 50);
  setReturn(packet, 3, 6, 3000, 50);  // another range
  setReturn(packet, 5, 7, 2000, 50);  // a second one without a first
  const DecodedScan scan = PacketDecoder({}).decode({packet}, kUnroundStart, "velodyne");
  ASSERT_EQ(scan.cloud.size(), 4u);
  EXPECT_EQ(scan.counters.equal_returns, 1u);
  EXPECT_NEAR(scan.cloud.z[2], 6.0 * std::sin(-9.0 * kPi / 180.0), 1e-6);
  EXPECT_EQ(scan.cloud.time_ns[1], scan.cloud.time_ns[2]) << "one firing, two returns";
  // The difference counts from pair to pair: 0.8 deg in 110.592 us.
  const double azimuth = (359.8 + 0.8 * (6 * 2.304) / 110.592) * kPi / 180.0;
  EXPECT_NEAR(std::atan2(-scan.cloud.y[1], scan.cloud.x[1]), azimuth - 2.0 * kPi, 1e-6);
}

TEST(PacketDecoder, TakesTheModelFromTheFactoryByteUnlessItIsGiven) {
  Packet packet = vlp16Packet();
  setReturn(packet, 0, 0, 1000, 1);
  const auto lowest = [&](std::uint8_t factory, const LidarSpec* model) {
    packet.data[1205] = factory;
    PacketDecoderConfig config;
    config.model = model;
    const TimedCloud cloud = PacketDecoder(config).decode({packet}, kUnroundStart, "v").cloud;
    const double d = std::hypot(std::hypot(cloud.x.at(0), cloud.y.at(0)), cloud.z.at(0));
    return std::make_pair(std::asin(cloud.z.at(0) / d) * 180.0 / kPi, d);
  };
  const auto near = [](std::pair<double, double> value, double elevation_deg, double range_m) {
    EXPECT_NEAR(value.first, elevation_deg, 1e-4);
    EXPECT_NEAR(value.second, range_m, 1e-6);
  };
  near(lowest(0x22, nullptr), -15.0, 2.0);
  near(lowest(0x24, nullptr), -10.0, 2.0);
  near(lowest(0x28, nullptr), -25.0, 4.0);
  near(lowest(0x21, nullptr), -30.67, 2.0);
  near(lowest(0x22, findLidarSpec("PuckHiRes")), -10.0, 2.0);
  near(lowest(0x77, findLidarSpec("HDL32E")), -30.67, 2.0);
}

TEST(PacketDecoder, CountsUnknownPacketsAndNamesTheByte) {
  Packet good = vlp16Packet();
  setReturn(good, 0, 0, 1000, 1);
  Packet sensor = good;
  sensor.stamp += 1;
  sensor.data[1205] = 0xA2;
  Packet mode = good;
  mode.stamp += 2;
  mode.data[1204] = 0x3C;
  const DecodedScan scan =
      PacketDecoder({}).decode({sensor, good, mode}, kUnroundStart, "velodyne");
  EXPECT_EQ(scan.cloud.size(), 1u);
  ASSERT_EQ(scan.counters.unknown_packets.size(), 2u);
  const auto first = scan.counters.unknown_packets.begin();
  EXPECT_NE(first->first.find("factory byte 0xA2"), std::string::npos) << first->first;
  EXPECT_EQ(first->second, 1u);
  EXPECT_NE(std::next(first)->first.find("return mode byte 0x3C"), std::string::npos);
}

TEST(PacketDecoder, BadBlocksAreSkippedAndHarmNoOther) {
  PacketEncoder::Config config;
  config.start_ns = kUnroundStart;
  config.rotation_hz = exactRotationHz(config.model, false);
  const Scan scan = makeScan(config, 3);
  std::vector<Packet> packets = scan.packets;
  packets[1].data[100 * 4] = 0;          // flag
  packets[1].data[100 * 5 + 3] = 0xFF;   // azimuth 65 xxx
  packets[2].data[100 * 11 + 1] = 0x00;  // the last block
  const DecodedScan decoded = PacketDecoder({}).decode(packets, kUnroundStart, "velodyne");
  EXPECT_EQ(decoded.counters.bad_blocks, 3u);
  const auto inBadBlock = [&](const Point& point) {
    const StampNs block = (point.time_ns - kUnroundStart) / 110592;
    return block == 12 + 4 || block == 12 + 5 || block == 24 + 11;
  };
  std::vector<Point> truth = scan.truth;
  truth.erase(std::remove_if(truth.begin(), truth.end(), inBadBlock), truth.end());
  ASSERT_LT(truth.size(), scan.truth.size());
  expectSame(decoded.cloud, truth, 0.0);
}

TEST(PacketDecoder, ALoneBlockGoesOnTurningAsThePacketBefore) {
  PacketEncoder::Config config;
  config.start_ns = kUnroundStart;
  config.rotation_hz = exactRotationHz(config.model, false);
  const Scan scan = makeScan(config, 2);
  std::vector<Packet> packets = scan.packets;
  for (int b = 1; b < 12; ++b) packets[1].data[100 * b] = 0;
  std::vector<Point> truth = scan.truth;
  truth.erase(
      std::remove_if(truth.begin(), truth.end(),
                     [](const Point& p) { return p.time_ns >= kUnroundStart + 1327104 + 110592; }),
      truth.end());
  expectSame(PacketDecoder({}).decode(packets, kUnroundStart, "velodyne").cloud, truth, 0.0);
}

TEST(PacketDecoder, ShuffledDuplicatedMissingAndEmptyPacketsLeaveTheRestAsItIs) {
  PacketEncoder::Config config;
  config.start_ns = kUnroundStart;
  const Scan scan = makeScan(config, 76);
  std::mt19937 random(4);
  std::vector<Packet> surviving;
  for (const Packet& packet : scan.packets) {
    if (random() % 10 != 0) surviving.push_back(packet);
  }
  ASSERT_LT(surviving.size(), scan.packets.size());
  const DecodedScan clean = PacketDecoder({}).decode(surviving, kUnroundStart, "velodyne");

  std::vector<Packet> dirty = surviving;
  std::size_t duplicates = 0;
  std::size_t zeros = 0;
  for (const Packet& packet : surviving) {
    if (random() % 5 == 0) {
      dirty.push_back(packet);
      ++duplicates;
    }
    if (random() % 7 == 0) {
      Packet zero;
      zero.stamp = packet.stamp + 5;
      dirty.push_back(zero);
      ++zeros;
    }
  }
  std::shuffle(dirty.begin(), dirty.end(), random);
  const DecodedScan decoded = PacketDecoder({}).decode(dirty, kUnroundStart, "velodyne");
  EXPECT_EQ(decoded.counters.duplicate_packets, duplicates);
  EXPECT_EQ(decoded.counters.zero_packets, zeros);
  EXPECT_EQ(decoded.counters.packets, dirty.size());
  EXPECT_EQ(decoded.cloud.x, clean.cloud.x);
  EXPECT_EQ(decoded.cloud.y, clean.cloud.y);
  EXPECT_EQ(decoded.cloud.z, clean.cloud.z);
  EXPECT_EQ(decoded.cloud.time_ns, clean.cloud.time_ns);
  EXPECT_EQ(decoded.cloud.firing, clean.cloud.firing);
}

TEST(PacketDecoder, AStampTellsThePacketsStartMiddleOrEnd) {
  for (const bool dual : {false, true}) {
    Packet packet = vlp16Packet(dual ? 0x39 : 0x37);
    setReturn(packet, 0, 0, 1000, 1);
    const StampNs duration = dual ? 663552 : 1327104;
    const auto first = [&](PacketStamp stamp, StampNs offset) {
      PacketDecoderConfig config;
      config.packet_stamp = stamp;
      config.time_offset_ns = offset;
      return PacketDecoder(config).decode({packet}, kUnroundStart, "velodyne").cloud.time_ns.at(0);
    };
    EXPECT_EQ(first(PacketStamp::kStart, 0), kUnroundStart);
    EXPECT_EQ(first(PacketStamp::kMiddle, 0), kUnroundStart - duration / 2);
    EXPECT_EQ(first(PacketStamp::kEnd, 0), kUnroundStart - duration);
    EXPECT_EQ(first(PacketStamp::kStart, -12345), kUnroundStart - 12345);
  }
}

TEST(PacketDecoder, RangeLimitsConcernTheMeasuredRange) {
  Packet packet = vlp16Packet();
  setReturn(packet, 0, 0, 499, 1);
  setReturn(packet, 0, 1, 500, 2);
  setReturn(packet, 0, 2, 1000, 3);
  setReturn(packet, 0, 3, 1001, 4);
  PacketDecoderConfig config;
  config.min_range_m = 1.0;
  config.max_range_m = 2.0;
  const DecodedScan scan = PacketDecoder(config).decode({packet}, kUnroundStart, "velodyne");
  EXPECT_EQ(scan.cloud.intensity, (std::vector<float>{2.0f, 3.0f}));
  EXPECT_EQ(scan.counters.out_of_range_points, 2u);
}

TEST(PacketDecoder, VerticalOffsetsGoByRing) {
  Packet packet = vlp16Packet();
  setReturn(packet, 0, 1, 1000, 1);  // ring 8
  PacketDecoderConfig config;
  const float plain = PacketDecoder(config).decode({packet}, kUnroundStart, "v").cloud.z.at(0);
  for (int ring = 0; ring < 16; ++ring) config.vertical_offsets_m.push_back(0.001 * ring);
  const float moved = PacketDecoder(config).decode({packet}, kUnroundStart, "v").cloud.z.at(0);
  EXPECT_NEAR(moved - plain, 0.008, 1e-6);

  packet.data[1205] = 0x28;
  const DecodedScan wrong = PacketDecoder(config).decode({packet}, kUnroundStart, "v");
  EXPECT_TRUE(wrong.cloud.empty());
  ASSERT_EQ(wrong.counters.unknown_packets.size(), 1u);
  EXPECT_NE(wrong.counters.unknown_packets.begin()->first.find("16 entries"), std::string::npos);
}

TEST(PacketDecoder, RefusesABadConfigurationWithEveryProblem) {
  PacketDecoderConfig config;
  config.model = findLidarSpec("VLP16");
  config.min_range_m = -1.0;
  config.max_range_m = std::nan("");
  config.vertical_offsets_m.resize(32);
  try {
    PacketDecoder decoder(config);
    FAIL();
  } catch (const ConfigError& error) {
    EXPECT_EQ(error.problems().size(), 3u);
  }
}

TEST(PacketDecoder, NoPacketsGiveAnEmptyCloud) {
  const DecodedScan scan = PacketDecoder({}).decode({}, 42, "velodyne");
  EXPECT_TRUE(scan.cloud.empty());
  EXPECT_EQ(scan.cloud.header_stamp, 42);
  EXPECT_TRUE(scan.cloud.firings.empty());
}

TEST(PacketDecoder, SurvivesRandomBytes) {
  std::mt19937 random(9);
  for (int round = 0; round < 3000; ++round) {
    Packet packet = vlp16Packet();
    packet.stamp = static_cast<StampNs>(random());
    if (round % 2 == 0) {
      for (std::uint8_t& byte : packet.data) byte = static_cast<std::uint8_t>(random());
    }
    for (int i = 0; i < 300; ++i) {
      packet.data[random() % 1200] = static_cast<std::uint8_t>(random());
    }
    const std::uint8_t modes[] = {0x37, 0x38, 0x39};
    const std::uint8_t models[] = {0x21, 0x22, 0x24, 0x28, 0xA1};
    packet.data[1204] = modes[random() % 3];
    packet.data[1205] = models[random() % 5];
    const TimedCloud cloud = PacketDecoder({}).decode({packet}, kUnroundStart, "velodyne").cloud;
    for (std::size_t i = 0; i < cloud.size(); ++i) {
      ASSERT_TRUE(std::isfinite(cloud.x[i]) && std::isfinite(cloud.y[i]) &&
                  std::isfinite(cloud.z[i]));
      ASSERT_LT(cloud.firing[i], cloud.firings.size());
    }
  }
}

// --- a real capture against somebody else's decoder ---------------------------------------------

/// One point of the other decoder's cloud: fields x y z intensity return_type channel azimuth
/// elevation distance time_stamp, packed.
struct OtherPoint {
  float x, y, z;
  int channel;
  float distance;
  std::uint32_t time_in_packet_ns;
};

std::vector<OtherPoint> readOtherCloud(const std::string& path) {
  std::ifstream stream(path, std::ios::binary);
  const std::string file((std::istreambuf_iterator<char>(stream)),
                         std::istreambuf_iterator<char>());
  const std::string mark = "DATA binary\n";
  const char* data = file.data() + file.find(mark) + mark.size();
  std::vector<OtherPoint> points;
  for (; data + 32 <= file.data() + file.size(); data += 32) {
    OtherPoint point;
    std::uint16_t channel;
    std::memcpy(&point.x, data, 4);
    std::memcpy(&point.y, data + 4, 4);
    std::memcpy(&point.z, data + 8, 4);
    std::memcpy(&channel, data + 14, 2);
    std::memcpy(&point.distance, data + 24, 4);
    std::memcpy(&point.time_in_packet_ns, data + 28, 4);
    point.channel = channel;
    points.push_back(point);
  }
  return points;
}

StampNs clockNs(const Packet& packet) {
  std::uint32_t us = 0;
  std::memcpy(&us, packet.data.data() + 1200, 4);
  return StampNs{us} * 1000;
}

double percentile(std::vector<double> values, double share) {
  std::sort(values.begin(), values.end());
  return values.at(static_cast<std::size_t>(share * static_cast<double>(values.size() - 1)));
}

TEST(PacketDecoder, AgreesWithAnIndependentDecoderOnARealCapture) {
  const std::string folder = "data/vlp16_packets/";
  const std::string cloud_name = "nebula_vlp16_expected_1673400472138016708.pcd";
  SLF_SKIP_WITHOUT(folder + "nebula_vlp16_scans.npz");
  SLF_SKIP_WITHOUT(folder + cloud_name);
  const auto arrays = readNpz(sharedPath(folder + "nebula_vlp16_scans.npz"));
  const std::vector<double> stamps = arrays.at("packet_stamp").as<double>();
  const std::vector<std::uint8_t> bytes = arrays.at("packets").as<std::uint8_t>();
  const std::vector<OtherPoint> others = readOtherCloud(sharedPath(folder + cloud_name));
  ASSERT_EQ(bytes.size(), stamps.size() * kPacketBytes);
  ASSERT_EQ(others.size(), 14831u);

  // The other's scan begins with the last packet of the third scan. Its packets carry their own
  // clock's stamps here: those of the capture are the host's, late by up to a millisecond.
  const std::size_t first = 452;
  std::vector<Packet> packets;
  for (std::size_t i = first; i < stamps.size(); ++i) {
    Packet packet;
    std::copy_n(bytes.begin() + static_cast<std::ptrdiff_t>(i * kPacketBytes), kPacketBytes,
                packet.data.begin());
    packet.stamp = kUnroundStart + clockNs(packet);
    packets.push_back(packet);
  }
  const DecodedScan scan = PacketDecoder({}).decode(packets, packets[0].stamp, "velodyne");
  std::map<std::pair<StampNs, int>, std::vector<std::size_t>> ours;
  for (std::size_t i = 0; i < scan.cloud.size(); ++i) {
    ours[{scan.cloud.time_ns[i], scan.cloud.ring[i]}].push_back(i);
  }

  // The other's times are relative to the packet and count each block of a pair as a time of its
  // own: block * 2 + firing firings. Its packets are found by their order and the exact range.
  const auto match = [&](const OtherPoint& other, std::size_t packet, int& block) -> long {
    const int laser = other.channel < 8 ? 2 * other.channel : 2 * (other.channel - 8) + 1;
    const int firing =
        static_cast<int>(std::lround((other.time_in_packet_ns - 2304.0 * laser) / 55296.0));
    block = firing / 2;
    const StampNs time =
        packets[packet].stamp + (block / 2 * 2 + firing % 2) * 55296 + laser * 2304;
    const auto found = ours.find({time, other.channel});
    if (found == ours.end()) return -1;
    for (const std::size_t i : found->second) {
      const Point p = at(scan.cloud, i);
      if (std::abs(distance(p, Point()) - other.distance) < 5e-4) return static_cast<long>(i);
    }
    return -1;
  };
  std::vector<double> all, first_returns;
  std::size_t packet = 0;
  std::uint32_t last_time = 0;
  std::size_t unmatched = 0;
  for (const OtherPoint& other : others) {
    if (other.time_in_packet_ns + 100000 < last_time) ++packet;
    last_time = other.time_in_packet_ns;
    int block = 0;
    long mine = match(other, packet, block);
    if (mine < 0 && packet + 1 < packets.size()) {
      mine = match(other, packet + 1, block);
      if (mine >= 0) ++packet;
    }
    if (mine < 0) {
      ++unmatched;
      continue;
    }
    if (block >= 10) continue;  // the other does not interpolate the azimuth of the last pair
    const Point p = at(scan.cloud, static_cast<std::size_t>(mine));
    Point q;
    q.x = other.x;
    q.y = other.y;
    q.z = other.z;
    all.push_back(distance(p, q));
    if (block % 2 == 0) first_returns.push_back(distance(p, q));
  }
  std::cout << others.size() << " points, " << unmatched << " unmatched; distance (mm) of "
            << all.size() << ": median " << 1e3 * percentile(all, 0.5) << ", 99 % "
            << 1e3 * percentile(all, 0.99) << ", max " << 1e3 * percentile(all, 1.0)
            << "; first returns: median " << 1e3 * percentile(first_returns, 0.5) << ", 99 % "
            << 1e3 * percentile(first_returns, 0.99) << ", max "
            << 1e3 * percentile(first_returns, 1.0) << "\n";
  EXPECT_EQ(unmatched, 0u);
  EXPECT_GT(all.size(), 12000u);
  EXPECT_LT(percentile(all, 0.5), 0.1e-3);
  EXPECT_LT(percentile(all, 0.99), 16e-3);
  EXPECT_LT(percentile(all, 1.0), 48e-3);
  // The other rounds azimuths to 0.01 deg: half a step at the largest range, 14.7 m.
  EXPECT_LT(percentile(first_returns, 1.0), 14.7 * 0.005 * kPi / 180.0 + 1e-4);
}

/// A capture in data/velodyne_packets, and what another decoder made of one of its scans.
struct Capture {
  const char* name;  ///< of the files: name_scans.npz, name_expected.npz
  const char* model;
  std::size_t first_packet;  ///< of the other's scan
  std::size_t points;        ///< of it
  /// How far into a slot the other's laser turns with the sensor, in slots. The other's geometry is
  /// compared with this undone: it is no property of the sensor.
  double (*others_progress)(int laser, int slot, int slots);
};

std::vector<Packet> packetsOf(const Capture& capture) {
  const auto arrays =
      readNpz(sharedPath(std::string("data/velodyne_packets/") + capture.name + "_scans.npz"));
  const std::vector<std::uint8_t> bytes = arrays.at("packets").as<std::uint8_t>();
  std::vector<Packet> packets(bytes.size() / kPacketBytes);
  for (std::size_t i = 0; i < packets.size(); ++i) {
    std::copy_n(bytes.begin() + static_cast<std::ptrdiff_t>(i * kPacketBytes), kPacketBytes,
                packets[i].data.begin());
    packets[i].stamp = kUnroundStart + clockNs(packets[i]);
  }
  packets.erase(packets.begin(),
                packets.begin() + static_cast<std::ptrdiff_t>(capture.first_packet));
  return packets;
}

std::vector<Point> othersOf(const Capture& capture) {
  const auto arrays =
      readNpz(sharedPath(std::string("data/velodyne_packets/") + capture.name + "_expected.npz"));
  const std::vector<float> x = arrays.at("x").as<float>(), y = arrays.at("y").as<float>(),
                           z = arrays.at("z").as<float>();
  std::vector<Point> points(x.size());
  for (std::size_t i = 0; i < x.size(); ++i) points[i] = {x[i], y[i], z[i], 0, 0, 0};
  return points;
}

/// The sensor's step from a slot of a packet to the next, rad; behind the last slot the same again.
double stepOf(const Packet& packet, const LidarSpec& spec, int slot) {
  const auto azimuth = [&](int s) {
    const std::uint8_t* const block = packet.data.data() + 100 * s * spec.blocksPerSlot(false);
    return block[2] | block[3] << 8;
  };
  const int from = std::min(slot, spec.slotsPerPacket(false) - 2);
  const int step = (azimuth(from + 1) - azimuth(from) + 54000) % 36000 - 18000;
  return step * kPi / 18000.0;
}

void expectAgreement(const Capture& capture, double median_m, double angle_rad) {
  const std::vector<Packet> packets = packetsOf(capture);
  const std::vector<Point> others = othersOf(capture);
  ASSERT_EQ(others.size(), capture.points);
  const LidarSpec& spec = *findLidarSpec(capture.model);
  PacketDecoderConfig config;
  config.longest_scan_ns = 2 * kNsPerSecond;
  const TimedCloud cloud = PacketDecoder(config).decode(packets, 0, "velodyne").cloud;
  std::vector<int> laser_of_ring(spec.lasers.size());
  for (int l = 0; l < spec.laserCount(); ++l) laser_of_ring[spec.lasers[l].ring] = l;

  std::vector<double> apart, angles;
  std::size_t mine = 0;
  for (Point other : others) {
    // Both write in the order of the packets' data: the next point of this range and height.
    const double range = distance(other, Point());
    Point point;
    for (;; ++mine) {
      ASSERT_LT(mine, cloud.size()) << "of " << apart.size() << " points";
      point = at(cloud, mine);
      if (std::abs(distance(point, Point()) - range) < 1e-4 && std::abs(point.z - other.z) < 1e-3)
        break;
    }
    const std::size_t p = cloud.firings[cloud.firing[mine]].packet;
    const StampNs in_packet = point.time_ns - packets[p].stamp;
    const int slot = static_cast<int>(in_packet / spec.slotNs());
    const double progress =
        static_cast<double>(in_packet % spec.slotNs()) / static_cast<double>(spec.slotNs());
    const double turn = stepOf(packets[p], spec, slot) *
                        (progress - capture.others_progress(laser_of_ring[point.ring], slot,
                                                            spec.slotsPerPacket(false)));
    const double x = other.x * std::cos(turn) + other.y * std::sin(turn);
    other.y = other.y * std::cos(turn) - other.x * std::sin(turn);
    other.x = x;
    apart.push_back(distance(point, other));
    angles.push_back(apart.back() / range);
    ++mine;
  }
  std::cout << capture.model << ": " << apart.size() << " points; distance (mm): median "
            << 1e3 * percentile(apart, 0.5) << ", 99 % " << 1e3 * percentile(apart, 0.99)
            << ", max " << 1e3 * percentile(apart, 1.0) << "; angle (deg): 99 % "
            << percentile(angles, 0.99) * 180.0 / kPi << ", max "
            << percentile(angles, 1.0) * 180.0 / kPi << "\n";
  EXPECT_LT(percentile(apart, 0.5), median_m);
  EXPECT_LT(percentile(angles, 0.99), angle_rad);
}

// The other rounds azimuths to 0.01 deg.
constexpr double kOthersRounding = 0.0052 * kPi / 180.0;

TEST(PacketDecoder, AgreesWithAnIndependentDecoderOnAVlp32c) {
  SLF_SKIP_WITHOUT("data/velodyne_packets/vlp32c_scans.npz");
  SLF_SKIP_WITHOUT("data/velodyne_packets/vlp32c_expected.npz");
  // The other fires the lasers one by one, where the manual pairs them, and not in the last block.
  expectAgreement({"vlp32c", "VLP32C", 0, 26216,
                   [](int laser, int slot, int slots) {
                     return slot + 1 == slots ? 0.0 : laser * 2.304 / 55.296;
                   }},
                  0.2e-3, kOthersRounding);
}

TEST(PacketDecoder, AgreesWithAnIndependentDecoderOnAVls128) {
  SLF_SKIP_WITHOUT("data/velodyne_packets/vls128_scans.npz");
  SLF_SKIP_WITHOUT("data/velodyne_packets/vls128_expected.npz");
  // The other interpolates from block to block; only behind the fourth of a firing the azimuth
  // changes.
  expectAgreement(
      {"vls128", "VLS128", 379, 208680,
       [](int laser, int slot, int slots) {
         return laser < 96 || slot + 1 == slots ? 0.0 : (laser / 8 + laser / 64) * 2.665 / 53.3;
       }},
      1e-3, kOthersRounding);
}

// --- stamps, blind sectors, modes ---------------------------------------------------------------

/// 75 packets of a VLP-16, and what comes out of them.
struct Stamped {
  Stamped() {
    PacketEncoder::Config config;
    config.start_ns = kUnroundStart;
    config.rotation_hz = exactRotationHz("VLP16", false);
    scan = makeScan(config, 75);
  }
  DecodedScan decoded() const {
    return PacketDecoder({}).decode(scan.packets, kUnroundStart, "velodyne");
  }
  Scan scan;
};

TEST(PacketTimes, PacketsFarFromTheOthersAreDroppedAndCounted) {
  const StampNs ms = 1000000;
  for (const StampNs off : {-3600000 * ms, 3600000 * ms, -1000 * ms, 1000 * ms, -500 * ms, 500 * ms,
                            -300 * ms, -kUnroundStart}) {
    for (const bool with_clock : {true, false}) {
      for (const std::vector<int>& which :
           {std::vector<int>{40}, {0}, {74}, {3, 17, 31, 66}, {70, 71, 72, 73, 74}}) {
        SCOPED_TRACE(std::to_string(off / ms) + " ms, " + std::to_string(which.size()) + " from " +
                     std::to_string(which[0]) + (with_clock ? "" : ", without a clock"));
        Stamped stamped;
        std::vector<Point> truth;
        for (const Point& point : stamped.scan.truth) {
          const auto packet = static_cast<int>((point.time_ns - kUnroundStart) / 1327104);
          if (std::find(which.begin(), which.end(), packet) == which.end()) truth.push_back(point);
        }
        for (Packet& packet : stamped.scan.packets) {
          if (!with_clock) std::fill_n(packet.data.begin() + 1200, 4, std::uint8_t{0});
        }
        for (const int p : which) stamped.scan.packets[p].stamp += off;
        const DecodedScan decoded = stamped.decoded();
        EXPECT_EQ(decoded.counters.outlier_packets, which.size());
        EXPECT_FALSE(decoded.time.warning) << decoded.time.text;
        expectSame(decoded.cloud, truth, 0.0101 * kPi / 180.0);
      }
    }
  }
}

TEST(PacketTimes, EqualStampsLeaveTheTimesToThePacketsOwnClock) {
  Stamped stamped;
  for (Packet& packet : stamped.scan.packets) packet.stamp = kUnroundStart;
  std::mt19937 random(3);
  std::shuffle(stamped.scan.packets.begin(), stamped.scan.packets.end(), random);
  const DecodedScan decoded = stamped.decoded();
  EXPECT_TRUE(decoded.time.warning);
  EXPECT_NE(decoded.time.text.find("one stamp"), std::string::npos) << decoded.time.text;
  ASSERT_EQ(decoded.cloud.size(), stamped.scan.truth.size());
  for (std::size_t i = 0; i < stamped.scan.truth.size(); ++i) {
    // The clock counts whole us.
    ASSERT_NEAR(decoded.cloud.time_ns[i], stamped.scan.truth[i].time_ns, 1000);
    ASSERT_LT(distance(at(decoded.cloud, i), stamped.scan.truth[i]), 1e-5);
  }
  for (Packet& packet : stamped.scan.packets) {
    std::fill_n(packet.data.begin() + 1200, 4, std::uint8_t{0});
  }
  const DecodedScan instant = stamped.decoded();
  EXPECT_TRUE(instant.time.warning);
  EXPECT_NE(instant.time.text.find("own clock does not run"), std::string::npos);
}

TEST(PacketTimes, RoundedAndLateStampsLeaveTheTimesToThePacketsOwnClock) {
  std::mt19937 random(5);
  const auto worst = [](const Stamped& stamped, const DecodedScan& decoded) {
    StampNs most = 0;
    for (std::size_t i = 0; i < stamped.scan.truth.size(); ++i) {
      most = std::max(most, std::abs(decoded.cloud.time_ns[i] - stamped.scan.truth[i].time_ns));
    }
    return most;
  };
  for (const StampNs unit : {1000000, 10000000}) {
    Stamped stamped;
    for (Packet& packet : stamped.scan.packets) packet.stamp -= packet.stamp % unit;
    const DecodedScan decoded = stamped.decoded();
    EXPECT_TRUE(decoded.time.warning);
    EXPECT_NE(decoded.time.text.find("rounded"), std::string::npos) << decoded.time.text;
    // The least rounded of the stamps tells where the scan lies: within the packets' distance.
    EXPECT_LT(worst(stamped, decoded), 1400000) << unit;
  }
  Stamped stamped;
  std::exponential_distribution<double> late(1.0 / 150e3);
  for (Packet& packet : stamped.scan.packets) {
    packet.stamp += static_cast<StampNs>(late(random)) + (random() % 20 == 0 ? 8000000 : 0);
  }
  const DecodedScan decoded = stamped.decoded();
  EXPECT_FALSE(decoded.time.warning);
  EXPECT_NE(decoded.time.text.find("own clock"), std::string::npos) << decoded.time.text;
  EXPECT_EQ(decoded.counters.outlier_packets, 0u);
  EXPECT_LT(worst(stamped, decoded), 250000) << "the usual delay";
}

TEST(PacketTimes, TheClockMayPassTheHour) {
  PacketEncoder::Config config;
  const StampNs hour = 3600 * kNsPerSecond;
  config.start_ns = kUnroundStart / hour * hour + hour - 40000000;
  Scan scan = makeScan(config, 75);
  for (Packet& packet : scan.packets) packet.stamp = config.start_ns;
  const DecodedScan decoded = PacketDecoder({}).decode(scan.packets, 0, "velodyne");
  ASSERT_EQ(decoded.cloud.size(), scan.truth.size());
  for (std::size_t i = 0; i < scan.truth.size(); ++i) {
    ASSERT_LE(std::abs(decoded.cloud.time_ns[i] - scan.truth[i].time_ns), 1000);
  }
}

TEST_P(EveryModel, NoPointIsTurnedAcrossABlindSector) {
  for (const auto& [begin, end] :
       {std::make_pair(300.3, 61.7), std::make_pair(61.0, 60.0), std::make_pair(10.0, 40.0)}) {
    SCOPED_TRACE(begin);
    PacketEncoder::Config config = this->config();
    config.rotation_hz = exactRotationHz(config.model, config.dual_return);
    config.start_azimuth_deg = 340.0;
    config.view_begin_deg = begin;
    config.view_end_deg = end;
    const Scan scan = makeScan(config, 400 / 12);
    const DecodedScan decoded = PacketDecoder({}).decode(scan.packets, kUnroundStart, "velodyne");
    ASSERT_EQ(decoded.cloud.size(), scan.truth.size());
    for (std::size_t i = 0; i < scan.truth.size(); ++i) {
      // Where the sector began and ended is known to 0.01 deg, 2.5 us.
      ASSERT_LE(std::abs(decoded.cloud.time_ns[i] - scan.truth[i].time_ns), 20000) << i;
      const double range = distance(scan.truth[i], Point());
      ASSERT_LT(distance(at(decoded.cloud, i), scan.truth[i]), range * 1e-3 * kPi / 180.0 + 1e-5)
          << i;
    }
  }
}

TEST(PacketDecoder, AStandingMotorTurnsNoPoint) {
  PacketEncoder::Config config;
  config.start_ns = kUnroundStart;
  config.rotation_hz = 1e-9;
  config.start_azimuth_deg = 77.0;
  const Scan scan = makeScan(config, 3);
  expectSame(PacketDecoder({}).decode(scan.packets, kUnroundStart, "velodyne").cloud, scan.truth,
             1e-9);
}

TEST(PacketDecoder, ADamagedAzimuthMovesNoOtherBlock) {
  PacketEncoder::Config config;
  config.start_ns = kUnroundStart;
  config.rotation_hz = exactRotationHz(config.model, false);
  Scan scan = makeScan(config, 3);
  scan.packets[1].data[100 * 5 + 3] ^= 0x40;  // 163.84 deg
  const TimedCloud cloud = PacketDecoder({}).decode(scan.packets, kUnroundStart, "velodyne").cloud;
  ASSERT_EQ(cloud.size(), scan.truth.size());
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    ASSERT_EQ(cloud.time_ns[i], scan.truth[i].time_ns);
    if ((cloud.time_ns[i] - kUnroundStart) / 110592 == 12 + 5) continue;
    ASSERT_LT(distance(at(cloud, i), scan.truth[i]), 1e-5) << i;
  }
}

TEST_P(EveryModel, WithTheModelGivenTheBlocksTellTheReturnMode) {
  PacketEncoder::Config config = this->config();
  config.rotation_hz = exactRotationHz(config.model, config.dual_return);
  Scan scan = makeScan(config, 20);
  for (const std::uint8_t blank : {std::uint8_t{0}, std::uint8_t{0x5A}}) {
    for (Packet& packet : scan.packets) packet.data[1204] = packet.data[1205] = blank;
    PacketDecoderConfig decoder;
    decoder.model = findLidarSpec(config.model);
    const DecodedScan decoded =
        PacketDecoder(decoder).decode(scan.packets, kUnroundStart, "velodyne");
    EXPECT_TRUE(decoded.counters.unknown_packets.empty());
    expectSame(decoded.cloud, scan.truth, 0.0);
  }
}

TEST(PacketDecoder, AnHdl64eIsRefusedWithTheReason) {
  Packet packet = vlp16Packet(0x48, 0xDC);
  for (int b = 1; b < 12; b += 2) packet.data[100 * b + 1] = 0xDD;
  const DecodedScan scan = PacketDecoder({}).decode({packet}, kUnroundStart, "velodyne");
  EXPECT_TRUE(scan.cloud.empty());
  ASSERT_EQ(scan.counters.unknown_packets.size(), 1u);
  EXPECT_NE(scan.counters.unknown_packets.begin()->first.find("HDL-64E"), std::string::npos);
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
// velodyne_msgs/VelodyneScan to points, as the nodelets and fuse_bag read it.
#include "edge/lidar_decoder.h"
#include "fuzz_target.h"
#include "packet_encoder.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace fuzz {
namespace {

constexpr std::size_t kMaxPackets = 8;

Echoes wallAt8m(const Shot& shot) {
  const double range = 8.0 / std::max(0.2, std::abs(std::cos(shot.azimuth_rad)));
  return {{range, 40}, {range + 3.0, 20}};
}

Bytes scanOf(unsigned config, PacketEncoder::Config encoder_config, int packets) {
  encoder_config.start_ns = 1546300800 * kNsPerSecond + 5;
  PacketEncoder encoder(encoder_config);
  Writer writer;
  writer.byte(config).byte(0);
  for (const Packet& packet : encoder.packets(packets, wallAt8m)) {
    writer.put(static_cast<std::uint32_t>(packet.stamp / kNsPerSecond))
        .put(static_cast<std::uint32_t>(packet.stamp % kNsPerSecond))
        .raw(packet.data.data(), packet.data.size());
  }
  return writer.bytes();
}

std::vector<Bytes> seeds() {
  std::vector<Bytes> all{Bytes{}};
  for (std::size_t i = 0; i < lidarSpecs().size(); ++i) {
    for (const bool dual : {false, true}) {
      PacketEncoder::Config config;
      config.model = lidarSpecs()[i].name;
      config.dual_return = dual;
      config.start_azimuth_deg = 359.0;
      all.push_back(scanOf(static_cast<unsigned>(i) + (dual ? 16u : 0u), config, 2));
    }
  }
  return all;
}

void run(const std::uint8_t* data, std::size_t size) {
  Reader reader(data, size);
  const unsigned options = reader.take<std::uint8_t>();
  const unsigned more = reader.take<std::uint8_t>();
  LidarConfig config;
  if (more & 1u) config.model = &lidarSpecs()[options % 16 % lidarSpecs().size()];
  config.packet_stamp = static_cast<PacketStamp>((options >> 4) % 3);
  if (more & 2u) config.min_range_m = 0.5, config.max_range_m = 30.0;
  if (more & 4u) config.time_offset_s = -1e9;
  VelodyneScan scan;
  scan.header.frame_id = more & 8u ? "" : "/velodyne";
  while (reader.left() > 0 && scan.packets.size() < kMaxPackets) {
    VelodynePacket packet;
    packet.stamp.sec = reader.take<std::uint32_t>();
    packet.stamp.nsec = reader.take<std::uint32_t>();
    for (auto& byte : packet.data) byte = reader.take<std::uint8_t>();
    scan.packets.push_back(packet);
  }

  std::uint64_t dropped = 0;
  LidarDecoder decoder(config, [&](const std::string& reason, std::uint64_t count) {
    expect(!reason.empty(), "a drop has a reason");
    dropped += count;
  });
  TimedCloud cloud;
  try {
    cloud = decoder.decode(scan);
  } catch (const DataError& error) {
    expectMessage(error);
    return;
  }
  const std::size_t n = cloud.size();
  expect(cloud.frame_id == "velodyne", "the frame has no slash");
  expect(cloud.y.size() == n && cloud.z.size() == n && cloud.intensity.size() == n &&
             cloud.ring.size() == n && cloud.time_ns.size() == n && cloud.firing.size() == n,
         "all arrays have one length");
  expect(n <= scan.packets.size() * 384, "no more points than returns");
  for (const auto* values : {&cloud.x, &cloud.y, &cloud.z, &cloud.intensity}) {
    expectFinite(*values, "points are finite");
  }
  for (std::size_t i = 0; i < n; ++i) {
    expect(cloud.ring[i] < 128, "rings are those of the sensor");
    expect(cloud.firing[i] < cloud.firings.size(), "a point's firing exists");
    const Firing& firing = cloud.firings[cloud.firing[i]];
    expect(firing.begin_ns <= cloud.time_ns[i] && cloud.time_ns[i] <= firing.end_ns,
           "a point's time lies in its firing");
    const double range =
        std::sqrt(double{cloud.x[i]} * cloud.x[i] + double{cloud.y[i]} * cloud.y[i] +
                  double{cloud.z[i]} * cloud.z[i]);
    expect(range > 0.0 && range < 300.0, "ranges are those of the sensor");
    if (more & 2u) expect(range > 0.49 && range < 30.01, "range limits hold");
  }
}

const char* const kWords[] = {"\xff\xee", "\x37\x22", "\x39\x28", nullptr};
const Registration kRegistered({"packets", seeds, run, kWords});

}  // namespace
}  // namespace fuzz
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
// Where velodyne_msgs is installed its own types are taken. Its headers are generated for this test
// from copies of its definitions; the nodelets that take packets are compiled with them too.
#include <gtest/gtest.h>
#include <velodyne_msgs/VelodyneScan.h>

#include <algorithm>
#include <string>
#include <type_traits>
#include <vector>

#include "edge/conversions.h"
#include "edge/lidar_decoder.h"
#include "packet_encoder.h"

namespace semantic_lidar_fusion {
namespace {

static_assert(std::is_same<VelodyneScan, velodyne_msgs::VelodyneScan>::value, "another scan");
static_assert(std::is_same<VelodynePacket, velodyne_msgs::VelodynePacket>::value, "another packet");

TEST(WithVelodyneMsgs, TypesAreThoseThatAreUsedWithoutThePackage) {
  EXPECT_STREQ(ros::message_traits::DataType<VelodyneScan>::value(), "velodyne_msgs/VelodyneScan");
  EXPECT_STREQ(ros::message_traits::MD5Sum<VelodyneScan>::value(),
               "50804fc9533a0e579e6322c04ae70566");
  EXPECT_STREQ(ros::message_traits::MD5Sum<VelodynePacket>::value(),
               "ae4f90a23256f44e82baa08dd45c3456");
}

TEST(WithVelodyneMsgs, ScansAreDecoded) {
  constexpr StampNs kStart = 1700000000000000000;
  PacketEncoder::Config sensor;
  sensor.start_ns = kStart;
  PacketEncoder encoder(sensor);
  velodyne_msgs::VelodyneScan scan;
  scan.header.frame_id = "velodyne";
  for (int i = 0; i < 5; ++i) {
    const Packet packet = encoder.next([](const Shot&) { return Echoes{{10.0, 7}, {10.0, 7}}; });
    velodyne_msgs::VelodynePacket message;
    message.stamp = rosTime(packet.stamp);
    std::copy(packet.data.begin(), packet.data.end(), message.data.begin());
    scan.packets.push_back(message);
  }
  LidarDecoder decoder(LidarConfig(), [](const std::string& reason, std::uint64_t count) {
    EXPECT_EQ(count, 0u) << "dropped: " << reason;
  });
  const TimedCloud cloud = decoder.decode(scan);
  EXPECT_EQ(cloud.frame_id, "velodyne");
  EXPECT_EQ(cloud.size(), 5u * 384u);
  EXPECT_EQ(scanInterval(cloud).first_ns, kStart);
}

}  // namespace
}  // namespace semantic_lidar_fusion

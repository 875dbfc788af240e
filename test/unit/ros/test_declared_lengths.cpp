// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <sensor_msgs/CameraInfo.h>
#include <sensor_msgs/CompressedImage.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/PointCloud2.h>
#include <tf2_msgs/TFMessage.h>

#include <cstring>
#include <string>

#include "edge/declared_lengths.h"
#include "edge/velodyne_messages.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

/// A call of its own: inlined, gcc 14 takes the vectors of a new message for empty after resize().
template <class M>
__attribute__((noinline)) void read(std::vector<std::uint8_t>* bytes, M* message) {
  ros::serialization::IStream in(bytes->data(), static_cast<std::uint32_t>(bytes->size()));
  ros::serialization::deserialize(in, *message);
}

/// Whole messages pass, every one that ends early does not, and no length that lies is believed:
/// what passes is deserialised within the bytes that are there.
template <class M>
void check(const M& message) {
  const std::string type = ros::message_traits::datatype<M>();
  const std::uint32_t size = ros::serialization::serializationLength(message);
  std::vector<std::uint8_t> bytes(size);
  ros::serialization::OStream out(bytes.data(), size);
  ros::serialization::serialize(out, message);
  EXPECT_NO_THROW(checkDeclaredLengths(type, bytes.data(), size)) << type;
  for (std::uint32_t cut = 0; cut < size; ++cut) {
    EXPECT_THROW(checkDeclaredLengths(type, bytes.data(), cut), DataError) << type << " " << cut;
  }
  int refused = 0;
  for (std::uint32_t at = 0; at + 4 <= size; ++at) {
    std::vector<std::uint8_t> lying = bytes;
    const std::uint32_t many = 50000000;
    std::memcpy(lying.data() + at, &many, sizeof(many));
    try {
      checkDeclaredLengths(type, lying.data(), size);
    } catch (const DataError& error) {
      ++refused;
      EXPECT_NE(std::string(error.what()).find("is shorter than a " + type), std::string::npos);
      continue;
    }
    M message_read;
    EXPECT_NO_THROW(read(&lying, &message_read)) << type << " at " << at;
  }
  EXPECT_GT(refused, 0) << type;
}

TEST(DeclaredLengths, AreComparedWithTheBytesThatAreThere) {
  sensor_msgs::Image image;
  image.header.frame_id = "camera";
  image.encoding = "bgr8";
  image.data.resize(30);
  check(image);
  sensor_msgs::CompressedImage compressed;
  compressed.format = "jpeg";
  compressed.data.resize(20);
  check(compressed);
  sensor_msgs::CameraInfo info;
  info.distortion_model = "equidistant";
  info.D = {1, 2, 3, 4};
  const std::string type = ros::message_traits::datatype<sensor_msgs::CameraInfo>();
  const std::uint32_t size = ros::serialization::serializationLength(info);
  std::vector<std::uint8_t> bytes(size);
  ros::serialization::OStream out(bytes.data(), size);
  ros::serialization::serialize(out, info);
  EXPECT_NO_THROW(checkDeclaredLengths(type, bytes.data(), size));
  const std::uint32_t many = 50000000;
  std::memcpy(bytes.data() + 16 + 8 + 4 + info.distortion_model.size(), &many, sizeof(many));
  EXPECT_THROW(checkDeclaredLengths(type, bytes.data(), size), DataError);
  sensor_msgs::PointCloud2 cloud;
  cloud.fields.resize(2);
  cloud.fields[0].name = "x";
  cloud.data.resize(16);
  check(cloud);
  tf2_msgs::TFMessage transforms;
  transforms.transforms.resize(2);
  transforms.transforms[0].child_frame_id = "base_link";
  check(transforms);
  EXPECT_NO_THROW(checkDeclaredLengths("std_msgs/String", nullptr, 0)) << "holds no list";
}

}  // namespace
}  // namespace semantic_lidar_fusion

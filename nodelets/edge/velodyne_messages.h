// SPDX-License-Identifier: MIT
/// velodyne_msgs/VelodyneScan, whether or not that package is installed.
///
/// With the package its own types are used, so that a driver nodelet in the same manager passes
/// pointers. Without it the types below have the same wire format, name, checksum and definition:
/// they subscribe, publish, and are read from and written to bags like the originals.
#pragma once

#if __has_include(<velodyne_msgs/VelodyneScan.h>)

#include <velodyne_msgs/VelodyneScan.h>

namespace semantic_lidar_fusion {
using VelodynePacket = velodyne_msgs::VelodynePacket;
using VelodyneScan = velodyne_msgs::VelodyneScan;
using VelodyneScanConstPtr = velodyne_msgs::VelodyneScanConstPtr;
}  // namespace semantic_lidar_fusion

#else

#include <ros/message_traits.h>
#include <ros/serialization.h>
#include <ros/time.h>
#include <std_msgs/Header.h>

#include <boost/array.hpp>
#include <boost/shared_ptr.hpp>
#include <cstdint>
#include <ostream>
#include <vector>

namespace semantic_lidar_fusion {

struct VelodynePacket {
  using Ptr = boost::shared_ptr<VelodynePacket>;
  using ConstPtr = boost::shared_ptr<const VelodynePacket>;

  ros::Time stamp;
  boost::array<std::uint8_t, 1206> data{};
};

struct VelodyneScan {
  using Ptr = boost::shared_ptr<VelodyneScan>;
  using ConstPtr = boost::shared_ptr<const VelodyneScan>;

  std_msgs::Header header;
  std::vector<VelodynePacket> packets;
};

using VelodyneScanConstPtr = VelodyneScan::ConstPtr;

inline std::ostream& operator<<(std::ostream& out, const VelodyneScan& scan) {
  return out << scan.header << "packets: " << scan.packets.size() << "\n";
}

}  // namespace semantic_lidar_fusion

namespace ros {
namespace message_traits {

template <>
struct IsMessage<semantic_lidar_fusion::VelodynePacket> : TrueType {};
template <>
struct IsMessage<const semantic_lidar_fusion::VelodynePacket> : TrueType {};
template <>
struct IsFixedSize<semantic_lidar_fusion::VelodynePacket> : TrueType {};
template <>
struct IsFixedSize<const semantic_lidar_fusion::VelodynePacket> : TrueType {};

template <>
struct MD5Sum<semantic_lidar_fusion::VelodynePacket> {
  static const char* value() { return "ae4f90a23256f44e82baa08dd45c3456"; }
  static const char* value(const semantic_lidar_fusion::VelodynePacket&) { return value(); }
};
template <>
struct DataType<semantic_lidar_fusion::VelodynePacket> {
  static const char* value() { return "velodyne_msgs/VelodynePacket"; }
  static const char* value(const semantic_lidar_fusion::VelodynePacket&) { return value(); }
};
template <>
struct Definition<semantic_lidar_fusion::VelodynePacket> {
  static const char* value() {
    return "# Raw Velodyne LIDAR packet.\n\n"
           "time stamp              # packet timestamp\n"
           "uint8[1206] data        # packet contents\n\n";
  }
  static const char* value(const semantic_lidar_fusion::VelodynePacket&) { return value(); }
};

template <>
struct IsMessage<semantic_lidar_fusion::VelodyneScan> : TrueType {};
template <>
struct IsMessage<const semantic_lidar_fusion::VelodyneScan> : TrueType {};
template <>
struct HasHeader<semantic_lidar_fusion::VelodyneScan> : TrueType {};
template <>
struct HasHeader<const semantic_lidar_fusion::VelodyneScan> : TrueType {};

template <>
struct MD5Sum<semantic_lidar_fusion::VelodyneScan> {
  static const char* value() { return "50804fc9533a0e579e6322c04ae70566"; }
  static const char* value(const semantic_lidar_fusion::VelodyneScan&) { return value(); }
};
template <>
struct DataType<semantic_lidar_fusion::VelodyneScan> {
  static const char* value() { return "velodyne_msgs/VelodyneScan"; }
  static const char* value(const semantic_lidar_fusion::VelodyneScan&) { return value(); }
};
template <>
struct Definition<semantic_lidar_fusion::VelodyneScan> {
  static const char* value() {
    return "# Velodyne LIDAR scan packets.\n\n"
           "Header           header         # standard ROS message header\n"
           "VelodynePacket[] packets        # vector of raw packets\n\n"
           "========================================================================"
           "========\n"
           "MSG: std_msgs/Header\n"
           "# Standard metadata for higher-level stamped data types.\n"
           "# This is generally used to communicate timestamped data \n"
           "# in a particular coordinate frame.\n"
           "# \n"
           "# sequence ID: consecutively increasing ID \n"
           "uint32 seq\n"
           "#Two-integer timestamp that is expressed as:\n"
           "# * stamp.sec: seconds (stamp_secs) since epoch (in Python the variable is called "
           "'secs')\n"
           "# * stamp.nsec: nanoseconds since stamp_secs (in Python the variable is called "
           "'nsecs')\n"
           "# time-handling sugar is provided by the client library\n"
           "time stamp\n"
           "#Frame this data is associated with\n"
           "string frame_id\n\n"
           "========================================================================"
           "========\n"
           "MSG: velodyne_msgs/VelodynePacket\n"
           "# Raw Velodyne LIDAR packet.\n\n"
           "time stamp              # packet timestamp\n"
           "uint8[1206] data        # packet contents\n\n";
  }
  static const char* value(const semantic_lidar_fusion::VelodyneScan&) { return value(); }
};

}  // namespace message_traits

namespace serialization {

template <>
struct Serializer<semantic_lidar_fusion::VelodynePacket> {
  template <typename Stream, typename Message>
  inline static void allInOne(Stream& stream, Message packet) {
    stream.next(packet.stamp);
    stream.next(packet.data);
  }
  ROS_DECLARE_ALLINONE_SERIALIZER
};

template <>
struct Serializer<semantic_lidar_fusion::VelodyneScan> {
  template <typename Stream, typename Message>
  inline static void allInOne(Stream& stream, Message scan) {
    stream.next(scan.header);
    stream.next(scan.packets);
  }
  ROS_DECLARE_ALLINONE_SERIALIZER
};

}  // namespace serialization
}  // namespace ros

#endif

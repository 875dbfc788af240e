// SPDX-License-Identifier: MIT
#include "edge/declared_lengths.h"

#include <cstring>
#include <map>

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

/// Steps over the parts of a serialised message, and throws DataError at its end.
class Bytes {
 public:
  Bytes(const std::string& datatype, const std::uint8_t* data, std::size_t size)
      : datatype_(datatype), data_(data), size_(size) {}

  void skip(std::size_t bytes) {
    if (bytes > size_) {
      throw DataError("is shorter than a " + datatype_ + ", by " + std::to_string(bytes - size_) +
                      " bytes or more");
    }
    data_ += bytes;
    size_ -= bytes;
  }
  /// The number of elements of a list, which take at least `least_bytes` each.
  std::uint32_t list(std::size_t least_bytes) {
    const std::uint8_t* const at = data_;
    skip(4);
    std::uint32_t count;  // of this host's byte order, as roscpp takes it
    std::memcpy(&count, at, sizeof(count));
    if (count > size_ / least_bytes) {
      throw DataError("is shorter than a " + datatype_ + ": it declares " + std::to_string(count) +
                      " elements where " + std::to_string(size_) + " bytes follow");
    }
    return count;
  }
  void bytes() { skip(list(1)); }
  /// seq, stamp and frame_id.
  void header() {
    skip(12);
    bytes();
  }

 private:
  const std::string& datatype_;
  const std::uint8_t* data_;
  std::size_t size_;
};

void walkImage(Bytes* message) {
  message->header();
  message->skip(8);
  message->bytes();  // encoding
  message->skip(5);
  message->bytes();
}

void walkCompressedImage(Bytes* message) {
  message->header();
  message->bytes();  // format
  message->bytes();
}

void walkCameraInfo(Bytes* message) {
  message->header();
  message->skip(8);
  message->bytes();  // distortion_model
  message->skip(8 * std::size_t{message->list(8)});
}

void walkPointCloud(Bytes* message) {
  message->header();
  message->skip(8);
  for (std::uint32_t fields = message->list(13); fields > 0; --fields) {
    message->bytes();  // name
    message->skip(9);
  }
  message->skip(9);
  message->bytes();
  message->skip(1);  // is_dense
}

void walkTransforms(Bytes* message) {
  constexpr std::size_t kTransform = 56;
  for (std::uint32_t left = message->list(12 + 4 + 4 + kTransform); left > 0; --left) {
    message->header();
    message->bytes();  // child_frame_id
    message->skip(kTransform);
  }
}

void walkPackets(Bytes* message) {
  constexpr std::size_t kPacket = 8 + 1206;
  message->header();
  message->skip(kPacket * message->list(kPacket));
}

}  // namespace

void checkDeclaredLengths(const std::string& datatype, const std::uint8_t* data, std::size_t size) {
  static const std::map<std::string, void (*)(Bytes*)> kWalks = {
      {"sensor_msgs/Image", walkImage},
      {"sensor_msgs/CompressedImage", walkCompressedImage},
      {"sensor_msgs/CameraInfo", walkCameraInfo},
      {"sensor_msgs/PointCloud2", walkPointCloud},
      {"tf2_msgs/TFMessage", walkTransforms},
      {"velodyne_msgs/VelodyneScan", walkPackets}};
  const auto walk = kWalks.find(datatype);
  if (walk == kWalks.end()) return;
  Bytes message(datatype, data, size);
  walk->second(&message);
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/truth.h"

#include <algorithm>
#include <cstring>
#include <string>

#include "edge/conversions.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

const char kTopic[] = "/points_truth";

}  // namespace

std::vector<std::uint16_t> visibleFlags(const sensor_msgs::PointCloud2& message) {
  const auto field = std::find_if(message.fields.begin(), message.fields.end(),
                                  [](const auto& entry) { return entry.name == "visible"; });
  if (field == message.fields.end() || field->datatype != sensor_msgs::PointField::UINT16) {
    throw DataError("has no field visible of type uint16");
  }
  const std::size_t step = message.point_step;
  const std::size_t count = static_cast<std::size_t>(message.width) * message.height;
  if (message.is_bigendian || std::size_t{field->offset} + sizeof(std::uint16_t) > step ||
      count > message.data.size() / std::max<std::size_t>(step, 1)) {
    throw DataError("has a layout that does not fit its size");
  }
  std::vector<std::uint16_t> flags(count);
  for (std::size_t i = 0; i < count; ++i) {
    std::memcpy(&flags[i], &message.data[i * step + field->offset], sizeof(std::uint16_t));
  }
  return flags;
}

VisibilityTruth::VisibilityTruth(const BagInput& input, StampNs offset_ns) {
  const BagInput::Topic* topic = input.find(kTopic);
  if (topic == nullptr) {
    throw Error(input.path() + ": no " + kTopic + "; --truth visibility takes it from there");
  }
  view_ = std::make_unique<rosbag::View>();
  input.addTo({topic->name}, view_.get());
  for (const rosbag::MessageInstance& message : *view_) {
    try {
      const auto stamped = messageOf<StampedMessage>(message);
      if (stamped) scans_.emplace(stampNs(stamped->header.stamp) + offset_ns, message);
    } catch (const DataError&) {  // its scan is told where it is asked for
    }
  }
}

void VisibilityTruth::apply(StampNs first_ns, std::size_t points,
                            std::vector<CameraView>* views) const {
  const auto found = scans_.find(first_ns);
  const auto message =
      found == scans_.end() ? nullptr : messageOf<sensor_msgs::PointCloud2>(found->second);
  if (!message) throw DataError(std::string(kTopic) + " has no scan of this time");
  const std::vector<std::uint16_t> flags = visibleFlags(*message);
  if (flags.size() != points) {
    throw DataError(std::string(kTopic) + " has " + std::to_string(flags.size()) +
                    " points; the scan has " + std::to_string(points));
  }
  for (CameraView& view : *views) {
    view.known_visible.resize(points);
    for (std::size_t i = 0; i < points; ++i) {
      view.known_visible[i] = static_cast<std::uint8_t>(flags[i] >> view.rig_index & 1);
    }
  }
}

}  // namespace semantic_lidar_fusion

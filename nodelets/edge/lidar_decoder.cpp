// SPDX-License-Identifier: MIT
#include "edge/lidar_decoder.h"

#include <utility>

#include "edge/conversions.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

PointCloudBytes cloudBytes(const sensor_msgs::PointCloud2& message, const std::string& frame) {
  PointCloudBytes bytes;
  bytes.header_stamp = stampNs(message.header.stamp);
  bytes.frame_id = frame;
  bytes.width = message.width;
  bytes.height = message.height;
  bytes.point_step = message.point_step;
  bytes.row_step = message.row_step;
  bytes.is_bigendian = message.is_bigendian != 0;
  for (const auto& field : message.fields) {
    bytes.fields.push_back({field.name, field.offset, field.datatype, field.count});
  }
  bytes.data = message.data.data();
  bytes.size = message.data.size();
  return bytes;
}

}  // namespace

LidarDecoder::LidarDecoder(const LidarConfig& config, CountDrops count_drops,
                           CountDrops count_left_out)
    : config_(config),
      count_drops_(std::move(count_drops)),
      count_left_out_(count_left_out ? std::move(count_left_out) : count_drops_),
      packets_(config.packetConfig()),
      clouds_(config.cloudConfig()) {}

std::string LidarDecoder::frame(const std::string& message_frame) const {
  const std::string frame = frameName(config_.frame.empty() ? message_frame : config_.frame);
  if (frame.empty()) {
    throw DataError(
        "header.frame_id is empty; it must name the lidar's frame, or the rig file must "
        "(lidar.frame)");
  }
  return frame;
}

void LidarDecoder::note(const std::string& text, bool warning) {
  constexpr std::size_t kMost = 100;
  if (noted_.size() < kMost && noted_.insert(text).second) notes_.push_back({text, warning});
}

/// One driver means one thing by its times: where scans are read in several ways, some are misread.
void LidarDecoder::noteTimes(const TimeDecision& decision) {
  time_decision_ = decision.text;
  note(decision.text, decision.warning);
  const bool changed =
      last_times_ && (last_times_->field != decision.field || last_times_->unit != decision.unit ||
                      last_times_->reference != decision.reference);
  if (changed) {
    note(
        "the times of one scan are read otherwise than those of the scan before; set "
        "lidar.time_unit and lidar.time_reference. Before: " +
            last_times_->text,
        true);
  }
  last_times_ = decision;
}

std::vector<LidarDecoder::Note> LidarDecoder::takeNotes() {
  std::vector<Note> notes;
  notes.swap(notes_);
  return notes;
}

TimedCloud LidarDecoder::decode(const VelodyneScan& message) {
  DecodedScan scan = packets_.decode(packets(message), stampNs(message.header.stamp),
                                     frame(message.header.frame_id));
  const PacketCounters& counters = scan.counters;
  count_drops_("duplicate packets", counters.duplicate_packets);
  count_drops_("packets of zeros", counters.zero_packets);
  count_drops_("packets stamped far from the others of their scan", counters.outlier_packets);
  count_drops_("bad packet blocks", counters.bad_blocks);
  count_left_out_("points out of range", counters.out_of_range_points);
  count_left_out_("second returns equal to the first", counters.equal_returns);
  for (const auto& [reason, count] : counters.unknown_packets) {
    count_drops_("packets with " + reason, count);
  }
  if (!scan.cloud.empty()) noteTimes(scan.time);
  return std::move(scan.cloud);
}

TimedCloud LidarDecoder::decode(const sensor_msgs::PointCloud2& message) {
  ReadCloud read = clouds_.read(cloudBytes(message, frame(message.header.frame_id)));
  count_left_out_("points that are not finite", read.counters.non_finite_points);
  count_left_out_("points without a return", read.counters.no_return_points);
  count_left_out_("points out of range", read.counters.out_of_range_points);
  count_drops_("points beyond lidar.largest_coordinate_m", read.counters.far_points);
  count_drops_("points with a time that is none of their scan's", read.counters.time_outliers);
  for (const std::string& text : read.notes) note(text, false);
  for (const std::string& text : read.warnings) note(text, true);
  if (!read.cloud.empty()) noteTimes(read.time);
  return std::move(read.cloud);
}

}  // namespace semantic_lidar_fusion

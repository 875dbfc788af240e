// SPDX-License-Identifier: MIT
/// The bytes of a sensor_msgs/PointCloud2 to points with a time each.
///
/// Drivers agree neither on the name nor on the unit nor on the origin of per-point times. Unless
/// the configuration says otherwise:
///   - the field is the first of t, time, timestamp, time_stamp, offset_time, time_offset,
///     timestamps;
///   - integers of up to 32 bits are ns after the header stamp;
///   - 32-bit floats are s after the header stamp, with their sign; a span above 1 means the
///   coarsest
///     of ms, us, ns that makes it one second at most;
///   - 64-bit floats and integers are absolute if in some unit they lie within a day of the header
///     stamp (and nearer to it than to zero, and the scan no longer than a second; ten in their
///     usual unit, s or ns), else relative: floats as above, integers in ns;
///   - 64-bit integers, for which PointField has no type, are pairs of u32 (lower half first),
///   PCL's
///     types 9 and 10, or f64 fields whose values make sense as integers only;
///   - relative times beyond a minute are those of another clock: the earliest point takes the
///   header
///     stamp, with a warning;
///   - all equal is an instant, with a warning.
/// Beams without a return, (0, 0, 0) or what else many points share, are left out before. Every
/// decision is that of the bulk of the points; times beyond `longest_scan_ns` from the middle one,
/// or a few that lie far from all others, are wrong and their points are left out.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/lidar/time_decision.h"

namespace semantic_lidar_fusion {

/// What to do with clouds that have no time field.
enum class WithoutTime : std::uint8_t {
  kReject,
  kInstant,  ///< all points at the header stamp
  kAzimuth,  ///< the sweep begins at the header stamp with the first point's azimuth and turns once
             ///< in sweep_period_ns, in the direction in which most points follow each other
};

struct PointCloudReaderConfig {
  std::string time_field;  ///< empty = detect
  TimeUnit time_unit = TimeUnit::kAuto;
  TimeReference time_reference = TimeReference::kAuto;
  WithoutTime without_time = WithoutTime::kInstant;
  StampNs sweep_period_ns = 100000000;  ///< for WithoutTime::kAzimuth
  StampNs time_offset_ns = 0;           ///< true time = stamp (or absolute time) + this
  double min_range_m = 0.0;             ///< nearer points do not come out; 0 = no limit
  double max_range_m = 0.0;             ///< farther points do not come out; 0 = no limit
  double largest_coordinate_m = 1e4;  ///< points with a larger |x|, |y| or |z| are no measurements
  StampNs longest_scan_ns = kNsPerSecond;  ///< points farther than this from the middle are wrong
};

/// As sensor_msgs/PointField.
struct PointFieldBytes {
  std::string name;
  std::uint32_t offset = 0;
  std::uint8_t datatype = 0;  ///< 1 i8, 2 u8, 3 i16, 4 u16, 5 i32, 6 u32, 7 f32, 8 f64
  std::uint32_t count = 1;
};

/// A view of a sensor_msgs/PointCloud2; `data` is not owned.
struct PointCloudBytes {
  StampNs header_stamp = 0;
  std::string frame_id;
  std::uint32_t width = 0;
  std::uint32_t height = 0;
  std::uint32_t point_step = 0;
  std::uint32_t row_step = 0;
  bool is_bigendian = false;
  std::vector<PointFieldBytes> fields;
  const std::uint8_t* data = nullptr;
  std::size_t size = 0;
};

struct PointCloudCounters {
  std::size_t points = 0;             ///< all that were given
  std::size_t non_finite_points = 0;  ///< dropped: a coordinate or the time is NaN or infinite
  std::size_t no_return_points = 0;   ///< dropped: (0, 0, 0), or a position that many points share
  std::size_t far_points = 0;         ///< dropped: beyond largest_coordinate_m
  std::size_t time_outliers = 0;      ///< dropped: a time that is none of the scan's
  std::size_t out_of_range_points = 0;
};

struct ReadCloud {
  TimedCloud cloud;  ///< one firing for each distinct time
  TimeDecision time;
  PointCloudCounters counters;
  std::vector<std::string> notes;     ///< what else a user should know of the layout, a line each
  std::vector<std::string> warnings;  ///< what is wrong with it and was read nevertheless
};

class PointCloudReader {
 public:
  /// Throws ConfigError (range limits, sweep period).
  explicit PointCloudReader(PointCloudReaderConfig config);

  /// Throws DataError, before any byte of a point is read, if the layout is impossible: sizes that
  /// do not fit each other, big-endian data, x, y or z missing or not floating-point, no time field
  /// where one is demanded.
  ReadCloud read(const PointCloudBytes& bytes) const;

 private:
  PointCloudReaderConfig config_;
};

}  // namespace semantic_lidar_fusion

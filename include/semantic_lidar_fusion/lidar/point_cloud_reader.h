// SPDX-License-Identifier: MIT
/// The bytes of a sensor_msgs/PointCloud2 to points with a time each.
///
/// Drivers agree neither on the name nor on the unit nor on the origin of per-point times. Unless
/// the configuration says otherwise:
///   - the field is the first of t, time, timestamp, time_stamp, offset_time;
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
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/point_cloud.h"

namespace semantic_lidar_fusion {

enum class TimeUnit : std::uint8_t { kAuto, kSeconds, kMilliseconds, kMicroseconds, kNanoseconds };
/// What a time field counts from.
enum class TimeReference : std::uint8_t {
  kAuto,
  kStamp,     ///< the header stamp
  kAbsolute,  ///< the epoch
  kScanEnd,   ///< the header stamp is the scan's end: times up to 0 count from it, of others the
              ///< latest point takes it
};
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

/// How the points' times were understood; the same for every cloud of one driver.
struct TimeDecision {
  std::string field;  ///< empty: no time field
  TimeUnit unit = TimeUnit::kAuto;
  TimeReference reference = TimeReference::kAuto;
  bool instant = false;  ///< all points have one time
  bool warning = false;  ///< worth a warning: no per-point time, or of another clock
  std::string text;      ///< one line for a log, without figures of the single cloud
};

struct PointCloudCounters {
  std::size_t points = 0;             ///< all that were given
  std::size_t non_finite_points = 0;  ///< dropped: a coordinate or the time is NaN or infinite
  std::size_t out_of_range_points = 0;
};

struct ReadCloud {
  TimedCloud cloud;  ///< one firing for each distinct time
  TimeDecision time;
  PointCloudCounters counters;
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

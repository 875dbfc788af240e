// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/lidar/point_cloud_reader.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <utility>

#include "range_limits.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

constexpr StampNs kDayNs = 86400 * kNsPerSecond;
/// No scan is longer; relative times beyond it belong to another clock.
constexpr StampNs kLongestOffsetNs = 60 * kNsPerSecond;
/// Times that no sensor means, and that would not fit 64 bits in ns with a stamp added.
constexpr double kLargestNs = 4e18;
/// Below it a 64-bit float is the image of an integer.
constexpr double kIntegerImage = 1e-100;

const char* const kTimeNames[] = {"t", "time", "timestamp", "time_stamp", "offset_time"};
const char* const kRingNames[] = {"ring", "channel", "line"};

enum DataType : std::uint8_t {
  kInt8 = 1,
  kUint8 = 2,
  kInt16 = 3,
  kUint16 = 4,
  kInt32 = 5,
  kUint32 = 6,
  kFloat32 = 7,
  kFloat64 = 8,
  kInt64 = 9,
  kUint64 = 10,
};

/// Bytes of one element; 0 for an unknown type.
std::uint64_t sizeOf(std::uint8_t datatype) {
  switch (datatype) {
    case kInt8:
    case kUint8:
      return 1;
    case kInt16:
    case kUint16:
      return 2;
    case kInt32:
    case kUint32:
    case kFloat32:
      return 4;
    case kFloat64:
    case kInt64:
    case kUint64:
      return 8;
    default:
      return 0;
  }
}

const char* nameOf(std::uint8_t datatype) {
  const char* const names[] = {"unknown", "int8",    "uint8",   "int16", "uint16", "int32",
                               "uint32",  "float32", "float64", "int64", "uint64"};
  return names[datatype <= kUint64 ? datatype : 0];
}

template <typename T>
T load(const std::uint8_t* bytes) {
  T value;
  std::memcpy(&value, bytes, sizeof(T));
  return value;
}

/// Where in each point a field lies, and how to read it.
struct Field {
  std::string name;
  std::uint32_t offset = 0;
  std::uint8_t datatype = 0;
  std::uint64_t count = 0;

  bool isInteger() const { return datatype != kFloat32 && datatype != kFloat64; }

  double asDouble(const std::uint8_t* point) const {
    const std::uint8_t* const bytes = point + offset;
    if (datatype == kFloat32) return load<float>(bytes);
    if (datatype == kFloat64) return load<double>(bytes);
    if (datatype == kUint64) return static_cast<double>(load<std::uint64_t>(bytes));
    return static_cast<double>(asInteger(point));
  }

  /// Of an integer type; values beyond 63 bits give the largest.
  std::int64_t asInteger(const std::uint8_t* point) const {
    const std::uint8_t* const bytes = point + offset;
    switch (datatype) {
      case kInt8:
        return load<std::int8_t>(bytes);
      case kUint8:
        return load<std::uint8_t>(bytes);
      case kInt16:
        return load<std::int16_t>(bytes);
      case kUint16:
        return load<std::uint16_t>(bytes);
      case kInt32:
        return load<std::int32_t>(bytes);
      case kUint32:
        return load<std::uint32_t>(bytes);
      case kInt64:
        return load<std::int64_t>(bytes);
      default:
        return static_cast<std::int64_t>(
            std::min(load<std::uint64_t>(bytes),
                     static_cast<std::uint64_t>(std::numeric_limits<std::int64_t>::max())));
    }
  }
};

[[noreturn]] void refuse(const std::string& what) { throw DataError("point cloud: " + what); }

/// Everything that must hold before a point's bytes may be read.
void checkLayout(const PointCloudBytes& bytes) {
  const std::uint64_t used_row = std::uint64_t{bytes.width} * bytes.point_step;
  const std::uint64_t all_rows = std::uint64_t{bytes.row_step} * bytes.height;
  if (bytes.is_bigendian) refuse("is_bigendian is true, only little-endian data can be read");
  if (bytes.row_step < used_row) {
    refuse("row_step is " + std::to_string(bytes.row_step) + ", must be at least width " +
           std::to_string(bytes.width) + " x point_step " + std::to_string(bytes.point_step));
  }
  if (all_rows != bytes.size) {
    refuse("data has " + std::to_string(bytes.size) + " bytes, must have row_step " +
           std::to_string(bytes.row_step) + " x height " + std::to_string(bytes.height));
  }
  if (!bytes.data) refuse("data is missing");
}

/// The field of a name; empty datatype 0 if there is none. Throws if it lies outside the point.
Field findField(const PointCloudBytes& bytes, const std::string& name) {
  for (const PointFieldBytes& candidate : bytes.fields) {
    if (candidate.name != name) continue;
    const std::uint64_t size = sizeOf(candidate.datatype);
    if (size == 0) {
      refuse("field '" + name + "' has the unknown datatype " + std::to_string(candidate.datatype));
    }
    const std::uint64_t count = std::max<std::uint64_t>(candidate.count, 1);
    if (candidate.offset + size * count > bytes.point_step) {
      refuse("field '" + name + "' (" + nameOf(candidate.datatype) + " at offset " +
             std::to_string(candidate.offset) + ", count " + std::to_string(candidate.count) +
             ") does not fit into a point_step of " + std::to_string(bytes.point_step));
    }
    return {name, candidate.offset, candidate.datatype, count};
  }
  return {};
}

Field findCoordinate(const PointCloudBytes& bytes, const std::string& name) {
  const Field field = findField(bytes, name);
  if (field.datatype != kFloat32 && field.datatype != kFloat64) {
    refuse(field.datatype == 0
               ? "has no field '" + name + "'"
               : "field '" + name + "' is " + nameOf(field.datatype) + ", must be float32 or 64");
  }
  return field;
}

/// A field name that stands for the time field, datatype 0 if there is none.
Field findTime(const PointCloudBytes& bytes, const std::string& configured) {
  Field field;
  if (!configured.empty()) {
    field = findField(bytes, configured);
    if (field.datatype == 0) {
      std::string names;
      for (const PointFieldBytes& other : bytes.fields) {
        names += (names.empty() ? "" : ", ") + other.name;
      }
      refuse("has no field '" + configured + "' (lidar.time_field); its fields are " + names);
    }
  } else {
    for (const char* const name : kTimeNames) {
      field = findField(bytes, name);
      if (field.datatype != 0) break;
    }
  }
  if (field.datatype == kUint32 && field.count == 2) field.datatype = kUint64;
  return field;
}

StampNs nsOf(TimeUnit unit) {
  switch (unit) {
    case TimeUnit::kSeconds:
      return 1000000000;
    case TimeUnit::kMilliseconds:
      return 1000000;
    case TimeUnit::kMicroseconds:
      return 1000;
    default:
      return 1;
  }
}

const char* nameOf(TimeUnit unit) {
  switch (unit) {
    case TimeUnit::kSeconds:
      return "s";
    case TimeUnit::kMilliseconds:
      return "ms";
    case TimeUnit::kMicroseconds:
      return "us";
    default:
      return "ns";
  }
}

/// Raw values of a time field, in integers or in floats after its type.
struct RawTimes {
  bool integer = false;
  std::vector<std::int64_t> integers;
  std::vector<double> floats;

  double asDouble(std::size_t i) const {
    return integer ? static_cast<double>(integers[i]) : floats[i];
  }
  std::size_t size() const { return integer ? integers.size() : floats.size(); }
};

/// Whether the values of a float64 field are integers by their bits.
bool areIntegerImages(const RawTimes& raw) {
  bool any = false;
  for (const double value : raw.floats) {
    if (std::abs(value) >= kIntegerImage) return false;
    any = any || value != 0.0;
  }
  return any;
}

/// value * unit in ns, keeping the fraction of large values of seconds.
StampNs toUnit(double value, StampNs unit_ns) {
  const double whole = std::floor(value);
  return static_cast<StampNs>(whole) * unit_ns +
         static_cast<StampNs>(std::llround((value - whole) * static_cast<double>(unit_ns)));
}

/// The coarsest unit that makes a span one second at most.
TimeUnit unitOfSpan(double span) {
  if (span <= 1.0) return TimeUnit::kSeconds;
  if (span <= 1e3) return TimeUnit::kMilliseconds;
  if (span <= 1e6) return TimeUnit::kMicroseconds;
  return TimeUnit::kNanoseconds;
}

const char* nameOf(TimeReference reference) {
  switch (reference) {
    case TimeReference::kAbsolute:
      return "since the epoch";
    case TimeReference::kScanEnd:
      return "to the scan's end, which is the header stamp";
    default:
      return "after the header stamp";
  }
}

/// Decides unit and reference of one cloud's times.
TimeDecision decide(const Field& field, const RawTimes& raw, double lowest, double highest,
                    StampNs header_stamp, const PointCloudReaderConfig& config) {
  TimeDecision decision;
  decision.field = field.name;
  decision.unit = config.time_unit;
  decision.reference = config.time_reference;
  const double middle = lowest + (highest - lowest) / 2.0;
  const bool wide =
      field.datatype == kFloat64 || field.datatype == kInt64 || field.datatype == kUint64;

  // Absolute times: the unit in which they come nearest to the header stamp. A unit that would make
  // the scan longer than scans are is none: near time zero (simulation) 0..0.1 s in ns would pass
  // for 0..100 s in us.
  if (decision.reference == TimeReference::kAbsolute ||
      (decision.reference == TimeReference::kAuto && wide)) {
    double best_distance = std::numeric_limits<double>::infinity();
    double best_magnitude = 0.0;
    TimeUnit best_unit = TimeUnit::kNanoseconds;
    for (const TimeUnit unit : {TimeUnit::kSeconds, TimeUnit::kMilliseconds,
                                TimeUnit::kMicroseconds, TimeUnit::kNanoseconds}) {
      if (config.time_unit != TimeUnit::kAuto && config.time_unit != unit) continue;
      const TimeUnit usual = raw.integer ? TimeUnit::kNanoseconds : TimeUnit::kSeconds;
      const double span_ns = (highest - lowest) * static_cast<double>(nsOf(unit));
      if (decision.reference == TimeReference::kAuto && config.time_unit == TimeUnit::kAuto &&
          span_ns > static_cast<double>(unit == usual ? 10 * kNsPerSecond : kNsPerSecond)) {
        continue;
      }
      const double ns = middle * static_cast<double>(nsOf(unit));
      const double distance = std::abs(ns - static_cast<double>(header_stamp));
      if (distance < best_distance) {
        best_distance = distance;
        best_magnitude = std::abs(ns);
        best_unit = unit;
      }
    }
    if (decision.reference == TimeReference::kAbsolute ||
        (best_distance <= static_cast<double>(kDayNs) && best_distance < best_magnitude)) {
      decision.reference = TimeReference::kAbsolute;
      decision.unit = best_unit;
    }
  }
  if (decision.reference == TimeReference::kAuto) decision.reference = TimeReference::kStamp;
  if (decision.unit == TimeUnit::kAuto) {
    decision.unit = raw.integer ? TimeUnit::kNanoseconds : unitOfSpan(highest - lowest);
  }
  decision.instant = lowest == highest && raw.size() > 1;
  decision.text = "point times: field '" + field.name + "' (" + nameOf(field.datatype) + ") in " +
                  nameOf(decision.unit) + " " + nameOf(decision.reference);
  if (decision.instant) {
    decision.warning = true;
    decision.text += "; all are equal: the cloud is taken as an instant";
  }
  return decision;
}

/// The points that come out, as far as they do not concern time.
struct Points {
  std::vector<const std::uint8_t*> bytes;
  RawTimes times;
};

/// Finite, also as a float.
bool isUsable(double value) {
  return std::abs(value) <= static_cast<double>(std::numeric_limits<float>::max());
}

/// Finite points (also in time), in order.
Points finitePoints(const PointCloudBytes& cloud, const std::array<Field, 3>& xyz,
                    const Field& time) {
  Points points;
  points.bytes.reserve(std::size_t{cloud.width} * cloud.height);
  const bool timed = time.datatype != 0;
  points.times.integer = timed && time.isInteger();
  for (std::uint32_t row = 0; row < cloud.height; ++row) {
    for (std::uint32_t column = 0; column < cloud.width; ++column) {
      const std::uint8_t* const point =
          cloud.data + std::size_t{row} * cloud.row_step + std::size_t{column} * cloud.point_step;
      if (!isUsable(xyz[0].asDouble(point)) || !isUsable(xyz[1].asDouble(point)) ||
          !isUsable(xyz[2].asDouble(point))) {
        continue;
      }
      if (timed && points.times.integer) {
        points.times.integers.push_back(time.asInteger(point));
      } else if (timed) {
        const double value = time.asDouble(point);
        if (!std::isfinite(value)) continue;
        points.times.floats.push_back(value);
      }
      points.bytes.push_back(point);
    }
  }
  if (time.datatype == kFloat64 && areIntegerImages(points.times)) {
    points.times.integer = true;
    for (const double value : points.times.floats) {
      points.times.integers.push_back(
          load<std::int64_t>(reinterpret_cast<const std::uint8_t*>(&value)));
    }
  }
  return points;
}

/// True times from raw ones.
std::vector<StampNs> trueTimes(const RawTimes& raw, StampNs header_stamp, TimeDecision& decision,
                               const PointCloudReaderConfig& config) {
  const StampNs unit_ns = nsOf(decision.unit);
  std::vector<StampNs> times(raw.size());
  for (std::size_t i = 0; i < raw.size(); ++i) {
    if (std::abs(raw.asDouble(i)) * static_cast<double>(unit_ns) > kLargestNs) {
      refuse("field '" + decision.field + "' holds " + std::to_string(raw.asDouble(i)) + " " +
             nameOf(decision.unit) + ", which no clock shows");
    }
    times[i] = raw.integer ? raw.integers[i] * unit_ns : toUnit(raw.floats[i], unit_ns);
  }
  StampNs origin = config.time_offset_ns;
  if (decision.reference != TimeReference::kAbsolute) {
    const auto span = std::minmax_element(times.begin(), times.end());
    const StampNs first = *span.first;
    const StampNs last = *span.second;
    origin += header_stamp;
    if (decision.reference == TimeReference::kScanEnd) {
      origin -= std::max<StampNs>(last, 0);
    } else if (config.time_reference == TimeReference::kAuto &&
               (first < -kLongestOffsetNs || last > kLongestOffsetNs)) {
      origin -= first;
      decision.warning = true;
      decision.text +=
          "; they are of another clock than the header stamp, which the earliest point takes";
    }
  }
  for (StampNs& time : times) time += origin;
  return times;
}

/// One turn of the sensor in `period_ns`, from the first point's azimuth on.
std::vector<StampNs> timesFromAzimuth(const std::vector<double>& azimuth, StampNs begin_ns,
                                      StampNs period_ns) {
  const auto wrapped = [](double angle) {
    return angle - 2.0 * kPi * std::round(angle / (2.0 * kPi));
  };
  // Direction of rotation: that of most steps from point to point.
  std::size_t forward = 0, backward = 0;
  for (std::size_t i = 1; i < azimuth.size(); ++i) {
    const double step = wrapped(azimuth[i] - azimuth[i - 1]);
    forward += step > 0.0 ? 1 : 0;
    backward += step < 0.0 ? 1 : 0;
  }
  const double sign = backward > forward ? -1.0 : 1.0;
  // Points in order of time make about one turn in all; then a laser that points a little behind
  // the first one is early, not a turn late. Points ring by ring make many turns.
  std::vector<double> turned(azimuth.size(), 0.0);
  double lowest = 0.0, highest = 0.0;
  for (std::size_t i = 1; i < azimuth.size(); ++i) {
    turned[i] = turned[i - 1] + sign * wrapped(azimuth[i] - azimuth[i - 1]);
    lowest = std::min(lowest, turned[i]);
    highest = std::max(highest, turned[i]);
  }
  const bool one_turn = highest - lowest < 3.0 * kPi;
  std::vector<StampNs> times(azimuth.size());
  for (std::size_t i = 0; i < azimuth.size(); ++i) {
    double turns = turned[i] / (2.0 * kPi);
    turns = one_turn ? std::min(std::max(turns, 0.0), 1.0) : turns - std::floor(turns);
    times[i] = begin_ns + std::llround(turns * static_cast<double>(period_ns));
  }
  return times;
}

/// One firing for each distinct time, in order of time; each point's index into them.
void groupByTime(TimedCloud& cloud) {
  std::vector<StampNs> distinct = cloud.time_ns;
  // Rows of an organised cloud repeat the same times: without repetitions in a row there is less to
  // sort.
  distinct.erase(std::unique(distinct.begin(), distinct.end()), distinct.end());
  if (!std::is_sorted(distinct.begin(), distinct.end())) {
    std::sort(distinct.begin(), distinct.end());
  }
  distinct.erase(std::unique(distinct.begin(), distinct.end()), distinct.end());
  cloud.firings.reserve(distinct.size());
  for (const StampNs time : distinct) {
    cloud.firings.push_back({time, time, static_cast<std::uint32_t>(cloud.firings.size())});
  }
  cloud.firing.resize(cloud.size());
  std::size_t k = 0;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const StampNs time = cloud.time_ns[i];
    if (distinct[k] != time && (k + 1 == distinct.size() || distinct[++k] != time)) {
      k = static_cast<std::size_t>(std::lower_bound(distinct.begin(), distinct.end(), time) -
                                   distinct.begin());
    }
    cloud.firing[i] = static_cast<std::uint32_t>(k);
  }
}

}  // namespace

PointCloudReader::PointCloudReader(PointCloudReaderConfig config) : config_(std::move(config)) {
  std::vector<std::string> problems;
  checkRangeLimits(config_.min_range_m, config_.max_range_m, problems);
  if (config_.sweep_period_ns <= 0) {
    problems.push_back("sweep_period_ns is " + std::to_string(config_.sweep_period_ns) +
                       ", must be more than 0");
  }
  if (!problems.empty()) throw ConfigError(std::move(problems));
}

ReadCloud PointCloudReader::read(const PointCloudBytes& bytes) const {
  ReadCloud result;
  TimedCloud& cloud = result.cloud;
  cloud.header_stamp = bytes.header_stamp;
  cloud.frame_id = bytes.frame_id;
  if (bytes.width == 0 || bytes.height == 0) {
    result.time.text = "point times: the cloud is empty";
    return result;
  }

  checkLayout(bytes);
  const std::array<Field, 3> xyz{
      {findCoordinate(bytes, "x"), findCoordinate(bytes, "y"), findCoordinate(bytes, "z")}};
  const Field intensity = findField(bytes, "intensity");
  Field ring;
  for (const char* const name : kRingNames) {
    if (ring.datatype == 0) ring = findField(bytes, name);
  }
  const Field time = findTime(bytes, config_.time_field);
  if (time.datatype == 0 && config_.without_time == WithoutTime::kReject) {
    refuse(
        "has no time field (t, time, timestamp, time_stamp, offset_time) and lidar.without_time is "
        "reject");
  }

  const Points points = finitePoints(bytes, xyz, time);
  const std::size_t count = points.bytes.size();
  result.counters.points = std::size_t{bytes.width} * bytes.height;
  result.counters.non_finite_points = result.counters.points - count;

  if (count == 0) {
    result.time.text = "point times: no point is finite";
    return result;
  }

  std::vector<StampNs> times;
  if (time.datatype != 0) {
    double lowest = std::numeric_limits<double>::infinity();
    double highest = -lowest;
    for (std::size_t i = 0; i < count; ++i) {
      lowest = std::min(lowest, points.times.asDouble(i));
      highest = std::max(highest, points.times.asDouble(i));
    }
    result.time = decide(time, points.times, lowest, highest, bytes.header_stamp, config_);
    times = trueTimes(points.times, bytes.header_stamp, result.time, config_);
  } else {
    result.time.warning = true;
    const StampNs begin_ns = bytes.header_stamp + config_.time_offset_ns;
    if (config_.without_time == WithoutTime::kAzimuth) {
      std::vector<double> azimuth(count);
      for (std::size_t i = 0; i < count; ++i) {
        azimuth[i] = std::atan2(xyz[1].asDouble(points.bytes[i]), xyz[0].asDouble(points.bytes[i]));
      }
      times = timesFromAzimuth(azimuth, begin_ns, config_.sweep_period_ns);
      result.time.text =
          "point times: no time field; from the azimuth, one turn from the header stamp on";
    } else {
      times.assign(count, begin_ns);
      result.time.instant = true;
      result.time.text = "point times: no time field; the cloud is taken as an instant";
    }
  }

  cloud.reserve(count);
  for (std::size_t i = 0; i < count; ++i) {
    const std::uint8_t* const point = points.bytes[i];
    const double x = xyz[0].asDouble(point);
    const double y = xyz[1].asDouble(point);
    const double z = xyz[2].asDouble(point);
    if (outOfRange(std::sqrt(x * x + y * y + z * z), config_.min_range_m, config_.max_range_m)) {
      ++result.counters.out_of_range_points;
      continue;
    }
    const double ring_value = ring.datatype != 0 ? ring.asDouble(point) : -1.0;
    cloud.x.push_back(static_cast<float>(x));
    cloud.y.push_back(static_cast<float>(y));
    cloud.z.push_back(static_cast<float>(z));
    const double brightness = intensity.datatype != 0 ? intensity.asDouble(point) : 0.0;
    cloud.intensity.push_back(isUsable(brightness) ? static_cast<float>(brightness) : 0.0f);
    cloud.ring.push_back(ring_value >= 0.0 && ring_value < kNoRing
                             ? static_cast<std::uint16_t>(ring_value)
                             : kNoRing);
    cloud.time_ns.push_back(times[i]);
  }
  groupByTime(cloud);
  return result;
}

}  // namespace semantic_lidar_fusion

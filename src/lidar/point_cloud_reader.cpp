// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/lidar/point_cloud_reader.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <limits>
#include <utility>

#include "range_limits.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

constexpr StampNs kDayNs = 86400 * kNsPerSecond;
/// Relative times beyond it belong to another clock.
constexpr StampNs kLongestOffsetNs = 60 * kNsPerSecond;
/// Times that no sensor means, and that would not fit 64 bits in ns with a stamp added.
constexpr double kLargestNs = 4e18;
/// Stands for them.
constexpr StampNs kNoClockNs = 4100000000000000000;
/// Below it a 64-bit float is the image of an integer.
constexpr double kIntegerImage = 1e-100;

/// A shorter scan is none of a spinning lidar; its unit is wrong.
constexpr StampNs kShortestNs = 1000000;
/// Clouds of fewer points may be parts of a scan, or short for other reasons.
constexpr std::size_t kManyPoints = 500;
/// Decisions look at the middle part of the values, so that this share may be wrong on each side.
constexpr double kTail = 0.1;
/// Values that stand for all others in decisions.
constexpr std::size_t kSample = 4096;
/// Times farther than this from all others, a turn at 10 Hz, are wrong if they are few.
constexpr StampNs kLoneNs = 100000000;
constexpr double kFew = 0.05;

// What drivers call them, the usual name first.
const std::vector<std::string> kTimeNames = {
    "t", "time", "timestamp", "time_stamp", "offset_time", "time_offset", "timestamps"};
const std::vector<std::string> kRingNames = {"ring",  "channel",  "line",
                                             "layer", "laser_id", "laser_number"};
const std::vector<std::string> kIntensityNames = {"intensity", "i", "reflectivity", "intensities"};

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

/// Everything that must hold before a point's bytes may be read. Returns the bytes from one row to
/// the next: row_step, or, where that cannot be (some drivers leave it 0 or tell the whole cloud's
/// bytes), the rows' own where the data are exactly they.
std::uint64_t checkLayout(const PointCloudBytes& bytes) {
  const std::uint64_t used_row = std::uint64_t{bytes.width} * bytes.point_step;
  if (bytes.is_bigendian) refuse("is_bigendian is true, only little-endian data can be read");
  const bool as_told =
      bytes.row_step >= used_row && std::uint64_t{bytes.row_step} * bytes.height == bytes.size;
  const bool as_needed = used_row <= std::numeric_limits<std::uint64_t>::max() / bytes.height &&
                         used_row * bytes.height == bytes.size;
  if (as_told || as_needed) {
    if (!bytes.data) refuse("data is missing");
    return as_told ? bytes.row_step : used_row;
  }
  if (bytes.row_step < used_row) {
    refuse("row_step is " + std::to_string(bytes.row_step) + ", must be at least width " +
           std::to_string(bytes.width) + " x point_step " + std::to_string(bytes.point_step));
  }
  refuse("data has " + std::to_string(bytes.size) + " bytes, must have row_step " +
         std::to_string(bytes.row_step) + " x height " + std::to_string(bytes.height));
}

/// "x, y, z", for messages.
std::string fieldNames(const PointCloudBytes& bytes) {
  constexpr std::size_t kMost = 40;
  std::string names;
  for (std::size_t i = 0; i < std::min(bytes.fields.size(), kMost); ++i) {
    names += (names.empty() ? "" : ", ") + bytes.fields[i].name;
  }
  return names + (bytes.fields.size() > kMost ? ", ..." : "");
}

std::string listed(const std::vector<std::string>& names) {
  std::string text;
  for (const std::string& name : names) text += (text.empty() ? "" : ", ") + name;
  return text;
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

/// The first of several names that there is; empty datatype 0 if there is none.
Field findField(const PointCloudBytes& bytes, const std::vector<std::string>& names) {
  Field field;
  for (const std::string& name : names) {
    if (field.datatype == 0) field = findField(bytes, name);
  }
  return field;
}

/// The time field, datatype 0 if there is none.
Field findTime(const PointCloudBytes& bytes, const std::string& configured) {
  Field field = configured.empty() ? findField(bytes, kTimeNames) : findField(bytes, configured);
  if (field.datatype == 0 && !configured.empty()) {
    refuse("has no field '" + configured + "' (lidar.time_field); its fields are " +
           fieldNames(bytes));
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

/// Whether the values of a float64 field, but for a few, are integers by their bits.
bool areIntegerImages(const RawTimes& raw) {
  std::size_t numbers = 0, images = 0;
  for (const double value : raw.floats) {
    numbers += std::abs(value) >= kIntegerImage ? 1 : 0;
    images += value != 0.0 && std::abs(value) < kIntegerImage ? 1 : 0;
  }
  return static_cast<double>(images) * kFew > static_cast<double>(numbers);
}

/// Index k of `count` that are spread over n values, in no step that rows could share.
std::size_t spread(std::size_t k, std::size_t n) { return k * 2654435761U % n; }

/// Where values lie, whatever a few of them say.
struct Bulk {
  double middle = 0.0;  ///< half of them are less
  /// The first and the last one that lies no farther from the inner ones than those from each
  /// other.
  double first = 0.0, last = 0.0;
  double span() const { return last - first; }
};

/// The inner values are all but kTail of them on each side.
template <typename ValueAt>
Bulk bulkOf(std::size_t size, const ValueAt& value_at) {
  std::vector<double> values(std::min(size, kSample));
  for (std::size_t k = 0; k < values.size(); ++k) {
    values[k] = value_at(size <= kSample ? k : spread(k, size));
  }
  const auto at = [&](double share) {
    const auto place = values.begin() + std::lround(share * static_cast<double>(values.size() - 1));
    std::nth_element(values.begin(), place, values.end());
    return *place;
  };
  const double low = at(kTail), high = at(1.0 - kTail);
  Bulk bulk{at(0.5), low, high};
  for (std::size_t i = 0; i < size; ++i) {
    const double value = value_at(i);
    if (value < low - (high - low) || value > high + (high - low)) continue;
    bulk.first = std::min(bulk.first, value);
    bulk.last = std::max(bulk.last, value);
  }
  return bulk;
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

/// One significant digit.
std::string rounded(double value) {
  char text[32];
  std::snprintf(text, sizeof(text), "%.1g", value);
  return text;
}

/// Warns of a scan that is shorter or longer than scans are, with the unit in which it is not.
void judgeSpan(double span, StampNs longest_scan_ns, TimeDecision* decision) {
  const auto ns = [&](TimeUnit unit) { return span * static_cast<double>(nsOf(unit)); };
  const auto longest = static_cast<double>(longest_scan_ns);
  const bool is_short = ns(decision->unit) < static_cast<double>(kShortestNs);
  const bool is_long = ns(decision->unit) > longest;
  if (!is_short && !is_long) return;
  std::string cure;
  for (const TimeUnit unit : {TimeUnit::kSeconds, TimeUnit::kMilliseconds, TimeUnit::kMicroseconds,
                              TimeUnit::kNanoseconds}) {
    if (cure.empty() && ns(unit) >= 5.0 * kShortestNs && ns(unit) <= longest) {
      cure = "; in " + std::string(nameOf(unit)) + " it would be " + rounded(ns(unit) * 1e-9) +
             " s: is that the unit (lidar.time_unit)?";
    }
  }
  // A part of a scan may be short; there is nothing to mend.
  if (is_short && cure.empty()) return;
  decision->warning = true;
  decision->text += "; the scan spans " + rounded(ns(decision->unit) * 1e-9) + " s, " +
                    (is_short ? "less than 1 ms" : "more than lidar.longest_scan_s") + cure;
}

/// Decides unit and reference of one cloud's times.
TimeDecision decide(const Field& field, const RawTimes& raw, const Bulk& bulk, StampNs header_stamp,
                    const PointCloudReaderConfig& config) {
  TimeDecision decision;
  decision.field = field.name;
  decision.unit = config.time_unit;
  decision.reference = config.time_reference;
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
      const double span_ns = bulk.span() * static_cast<double>(nsOf(unit));
      if (decision.reference == TimeReference::kAuto && config.time_unit == TimeUnit::kAuto &&
          span_ns > static_cast<double>(unit == usual ? 10 * kNsPerSecond : kNsPerSecond)) {
        continue;
      }
      const double ns = bulk.middle * static_cast<double>(nsOf(unit));
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
    decision.unit = raw.integer ? TimeUnit::kNanoseconds : unitOfSpan(bulk.span());
  }
  decision.instant = bulk.first == bulk.last && raw.size() > 1;
  decision.text = "point times: field '" + field.name + "' (" + nameOf(field.datatype) + ") in " +
                  nameOf(decision.unit) + " " + nameOf(decision.reference);
  if (decision.instant) {
    decision.warning = true;
    decision.text += "; all are equal: the cloud is taken as an instant";
  } else if (raw.size() >= kManyPoints) {
    judgeSpan(bulk.span(), config.longest_scan_ns, &decision);
  }
  return decision;
}

/// The points that come out, as far as they do not concern time.
struct Points {
  std::vector<const std::uint8_t*> bytes;
  RawTimes times;  ///< of each; none without a time field
};

/// Finite, also as a float.
bool isUsable(double value) {
  return std::abs(value) <= static_cast<double>(std::numeric_limits<float>::max());
}

using Position = std::array<double, 3>;

Position positionOf(const std::uint8_t* point, const std::array<Field, 3>& xyz) {
  return {{xyz[0].asDouble(point), xyz[1].asDouble(point), xyz[2].asDouble(point)}};
}

/// Positions that so many points share that none measured them: what a driver writes for beams
/// without a return.
std::vector<Position> fillers(const std::vector<const std::uint8_t*>& points,
                              const std::array<Field, 3>& xyz) {
  constexpr std::size_t kFewest = 100, kLooks = 512, kSuspicious = 5;
  constexpr double kShare = 0.01;
  if (points.size() < kFewest) return {};
  std::vector<Position> seen(std::min(points.size(), kLooks));
  for (std::size_t k = 0; k < seen.size(); ++k) {
    const std::size_t i = points.size() <= kLooks ? k : spread(k, points.size());
    seen[k] = positionOf(points[i], xyz);
  }
  std::sort(seen.begin(), seen.end());
  std::vector<Position> result;
  for (auto first = seen.begin(); first != seen.end();) {
    const auto end = std::upper_bound(first, seen.end(), *first);
    if (static_cast<std::size_t>(end - first) >= kSuspicious) {
      const auto equal = static_cast<std::size_t>(std::count_if(
          points.begin(), points.end(),
          [&](const std::uint8_t* point) { return positionOf(point, xyz) == *first; }));
      // A cloud of one position alone tells nothing.
      if (static_cast<double>(equal) >= kShare * static_cast<double>(points.size()) &&
          equal >= 16 && equal < points.size()) {
        result.push_back(*first);
      }
    }
    first = end;
  }
  return result;
}

/// The points that were measured, in order: finite, not (0, 0, 0), not a filler, within all limits.
std::vector<const std::uint8_t*> measuredPoints(const PointCloudBytes& cloud,
                                                std::uint64_t row_bytes,
                                                const std::array<Field, 3>& xyz,
                                                const PointCloudReaderConfig& config,
                                                PointCloudCounters* counters) {
  std::vector<const std::uint8_t*> points;
  points.reserve(std::size_t{cloud.width} * cloud.height);
  for (std::uint32_t row = 0; row < cloud.height; ++row) {
    for (std::uint32_t column = 0; column < cloud.width; ++column) {
      const std::uint8_t* const point =
          cloud.data + row * row_bytes + std::size_t{column} * cloud.point_step;
      const Position at = positionOf(point, xyz);
      if (!isUsable(at[0]) || !isUsable(at[1]) || !isUsable(at[2])) {
        ++counters->non_finite_points;
      } else if (at[0] == 0.0 && at[1] == 0.0 && at[2] == 0.0) {
        ++counters->no_return_points;
      } else if (std::abs(at[0]) > config.largest_coordinate_m ||
                 std::abs(at[1]) > config.largest_coordinate_m ||
                 std::abs(at[2]) > config.largest_coordinate_m) {
        ++counters->far_points;
      } else if (outOfRange(std::sqrt(at[0] * at[0] + at[1] * at[1] + at[2] * at[2]),
                            config.min_range_m, config.max_range_m)) {
        ++counters->out_of_range_points;
      } else {
        points.push_back(point);
      }
    }
  }
  const std::vector<Position> none = fillers(points, xyz);
  if (none.empty()) return points;
  const auto kept = std::remove_if(points.begin(), points.end(), [&](const std::uint8_t* point) {
    return std::find(none.begin(), none.end(), positionOf(point, xyz)) != none.end();
  });
  counters->no_return_points += static_cast<std::size_t>(points.end() - kept);
  points.erase(kept, points.end());
  return points;
}

/// Adds the raw times; points whose time is not finite are left out.
Points timedPoints(std::vector<const std::uint8_t*> bytes, const Field& time,
                   PointCloudCounters* counters) {
  Points points;
  points.bytes = std::move(bytes);
  if (time.datatype == 0) return points;
  points.times.integer = time.isInteger();
  if (points.times.integer) {
    points.times.integers.reserve(points.bytes.size());
    for (const std::uint8_t* const point : points.bytes) {
      points.times.integers.push_back(time.asInteger(point));
    }
    return points;
  }
  std::size_t kept = 0;
  points.times.floats.reserve(points.bytes.size());
  for (const std::uint8_t* const point : points.bytes) {
    const double value = time.asDouble(point);
    if (!std::isfinite(value)) continue;
    points.times.floats.push_back(value);
    points.bytes[kept++] = point;
  }
  counters->non_finite_points += points.bytes.size() - kept;
  points.bytes.resize(kept);
  if (time.datatype == kFloat64 && areIntegerImages(points.times)) {
    points.times.integer = true;
    for (const double value : points.times.floats) {
      points.times.integers.push_back(
          load<std::int64_t>(reinterpret_cast<const std::uint8_t*>(&value)));
    }
  }
  return points;
}

/// Which times belong to the scan: those within longest_scan of the middle one, but for a few that
/// lie far from all others.
std::vector<bool> withinScan(const std::vector<StampNs>& times, StampNs middle,
                             StampNs longest_scan_ns) {
  // How many lie in each ms around the middle one.
  constexpr StampNs kBinNs = 1000000;
  const auto reach = static_cast<std::ptrdiff_t>(longest_scan_ns / kBinNs + 1);
  std::vector<std::size_t> bins(static_cast<std::size_t>(2 * reach + 1));
  const auto binOf = [&](StampNs time) -> std::ptrdiff_t {
    const StampNs since = time - middle;
    const bool far = since > longest_scan_ns || since < -longest_scan_ns;
    return far ? -1 : static_cast<std::ptrdiff_t>((since + reach * kBinNs) / kBinNs);
  };
  for (const StampNs time : times) {
    const std::ptrdiff_t bin = binOf(time);
    if (bin >= 0) ++bins[static_cast<std::size_t>(bin)];
  }
  // From the middle to the first pause that is longer than a turn and than all up to it.
  std::ptrdiff_t first = reach, last = reach;
  for (std::ptrdiff_t k = 1; k <= reach; ++k) {
    const std::ptrdiff_t pause = std::max<std::ptrdiff_t>(kLoneNs / kBinNs, last - first);
    if (bins[static_cast<std::size_t>(reach - k)] > 0 && first - (reach - k) <= pause) {
      first = reach - k;
    }
    if (bins[static_cast<std::size_t>(reach + k)] > 0 && reach + k - last <= pause) {
      last = reach + k;
    }
  }
  std::vector<bool> lone(bins.size(), false);
  std::size_t lone_count = 0;
  for (std::ptrdiff_t bin = 0; bin < static_cast<std::ptrdiff_t>(bins.size()); ++bin) {
    if (bin >= first && bin <= last) continue;
    lone[static_cast<std::size_t>(bin)] = true;
    lone_count += bins[static_cast<std::size_t>(bin)];
  }
  const bool few = static_cast<double>(lone_count) <= kFew * static_cast<double>(times.size());
  std::vector<bool> within(times.size());
  for (std::size_t i = 0; i < times.size(); ++i) {
    const std::ptrdiff_t bin = binOf(times[i]);
    within[i] = bin >= 0 && !(few && lone[static_cast<std::size_t>(bin)]);
  }
  return within;
}

/// True times from raw ones. Points whose time is none of the scan's are taken out of `points`.
std::vector<StampNs> trueTimes(Points* points, StampNs header_stamp, TimeDecision* decision,
                               const PointCloudReaderConfig& config, PointCloudCounters* counters) {
  const RawTimes& raw = points->times;
  const StampNs unit_ns = nsOf(decision->unit);
  std::vector<StampNs> times(raw.size());
  for (std::size_t i = 0; i < raw.size(); ++i) {
    const double ns = raw.asDouble(i) * static_cast<double>(unit_ns);
    times[i] = std::abs(ns) > kLargestNs ? (ns > 0.0 ? kNoClockNs : -kNoClockNs)
               : raw.integer             ? raw.integers[i] * unit_ns
                                         : toUnit(raw.floats[i], unit_ns);
  }
  std::vector<StampNs> sorted(std::min(times.size(), kSample));
  for (std::size_t k = 0; k < sorted.size(); ++k) {
    sorted[k] = times[times.size() <= kSample ? k : spread(k, times.size())];
  }
  const auto half = sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2);
  std::nth_element(sorted.begin(), half, sorted.end());
  if (std::abs(*half) >= kNoClockNs) {
    refuse("field '" + decision->field + "' in " + nameOf(decision->unit) +
           " holds times that no clock shows");
  }
  const std::vector<bool> within = withinScan(times, *half, config.longest_scan_ns);
  StampNs first = std::numeric_limits<StampNs>::max(), last = std::numeric_limits<StampNs>::min();
  std::size_t kept = 0;
  for (std::size_t i = 0; i < times.size(); ++i) {
    if (!within[i]) continue;
    first = std::min(first, times[i]);
    last = std::max(last, times[i]);
    points->bytes[kept] = points->bytes[i];
    times[kept++] = times[i];
  }
  counters->time_outliers = times.size() - kept;
  times.resize(kept);
  points->bytes.resize(kept);

  StampNs origin = config.time_offset_ns;
  if (decision->reference != TimeReference::kAbsolute) {
    origin += header_stamp;
    if (decision->reference == TimeReference::kScanEnd) {
      origin -= std::max<StampNs>(last, 0);
    } else if (config.time_reference == TimeReference::kAuto &&
               (first < -kLongestOffsetNs || last > kLongestOffsetNs)) {
      origin -= first;
      decision->warning = true;
      decision->text +=
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

/// For clouds without a time field.
std::vector<StampNs> timesWithoutField(const std::vector<const std::uint8_t*>& points,
                                       const std::array<Field, 3>& xyz, StampNs header_stamp,
                                       const PointCloudReaderConfig& config,
                                       TimeDecision* decision) {
  decision->warning = true;
  const StampNs begin_ns = header_stamp + config.time_offset_ns;
  if (config.without_time != WithoutTime::kAzimuth) {
    decision->instant = true;
    decision->text = "point times: the cloud is taken as an instant";
    return std::vector<StampNs>(points.size(), begin_ns);
  }
  std::vector<double> azimuth;
  for (const std::uint8_t* const point : points) {
    azimuth.push_back(std::atan2(xyz[1].asDouble(point), xyz[0].asDouble(point)));
  }
  decision->text = "point times: from the azimuth, one turn from the header stamp on";
  return timesFromAzimuth(azimuth, begin_ns, config.sweep_period_ns);
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
  if (config_.longest_scan_ns < kShortestNs) {
    problems.push_back("lidar.longest_scan_s is " + std::to_string(config_.longest_scan_ns) +
                       " ns, must be at least 1 ms");
  }
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

  const std::uint64_t row_bytes = checkLayout(bytes);
  if (row_bytes != bytes.row_step) {
    result.warnings.push_back(
        "row_step is not width x point_step, as which it is taken: the data fit");
  }
  const std::array<Field, 3> xyz{
      {findCoordinate(bytes, "x"), findCoordinate(bytes, "y"), findCoordinate(bytes, "z")}};
  const Field intensity = findField(bytes, kIntensityNames);
  const Field ring = findField(bytes, kRingNames);
  if (ring.datatype == 0) {
    result.notes.push_back("no field of the laser's ring (" + listed(kRingNames) +
                           "); the cloud's fields are " + fieldNames(bytes));
  }
  const Field time = findTime(bytes, config_.time_field);
  const std::string no_time = "no time field (" + listed(kTimeNames) +
                              ", or set lidar.time_field); the cloud's fields are " +
                              fieldNames(bytes);
  if (time.datatype == 0 && config_.without_time == WithoutTime::kReject) {
    refuse("has " + no_time + ", and lidar.without_time is reject");
  }

  PointCloudCounters& counters = result.counters;
  counters.points = std::size_t{bytes.width} * bytes.height;
  Points points =
      timedPoints(measuredPoints(bytes, row_bytes, xyz, config_, &counters), time, &counters);
  if (points.bytes.empty()) {
    result.time.text = "point times: the cloud has no point within the limits";
    return result;
  }

  std::vector<StampNs> times;
  if (time.datatype != 0) {
    const Bulk bulk =
        bulkOf(points.times.size(), [&](std::size_t i) { return points.times.asDouble(i); });
    result.time = decide(time, points.times, bulk, bytes.header_stamp, config_);
    times = trueTimes(&points, bytes.header_stamp, &result.time, config_, &counters);
  } else {
    times = timesWithoutField(points.bytes, xyz, bytes.header_stamp, config_, &result.time);
    result.time.text += "; " + no_time;
  }

  cloud.reserve(points.bytes.size());
  for (std::size_t i = 0; i < points.bytes.size(); ++i) {
    const std::uint8_t* const point = points.bytes[i];
    const double ring_value = ring.datatype != 0 ? ring.asDouble(point) : -1.0;
    cloud.x.push_back(static_cast<float>(xyz[0].asDouble(point)));
    cloud.y.push_back(static_cast<float>(xyz[1].asDouble(point)));
    cloud.z.push_back(static_cast<float>(xyz[2].asDouble(point)));
    const double brightness = intensity.datatype != 0 ? intensity.asDouble(point) : 0.0;
    cloud.intensity.push_back(isUsable(brightness) ? static_cast<float>(brightness) : 0.0f);
    cloud.ring.push_back(ring_value >= 0.0 && ring_value < kNoRing
                             ? static_cast<std::uint16_t>(ring_value)
                             : kNoRing);
  }
  cloud.time_ns = std::move(times);
  groupByTime(cloud);
  return result;
}

}  // namespace semantic_lidar_fusion

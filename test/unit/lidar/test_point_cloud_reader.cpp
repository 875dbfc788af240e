// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <functional>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/lidar/point_cloud_reader.h"
#include "semantic_lidar_fusion/motion/compensation.h"
#include "stamps.h"

namespace semantic_lidar_fusion {
namespace {

constexpr std::uint8_t kInt8 = 1, kUint8 = 2, kUint16 = 4, kInt32 = 5, kUint32 = 6, kFloat32 = 7,
                       kFloat64 = 8, kUint64 = 10;

/// A PointCloud2 under construction, with its bytes.
struct Message {
  PointCloudBytes header;
  std::vector<std::uint8_t> data;

  Message(std::uint32_t width, std::uint32_t height, std::uint32_t point_step,
          std::uint32_t row_padding = 0) {
    header.header_stamp = kUnroundStart;
    header.frame_id = "lidar";
    header.width = width;
    header.height = height;
    header.point_step = point_step;
    header.row_step = width * point_step + row_padding;
    data.assign(std::size_t{header.row_step} * height, 0);
  }
  Message& field(const std::string& name, std::uint32_t offset, std::uint8_t datatype,
                 std::uint32_t count = 1) {
    header.fields.push_back({name, offset, datatype, count});
    return *this;
  }
  /// Points at (0, 0, 1).
  Message& xyz() {
    for (std::size_t i = 0; i < std::size_t{header.width} * header.height; ++i) set(i, 8, 1.0f);
    return field("x", 0, kFloat32).field("y", 4, kFloat32).field("z", 8, kFloat32);
  }
  template <typename T>
  void set(std::size_t i, std::uint32_t offset, T value) {
    const std::size_t row = i / header.width;
    const std::size_t column = i % header.width;
    std::memcpy(data.data() + row * header.row_step + column * header.point_step + offset, &value,
                sizeof(T));
  }
  PointCloudBytes view() const {
    PointCloudBytes bytes = header;
    bytes.data = data.data();
    bytes.size = data.size();
    return bytes;
  }
};

std::string errorOf(const PointCloudBytes& bytes, const PointCloudReaderConfig& config = {}) {
  try {
    PointCloudReader(config).read(bytes);
  } catch (const DataError& error) {
    return error.what();
  }
  return "";
}

// --- time conventions ----------------------------------------------------------------------------

constexpr std::size_t kPoints = 1000;
constexpr StampNs kStepNs = 100000;
constexpr StampNs kSpanNs = (kPoints - 1) * kStepNs;
constexpr StampNs kEnd = kUnroundStart + kSpanNs;

/// How one driver writes the time of a point that was measured at kUnroundStart + ns.
struct Convention {
  std::string name;
  std::string field;
  std::uint8_t datatype;
  std::uint32_t count;
  StampNs header_stamp;
  std::function<void(Message&, std::size_t, StampNs ns)> write;
  PointCloudReaderConfig config;
  TimeUnit unit;
  TimeReference reference;
};

constexpr std::uint32_t kTimeOffset = 16;

template <typename T>
std::function<void(Message&, std::size_t, StampNs)> writes(std::function<T(StampNs)> value) {
  return [value](Message& m, std::size_t i, StampNs ns) { m.set<T>(i, kTimeOffset, value(ns)); };
}

std::vector<Convention> conventions() {
  const PointCloudReaderConfig standard;
  PointCloudReaderConfig scan_end;
  scan_end.time_reference = TimeReference::kScanEnd;
  PointCloudReaderConfig offset;
  offset.time_offset_ns = -7000000;
  PointCloudReaderConfig named;
  named.time_field = "when";
  named.time_unit = TimeUnit::kMicroseconds;
  const auto f32 = [](double per_ns, StampNs shift) {
    return writes<float>(
        [=](StampNs ns) { return static_cast<float>(static_cast<double>(ns - shift) * per_ns); });
  };
  const auto f64 = [](double per_ns) {
    return writes<double>([=](StampNs ns) { return static_cast<double>(ns) * per_ns; });
  };
  const auto seconds = writes<double>([](StampNs ns) {
    return static_cast<double>((kUnroundStart + ns) / kNsPerSecond) +
           static_cast<double>((kUnroundStart + ns) % kNsPerSecond) * 1e-9;
  });
  const auto u32 = writes<std::uint32_t>([](StampNs ns) { return static_cast<std::uint32_t>(ns); });
  const auto u64 = [](StampNs shift, StampNs unit) {
    return writes<std::uint64_t>(
        [=](StampNs ns) { return static_cast<std::uint64_t>((shift + ns) / unit); });
  };
  const TimeUnit s = TimeUnit::kSeconds, ms = TimeUnit::kMilliseconds, us = TimeUnit::kMicroseconds,
                 ns = TimeUnit::kNanoseconds;
  const TimeReference stamp = TimeReference::kStamp, absolute = TimeReference::kAbsolute;
  return {
      {"velodyne, stamp of the first", "time", kFloat32, 1, kUnroundStart, f32(1e-9, 0), standard,
       s, stamp},
      {"velodyne, stamp of the last", "time", kFloat32, 1, kEnd, f32(1e-9, kSpanNs), standard, s,
       stamp},
      {"float ms", "time", kFloat32, 1, kUnroundStart, f32(1e-6, 0), standard, ms, stamp},
      {"float us", "time", kFloat32, 1, kUnroundStart, f32(1e-3, 0), standard, us, stamp},
      {"float ns", "time", kFloat32, 1, kUnroundStart, f32(1.0, 0), standard, ns, stamp},
      {"ouster", "t", kUint32, 1, kUnroundStart, u32, standard, ns, stamp},
      {"livox offset", "offset_time", kUint32, 1, kUnroundStart, u32, standard, ns, stamp},
      {"hesai", "timestamp", kFloat64, 1, kUnroundStart, seconds, standard, s, absolute},
      {"hesai, stamp of the last", "timestamp", kFloat64, 1, kEnd, seconds, standard, s, absolute},
      {"livox, ns in float64", "timestamp", kFloat64, 1, kUnroundStart,
       writes<double>([](StampNs t) { return static_cast<double>(kUnroundStart + t); }), standard,
       ns, absolute},
      {"float64 s after the stamp", "time", kFloat64, 1, kUnroundStart, f64(1e-9), standard, s,
       stamp},
      {"float64 ns after the stamp", "time", kFloat64, 1, kUnroundStart, f64(1.0), standard, ns,
       stamp},
      {"uint64 ns", "time_stamp", kUint64, 1, kUnroundStart, u64(kUnroundStart, 1), standard, ns,
       absolute},
      {"uint64 us", "time_stamp", kUint64, 1, kUnroundStart, u64(kUnroundStart, 1000), standard, us,
       absolute},
      {"uint64 ns after the stamp", "time_stamp", kUint64, 1, kUnroundStart, u64(0, 1), standard,
       ns, stamp},
      {"uint64 as two uint32", "timestamp", kUint32, 2, kUnroundStart, u64(kUnroundStart, 1),
       standard, ns, absolute},
      {"uint64 called float64", "timestamp", kFloat64, 1, kUnroundStart, u64(kUnroundStart, 1),
       standard, ns, absolute},
      {"scan end by configuration", "t", kUint32, 1, kEnd, u32, scan_end, ns,
       TimeReference::kScanEnd},
      {"sensor's offset", "t", kUint32, 1, kUnroundStart + 7000000, u32, offset, ns, stamp},
      {"named field and unit", "when", kInt32, 1, kUnroundStart,
       writes<std::int32_t>([](StampNs t) { return static_cast<std::int32_t>(t / 1000); }), named,
       us, stamp},
      {"another clock", "timestamp", kFloat64, 1, kUnroundStart,
       writes<double>([](StampNs t) { return 5234.5 + static_cast<double>(t) * 1e-9; }), standard,
       s, stamp},
  };
}

/// 15 m/s and 30 deg/s.
Transform pose(StampNs t) {
  const double w = kPi / 6.0;
  const double angle = w * toSeconds(t - kUnroundStart);
  Transform T = Transform::Identity();
  T.linear() = Eigen::AngleAxisd(angle, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T.translation() =
      Eigen::Vector3d(15.0 / w * std::sin(angle), 15.0 / w * (1.0 - std::cos(angle)), 0.0);
  return T;
}

TEST(PointCloudReader, EveryTimeConventionGivesTheSamePoints) {
  PoseBuffer odometry;
  for (StampNs t = kUnroundStart - 50000000; t <= kUnroundStart + 200000000; t += 10000000) {
    odometry.add({t, pose(t)});
  }
  const StampNs reference = kUnroundStart + 40000000;
  for (const Convention& convention : conventions()) {
    SCOPED_TRACE(convention.name);
    Message message(kPoints, 1, 24);
    message.xyz()
        .field("intensity", 12, kFloat32)
        .field(convention.field, kTimeOffset, convention.datatype, convention.count);
    message.header.header_stamp = convention.header_stamp;
    for (std::size_t i = 0; i < kPoints; ++i) {
      const double azimuth = 2.0 * kPi * static_cast<double>(i) / kPoints;
      message.set<float>(i, 0, static_cast<float>(50.0 * std::cos(azimuth)));
      message.set<float>(i, 4, static_cast<float>(-50.0 * std::sin(azimuth)));
      message.set<float>(i, 8, 1.0f);
      convention.write(message, i, static_cast<StampNs>(i) * kStepNs);
    }
    const ReadCloud read = PointCloudReader(convention.config).read(message.view());
    ASSERT_EQ(read.cloud.size(), kPoints);
    EXPECT_EQ(read.time.field, convention.field);
    EXPECT_EQ(read.time.unit, convention.unit) << read.time.text;
    EXPECT_EQ(read.time.reference, convention.reference) << read.time.text;
    EXPECT_EQ(read.time.warning, convention.name == "another clock") << read.time.text;
    EXPECT_FALSE(read.time.instant);

    const Cloud cloud =
        compensate(read.cloud, reference, odometry, Transform::Identity(), CompensationConfig())
            .cloud;
    double largest = 0.0;
    for (std::size_t i = 0; i < kPoints; ++i) {
      const StampNs t = kUnroundStart + static_cast<StampNs>(i) * kStepNs;
      // The same odometry, so that its own error (0.1 mm) does not count here.
      const Eigen::Vector3d expected =
          odometry.lookup(reference)->inverse() * *odometry.lookup(t) *
          Eigen::Vector3d(read.cloud.x[i], read.cloud.y[i], read.cloud.z[i]);
      largest = std::max(largest,
                         (Eigen::Vector3d(cloud.x[i], cloud.y[i], cloud.z[i]) - expected).norm());
      ASSERT_EQ(cloud.status[i], 0);
    }
    EXPECT_LT(largest, 1e-4);
  }
}

TEST(PointCloudReader, SimulationTimeNearZeroDoesNotConfuse) {
  // Within a day of the header stamp are both 12.05 s as absolute and 0.05 s as relative time.
  for (const bool absolute : {false, true}) {
    Message message(2, 1, 24);
    message.xyz().field("timestamp", 16, kFloat64);
    message.header.header_stamp = 12 * kNsPerSecond;
    message.set<double>(0, 16, absolute ? 12.0 : 0.0);
    message.set<double>(1, 16, absolute ? 12.05 : 0.05);
    const ReadCloud read = PointCloudReader({}).read(message.view());
    EXPECT_EQ(read.cloud.time_ns.at(0), 12 * kNsPerSecond);
    EXPECT_EQ(read.cloud.time_ns.at(1), 12050000000);
  }
}

TEST(PointCloudReader, RelativeTimesNearZeroAreNotAbsoluteInAnotherUnit) {
  // Stamps for which 0.1 s in the field's unit, read in a coarser one, is about the stamp.
  for (const StampNs stamp : {80 * kNsPerSecond, 80000 * kNsPerSecond}) {
    for (const double per_second : {1.0, 1e3, 1e6, 1e9}) {
      for (const std::uint8_t type : {kFloat64, kUint64}) {
        if (type == kUint64 && per_second != 1e9) continue;
        SCOPED_TRACE(std::to_string(stamp) + " " + std::to_string(per_second));
        Message message(3, 1, 24);
        message.xyz().field("time", 16, type);
        message.header.header_stamp = stamp;
        for (std::size_t i = 0; i < 3; ++i) {
          const double value = 0.05 * static_cast<double>(i) * per_second;
          if (type == kUint64) {
            message.set<std::uint64_t>(i, 16, static_cast<std::uint64_t>(value));
          } else {
            message.set<double>(i, 16, value);
          }
        }
        const ReadCloud read = PointCloudReader({}).read(message.view());
        EXPECT_EQ(read.time.reference, TimeReference::kStamp) << read.time.text;
        EXPECT_EQ(read.cloud.time_ns,
                  (std::vector<StampNs>{stamp, stamp + 50000000, stamp + 100000000}));
      }
    }
  }
}

TEST(PointCloudReader, ADayFromTheStampIsNotAbsolute) {
  for (const double days : {0.9, 1.1}) {
    Message message(2, 1, 24);
    message.xyz().field("timestamp", 16, kFloat64);
    const double base = static_cast<double>(kUnroundStart) * 1e-9 + days * 86400.0;
    message.set<double>(0, 16, base);
    message.set<double>(1, 16, base + 0.1);
    const ReadCloud read = PointCloudReader({}).read(message.view());
    EXPECT_EQ(read.time.reference, days < 1.0 ? TimeReference::kAbsolute : TimeReference::kStamp);
    EXPECT_NEAR(toSeconds(read.cloud.time_ns.at(1) - read.cloud.time_ns.at(0)), 0.1, 1e-6);
    EXPECT_NEAR(toSeconds(read.cloud.time_ns.at(0) - kUnroundStart),
                days < 1.0 ? days * 86400.0 : 0.0, 1e-6);
  }
}

TEST(PointCloudReader, EqualTimesAreAnInstantWithAWarning) {
  Message message(5, 1, 20);
  message.xyz().field("t", 16, kUint32);
  for (std::size_t i = 0; i < 5; ++i) message.set<std::uint32_t>(i, 16, 0);
  const ReadCloud read = PointCloudReader({}).read(message.view());
  EXPECT_TRUE(read.time.instant);
  EXPECT_TRUE(read.time.warning);
  EXPECT_NE(read.time.text.find("instant"), std::string::npos);
  EXPECT_EQ(read.cloud.firings.size(), 1u);
  EXPECT_EQ(read.cloud.time_ns, std::vector<StampNs>(5, kUnroundStart));
}

/// The clouds of a convention with the raw times of some points replaced by those of
/// kUnroundStart + ns: what comes out must be as without them.
TEST(PointCloudReader, AFewWrongTimesChangeNothingForTheOthers) {
  const StampNs s = kNsPerSecond;
  for (const Convention& c : conventions()) {
    for (const StampNs wrong :
         std::vector<StampNs>{3604361924, 2 * s, 500 * s / 1000, 300 * s / 1000, -2 * s, -s / 2,
                              3600 * s, -3600 * s, -kUnroundStart}) {
      for (const std::vector<std::size_t>& which :
           {std::vector<std::size_t>{0}, {500}, {kPoints - 1}, {3, 4, 5, 400, 401, 700, 999}}) {
        // What the type cannot tell is no case: before the stamp, unsigned; after 4.29 s; float ms.
        const bool is_signed = c.datatype == kFloat32 || c.datatype == kFloat64;
        const bool absolute = c.reference == TimeReference::kAbsolute;
        if (!is_signed && !absolute && wrong < 0) continue;
        if (c.datatype == kUint32 && c.count == 1 && wrong > 4 * s) continue;
        SCOPED_TRACE(c.name + ", wrong by " + std::to_string(toSeconds(wrong)) + " s at " +
                     std::to_string(which[0]));
        Message message(kPoints, 1, 24);
        message.xyz().field(c.field, kTimeOffset, c.datatype, c.count);
        message.header.header_stamp = c.header_stamp;
        for (std::size_t i = 0; i < kPoints; ++i) {
          c.write(message, i, static_cast<StampNs>(i) * kStepNs);
        }
        const ReadCloud right = PointCloudReader(c.config).read(message.view());
        for (const std::size_t i : which) c.write(message, i, wrong);
        const ReadCloud read = PointCloudReader(c.config).read(message.view());
        EXPECT_EQ(read.time.unit, right.time.unit);
        EXPECT_EQ(read.time.reference, right.time.reference);
        EXPECT_EQ(read.time.text, right.time.text);
        EXPECT_EQ(read.counters.time_outliers, which.size());
        std::vector<StampNs> expected;
        for (std::size_t i = 0; i < kPoints; ++i) {
          if (std::find(which.begin(), which.end(), i) == which.end()) {
            expected.push_back(right.cloud.time_ns[i]);
          }
        }
        // Where the first or the last point takes the stamp, another one may be the first or last.
        const bool by_end = c.reference == TimeReference::kScanEnd || c.name == "another clock";
        const StampNs shift = by_end && read.cloud.time_ns.size() == expected.size()
                                  ? read.cloud.time_ns.back() - expected.back()
                                  : 0;
        EXPECT_LE(std::abs(shift), kStepNs);
        for (StampNs& time : expected) time += shift;
        EXPECT_EQ(read.cloud.time_ns, expected);
      }
    }
  }
}

TEST(PointCloudReader, AScanThatIsTooShortOrTooLongIsSaidWithTheLikelyUnit) {
  struct Case {
    double per_second;  ///< what the driver's unit is
    const char* word;
  };
  for (const Case& c :
       {Case{1e6, "in us it would be 0.1 s"}, {1e3, "in ms it would be 0.1 s"}, {1e9, ""}}) {
    Message message(kPoints, 1, 20);
    message.xyz().field("t", 16, kUint32);
    for (std::size_t i = 0; i < kPoints; ++i) {
      message.set<std::uint32_t>(
          i, 16, static_cast<std::uint32_t>(1e-4 * static_cast<double>(i) * c.per_second));
    }
    const ReadCloud read = PointCloudReader({}).read(message.view());
    EXPECT_EQ(read.time.warning, *c.word != 0) << read.time.text;
    EXPECT_NE(read.time.text.find(c.word), std::string::npos) << read.time.text;
  }
  Message message(kPoints, 1, 24);
  message.xyz().field("t", 16, kFloat64);
  for (std::size_t i = 0; i < kPoints; ++i) {
    message.set<double>(i, 16, 100.0 * static_cast<double>(i));  // us
  }
  PointCloudReaderConfig config;
  config.time_unit = TimeUnit::kMilliseconds;
  const ReadCloud read = PointCloudReader(config).read(message.view());
  EXPECT_TRUE(read.time.warning);
  EXPECT_NE(read.time.text.find("more than lidar.longest_scan_s; in us"), std::string::npos)
      << read.time.text;
  EXPECT_GT(read.counters.time_outliers, kPoints / 2);
  config.longest_scan_ns = 200 * kNsPerSecond;
  EXPECT_EQ(PointCloudReader(config).read(message.view()).counters.time_outliers, 0u);
}

TEST(PointCloudReader, WithoutATimeFieldTheConfigurationDecides) {
  Message message(8, 1, 12);
  message.xyz();
  // Clockwise from -135 deg, a full turn less one step.
  for (std::size_t i = 0; i < 8; ++i) {
    const double azimuth = -2.35 - 2.0 * kPi * static_cast<double>(i) / 8.0;
    message.set<float>(i, 0, static_cast<float>(10.0 * std::cos(azimuth)));
    message.set<float>(i, 4, static_cast<float>(10.0 * std::sin(azimuth)));
  }
  PointCloudReaderConfig config;
  config.time_offset_ns = 1000;
  ReadCloud read = PointCloudReader(config).read(message.view());
  EXPECT_TRUE(read.time.instant && read.time.warning);
  EXPECT_EQ(read.cloud.time_ns, std::vector<StampNs>(8, kUnroundStart + 1000));

  config.without_time = WithoutTime::kAzimuth;
  read = PointCloudReader(config).read(message.view());
  EXPECT_TRUE(read.time.warning);
  EXPECT_FALSE(read.time.instant);
  for (std::size_t i = 0; i < 8; ++i) {
    EXPECT_NEAR(static_cast<double>(read.cloud.time_ns[i] - kUnroundStart - 1000),
                12500000.0 * static_cast<double>(i), 50.0);
  }

  config.without_time = WithoutTime::kReject;
  EXPECT_NE(errorOf(message.view(), config).find("no time field"), std::string::npos);
}

TEST(PointCloudReader, TheAzimuthModelKnowsBothDirectionsAndRingByRingOrder) {
  constexpr std::size_t kColumns = 90, kRings = 4;
  for (const double sign : {-1.0, 1.0}) {
    for (const bool ring_by_ring : {false, true}) {
      Message message(kColumns * kRings, 1, 12);
      message.xyz();
      std::vector<double> expected_ns;
      for (std::size_t i = 0; i < kColumns * kRings; ++i) {
        const std::size_t column = ring_by_ring ? i % kColumns : i / kRings;
        const double turn = static_cast<double>(column) / kColumns;
        const double azimuth = 0.7 + sign * 2.0 * kPi * turn;
        message.set<float>(i, 0, static_cast<float>(10.0 * std::cos(azimuth)));
        message.set<float>(i, 4, static_cast<float>(10.0 * std::sin(azimuth)));
        expected_ns.push_back(1e8 * turn);
      }
      PointCloudReaderConfig config;
      config.without_time = WithoutTime::kAzimuth;
      const ReadCloud read = PointCloudReader(config).read(message.view());
      for (std::size_t i = 0; i < expected_ns.size(); ++i) {
        double ns = static_cast<double>(read.cloud.time_ns[i] - kUnroundStart);
        if (ring_by_ring && ns > 99.9e6) ns -= 1e8;  // the seam itself, by rounding of float
        ASSERT_NEAR(ns, expected_ns[i], 100.0) << sign << ring_by_ring << " " << i;
      }
    }
  }
}

// --- points and fields ---------------------------------------------------------------------------

TEST(PointCloudReader, ReadsEveryTypeOfFieldInOrganisedCloudsWithPadding) {
  struct Case {
    std::uint8_t ring_type, intensity_type;
    std::string ring_name;
  };
  for (const Case& c : {Case{kUint16, kFloat32, "ring"}, Case{kUint8, kUint8, "line"},
                        Case{kUint32, kUint16, "channel"}, Case{kInt32, kFloat64, "ring"},
                        Case{kInt8, kUint32, "ring"}}) {
    Message message(3, 2, 56, 12);
    message.field("z", 40, kFloat64).field("y", 8, kFloat64).field("x", 0, kFloat64);
    message.field(c.ring_name, 16, c.ring_type).field("intensity", 24, c.intensity_type);
    message.field("t", 32, kUint32);
    for (std::size_t i = 0; i < 6; ++i) {
      const double v = static_cast<double>(i);
      message.set<double>(i, 0, 1.0 + v);
      message.set<double>(i, 8, 2.0 + v);
      message.set<double>(i, 40, 3.0 + v);
      message.set<std::uint32_t>(i, 16, static_cast<std::uint32_t>(10 + i));  // little-endian
      if (c.intensity_type == kFloat32) message.set<float>(i, 24, static_cast<float>(20.0 + v));
      if (c.intensity_type == kFloat64) message.set<double>(i, 24, 20.0 + v);
      if (c.intensity_type != kFloat32 && c.intensity_type != kFloat64) {
        message.set<std::uint32_t>(i, 24, static_cast<std::uint32_t>(20 + i));
      }
      // Both rows were measured at the same three times.
      message.set<std::uint32_t>(i, 32, static_cast<std::uint32_t>(1000 * (i % 3)));
    }
    const TimedCloud cloud = PointCloudReader({}).read(message.view()).cloud;
    EXPECT_EQ(cloud.frame_id, "lidar");
    EXPECT_EQ(cloud.header_stamp, kUnroundStart);
    EXPECT_EQ(cloud.x, (std::vector<float>{1, 2, 3, 4, 5, 6}));
    EXPECT_EQ(cloud.y, (std::vector<float>{2, 3, 4, 5, 6, 7}));
    EXPECT_EQ(cloud.z, (std::vector<float>{3, 4, 5, 6, 7, 8}));
    EXPECT_EQ(cloud.intensity, (std::vector<float>{20, 21, 22, 23, 24, 25}));
    EXPECT_EQ(cloud.ring, (std::vector<std::uint16_t>{10, 11, 12, 13, 14, 15}));
    EXPECT_EQ(cloud.firing, (std::vector<std::uint32_t>{0, 1, 2, 0, 1, 2}));
    ASSERT_EQ(cloud.firings.size(), 3u);
    EXPECT_EQ(cloud.firings[2].begin_ns, kUnroundStart + 2000);
    EXPECT_EQ(cloud.firings[2].end_ns, kUnroundStart + 2000);
    EXPECT_EQ(cloud.firings[2].packet, 2u);
  }
}

TEST(PointCloudReader, AbsentFieldsHaveTheirStandardValues) {
  Message message(1, 1, 12);
  message.xyz();
  const TimedCloud cloud = PointCloudReader({}).read(message.view()).cloud;
  EXPECT_EQ(cloud.intensity.at(0), 0.0f);
  EXPECT_EQ(cloud.ring.at(0), kNoRing);
}

TEST(PointCloudReader, KnowsTheNamesOfManyDriversAndListsTheFieldsWhereNoneFits) {
  for (const char* const ring : {"ring", "channel", "line", "layer", "laser_id", "laser_number"}) {
    for (const char* const intensity : {"intensity", "i", "reflectivity", "intensities"}) {
      Message message(2, 1, 20);
      message.xyz().field(ring, 12, kUint16).field(intensity, 16, kFloat32);
      message.set<std::uint16_t>(1, 12, 7);
      message.set<float>(1, 16, 9.0f);
      const ReadCloud read = PointCloudReader({}).read(message.view());
      EXPECT_EQ(read.cloud.ring.at(1), 7) << ring;
      EXPECT_EQ(read.cloud.intensity.at(1), 9.0f) << intensity;
      EXPECT_TRUE(read.notes.empty());
    }
  }
  Message message(2, 1, 20);
  message.xyz().field("strahl", 12, kUint16).field("zeit", 16, kUint32);
  const ReadCloud read = PointCloudReader({}).read(message.view());
  ASSERT_EQ(read.notes.size(), 1u);
  EXPECT_NE(read.notes[0].find("x, y, z, strahl, zeit"), std::string::npos) << read.notes[0];
  EXPECT_NE(read.time.text.find("x, y, z, strahl, zeit"), std::string::npos) << read.time.text;
}

TEST(PointCloudReader, ARowStepThatCannotBeIsTakenFromTheData) {
  Message message(3, 2, 12);
  message.xyz();
  for (std::size_t i = 0; i < 6; ++i) message.set<float>(i, 0, static_cast<float>(i));
  for (const std::uint32_t row_step : {0u, 12u, 72u, 1000000u}) {
    message.header.row_step = row_step;
    const ReadCloud read = PointCloudReader({}).read(message.view());
    EXPECT_EQ(read.cloud.x, (std::vector<float>{0, 1, 2, 3, 4, 5})) << row_step;
    ASSERT_EQ(read.warnings.size(), 1u);
    EXPECT_NE(read.warnings[0].find("row_step"), std::string::npos);
  }
}

TEST(PointCloudReader, BeamsWithoutAReturnDoNotComeOut) {
  const float far = 1e6f;
  for (const std::vector<float>& none :
       {std::vector<float>{0, 0, 0}, {-1, -1, -1}, {0.3f, 0.1f, -0.2f}, {0, 0, far}}) {
    Message message(1000, 4, 20);
    message.xyz().field("t", 16, kUint32);
    std::mt19937 random(5);
    std::size_t without = 0;
    for (std::size_t i = 0; i < 4000; ++i) {
      const bool returned = random() % 3 != 0;
      without += returned ? 0 : 1;
      message.set<float>(i, 0, returned ? 3.0f + 1e-3f * static_cast<float>(i) : none[0]);
      message.set<float>(i, 4, returned ? 1.0f : none[1]);
      message.set<float>(i, 8, returned ? 2.0f : none[2]);
      // What such beams have as their time must not matter.
      message.set<std::uint32_t>(
          i, 16, returned ? 1000000 + static_cast<std::uint32_t>(i) * 20000 : 4000000000u);
    }
    const ReadCloud read = PointCloudReader({}).read(message.view());
    EXPECT_EQ(read.counters.no_return_points + read.counters.far_points, without);
    EXPECT_EQ(read.counters.time_outliers, 0u);
    EXPECT_EQ(read.cloud.size(), 4000 - without);
    EXPECT_FALSE(read.time.warning) << read.time.text;
  }
}

TEST(PointCloudReader, PointsBeyondEveryMeasurementAreDroppedAndCounted) {
  Message message(4, 1, 12);
  message.xyz();
  message.set<float>(0, 0, 1e4f);
  message.set<float>(1, 4, -1.1e4f);
  message.set<float>(2, 8, 1e30f);
  const ReadCloud read = PointCloudReader({}).read(message.view());
  EXPECT_EQ(read.cloud.size(), 2u);
  EXPECT_EQ(read.counters.far_points, 2u);
}

TEST(PointCloudReader, DropsAndCountsWhatIsNotFinite) {
  const float nan = std::numeric_limits<float>::quiet_NaN();
  const float inf = std::numeric_limits<float>::infinity();
  Message message(6, 1, 24);
  message.xyz().field("time", 12, kFloat32).field("intensity", 16, kFloat32);
  for (std::size_t i = 0; i < 6; ++i) {
    message.set<float>(i, 0, static_cast<float>(i));
    message.set<float>(i, 12, 0.01f * static_cast<float>(i));
  }
  message.set<float>(1, 0, nan);
  message.set<float>(2, 4, inf);
  message.set<float>(3, 8, -inf);
  message.set<float>(4, 12, nan);
  message.set<float>(5, 16, nan);
  const ReadCloud read = PointCloudReader({}).read(message.view());
  EXPECT_EQ(read.cloud.x, (std::vector<float>{0, 5}));
  EXPECT_EQ(read.counters.points, 6u);
  EXPECT_EQ(read.counters.non_finite_points, 4u);
  EXPECT_EQ(read.cloud.intensity, (std::vector<float>{0, 0}));

  for (std::size_t i = 0; i < 6; ++i) message.set<float>(i, 0, nan);
  const ReadCloud none = PointCloudReader({}).read(message.view());
  EXPECT_TRUE(none.cloud.empty());
  EXPECT_TRUE(none.cloud.firings.empty());
  EXPECT_EQ(none.counters.non_finite_points, 6u);
}

TEST(PointCloudReader, RangeLimitsDropAndCount) {
  Message message(4, 1, 12);
  message.xyz();
  for (std::size_t i = 0; i < 4; ++i) message.set<float>(i, 8, static_cast<float>(i) + 0.5f);
  PointCloudReaderConfig config;
  config.min_range_m = 1.5;
  config.max_range_m = 2.5;
  const ReadCloud read = PointCloudReader(config).read(message.view());
  EXPECT_EQ(read.cloud.z, (std::vector<float>{1.5f, 2.5f}));
  EXPECT_EQ(read.counters.out_of_range_points, 2u);
}

TEST(PointCloudReader, AnEmptyCloudIsEmpty) {
  Message message(0, 1, 12);
  const ReadCloud read = PointCloudReader({}).read(message.view());
  EXPECT_TRUE(read.cloud.empty());
  EXPECT_EQ(read.cloud.header_stamp, kUnroundStart);
  EXPECT_EQ(read.cloud.frame_id, "lidar");
}

TEST(PointCloudReader, RefusesImpossibleLayoutsAndNamesThem) {
  const auto good = [] {
    Message message(4, 2, 20, 4);
    message.xyz().field("t", 16, kUint32);
    return message;
  };
  EXPECT_EQ(errorOf(good().view()), "");
  const auto refused = [&](const std::function<void(PointCloudBytes&)>& change,
                           const std::string& word) {
    const Message message = good();
    PointCloudBytes bytes = message.view();
    change(bytes);
    const std::string error = errorOf(bytes);
    EXPECT_NE(error.find(word), std::string::npos) << "'" << error << "' lacks '" << word << "'";
  };
  refused([](PointCloudBytes& b) { b.is_bigendian = true; }, "is_bigendian");
  refused([](PointCloudBytes& b) { b.row_step = 79; }, "row_step is 79");
  refused([](PointCloudBytes& b) { b.size -= 1; }, "167 bytes");
  refused([](PointCloudBytes& b) { b.size += 1; }, "169 bytes");
  refused([](PointCloudBytes& b) { b.height = 3; }, "height 3");
  refused([](PointCloudBytes& b) { b.width = 5; }, "width 5");
  refused([](PointCloudBytes& b) { b.width = 4294967295u; }, "width 4294967295");
  refused([](PointCloudBytes& b) { b.point_step = 10; }, "point_step of 10");
  refused([](PointCloudBytes& b) { b.data = nullptr; }, "data");
  refused([](PointCloudBytes& b) { b.fields[0].name = "X"; }, "no field 'x'");
  refused([](PointCloudBytes& b) { b.fields[2].datatype = kUint32; }, "'z' is uint32");
  refused([](PointCloudBytes& b) { b.fields[1].datatype = 99; }, "unknown datatype 99");
  refused([](PointCloudBytes& b) { b.fields[1].offset = 4294967295u; }, "does not fit");
  refused([](PointCloudBytes& b) { b.fields[3].count = 4294967295u; }, "does not fit");
  refused([](PointCloudBytes& b) { b.fields[3].offset = 17; }, "does not fit");

  PointCloudReaderConfig config;
  config.time_field = "when";
  EXPECT_NE(errorOf(good().view(), config).find("no field 'when'"), std::string::npos);
}

TEST(PointCloudReader, OfFieldsOfOneNameTheFirstCounts) {
  // Nothing of the second is checked, so nothing of it may decide what is read: 64 bits of time at
  // the end of the last point would lie outside the data.
  Message message(2, 1, 16);
  message.xyz().field("t", 12, kUint32).field("t", 0, kUint32, 2).field("x", 12, kFloat64);
  for (std::uint32_t i = 0; i < 2; ++i) {
    message.set(i, 0, 5.0f + static_cast<float>(i));
    message.set(i, 12, i * 1000u);
  }
  const ReadCloud read = PointCloudReader(PointCloudReaderConfig{}).read(message.view());
  ASSERT_EQ(read.cloud.size(), 2u);
  EXPECT_EQ(read.cloud.x[1], 6.0f);
  EXPECT_EQ(read.cloud.time_ns[1] - read.cloud.time_ns[0], 1000);
}

TEST(PointCloudReader, RefusesABadConfiguration) {
  PointCloudReaderConfig config;
  config.min_range_m = 3.0;
  config.max_range_m = 2.0;
  config.sweep_period_ns = 0;
  try {
    PointCloudReader reader(config);
    FAIL();
  } catch (const ConfigError& error) {
    EXPECT_EQ(error.problems().size(), 2u);
  }
}

TEST(PointCloudReader, SurvivesRandomHeadersAndBytes) {
  std::mt19937 random(21);
  const char* const names[] = {"x", "y", "z", "t", "time", "timestamp", "ring", "intensity"};
  std::size_t accepted = 0;
  for (int round = 0; round < 20000; ++round) {
    Message message(random() % 5, random() % 4, 16 + random() % 32, random() % 9);
    message.xyz();
    for (int f = 0; f < 4; ++f) {
      message.field(names[random() % 8], random() % 40, static_cast<std::uint8_t>(random() % 12),
                    random() % 3);
    }
    if (random() % 4 == 0) {
      message.header.fields[random() % message.header.fields.size()].offset = random();
    }
    for (std::uint8_t& byte : message.data) byte = static_cast<std::uint8_t>(random());
    PointCloudBytes bytes = message.view();
    if (random() % 4 == 0) bytes.row_step = random() % 200;
    if (random() % 8 == 0) bytes.width = random();
    PointCloudReaderConfig config;
    config.without_time = static_cast<WithoutTime>(random() % 3);
    config.time_unit = static_cast<TimeUnit>(random() % 5);
    config.time_reference = static_cast<TimeReference>(random() % 4);
    try {
      const ReadCloud read = PointCloudReader(config).read(bytes);
      ++accepted;
      const PointCloudCounters& counters = read.counters;
      ASSERT_EQ(read.cloud.size() + counters.non_finite_points + counters.no_return_points +
                    counters.far_points + counters.time_outliers + counters.out_of_range_points,
                counters.points);
      for (std::size_t i = 0; i < read.cloud.size(); ++i) {
        ASSERT_TRUE(std::isfinite(read.cloud.x[i]) && std::isfinite(read.cloud.intensity[i]));
        ASSERT_EQ(read.cloud.firings.at(read.cloud.firing[i]).begin_ns, read.cloud.time_ns[i]);
      }
    } catch (const DataError&) {
    }
  }
  EXPECT_GT(accepted, 1000u);
}

}  // namespace
}  // namespace semantic_lidar_fusion

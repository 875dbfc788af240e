// SPDX-License-Identifier: MIT
// sensor_msgs/PointCloud2 of a lidar driver to points with times, and of `points_compensated`.
#include <sensor_msgs/PointCloud2.h>

#include "edge/conversions.h"
#include "edge/lidar_decoder.h"
#include "fuzz_target.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace fuzz {
namespace {

using sensor_msgs::PointField;

const char* const kNames[] = {"x",    "y",         "z",          "intensity",   "ring", "t",
                              "time", "timestamp", "time_stamp", "offset_time", "dt",   "status"};
constexpr unsigned kNameCount = sizeof(kNames) / sizeof(kNames[0]);
constexpr unsigned kMaxFields = 12;

struct SeedField {
  unsigned name;
  std::uint32_t offset;
  std::uint8_t datatype;
  std::uint32_t count = 1;
};

/// 6 points, each field with values that suit it.
Bytes cloudOf(const std::vector<SeedField>& fields, std::uint32_t point_step,
              const std::function<void(std::uint32_t, std::uint8_t*)>& point) {
  constexpr std::uint32_t kWidth = 3, kHeight = 2;
  Writer writer;
  writer.byte(0).byte(0).byte(0).put(std::uint32_t{1546300800}).put(std::uint32_t{5000});
  writer.put(kWidth).put(kHeight).put(point_step).put(kWidth * point_step).byte(0);
  writer.byte(static_cast<unsigned>(fields.size()));
  for (const SeedField& field : fields) {
    writer.byte(field.name).put(field.offset).byte(field.datatype).put(field.count);
  }
  for (std::uint32_t i = 0; i < kWidth * kHeight; ++i) {
    Bytes bytes(point_step, 0);
    point(i, bytes.data());
    writer.raw(bytes.data(), bytes.size());
  }
  return writer.bytes();
}

template <typename T>
void store(std::uint8_t* at, T value) {
  std::memcpy(at, &value, sizeof(T));
}

void storeXyz(std::uint32_t i, std::uint8_t* point) {
  store(point, 5.0f + static_cast<float>(i));
  store(point + 4, 0.5f * static_cast<float>(i));
  store(point + 8, -1.0f);
}

std::vector<Bytes> seeds() {
  const std::vector<SeedField> xyz = {
      {0, 0, PointField::FLOAT32}, {1, 4, PointField::FLOAT32}, {2, 8, PointField::FLOAT32}};
  const auto with = [&](std::vector<SeedField> more) {
    more.insert(more.begin(), xyz.begin(), xyz.end());
    return more;
  };
  const auto store_ns = [](std::uint32_t i, std::uint8_t* point) {
    storeXyz(i, point);
    store(point + 12, std::uint64_t{1546300800000000000} + i * 10000000u);
  };
  std::vector<Bytes> all{Bytes{}};
  all.push_back(cloudOf(xyz, 12, storeXyz));
  all.push_back(cloudOf(with({{5, 12, PointField::UINT32}, {4, 16, PointField::UINT16}}), 20,
                        [](std::uint32_t i, std::uint8_t* point) {
                          storeXyz(i, point);
                          store(point + 12, i * 10000000u);
                          store(point + 16, static_cast<std::uint16_t>(i));
                        }));
  all.push_back(
      cloudOf(with({{6, 12, PointField::FLOAT32}}), 16, [](std::uint32_t i, std::uint8_t* point) {
        storeXyz(i, point);
        store(point + 12, -0.01f * static_cast<float>(i));
      }));
  all.push_back(
      cloudOf(with({{7, 12, PointField::FLOAT64}}), 20, [](std::uint32_t i, std::uint8_t* point) {
        storeXyz(i, point);
        store(point + 12, 1546300800.0 + 0.01 * i);
      }));
  all.push_back(cloudOf(with({{9, 12, PointField::FLOAT64}}), 20, store_ns));
  all.push_back(cloudOf(with({{9, 12, PointField::UINT32, 2}}), 20, store_ns));
  all.push_back(cloudOf(with({{9, 12, PointField::UINT32}, {9, 0, PointField::UINT32, 2}}), 16,
                        [](std::uint32_t i, std::uint8_t* point) {
                          storeXyz(i, point);
                          store(point + 12, i * 10000000u);
                        }));
  all.push_back(cloudOf(with({{3, 12, PointField::FLOAT32},
                              {4, 16, PointField::UINT16},
                              {10, 20, PointField::FLOAT32},
                              {11, 24, PointField::UINT8}}),
                        28, [](std::uint32_t i, std::uint8_t* point) {
                          storeXyz(i, point);
                          store(point + 20, 0.01f * static_cast<float>(i));
                          store(point + 24, static_cast<std::uint8_t>(i % 2 * 4));
                        }));
  return all;
}

sensor_msgs::PointCloud2 takeMessage(Reader* reader) {
  sensor_msgs::PointCloud2 message;
  message.header.frame_id = "velodyne";
  message.header.stamp.sec = reader->take<std::uint32_t>();
  message.header.stamp.nsec = reader->take<std::uint32_t>();
  message.width = reader->take<std::uint32_t>();
  message.height = reader->take<std::uint32_t>();
  message.point_step = reader->take<std::uint32_t>();
  message.row_step = reader->take<std::uint32_t>();
  message.is_bigendian = reader->take<std::uint8_t>();
  const unsigned fields = reader->choice(kMaxFields + 1);
  for (unsigned i = 0; i < fields; ++i) {
    PointField field;
    field.name = kNames[reader->choice(kNameCount)];
    field.offset = reader->take<std::uint32_t>();
    field.datatype = reader->take<std::uint8_t>();
    field.count = reader->take<std::uint32_t>();
    message.fields.push_back(field);
  }
  message.data = reader->rest();
  return message;
}

void checkTimedCloud(const TimedCloud& cloud) {
  const std::size_t n = cloud.size();
  expect(cloud.y.size() == n && cloud.z.size() == n && cloud.intensity.size() == n &&
             cloud.ring.size() == n && cloud.time_ns.size() == n && cloud.firing.size() == n,
         "all arrays have one length");
  for (const auto* values : {&cloud.x, &cloud.y, &cloud.z, &cloud.intensity}) {
    expectFinite(*values, "points are finite");
  }
  for (std::size_t i = 0; i < n; ++i) {
    expect(cloud.firing[i] < cloud.firings.size(), "a point's firing exists");
    expect(cloud.firings[cloud.firing[i]].begin_ns == cloud.time_ns[i],
           "a firing has its points' time");
  }
}

void run(const std::uint8_t* data, std::size_t size) {
  Reader reader(data, size);
  LidarConfig config;
  config.time_unit = static_cast<TimeUnit>(reader.choice(5));
  config.time_reference = static_cast<TimeReference>(reader.choice(4));
  const unsigned more = reader.take<std::uint8_t>();
  config.without_time = static_cast<WithoutTime>(more % 3);
  if (more & 4u) config.min_range_m = 1.0, config.max_range_m = 50.0;
  if (more & 8u) config.time_field = "t";
  const sensor_msgs::PointCloud2 message = takeMessage(&reader);
  const std::uint64_t given = std::uint64_t{message.width} * message.height;

  std::uint64_t dropped = 0;
  LidarDecoder decoder(config, [&](const std::string&, std::uint64_t count) { dropped += count; });
  try {
    const TimedCloud cloud = decoder.decode(message);
    checkTimedCloud(cloud);
    expect(cloud.size() + dropped == given, "points in = points out + counted drops");
  } catch (const DataError& error) {
    expectMessage(error);
  }

  try {
    const Cloud cloud = compensatedCloud(message);
    const std::size_t n = cloud.size();
    expect(cloud.y.size() == n && cloud.z.size() == n && cloud.intensity.size() == n &&
               cloud.ring.size() == n && cloud.dt.size() == n && cloud.status.size() == n,
           "all arrays have one length");
    expect(n <= given, "no more points than given");
    for (const auto* values : {&cloud.x, &cloud.y, &cloud.z, &cloud.intensity, &cloud.dt}) {
      expectFinite(*values, "points are finite");
    }
    for (const std::uint8_t status : cloud.status) {
      expect(status == 0 || status == 4, "the status of a compensated point is 0 or 4");
    }
  } catch (const DataError& error) {
    expectMessage(error);
  }
}

const char* const kWords[] = {"\x07\x01\x00\x00", "\x08\x01\x00\x00", nullptr};
const Registration kRegistered({"point_cloud", seeds, run, kWords});

}  // namespace
}  // namespace fuzz
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
// Fields of output clouds: one column each.
#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <cstring>

#include "semantic_lidar_fusion/common/cloud_bytes.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

template <typename T>
T valueAt(const CloudBytes& bytes, std::size_t point, const std::string& name) {
  for (const CloudField& field : bytes.fields) {
    if (field.name != name) continue;
    EXPECT_EQ(field.type, fieldType<T>()) << name;
    EXPECT_EQ(field.offset % sizeof(T), 0u) << name;
    T value;
    std::memcpy(&value, &bytes.data[point * bytes.point_step + field.offset], sizeof(T));
    return value;
  }
  ADD_FAILURE() << "no field " << name;
  return {};
}

SemanticCloud cloudOf(std::size_t points) {
  SemanticCloud cloud;
  cloud.points.resize(points);
  cloud.class_count = 2;
  for (std::size_t i = 0; i < points; ++i) {
    const auto value = static_cast<float>(i);
    cloud.points.x[i] = value;
    cloud.points.dt[i] = -value;
    cloud.points.ring[i] = static_cast<std::uint16_t>(i);
    cloud.label.push_back(static_cast<std::uint8_t>(i % 2));
    cloud.confidence.push_back(0.5f + value);
    cloud.entropy.push_back(0.25f);
    cloud.cameras.push_back(static_cast<std::uint16_t>(i % 7));
    cloud.probabilities.insert(cloud.probabilities.end(), {value, 2.0f * value});
  }
  return cloud;
}

LabelSet twoClasses() {
  return LabelSet::fromYaml(
      YAML::Load("[{name: road, color: [1, 2, 3]}, {name: wall, color: [4, 5, 6]}]"), "test");
}

TEST(CloudBytes, ALineAddsAField) {
  // Fields that the package does not have, of every type, on more points than are written at once.
  constexpr std::size_t kPoints = 300;
  const LabelSet classes = twoClasses();
  const SemanticCloud cloud = cloudOf(kPoints);
  std::vector<std::uint8_t> parity;
  std::vector<std::uint16_t> row;
  std::vector<std::uint32_t> number;
  std::vector<float> range_m;
  for (std::size_t i = 0; i < kPoints; ++i) {
    parity.push_back(static_cast<std::uint8_t>(i % 2));
    row.push_back(static_cast<std::uint16_t>(3 * i));
    number.push_back(static_cast<std::uint32_t>(70000 + i));
    range_m.push_back(0.1f * static_cast<float>(i));
  }
  CloudColumns columns = semanticColumns(cloud, classes);
  columns.push_back(cloudColumn("parity", std::vector<std::uint8_t>(parity)));
  columns.push_back(cloudColumn("range_m", range_m));
  columns.push_back(cloudColumn("row", row));
  columns.push_back(cloudColumn("number", number));

  const CloudBytes plain = semanticCloudBytes(cloud, classes);
  const CloudBytes more = cloudBytes(kPoints, columns);
  ASSERT_EQ(more.fields.size(), plain.fields.size() + 4);
  EXPECT_EQ(more.point_step % 4, 0u);
  EXPECT_EQ(more.data.size(), kPoints * more.point_step);
  for (std::size_t i = 0; i < kPoints; ++i) {
    ASSERT_EQ(valueAt<std::uint8_t>(more, i, "parity"), parity[i]);
    ASSERT_EQ(valueAt<float>(more, i, "range_m"), range_m[i]);
    ASSERT_EQ(valueAt<std::uint16_t>(more, i, "row"), row[i]);
    ASSERT_EQ(valueAt<std::uint32_t>(more, i, "number"), number[i]);
    ASSERT_EQ(valueAt<float>(more, i, "confidence"), cloud.confidence[i]);
    ASSERT_EQ(valueAt<float>(more, i, "p_wall"), cloud.probabilities[2 * i + 1]);
    // The others stand where they stood.
    ASSERT_EQ(std::memcmp(&more.data[i * more.point_step], &plain.data[i * plain.point_step],
                          plain.point_step),
              0);
  }
}

TEST(CloudBytes, NoPointsHaveFieldsAndNoBytes) {
  const CloudBytes bytes = semanticCloudBytes(cloudOf(0), twoClasses());
  EXPECT_EQ(bytes.fields.size(), 14u);
  EXPECT_TRUE(bytes.data.empty());
  EXPECT_GT(bytes.point_step, 0u);
}

TEST(CloudBytes, RefusesMorePointsThanAMessageHolds) {
  const std::vector<std::uint32_t> one(1);
  EXPECT_THROW(cloudBytes(std::size_t{1} << 30, {cloudColumn("a", one)}), DataError);
}

}  // namespace
}  // namespace semantic_lidar_fusion

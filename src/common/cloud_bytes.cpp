// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/common/cloud_bytes.h"

#include <array>
#include <cstring>
#include <limits>

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

std::uint32_t sizeOf(FieldType type) {
  switch (type) {
    case FieldType::kUint8:
      return 1;
    case FieldType::kUint16:
      return 2;
    default:
      return 4;
  }
}

/// Appends a field at its natural alignment and returns its offset.
std::uint32_t addField(const std::string& name, FieldType type, CloudBytes* bytes) {
  const std::uint32_t size = sizeOf(type);
  const std::uint32_t offset = (bytes->point_step + size - 1) / size * size;
  bytes->point_step = offset + size;
  bytes->fields.push_back({name, type, offset});
  return offset;
}

void allocatePoints(std::size_t points, CloudBytes* bytes) {
  bytes->point_step = (bytes->point_step + 3) / 4 * 4;
  const std::uint64_t size = static_cast<std::uint64_t>(points) * bytes->point_step;
  if (size > std::numeric_limits<std::uint32_t>::max()) {
    throw DataError("cloud of " + std::to_string(points) + " points does not fit a PointCloud2");
  }
  bytes->data.resize(size);
}

template <typename T>
void put(const T& value, std::uint32_t offset, std::uint8_t* point) {
  std::memcpy(point + offset, &value, sizeof(T));
}

struct CommonOffsets {
  std::uint32_t x, y, z, intensity, ring, dt;
};

CommonOffsets addCommonFields(CloudBytes* bytes) {
  CommonOffsets at{};
  at.x = addField("x", FieldType::kFloat32, bytes);
  at.y = addField("y", FieldType::kFloat32, bytes);
  at.z = addField("z", FieldType::kFloat32, bytes);
  at.intensity = addField("intensity", FieldType::kFloat32, bytes);
  at.ring = addField("ring", FieldType::kUint16, bytes);
  at.dt = addField("dt", FieldType::kFloat32, bytes);
  return at;
}

void putCommon(const Cloud& cloud, std::size_t i, const CommonOffsets& at, std::uint8_t* point) {
  put(cloud.x[i], at.x, point);
  put(cloud.y[i], at.y, point);
  put(cloud.z[i], at.z, point);
  put(cloud.intensity[i], at.intensity, point);
  put(cloud.ring[i], at.ring, point);
  put(cloud.dt[i], at.dt, point);
}

/// 0xRRGGBB by label.
std::array<std::uint32_t, 256> colorsOf(const LabelSet& classes) {
  std::array<std::uint32_t, 256> colors;
  colors.fill(kNoClassRgb);
  for (int id = 0; id < classes.size(); ++id) {
    const auto& color = classes[id].color_rgb;
    colors[static_cast<std::size_t>(id)] = static_cast<std::uint32_t>(color[0]) << 16 |
                                           static_cast<std::uint32_t>(color[1]) << 8 | color[2];
  }
  return colors;
}

}  // namespace

CloudBytes compensatedCloudBytes(const Cloud& cloud) {
  CloudBytes bytes;
  const CommonOffsets common = addCommonFields(&bytes);
  const std::uint32_t status = addField("status", FieldType::kUint8, &bytes);
  allocatePoints(cloud.size(), &bytes);
  std::uint8_t* point = bytes.data.data();
  for (std::size_t i = 0; i < cloud.size(); ++i, point += bytes.point_step) {
    putCommon(cloud, i, common, point);
    put(cloud.status[i], status, point);
  }
  return bytes;
}

CloudBytes semanticCloudBytes(const SemanticCloud& cloud, const LabelSet& classes) {
  if (cloud.class_count != classes.size()) {
    throw DataError("semantic cloud has " + std::to_string(cloud.class_count) +
                    " classes; the class set has " + std::to_string(classes.size()));
  }
  CloudBytes bytes;
  const CommonOffsets common = addCommonFields(&bytes);
  const std::uint32_t rgb = addField("rgb", FieldType::kFloat32, &bytes);
  const std::uint32_t label = addField("label", FieldType::kUint8, &bytes);
  const std::uint32_t confidence = addField("confidence", FieldType::kFloat32, &bytes);
  const std::uint32_t entropy = addField("entropy", FieldType::kFloat32, &bytes);
  const std::uint32_t cameras = addField("cameras", FieldType::kUint16, &bytes);
  const std::uint32_t status = addField("status", FieldType::kUint8, &bytes);
  std::uint32_t first_class = 0;
  for (int id = 0; id < classes.size(); ++id) {
    const std::uint32_t offset = addField("p_" + classes[id].name, FieldType::kFloat32, &bytes);
    if (id == 0) first_class = offset;
  }
  allocatePoints(cloud.size(), &bytes);

  const std::array<std::uint32_t, 256> rgb_of_label = colorsOf(classes);
  const std::size_t class_count = static_cast<std::size_t>(cloud.class_count);
  std::uint8_t* point = bytes.data.data();
  for (std::size_t i = 0; i < cloud.size(); ++i, point += bytes.point_step) {
    putCommon(cloud.points, i, common, point);
    put(rgb_of_label[cloud.label[i]], rgb, point);
    put(cloud.label[i], label, point);
    put(cloud.confidence[i], confidence, point);
    put(cloud.entropy[i], entropy, point);
    put(cloud.cameras[i], cameras, point);
    put(cloud.points.status[i], status, point);
    if (class_count == 0) continue;
    std::memcpy(point + first_class, cloud.probabilities.data() + i * class_count,
                class_count * sizeof(float));
  }
  return bytes;
}

}  // namespace semantic_lidar_fusion

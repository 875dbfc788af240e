// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/common/cloud_bytes.h"

#include <algorithm>
#include <array>
#include <cstring>
#include <limits>
#include <type_traits>
#include <utility>

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

/// Appends fields at their natural alignment; returns the first one's offset.
std::uint32_t addFields(const CloudColumn& column, CloudBytes* bytes) {
  const std::uint32_t size = sizeOf(column.type);
  bytes->point_step = (bytes->point_step + size - 1) / size * size;
  const std::uint32_t first = bytes->point_step;
  for (const std::string& name : column.names) {
    bytes->fields.push_back({name, column.type, bytes->point_step});
    bytes->point_step += size;
  }
  return first;
}

void allocatePoints(std::size_t points, CloudBytes* bytes) {
  bytes->point_step = (bytes->point_step + 3) / 4 * 4;
  const std::uint64_t size = static_cast<std::uint64_t>(points) * bytes->point_step;
  if (size > std::numeric_limits<std::uint32_t>::max()) {
    throw DataError("cloud of " + std::to_string(points) + " points does not fit a PointCloud2");
  }
  bytes->data.resize(size);
}

/// Copies `count` values of kBytes to places `step` bytes apart.
template <std::size_t kBytes>
void scatter(const std::uint8_t* values, std::size_t count, std::size_t step, std::uint8_t* to) {
  for (std::size_t i = 0; i < count; ++i, values += kBytes, to += step) {
    std::memcpy(to, values, kBytes);
  }
}

/// The column's values of points [first, first + count).
void scatterColumn(const CloudColumn& column, std::size_t first, std::size_t count,
                   std::size_t step, std::uint8_t* to) {
  const std::size_t bytes = column.names.size() * sizeOf(column.type);
  if (bytes == 0) return;
  const std::uint8_t* values = column.values + first * bytes;
  if (bytes == 1) return scatter<1>(values, count, step, to);
  if (bytes == 2) return scatter<2>(values, count, step, to);
  if (bytes == 4) return scatter<4>(values, count, step, to);
  for (std::size_t i = 0; i < count; ++i) std::memcpy(to + i * step, values + i * bytes, bytes);
}

/// 0xRRGGBB of each point.
std::vector<std::uint32_t> colorsOf(const std::vector<std::uint8_t>& labels,
                                    const LabelSet& classes) {
  std::array<std::uint32_t, 256> color_of_label;
  color_of_label.fill(kNoClassRgb);
  for (int id = 0; id < classes.size(); ++id) {
    const auto& color = classes[id].color_rgb;
    color_of_label[static_cast<std::size_t>(id)] = static_cast<std::uint32_t>(color[0]) << 16 |
                                                   static_cast<std::uint32_t>(color[1]) << 8 |
                                                   color[2];
  }
  std::vector<std::uint32_t> colors(labels.size());
  for (std::size_t i = 0; i < labels.size(); ++i) colors[i] = color_of_label[labels[i]];
  return colors;
}

CloudColumns compensatedColumns(const Cloud& cloud) {
  CloudColumns columns;
  visitCompensatedFields(cloud, [&](const char* name, const auto& values) {
    columns.push_back(cloudColumn(name, values));
  });
  return columns;
}

}  // namespace

CloudColumns semanticColumns(const SemanticCloud& cloud, const LabelSet& classes) {
  if (cloud.class_count != classes.size()) {
    throw DataError("semantic cloud has " + std::to_string(cloud.class_count) +
                    " classes; the class set has " + std::to_string(classes.size()));
  }
  CloudColumns columns = compensatedColumns(cloud.points);
  const CloudColumn status = columns.back();
  columns.pop_back();
  columns.push_back(cloudColumn("rgb", colorsOf(cloud.label, classes)));
  columns.back().type = FieldType::kFloat32;  // packed, as RViz and PCL read it
  columns.push_back(cloudColumn("label", cloud.label));
  columns.push_back(cloudColumn("confidence", cloud.confidence));
  columns.push_back(cloudColumn("entropy", cloud.entropy));
  columns.push_back(cloudColumn("cameras", cloud.cameras));
  columns.push_back(status);
  columns.push_back(cloudColumn("", cloud.probabilities));
  columns.back().names.clear();
  for (int id = 0; id < classes.size(); ++id) {
    columns.back().names.push_back("p_" + classes[id].name);
  }
  return columns;
}

CloudBytes cloudBytes(std::size_t points, const CloudColumns& columns) {
  // All fields of some points before the next points: their bytes stay in the nearest cache.
  constexpr std::size_t kAtOnce = 128;
  CloudBytes bytes;
  std::vector<std::uint32_t> offsets;
  for (const CloudColumn& column : columns) offsets.push_back(addFields(column, &bytes));
  allocatePoints(points, &bytes);
  for (std::size_t first = 0; first < points; first += kAtOnce) {
    const std::size_t count = std::min(kAtOnce, points - first);
    std::uint8_t* point = bytes.data.data() + first * bytes.point_step;
    for (std::size_t c = 0; c < columns.size(); ++c) {
      scatterColumn(columns[c], first, count, bytes.point_step, point + offsets[c]);
    }
  }
  return bytes;
}

CloudBytes compensatedCloudBytes(const Cloud& cloud) {
  return cloudBytes(cloud.size(), compensatedColumns(cloud));
}

CloudBytes semanticCloudBytes(const SemanticCloud& cloud, const LabelSet& classes) {
  return cloudBytes(cloud.size(), semanticColumns(cloud, classes));
}

CloudBytes pixelCloudBytes(const Cloud& cloud, const CloudPixels& pixels) {
  CloudColumns columns;
  const auto addOfCloud = [&](const char* name, const auto& values) {
    std::decay_t<decltype(values)> picked;
    picked.reserve(pixels.index.size());
    for (const std::uint32_t i : pixels.index) picked.push_back(values[i]);
    columns.push_back(cloudColumn(name, std::move(picked)));
  };
  addOfCloud("x", cloud.x);
  addOfCloud("y", cloud.y);
  addOfCloud("z", cloud.z);
  addOfCloud("intensity", cloud.intensity);
  addOfCloud("ring", cloud.ring);
  columns.push_back(cloudColumn("u", pixels.u));
  columns.push_back(cloudColumn("v", pixels.v));
  columns.push_back(cloudColumn("cov_uu", pixels.uu));
  columns.push_back(cloudColumn("cov_uv", pixels.uv));
  columns.push_back(cloudColumn("cov_vv", pixels.vv));
  std::vector<std::uint8_t> status;
  for (const PointStatus value : pixels.status) status.push_back(static_cast<std::uint8_t>(value));
  columns.push_back(cloudColumn("status", std::move(status)));
  return cloudBytes(pixels.index.size(), columns);
}

}  // namespace semantic_lidar_fusion

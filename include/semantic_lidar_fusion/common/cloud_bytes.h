// SPDX-License-Identifier: MIT
/// The clouds that the package gives away, point by point, as a sensor_msgs/PointCloud2 holds them:
/// fields at their natural alignment, a point's size a multiple of 4, the bytes of this machine.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/label_set.h"
#include "semantic_lidar_fusion/common/point_cloud.h"

namespace semantic_lidar_fusion {

/// Of sensor_msgs/PointField, as far as it is used.
enum class FieldType : std::uint8_t { kUint8 = 2, kUint16 = 4, kFloat32 = 7 };

struct CloudField {
  std::string name;
  FieldType type = FieldType::kFloat32;
  std::uint32_t offset = 0;  ///< in the point
};

struct CloudBytes {
  std::vector<CloudField> fields;
  std::uint32_t point_step = 0;
  std::vector<std::uint8_t> data;
};

/// `points_compensated`: x y z intensity f32, ring u16, dt f32, status u8. Throws DataError if the
/// points do not fit a message.
CloudBytes compensatedCloudBytes(const Cloud& cloud);

/// `points_semantic`: x y z intensity f32, ring u16, dt f32, rgb f32, label u8, confidence f32,
/// entropy f32, cameras u16, status u8, p_<class> f32 for each class. Throws DataError if the
/// cloud's class count is not that of `classes`, or the points do not fit a message.
CloudBytes semanticCloudBytes(const SemanticCloud& cloud, const LabelSet& classes);
/// Colour (0xRRGGBB) of points without a class.
constexpr std::uint32_t kNoClassRgb = 0x606060;

}  // namespace semantic_lidar_fusion

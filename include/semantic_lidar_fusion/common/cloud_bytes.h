// SPDX-License-Identifier: MIT
/// The clouds that the package gives away, point by point, as a sensor_msgs/PointCloud2 holds them:
/// fields at their natural alignment, a point's size a multiple of 4, the bytes of this machine.
///
/// A field is a column of values: a line of semanticColumns() adds one to `points_semantic`, live,
/// offline and in Python.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "semantic_lidar_fusion/common/label_set.h"
#include "semantic_lidar_fusion/common/point_cloud.h"

namespace semantic_lidar_fusion {

/// Of sensor_msgs/PointField, as far as it is used.
enum class FieldType : std::uint8_t { kUint8 = 2, kUint16 = 4, kUint32 = 6, kFloat32 = 7 };

/// The type of a field for values of type T.
template <typename T>
constexpr FieldType fieldType() {
  static_assert(std::is_same<T, float>::value || (std::is_unsigned<T>::value && sizeof(T) <= 4),
                "fields are u8, u16, u32 or f32");
  if (std::is_same<T, float>::value) return FieldType::kFloat32;
  return sizeof(T) == 1   ? FieldType::kUint8
         : sizeof(T) == 2 ? FieldType::kUint16
                          : FieldType::kUint32;
}

/// The values of a field, or of several whose values lie side by side for each point.
struct CloudColumn {
  std::vector<std::string> names;
  FieldType type = FieldType::kFloat32;
  const std::uint8_t* values = nullptr;  ///< points x names.size(), row-major
  std::shared_ptr<const void> owner;     ///< of the values, if nobody else keeps them
};
using CloudColumns = std::vector<CloudColumn>;

/// `values`: one for each point; they outlive the column.
template <typename T>
CloudColumn cloudColumn(const std::string& name, const std::vector<T>& values) {
  const auto* bytes = reinterpret_cast<const std::uint8_t*>(values.data());
  return {{name}, fieldType<T>(), bytes, nullptr};
}
/// The column keeps the values.
template <typename T>
CloudColumn cloudColumn(const std::string& name, std::vector<T>&& values) {
  const auto kept = std::make_shared<const std::vector<T>>(std::move(values));
  CloudColumn column = cloudColumn(name, *kept);
  column.owner = kept;
  return column;
}

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

/// Calls visit(name, values) for each field of `points_compensated`, in order: to write it and to
/// read it back.
template <typename AnyCloud, typename Visit>
void visitCompensatedFields(AnyCloud& cloud, const Visit& visit) {
  visit("x", cloud.x);
  visit("y", cloud.y);
  visit("z", cloud.z);
  visit("intensity", cloud.intensity);
  visit("ring", cloud.ring);
  visit("dt", cloud.dt);
  visit("status", cloud.status);
}

/// `points_semantic`: x y z intensity f32, ring u16, dt f32, rgb f32, label u8, confidence f32,
/// entropy f32, cameras u16, status u8, p_<class> f32 for each class. Throws DataError if the
/// cloud's class count is not that of `classes`.
CloudColumns semanticColumns(const SemanticCloud& cloud, const LabelSet& classes);

/// Throws DataError if the points do not fit a message.
CloudBytes cloudBytes(std::size_t points, const CloudColumns& columns);
/// `points_compensated`: x y z intensity f32, ring u16, dt f32, status u8.
CloudBytes compensatedCloudBytes(const Cloud& cloud);
/// `points_semantic`: the columns of semanticColumns().
CloudBytes semanticCloudBytes(const SemanticCloud& cloud, const LabelSet& classes);
/// Colour (0xRRGGBB) of points without a class.
constexpr std::uint32_t kNoClassRgb = 0x606060;

/// The points of a cloud that lie within one camera's image; arrays of equal length.
struct CloudPixels {
  const std::vector<std::uint32_t>& index;  ///< into the cloud
  const std::vector<float>&u, &v;           ///< px
  const std::vector<float>&uu, &uv, &vv;    ///< covariance, px^2
  const std::vector<PointStatus>& status;   ///< in this camera
};
/// `<camera>/points_pixel`: x y z intensity f32, ring u16, u v cov_uu cov_uv cov_vv f32, status u8.
CloudBytes pixelCloudBytes(const Cloud& cloud, const CloudPixels& pixels);

}  // namespace semantic_lidar_fusion

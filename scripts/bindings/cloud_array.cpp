// SPDX-License-Identifier: MIT
#include "cloud_array.h"

#include "arrays.h"

namespace py = pybind11;

namespace semantic_lidar_fusion {

py::array structuredArray(CloudBytes&& bytes) {
  py::list names, formats, offsets;
  for (const CloudField& field : bytes.fields) {
    names.append(field.name);
    switch (field.type) {
      case FieldType::kUint8:
        formats.append("u1");
        break;
      case FieldType::kUint16:
        formats.append("u2");
        break;
      case FieldType::kUint32:
        formats.append("u4");
        break;
      case FieldType::kFloat32:
        formats.append("f4");
    }
    offsets.append(field.offset);
  }
  const py::dtype layout(names, formats, offsets, static_cast<py::ssize_t>(bytes.point_step));
  return arrayOf(std::move(bytes.data)).attr("view")(layout).cast<py::array>();
}

}  // namespace semantic_lidar_fusion

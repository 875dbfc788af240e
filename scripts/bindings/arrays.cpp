// SPDX-License-Identifier: MIT
#include "arrays.h"

namespace py = pybind11;

namespace semantic_lidar_fusion {
namespace {

int depthOf(const py::array& values) {
  if (py::isinstance<py::array_t<std::uint8_t>>(values)) return CV_8U;
  if (py::isinstance<py::array_t<std::uint16_t>>(values)) return CV_16U;
  if (py::isinstance<py::array_t<std::int32_t>>(values)) return CV_32S;
  if (py::isinstance<py::array_t<float>>(values)) return CV_32F;
  throw py::value_error("an image of uint8, uint16, int32 or float32 is wanted, not of " +
                        std::string(py::str(values.dtype())));
}

py::dtype dtypeOf(int depth) {
  switch (depth) {
    case CV_8U:
      return py::dtype::of<std::uint8_t>();
    case CV_16U:
      return py::dtype::of<std::uint16_t>();
    case CV_32S:
      return py::dtype::of<std::int32_t>();
    default:
      return py::dtype::of<float>();
  }
}

/// Keeps an array and, wherever it is let go, takes the interpreter's lock for it.
std::shared_ptr<const void> keeperOf(const py::array& values) {
  return std::shared_ptr<const void>(new py::array(values), [](const void* kept) {
    const py::gil_scoped_acquire lock;
    delete static_cast<const py::array*>(kept);
  });
}

}  // namespace

py::array arrayOf(const cv::Mat& pixels) {
  auto* const owned = new cv::Mat(pixels);
  const py::capsule owner(owned, [](void* p) { delete static_cast<cv::Mat*>(p); });
  std::vector<py::ssize_t> shape = {owned->rows, owned->cols};
  std::vector<py::ssize_t> strides = {static_cast<py::ssize_t>(owned->step[0]),
                                      static_cast<py::ssize_t>(owned->elemSize())};
  if (owned->channels() > 1) {
    shape.push_back(owned->channels());
    strides.push_back(static_cast<py::ssize_t>(owned->elemSize1()));
  }
  if (owned->empty()) strides.clear();
  return py::array(dtypeOf(owned->depth()), shape, strides, owned->data, owner);
}

cv::Mat matOf(const py::object& pixels, std::shared_ptr<const void>* owner) {
  if (pixels.is_none()) return {};
  py::array values = py::array::ensure(pixels);
  if (!values || (values.ndim() != 2 && values.ndim() != 3) || values.size() == 0) {
    throw py::value_error("an image of (rows, columns) or (rows, columns, channels) is wanted");
  }
  const int depth = depthOf(values);
  const py::ssize_t channels = values.ndim() == 3 ? values.shape(2) : 1;
  if (channels > CV_CN_MAX) {
    throw py::value_error("an image of at most " + std::to_string(CV_CN_MAX) +
                          " channels is wanted");
  }
  const py::ssize_t element = values.itemsize();
  const bool adjacent = values.strides(1) == element * channels &&
                        (values.ndim() == 2 || values.strides(2) == element) &&
                        values.strides(0) >= values.strides(1) * values.shape(1);
  if (!adjacent) {
    values = py::module_::import("numpy").attr("ascontiguousarray")(values).cast<py::array>();
  }
  *owner = keeperOf(values);
  return cv::Mat(static_cast<int>(values.shape(0)), static_cast<int>(values.shape(1)),
                 CV_MAKETYPE(depth, static_cast<int>(channels)), const_cast<void*>(values.data()),
                 static_cast<std::size_t>(values.strides(0)));
}

Transform transformOf(const Doubles& matrix) {
  if (matrix.ndim() != 2 || matrix.shape(0) != 4 || matrix.shape(1) != 4) {
    throw py::value_error("a transform: a matrix of 4 x 4 is wanted");
  }
  Transform transform = Transform::Identity();
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 4; ++column) transform(row, column) = matrix.at(row, column);
  }
  return transform;
}

std::optional<Transform> optionalTransformOf(const py::object& matrix) {
  if (matrix.is_none()) return std::nullopt;
  return transformOf(matrix.cast<Doubles>());
}

Doubles matrixOf(const Transform& transform) {
  Doubles matrix({4, 4});
  auto values = matrix.mutable_unchecked<2>();
  for (int row = 0; row < 4; ++row) {
    for (int column = 0; column < 4; ++column) values(row, column) = transform(row, column);
  }
  return matrix;
}

}  // namespace semantic_lidar_fusion

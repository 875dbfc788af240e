// SPDX-License-Identifier: MIT
/// Numpy arrays <-> the core's types. Nothing is copied unless it says so.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <cstdint>
#include <memory>
#include <opencv2/core.hpp>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

/// As doubles, converted (and copied) if need be.
using Doubles = pybind11::array_t<double, pybind11::array::c_style | pybind11::array::forcecast>;
using Stamps =
    pybind11::array_t<std::int64_t, pybind11::array::c_style | pybind11::array::forcecast>;

/// The number of rows of an array (N, columns). Throws ValueError for another shape.
inline pybind11::ssize_t rowsOf(const pybind11::array& values, pybind11::ssize_t columns) {
  if (values.ndim() != 2 || values.shape(1) != columns) {
    throw pybind11::value_error("an array of N x " + std::to_string(columns) + " is wanted");
  }
  return values.shape(0);
}

/// A view (N,) of a member of `owner`, which lives as long as the view.
template <typename T>
pybind11::array_t<T> viewOf(const std::vector<T>& values, const pybind11::object& owner) {
  return pybind11::array_t<T>(static_cast<pybind11::ssize_t>(values.size()), values.data(), owner);
}

/// An array that takes the values over.
template <typename T>
pybind11::array_t<T> arrayOf(std::vector<T>&& values) {
  auto* const owned = new std::vector<T>(std::move(values));
  const pybind11::capsule owner(owned, [](void* p) { delete static_cast<std::vector<T>*>(p); });
  return pybind11::array_t<T>(static_cast<pybind11::ssize_t>(owned->size()), owned->data(), owner);
}

/// An array (rows, columns) or (rows, columns, channels) that shares the pixels of `pixels`.
pybind11::array arrayOf(const cv::Mat& pixels);

/// The pixels of an array (rows, columns) or (rows, columns, channels) of u8, u16, i32 or f32; a
/// copy only where the elements of a row are not adjacent. `owner` then keeps the memory. An empty
/// image for None. Throws ValueError for another type or shape.
cv::Mat matOf(const pybind11::object& pixels, std::shared_ptr<const void>* owner);

/// A matrix (4, 4) whose last row is 0 0 0 1. Throws ValueError for another shape.
Transform transformOf(const Doubles& matrix);
/// The same; empty for None.
std::optional<Transform> optionalTransformOf(const pybind11::object& matrix);
Doubles matrixOf(const Transform& transform);

}  // namespace semantic_lidar_fusion

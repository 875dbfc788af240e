// SPDX-License-Identifier: MIT
/// Superpixels, their share, and what they make of a network's scores (paper, eq. 1-4).
#include <pybind11/stl.h>

#include "arrays.h"
#include "bindings.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/superpixel/slic.h"
#include "semantic_lidar_fusion/superpixel/uncertainty.h"

namespace py = pybind11;

namespace semantic_lidar_fusion {
namespace {

using Floats = py::array_t<float, py::array::c_style | py::array::forcecast>;

/// Superpixel ids (rows, columns) of an image; without `size` (columns, rows) of the image's size.
py::array superpixels(const py::object& image, const std::optional<std::pair<int, int>>& size,
                      int count, double compactness, int iterations) {
  std::shared_ptr<const void> owner;
  const cv::Mat pixels = matOf(image, &owner);
  SlicConfig config;
  config.count = count;
  config.compactness = compactness;
  config.iterations = iterations;
  const ImageSize map_size =
      size ? ImageSize{size->first, size->second} : ImageSize{pixels.cols, pixels.rows};
  SuperpixelMap map;
  {
    const py::gil_scoped_release release;
    map = Slic(config).cluster(pixels, map_size);
  }
  return arrayOf(map.ids);
}

/// A partition from its ids. Throws ValueError unless it is one of 0..K-1, all used.
SuperpixelMap mapOf(const cv::Mat& ids) {
  if (ids.type() != CV_32SC1) throw py::value_error("superpixels: ids (rows, columns) int32");
  double least = 0, most = 0;
  cv::minMaxIdx(ids, &least, &most);
  if (least < 0 || most >= static_cast<double>(ids.total())) {
    throw py::value_error("superpixels: ids from 0 to their number - 1 are wanted");
  }
  SuperpixelMap map;
  map.ids = ids;
  map.count = static_cast<int>(most) + 1;
  map.sizes.assign(static_cast<std::size_t>(map.count), 0);
  for (int row = 0; row < ids.rows; ++row) {
    for (int c = 0; c < ids.cols; ++c) ++map.sizes[static_cast<std::size_t>(ids.at<int>(row, c))];
  }
  for (const int size : map.sizes) {
    if (size == 0) throw py::value_error("superpixels: an id below the highest is not used");
  }
  return map;
}

py::array share(const py::object& ids, const py::object& scores) {
  std::shared_ptr<const void> ids_owner, scores_owner;
  const SuperpixelMap map = mapOf(matOf(ids, &ids_owner));
  const cv::Mat values = matOf(scores, &scores_owner);
  ShareMap result;
  {
    const py::gil_scoped_release release;
    result = computeShare(map, ScoreMap(values, values.channels(), {}));
  }
  return arrayOf(result.share);
}

/// P (N, C) in double of scores (N, C) and shares (N,).
py::array_t<double> softmax(const Floats& scores, const Doubles& shares, double temperature,
                            double exponent) {
  if (scores.ndim() != 2 || scores.shape(1) < 1 || shares.ndim() != 1 ||
      shares.shape(0) != scores.shape(0)) {
    throw py::value_error("scores (N, C) and shares (N,) are wanted");
  }
  if (!(temperature > 0.0) || !(exponent >= 0.0)) {
    throw ConfigError({"temperature = " + std::to_string(temperature) + ", exponent = " +
                       std::to_string(exponent) + ": must be above 0, and at least 0"});
  }
  const UncertaintyConfig config{temperature, exponent};
  const int classes = static_cast<int>(scores.shape(1));
  py::array_t<double> result({scores.shape(0), scores.shape(1)});
  auto rows = result.mutable_unchecked<2>();
  for (py::ssize_t i = 0; i < scores.shape(0); ++i) {
    temperedSoftmax(scores.data(i, 0), classes, shares.at(i), config, &rows(i, 0));
  }
  return result;
}

}  // namespace

void addSemantics(py::module_& module) {
  module.def("superpixels", &superpixels, py::arg("image"), py::arg("size") = py::none(),
             py::arg("count") = 1000, py::arg("compactness") = 10.0, py::arg("iterations") = 10);
  module.def("share", &share, py::arg("superpixels"), py::arg("scores"));
  module.def("tempered_softmax", &softmax, py::arg("scores"), py::arg("share"),
             py::arg("temperature") = 1.0, py::arg("exponent") = 2.0);
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The Python module semantic_lidar_fusion._cameras: the core's camera models for numpy arrays.
/// semantic_lidar_fusion/cameras.py is its only user.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <array>
#include <limits>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/error.h"

namespace py = pybind11;

namespace semantic_lidar_fusion {
namespace {

using Rows = py::array_t<double, py::array::c_style | py::array::forcecast>;

/// (N, columns) rows of doubles.
py::ssize_t rowsOf(const Rows& values, py::ssize_t columns) {
  if (values.ndim() != 2 || values.shape(1) != columns) {
    throw py::value_error("an array of N x " + std::to_string(columns) + " is wanted");
  }
  return values.shape(0);
}

std::unique_ptr<CameraModel> makeModel(
    const std::string& frame, const std::array<int, 2>& size, const std::string& distortion_model,
    const std::vector<double>& d, const std::array<double, 9>& k, const std::array<double, 9>& r,
    const std::array<double, 12>& p, const std::array<int, 2>& binning,
    const std::array<int, 4>& roi, bool rectified, double max_theta_deg,
    const std::string& lens_file, const std::string& lens_camera) {
  CameraInfo info;
  info.frame_id = frame;
  info.size = {size[0], size[1]};
  info.distortion_model = distortion_model;
  info.d = d;
  info.k = k;
  info.r = r;
  info.p = p;
  info.binning_x = binning[0], info.binning_y = binning[1];
  info.roi_x = roi[0], info.roi_y = roi[1], info.roi_width = roi[2], info.roi_height = roi[3];
  CameraModelOptions options;
  options.rectified = rectified;
  options.max_theta_deg = max_theta_deg;
  if (!lens_file.empty()) {
    options.lens = std::make_shared<const LensCalibration>(loadLens(lens_file, lens_camera));
  }
  return std::make_unique<CameraModel>(info, options);
}

/// Pixels (N, 2) of points (N, 3), NaN where the model has none.
py::array_t<double> project(const CameraModel& camera, const Rows& points) {
  const py::ssize_t count = rowsOf(points, 3);
  py::array_t<double> pixels({count, py::ssize_t{2}});
  const auto in = points.unchecked<2>();
  auto out = pixels.mutable_unchecked<2>();
  for (py::ssize_t i = 0; i < count; ++i) {
    const auto pixel = camera.project({in(i, 0), in(i, 1), in(i, 2)});
    out(i, 0) = pixel ? pixel->x() : std::numeric_limits<double>::quiet_NaN();
    out(i, 1) = pixel ? pixel->y() : std::numeric_limits<double>::quiet_NaN();
  }
  return pixels;
}

/// Unit rays (N, 3) of pixels (N, 2), NaN where no ray maps to them.
py::array_t<double> rays(const CameraModel& camera, const Rows& pixels) {
  const py::ssize_t count = rowsOf(pixels, 2);
  py::array_t<double> result({count, py::ssize_t{3}});
  const auto in = pixels.unchecked<2>();
  auto out = result.mutable_unchecked<2>();
  for (py::ssize_t i = 0; i < count; ++i) {
    const auto ray = camera.ray({in(i, 0), in(i, 1)});
    for (int axis = 0; axis < 3; ++axis) {
      out(i, axis) = ray ? (*ray)[axis] : std::numeric_limits<double>::quiet_NaN();
    }
  }
  return result;
}

py::array_t<double> thetas(const CameraModel& camera, const Rows& points) {
  const py::ssize_t count = rowsOf(points, 3);
  py::array_t<double> result(count);
  const auto in = points.unchecked<2>();
  auto out = result.mutable_unchecked<1>();
  for (py::ssize_t i = 0; i < count; ++i) out(i) = camera.theta({in(i, 0), in(i, 1), in(i, 2)});
  return result;
}

}  // namespace
}  // namespace semantic_lidar_fusion

PYBIND11_MODULE(_cameras, m) {
  using namespace semantic_lidar_fusion;  // NOLINT: the module's own functions
  py::register_exception<Error>(m, "CameraError", PyExc_ValueError);
  py::class_<CameraModel>(m, "CameraModel")
      .def(py::init(&makeModel), py::kw_only(), py::arg("frame"), py::arg("size"),
           py::arg("distortion_model"), py::arg("d"), py::arg("k"), py::arg("r"), py::arg("p"),
           py::arg("binning"), py::arg("roi"), py::arg("rectified"), py::arg("max_theta_deg"),
           py::arg("lens_file"), py::arg("lens_camera"))
      .def_property_readonly("size",
                             [](const CameraModel& camera) {
                               return std::make_pair(camera.imageSize().width,
                                                     camera.imageSize().height);
                             })
      .def_property_readonly("max_theta", &CameraModel::maxThetaRad)
      .def("project", &project)
      .def("rays", &rays)
      .def("theta", &thetas);
}

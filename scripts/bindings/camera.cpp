// SPDX-License-Identifier: MIT
/// The core's camera models for arrays of points and pixels.
#include <pybind11/stl.h>

#include <array>
#include <limits>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "arrays.h"
#include "bindings.h"
#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/error.h"

namespace py = pybind11;

namespace semantic_lidar_fusion {
namespace {

/// The numbers of a matrix of any shape.
template <std::size_t N>
std::array<double, N> numbersOf(const py::object& values, const char* name) {
  std::array<double, N> result{};
  if (values.is_none()) return result;
  const auto given = values.cast<Doubles>();
  if (given.size() != static_cast<py::ssize_t>(N)) {
    throw py::value_error(std::string(name) + ": " + std::to_string(N) + " numbers are wanted");
  }
  std::copy(given.data(), given.data() + N, result.begin());
  return result;
}

std::shared_ptr<CameraModel> makeModel(
    const std::string& frame, const std::array<int, 2>& size, const std::string& distortion_model,
    const std::vector<double>& d, const py::object& k, const py::object& r, const py::object& p,
    const std::array<int, 2>& binning, const std::array<int, 4>& roi, bool rectified,
    double max_theta_deg, const std::string& lens_file, const std::string& lens_camera) {
  CameraInfo info;
  info.frame_id = frame;
  info.size = {size[0], size[1]};
  info.distortion_model = distortion_model;
  info.d = d;
  info.k = numbersOf<9>(k, "k");
  info.r = numbersOf<9>(r, "r");
  info.p = numbersOf<12>(p, "p");
  info.binning_x = binning[0], info.binning_y = binning[1];
  info.roi_x = roi[0], info.roi_y = roi[1], info.roi_width = roi[2], info.roi_height = roi[3];
  CameraModelOptions options;
  options.rectified = rectified;
  options.max_theta_deg = max_theta_deg;
  if (!lens_file.empty()) {
    options.lens = std::make_shared<const LensCalibration>(loadLens(lens_file, lens_camera));
  }
  return std::make_shared<CameraModel>(info, options);
}

/// Pixels (N, 2) of points (N, 3), NaN where the model has none.
py::array_t<double> project(const CameraModel& camera, const Doubles& points) {
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
py::array_t<double> rays(const CameraModel& camera, const Doubles& pixels) {
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

py::array_t<double> thetas(const CameraModel& camera, const Doubles& points) {
  const py::ssize_t count = rowsOf(points, 3);
  py::array_t<double> result(count);
  const auto in = points.unchecked<2>();
  auto out = result.mutable_unchecked<1>();
  for (py::ssize_t i = 0; i < count; ++i) out(i) = camera.theta({in(i, 0), in(i, 1), in(i, 2)});
  return result;
}

}  // namespace

void addCamera(py::module_& module) {
  py::class_<CameraModel, std::shared_ptr<CameraModel>>(module, "CameraModel")
      .def(py::init(&makeModel), py::kw_only(), py::arg("frame") = "camera",
           py::arg("size") = std::array<int, 2>{0, 0}, py::arg("distortion_model") = "",
           py::arg("d") = std::vector<double>{}, py::arg("k") = py::none(),
           py::arg("r") = py::none(), py::arg("p") = py::none(),
           py::arg("binning") = std::array<int, 2>{0, 0},
           py::arg("roi") = std::array<int, 4>{0, 0, 0, 0}, py::arg("rectified") = false,
           py::arg("max_theta_deg") = 0.0, py::arg("lens_file") = "", py::arg("lens_camera") = "")
      .def_property_readonly("size",
                             [](const CameraModel& camera) {
                               return std::make_pair(camera.imageSize().width,
                                                     camera.imageSize().height);
                             })
      .def_property_readonly("max_theta", &CameraModel::maxThetaRad)
      .def("project", &project, py::arg("points"))
      .def("rays", &rays, py::arg("pixels"))
      .def("theta", &thetas, py::arg("points"));
}

}  // namespace semantic_lidar_fusion

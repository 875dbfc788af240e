// SPDX-License-Identifier: MIT
/// Which points a camera sees (paper, eq. 6-14), and smoothing along the lidar's surfaces.
#include <pybind11/stl.h>

#include "arrays.h"
#include "bindings.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/projection/occlusion_mask.h"
#include "semantic_lidar_fusion/smoothing/surface_smoother.h"

namespace py = pybind11;

namespace semantic_lidar_fusion {
namespace {

OcclusionConfig configOf(const std::string& mode, double vertical_step_deg,
                         double horizontal_step_deg, double depth_margin_m,
                         double depth_margin_ratio) {
  OcclusionConfig config;
  config.mode = nullptr;
  std::string known;
  for (const OcclusionMode* candidate : occlusionModes()) {
    if (mode == candidate->name) config.mode = candidate;
    known += (known.empty() ? "" : ", ") + std::string(candidate->name);
  }
  if (!config.mode) throw ConfigError({"mode = " + mode + ": must be one of " + known});
  config.vertical_step_deg = vertical_step_deg;
  config.horizontal_step_deg = horizontal_step_deg;
  config.depth_margin_m = depth_margin_m;
  config.depth_margin_ratio = depth_margin_ratio;
  return config;
}

/// The points that fall into the image, with what the mask says of them.
py::dict visible(const Cloud& cloud, const CameraModel& camera, const Doubles& T_camera_lidar,
                 const std::string& mode, double vertical_step_deg, double horizontal_step_deg,
                 double depth_margin_m, double depth_margin_ratio) {
  const OcclusionConfig config =
      configOf(mode, vertical_step_deg, horizontal_step_deg, depth_margin_m, depth_margin_ratio);
  const Transform T = transformOf(T_camera_lidar);
  ProjectedPoints points, inside;
  std::vector<std::uint8_t> seen, seen_inside;
  {
    const py::gil_scoped_release release;
    const BeamGrid grid = beamGrid(cloud, config);
    points = projectCloud(cloud, T, camera, castMarginPx(camera, grid, config));
    seen = visiblePoints(cloud, points, T, camera, grid, config);
    for (std::size_t k = 0; k < points.size(); ++k) {
      if (!inImage(points.u[k], points.v[k], camera.imageSize())) continue;
      inside.index.push_back(points.index[k]);
      inside.u.push_back(points.u[k]);
      inside.v.push_back(points.v[k]);
      inside.distance.push_back(points.distance[k]);
      inside.theta.push_back(points.theta[k]);
      seen_inside.push_back(seen[k]);
    }
  }
  py::dict result;
  result["index"] = arrayOf(std::move(inside.index));
  result["u"] = arrayOf(std::move(inside.u));
  result["v"] = arrayOf(std::move(inside.v));
  result["distance"] = arrayOf(std::move(inside.distance));
  result["theta"] = arrayOf(std::move(inside.theta));
  result["visible"] = arrayOf(std::move(seen_inside)).attr("view")("bool");
  return result;
}

/// A smoothed copy of the distributions (N, C) of a cloud's points; rows of points that are not
/// fused are taken and given as they are.
py::array smooth(const Cloud& cloud, const py::array& probabilities, const py::object& fused,
                 int iterations, double distance_m, double intensity) {
  const py::ssize_t count = static_cast<py::ssize_t>(cloud.size());
  const auto given =
      probabilities.cast<py::array_t<float, py::array::c_style | py::array::forcecast>>();
  if (given.ndim() != 2 || given.shape(0) != count || given.shape(1) < 1) {
    throw py::value_error("probabilities: (N, C), a row for each point, are wanted");
  }
  if (iterations < 0 || iterations > SmoothingConfig::kMostIterations || !(distance_m > 0.0) ||
      !(intensity >= 0.0)) {
    throw ConfigError({"smoothing: iterations 0 to " +
                       std::to_string(SmoothingConfig::kMostIterations) +
                       ", distance_m above 0 and intensity of at least 0 are wanted"});
  }
  SemanticCloud semantic;
  semantic.points = cloud;
  semantic.class_count = static_cast<int>(given.shape(1));
  semantic.probabilities.assign(given.data(), given.data() + given.size());
  semantic.label.resize(cloud.size());
  semantic.confidence.resize(cloud.size());
  semantic.entropy.resize(cloud.size());
  semantic.cameras.resize(cloud.size());
  const auto is_fused = fused.cast<py::array_t<bool, py::array::c_style | py::array::forcecast>>();
  if (is_fused.size() != count) throw py::value_error("fused: (N,) is wanted");
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    semantic.points.status[i] = static_cast<std::uint8_t>(
        is_fused.data()[i] ? PointStatus::kFused : PointStatus::kOutsideImages);
  }
  {
    const py::gil_scoped_release release;
    SmoothingConfig config;
    config.iterations = iterations;
    config.distance_m = distance_m;
    config.intensity = intensity;
    smoothAlongSurfaces(beamGrid(cloud, {}, nullptr, true), config, &semantic);
  }
  py::array smoothed = arrayOf(std::move(semantic.probabilities));
  return smoothed.reshape({count, given.shape(1)});
}

}  // namespace

void addProjection(py::module_& module) {
  const OcclusionConfig defaults;
  module.def("visible", &visible, py::arg("cloud"), py::arg("camera"), py::arg("T_camera_lidar"),
             py::arg("mode") = defaults.mode->name,
             py::arg("vertical_step_deg") = defaults.vertical_step_deg,
             py::arg("horizontal_step_deg") = defaults.horizontal_step_deg,
             py::arg("depth_margin_m") = defaults.depth_margin_m,
             py::arg("depth_margin_ratio") = defaults.depth_margin_ratio);
  const SmoothingConfig smoothing;
  module.def("smooth", &smooth, py::arg("cloud"), py::arg("probabilities"), py::arg("fused"),
             py::arg("iterations") = 10, py::arg("distance_m") = smoothing.distance_m,
             py::arg("intensity") = smoothing.intensity);
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The core's voxel map for numpy arrays, and OctoMap files where liboctomap is installed.
/// semantic_lidar_fusion/maps/semantic_map.py is its only user and checks shapes and types before
/// it calls.
#include "semantic_lidar_fusion/map/voxel_map.h"

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <string>
#include <vector>

#include "arrays.h"
#include "bindings.h"
#include "octomap_file.h"
#include "semantic_lidar_fusion/common/error.h"

namespace py = pybind11;

namespace semantic_lidar_fusion {
namespace {

Column column(const py::array& values) {
  return Column{static_cast<const std::uint8_t*>(values.data()), values.strides(0)};
}

template <typename Value>
py::array checked(const py::array& values, int dimensions, const char* name) {
  if (!py::isinstance<py::array_t<Value>>(values) || values.ndim() != dimensions)
    throw py::value_error(std::string(name) + ": wrong type or shape");
  return values;
}

VoxelMapConfig makeConfig(double voxel_size_m, bool dirichlet, double weight, double floor,
                          const std::vector<double>& prior, double min_range_m, double max_range_m,
                          double ray_range_m, const std::vector<std::uint8_t>& returns) {
  VoxelMapConfig config;
  config.voxel_size_m = voxel_size_m;
  config.evidence.kind = dirichlet ? EvidenceKind::kDirichlet : EvidenceKind::kLog;
  config.evidence.weight = weight;
  config.evidence.floor = floor;
  config.evidence.prior = prior;
  config.min_range_m = min_range_m;
  config.max_range_m = max_range_m;
  config.ray_range_m = ray_range_m;
  config.returns = returns;
  return config;
}

Transform poseOf(const py::array& pose) {
  return transformOf(checked<double>(pose, 2, "pose").cast<Doubles>());
}

std::vector<std::size_t> integrate(VoxelMap* map, const py::array& x, const py::array& y,
                                   const py::array& z, const py::array& intensity,
                                   const py::array& status, const py::array& probabilities,
                                   const py::array& pose, StampNs stamp_ns,
                                   const py::array& origins, const py::array& passes) {
  SemanticPoints points;
  points.count = static_cast<std::size_t>(checked<float>(x, 1, "x").shape(0));
  points.x = column(x);
  points.y = column(checked<float>(y, 1, "y"));
  points.z = column(checked<float>(z, 1, "z"));
  points.intensity = column(checked<float>(intensity, 1, "intensity"));
  points.status = column(checked<std::uint8_t>(status, 1, "status"));
  points.probabilities = column(checked<float>(probabilities, 2, "probabilities"));
  for (const py::array* values : {&y, &z, &intensity, &status, &probabilities}) {
    if (static_cast<std::size_t>(values->shape(0)) != points.count)
      throw py::value_error("columns of different lengths");
  }
  if (probabilities.shape(1) != map->classCount() ||
      (map->classCount() > 1 && probabilities.strides(1) != sizeof(float)))
    throw py::value_error("probabilities: as many adjacent columns as the map has classes");
  const auto from = checked<double>(origins, 2, "origins")
                        .cast<py::array_t<double, py::array::c_style | py::array::forcecast>>();
  if (from.shape(0) != 0) {
    if (static_cast<std::size_t>(from.shape(0)) != points.count || from.shape(1) != 3)
      throw py::value_error("origins: must be (N, 3), or empty");
    points.origins = from.data();
  }
  checked<std::uint8_t>(passes, 1, "passes");
  if (passes.shape(0) != 0) {
    if (static_cast<std::size_t>(passes.shape(0)) != points.count)
      throw py::value_error("passes: must be (N,), or empty");
    points.passes = column(passes);
  }
  const Transform T_map_lidar = poseOf(pose);
  IntegrationCounts counts;
  {
    const py::gil_scoped_release release;
    counts = map->integrate(points, T_map_lidar, stamp_ns);
  }
  return {counts.labelled, counts.occupied, counts.no_odometry, counts.out_of_range,
          counts.invalid};
}

using Indices = py::array_t<std::int64_t, py::array::c_style>;
using Bytes = py::array_t<std::uint8_t, py::array::c_style>;

void add(VoxelMap* map, const Bytes& records, const Bytes& bricks) {
  map->add(records.data(), static_cast<std::size_t>(records.size()), bricks.data(),
           static_cast<std::size_t>(bricks.size()));
}

void addMoved(VoxelMap* map, const Bytes& bricks, const py::array& T_theirs_ours) {
  map->addMoved(bricks.data(), static_cast<std::size_t>(bricks.size()), poseOf(T_theirs_ours));
}

Bytes passesAt(const VoxelMap& map, const py::array& x, const py::array& y, const py::array& z,
               const py::array& pose) {
  SemanticPoints points;
  points.count = static_cast<std::size_t>(checked<float>(x, 1, "x").shape(0));
  points.x = column(x);
  points.y = column(checked<float>(y, 1, "y"));
  points.z = column(checked<float>(z, 1, "z"));
  if (y.shape(0) != x.shape(0) || z.shape(0) != x.shape(0))
    throw py::value_error("columns of different lengths");
  Bytes result(static_cast<py::ssize_t>(points.count));
  map.passesAt(points, poseOf(pose), result.mutable_data());
  return result;
}

}  // namespace

void addVoxelMap(py::module_& module) {
  py::class_<VoxelMap>(module, "VoxelMap")
      .def(py::init([](double voxel_size_m, bool dirichlet, double weight, double floor,
                       const std::vector<double>& prior, double min_range_m, double max_range_m,
                       double ray_range_m, const std::vector<std::uint8_t>& returns) {
        return new VoxelMap(makeConfig(voxel_size_m, dirichlet, weight, floor, prior, min_range_m,
                                       max_range_m, ray_range_m, returns));
      }))
      .def("__len__", &VoxelMap::size)
      .def_property_readonly("memory_bytes", &VoxelMap::memoryBytes)
      .def("integrate", &integrate)
      .def("add", &add)
      .def("add_moved", &addMoved)
      .def("passes_at", &passesAt)
      .def("records", [](const VoxelMap& map, bool sorted) { return arrayOf(map.records(sorted)); })
      .def("bricks", [](const VoxelMap& map, bool sorted) { return arrayOf(map.bricks(sorted)); })
      .def("keep_inside", &VoxelMap::keepInside)
      .def("clear", &VoxelMap::clear);
  module.attr("has_octomap") = hasOctomap();
  module.def("write_octomap", [](const Indices& occupied, const Bytes& rgb, const Indices& free,
                                 double size, const std::string& color_path,
                                 const std::string& binary_path) {
    if (occupied.ndim() != 2 || rgb.ndim() != 2 || free.ndim() != 2 || occupied.shape(1) != 3 ||
        rgb.shape(1) != 3 || free.shape(1) != 3 || occupied.shape(0) != rgb.shape(0))
      throw py::value_error("occupied, rgb and free: must be (N, 3), (N, 3) and (M, 3)");
    writeOctomap({occupied.data(), static_cast<std::size_t>(occupied.shape(0))}, rgb.data(),
                 {free.data(), static_cast<std::size_t>(free.shape(0))}, size, color_path,
                 binary_path);
  });
}

}  // namespace semantic_lidar_fusion

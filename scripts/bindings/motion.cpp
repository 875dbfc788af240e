// SPDX-License-Identifier: MIT
/// Poses in time, and clouds as the lidar sees them at one time.
#include <pybind11/stl.h>

#include <array>

#include "arrays.h"
#include "bindings.h"
#include "cloud_array.h"
#include "semantic_lidar_fusion/common/cloud_bytes.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/motion/pose_buffer.h"

namespace py = pybind11;

namespace semantic_lidar_fusion {
namespace {

/// Poses (M, 4, 4) of T_fixed_vehicle, or (M, 7): x y z, then the quaternion x y z w.
std::unique_ptr<PoseBuffer> poseBuffer(const Stamps& stamps, const Doubles& poses,
                                       double fastest_mps) {
  const py::ssize_t count = stamps.size();
  const bool matrices = poses.ndim() == 3 && poses.shape(1) == 4 && poses.shape(2) == 4;
  const bool quaternions = poses.ndim() == 2 && poses.shape(1) == 7;
  if (stamps.ndim() != 1 || (!matrices && !quaternions) || poses.shape(0) != count) {
    throw py::value_error("poses: (M, 4, 4) or (M, 7), and M stamps, are wanted");
  }
  std::vector<StampedPose> readings(static_cast<std::size_t>(count));
  for (py::ssize_t i = 0; i < count; ++i) {
    StampedPose& reading = readings[static_cast<std::size_t>(i)];
    reading.stamp = stamps.at(i);
    if (quaternions) {
      const double* v = poses.data(i, 0);
      reading.T_fixed_vehicle =
          transformOf(Eigen::Vector3d(v[0], v[1], v[2]), v[6], v[3], v[4], v[5]);
    } else {
      for (int row = 0; row < 3; ++row) {
        for (int c = 0; c < 4; ++c) reading.T_fixed_vehicle(row, c) = poses.at(i, row, c);
      }
    }
  }
  auto buffer = std::make_unique<PoseBuffer>(0, fastest_mps);
  buffer->add(readings);
  return buffer;
}

py::object lookup(const PoseBuffer& buffer, StampNs stamp) {
  const std::optional<Transform> pose = buffer.lookup(stamp);
  return pose ? py::object(matrixOf(*pose)) : py::none();
}

template <typename T>
py::array_t<T> column(const py::object& cloud, std::vector<T> Cloud::*member) {
  return viewOf(cloud.cast<const Cloud&>().*member, cloud);
}

/// A rigid cloud of one's own points; `ring` may be None.
std::unique_ptr<Cloud> makeCloud(const Doubles& xyz, const py::object& ring,
                                 const py::object& intensity, StampNs stamp,
                                 const std::string& frame) {
  const auto count = static_cast<std::size_t>(rowsOf(xyz, 3));
  auto cloud = std::make_unique<Cloud>();
  cloud->frame_id = frame;
  cloud->stamp = cloud->first_point_ns = stamp;
  cloud->resize(count);
  std::fill(cloud->dt.begin(), cloud->dt.end(), 0.0f);
  std::fill(cloud->ring.begin(), cloud->ring.end(), kNoRing);
  std::fill(cloud->intensity.begin(), cloud->intensity.end(), 0.0f);
  std::fill(cloud->status.begin(), cloud->status.end(), std::uint8_t{0});
  for (std::size_t i = 0; i < count; ++i) {
    const auto row = static_cast<py::ssize_t>(i);
    cloud->x[i] = static_cast<float>(xyz.at(row, 0));
    cloud->y[i] = static_cast<float>(xyz.at(row, 1));
    cloud->z[i] = static_cast<float>(xyz.at(row, 2));
  }
  const auto fill = [&](const py::object& values, auto* target) {
    if (values.is_none()) return;
    using Value = typename std::remove_pointer_t<decltype(target)>::value_type;
    const auto given = values.cast<py::array_t<Value, py::array::c_style | py::array::forcecast>>();
    if (static_cast<std::size_t>(given.size()) != count) {
      throw py::value_error("ring and intensity: one value for each point is wanted");
    }
    std::copy(given.data(), given.data() + count, target->begin());
  };
  fill(ring, &cloud->ring);
  fill(intensity, &cloud->intensity);
  return cloud;
}

}  // namespace

void addMotion(py::module_& module) {
  module.def(
      "transform",
      [](const std::array<double, 3>& t, const std::array<double, 4>& q) {
        return matrixOf(transformOf(Eigen::Vector3d(t[0], t[1], t[2]), q[3], q[0], q[1], q[2]));
      },
      py::arg("translation"), py::arg("quaternion"));
  py::class_<PoseBuffer>(module, "PoseBuffer")
      .def(py::init(&poseBuffer), py::arg("stamps_ns"), py::arg("poses"),
           py::arg("fastest_mps") = 0.0)
      .def("__len__", &PoseBuffer::size)
      .def("covers", &PoseBuffer::covers, py::arg("stamp_ns"))
      .def("lookup", &lookup, py::arg("stamp_ns"));
  py::class_<Cloud>(module, "Cloud")
      .def(py::init(&makeCloud), py::arg("xyz"), py::arg("ring") = py::none(),
           py::arg("intensity") = py::none(), py::arg("stamp_ns") = 0, py::arg("frame") = "lidar")
      .def("__len__", &Cloud::size)
      .def_readonly("frame", &Cloud::frame_id)
      .def_readonly("stamp_ns", &Cloud::stamp)
      .def_property_readonly("x", [](const py::object& c) { return column(c, &Cloud::x); })
      .def_property_readonly("y", [](const py::object& c) { return column(c, &Cloud::y); })
      .def_property_readonly("z", [](const py::object& c) { return column(c, &Cloud::z); })
      .def_property_readonly("intensity",
                             [](const py::object& c) { return column(c, &Cloud::intensity); })
      .def_property_readonly("ring", [](const py::object& c) { return column(c, &Cloud::ring); })
      .def_property_readonly("dt", [](const py::object& c) { return column(c, &Cloud::dt); })
      .def_property_readonly("status",
                             [](const py::object& c) { return column(c, &Cloud::status); })
      .def("points",
           [](const Cloud& cloud) { return structuredArray(compensatedCloudBytes(cloud)); });
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/config/rig.h"

#include <pybind11/stl.h>
#include <yaml-cpp/yaml.h>

#include "arrays.h"
#include "bindings.h"
#include "semantic_lidar_fusion/common/error.h"

namespace py = pybind11;

namespace semantic_lidar_fusion {
namespace {

Rig parsed(const std::string& text, const std::string& folder,
           const std::vector<std::string>& overrides) {
  YAML::Node tree;
  try {
    tree = YAML::Load(text);
  } catch (const YAML::Exception& error) {
    throw ConfigError({std::string("the rig is no YAML: ") + error.what()});
  }
  return rigFromYaml(tree, folder, "the rig", overrides);
}

py::array_t<std::uint8_t> colors(const Rig& rig) {
  py::array_t<std::uint8_t> result({py::ssize_t{rig.classes.size()}, py::ssize_t{3}});
  auto values = result.mutable_unchecked<2>();
  for (int id = 0; id < rig.classes.size(); ++id) {
    for (std::size_t c = 0; c < 3; ++c) {
      values(id, static_cast<py::ssize_t>(c)) = rig.classes[id].color_rgb[c];
    }
  }
  return result;
}

}  // namespace

void addRig(py::module_& module) {
  py::class_<Rig, std::shared_ptr<Rig>>(module, "Rig")
      .def_static("load", &loadRig, py::arg("path"),
                  py::arg("overrides") = std::vector<std::string>{})
      .def_static("parse", &parsed, py::arg("text"), py::arg("folder") = ".",
                  py::arg("overrides") = std::vector<std::string>{})
      .def_readonly("yaml", &Rig::yaml)
      .def_readonly("name", &Rig::name)
      .def_readonly("fixed_frame", &Rig::fixed_frame)
      .def_readonly("vehicle_frame", &Rig::vehicle_frame)
      .def_property_readonly("class_names",
                             [](const Rig& rig) {
                               std::vector<std::string> names;
                               for (const ClassInfo& info : rig.classes.classes()) {
                                 names.push_back(info.name);
                               }
                               return names;
                             })
      .def_property_readonly("class_colors", &colors)
      .def_property_readonly("camera_names", [](const Rig& rig) {
        std::vector<std::string> names;
        for (const CameraConfig& camera : rig.cameras) names.push_back(camera.name);
        return names;
      });
}

}  // namespace semantic_lidar_fusion

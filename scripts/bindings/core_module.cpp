// SPDX-License-Identifier: MIT
#include "bindings.h"
#include "semantic_lidar_fusion/common/error.h"

namespace py = pybind11;

namespace semantic_lidar_fusion {

void addErrors(py::module_& module) {
  // Kept for the life of the process: the translator outlives the module.
  static PyObject* config_error = nullptr;
  static PyObject* data_error = nullptr;
  const py::module_ errors = py::module_::import("semantic_lidar_fusion.errors");
  config_error = py::object(errors.attr("ConfigError")).release().ptr();
  data_error = py::object(errors.attr("DataError")).release().ptr();
  module.attr("ConfigError") = py::handle(config_error);
  module.attr("DataError") = py::handle(data_error);
  py::register_exception_translator([](std::exception_ptr thrown) {
    try {
      if (thrown) std::rethrow_exception(thrown);
    } catch (const ConfigError& error) {
      PyErr_SetString(config_error, error.what());
    } catch (const Error& error) {
      PyErr_SetString(data_error, error.what());
    }
  });
}

}  // namespace semantic_lidar_fusion

PYBIND11_MODULE(_core, module) {
  using namespace semantic_lidar_fusion;  // NOLINT: the parts alone
  module.doc() = "The core of semantic_lidar_fusion; use semantic_lidar_fusion.core.";
  addErrors(module);
  addRig(module);
  addCamera(module);
  addLidar(module);
  addMotion(module);
  addSemantics(module);
  addProjection(module);
  addPipeline(module);
  addVoxelMap(module);
}

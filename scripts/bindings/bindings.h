// SPDX-License-Identifier: MIT
/// The Python module semantic_lidar_fusion._core, part by part: each function adds a part of the
/// core. What is public is named in semantic_lidar_fusion/core.py, typed in _core.pyi.
///
/// Errors of the core become those of semantic_lidar_fusion/errors.py. Objects may be used by one
/// thread at a time; long work gives up the interpreter's lock.
#pragma once

#include <pybind11/pybind11.h>

namespace semantic_lidar_fusion {

void addErrors(pybind11::module_& module);
void addRig(pybind11::module_& module);
void addLidar(pybind11::module_& module);
void addMotion(pybind11::module_& module);
void addCamera(pybind11::module_& module);
void addSemantics(pybind11::module_& module);
void addProjection(pybind11::module_& module);
void addPipeline(pybind11::module_& module);
void addVoxelMap(pybind11::module_& module);

}  // namespace semantic_lidar_fusion

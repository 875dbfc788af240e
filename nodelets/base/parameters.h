// SPDX-License-Identifier: MIT
/// The rig from ROS parameters, through the one loader of the core.
#pragma once

#include <ros/node_handle.h>
#include <xmlrpcpp/XmlRpcValue.h>
#include <yaml-cpp/yaml.h>

#include <string>
#include <vector>

#include "semantic_lidar_fusion/config/rig.h"

namespace semantic_lidar_fusion {

/// The same tree as YAML. `key` names the parameter in errors. Throws ConfigError on a type that
/// YAML files of this package do not have (date, binary).
YAML::Node yamlTree(XmlRpc::XmlRpcValue value, const std::string& key);

/// Parameters, each searched from `node` upwards (so that nodelets of one namespace share them):
///   rig_file       path of a rig file; or
///   rig            the same tree as parameters (rosparam load, ns="rig"), with
///   rig_directory  the folder that relative paths in `rig` start from (default: the working
///                  directory), and for both
///   overrides      list of "key=value" (see loadRig), or one string of them separated by blanks.
/// Throws ConfigError with every problem.
Rig loadRigFromParameters(const ros::NodeHandle& node);

/// One line for each parameter in the node's namespace that nothing reads, with the name that it
/// may have been meant for, and for a rig tree that a rig file hides.
std::vector<std::string> unknownParameters(const ros::NodeHandle& node);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// What the tools and nodelets say about themselves.
#pragma once

#include <std_msgs/String.h>

#include <string>

#include "semantic_lidar_fusion/config/rig.h"

namespace semantic_lidar_fusion {

/// The package's version, as in package.xml.
extern const char kVersion[];

/// The resolved rig under a comment that names the version: a rig file with every key.
std::string configurationText(const Rig& rig);
/// The same for the topic `configuration`.
std_msgs::String configurationMessage(const Rig& rig);

}  // namespace semantic_lidar_fusion

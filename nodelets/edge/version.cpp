// SPDX-License-Identifier: MIT
#include "edge/version.h"

namespace semantic_lidar_fusion {

const char kVersion[] = SLF_VERSION;

std::string configurationText(const Rig& rig) {
  return std::string("# semantic_lidar_fusion ") + kVersion + "\n" + rig.yaml;
}

std_msgs::String configurationMessage(const Rig& rig) {
  std_msgs::String message;
  message.data = configurationText(rig);
  return message;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The command line of fuse_bag.
#pragma once

#include <string>
#include <vector>

#include "tools/common/command_line.h"

namespace semantic_lidar_fusion {

struct FuseBagOptions : CommonOptions {
  std::vector<std::string> inputs;  ///< the bags of one drive
  std::string output;
  std::string rig;
  std::vector<std::string> overrides;  ///< --set key=value
  bool true_visibility = false;        ///< --truth visibility
  bool all = false;
  bool tf = false;
  bool print_rig = false;
};

/// Throws UsageError.
FuseBagOptions parseFuseBagOptions(const std::vector<std::string>& arguments);

extern const char kFuseBagUsage[];

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The command line of fuse_bag.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "tools/common/command_line.h"

namespace semantic_lidar_fusion {

/// One output.
struct OutputOptions {
  std::string path;
  std::vector<std::string> overrides;  ///< --set key=value
  bool true_visibility = false;        ///< --truth visibility
  std::string report;                  ///< --report FILE.html; empty: none
};

struct FuseBagOptions : CommonOptions {
  std::vector<std::string> inputs;  ///< the bags of one drive
  std::vector<OutputOptions> outputs = std::vector<OutputOptions>(1);
  std::string rig;
  int jobs = 0;                 ///< threads; 0: one for each processor
  double start_s = 0.0;         ///< since the first message
  std::optional<double> end_s;  ///< the same; empty: to the last one
  bool uncompressed = false;
  bool all = false;
  bool tf = true;
  bool print_rig = false;
};

/// Throws UsageError.
FuseBagOptions parseFuseBagOptions(const std::vector<std::string>& arguments);

extern const char kFuseBagUsage[];

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The command line of fuse_bag.
#pragma once

#include <stdexcept>
#include <string>
#include <vector>

namespace semantic_lidar_fusion {

struct FuseBagOptions {
  std::vector<std::string> inputs;  ///< the bags of one drive
  std::string output;
  std::string rig;
  std::vector<std::string> overrides;  ///< --set key=value
  bool true_visibility = false;        ///< --truth visibility
  bool all = false;
  bool tf = false;
  bool force = false;
  bool quiet = false;
  bool print_rig = false;
  bool version = false;
  bool help = false;
};

/// The command line is wrong; what() says how.
class UsageError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Throws UsageError.
FuseBagOptions parseFuseBagOptions(const std::vector<std::string>& arguments);

extern const char kFuseBagUsage[];

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/fuse_bag_options.h"

namespace semantic_lidar_fusion {

const char kFuseBagUsage[] =
    R"(usage: fuse_bag IN.bag [IN.bag ...] OUT.bag --rig FILE [options]
       fuse_bag --print-rig --rig FILE [--set KEY=VALUE]

Transfers camera semantics to the lidar points of a bag: the whole pipeline, without a ROS master,
as fast as the machine allows. The same input gives the same bytes.

  IN.bag           lidar, camera_info, tf (or odometry), images and scores; several bags are one
                   drive (rosbag record --split, images or tf_static apart)
  OUT.bag          /scan_reference, /points_compensated, /points_semantic, /class_info,
                   /configuration (the rig as used) and for each camera /<camera>/selection

options:
  --rig FILE       the rig file (see config/usyd.yaml)
  --set KEY=VALUE  override a key of the rig file, e.g. --set occlusion.mode=paper; repeatable
  --all            also write for each camera superpixels, share, probabilities, scores (where the
                   package's own network made them), projection_overlay and uncertainty_overlay
  --tf             also copy /tf and /tf_static to OUT.bag
  --truth visibility
                   let the bag's /points_truth, and no mask, say which camera sees which point
  --force          replace OUT.bag whatever it is; without, an earlier output only
  --quiet          no progress and no summary
  --print-rig      print the rig file with --set applied and every default filled in, and end; the
                   output is a rig file
  --version        print the version
  --help           this text

Exit codes: 0 done; 1 failed (then OUT.bag is as before), or done, but no point got a class though
the rig has cameras; 2 wrong command line.
)";

FuseBagOptions parseFuseBagOptions(const std::vector<std::string>& arguments) {
  FuseBagOptions options;
  std::vector<std::string> files;
  bool only_files = false;
  for (std::size_t i = 0; i < arguments.size(); ++i) {
    const std::string& argument = arguments[i];
    if (only_files || argument.size() < 2 || argument[0] != '-') {
      files.push_back(argument);
      continue;
    }
    const std::size_t equals = argument.find('=');
    const std::string name = argument.substr(0, equals);
    const bool takes_value = name == "--rig" || name == "--set" || name == "--truth";
    if (!takes_value && equals != std::string::npos) {
      throw UsageError("unknown option " + argument);
    }
    std::string value;
    if (takes_value) {
      if (equals != std::string::npos) {
        value = argument.substr(equals + 1);
      } else if (++i < arguments.size()) {
        value = arguments[i];
      } else {
        throw UsageError(name + " needs a value");
      }
    }
    if (name == "--") {
      only_files = true;
    } else if (name == "--rig") {
      options.rig = value;
    } else if (name == "--set") {
      if (value.find('=') == std::string::npos) {
        throw UsageError("--set " + value + ": KEY=VALUE is wanted");
      }
      options.overrides.push_back(value);
    } else if (name == "--truth") {
      if (value != "visibility") throw UsageError("--truth " + value + ": must be visibility");
      options.true_visibility = true;
    } else if (name == "--all") {
      options.all = true;
    } else if (name == "--tf") {
      options.tf = true;
    } else if (name == "--force") {
      options.force = true;
    } else if (name == "--quiet" || name == "-q") {
      options.quiet = true;
    } else if (name == "--print-rig") {
      options.print_rig = true;
    } else if (name == "--version") {
      options.version = true;
      return options;
    } else if (name == "--help" || name == "-h") {
      options.help = true;
      return options;
    } else {
      throw UsageError("unknown option " + argument);
    }
  }
  if (options.rig.empty() && (options.print_rig || files.size() >= 2)) {
    throw UsageError("--rig FILE is wanted");
  }
  if (options.print_rig) {
    if (!files.empty()) throw UsageError("--print-rig takes no bag; " + files[0] + " was given");
    return options;
  }
  if (files.size() < 2) {
    throw UsageError("IN.bag and OUT.bag are wanted; " + std::to_string(files.size()) +
                     " file name" + (files.size() == 1 ? " was" : "s were") + " given");
  }
  options.output = files.back();
  files.pop_back();
  options.inputs = files;
  return options;
}

}  // namespace semantic_lidar_fusion

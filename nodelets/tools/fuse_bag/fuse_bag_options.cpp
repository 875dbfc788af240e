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
  OptionReader reader(&options);
  reader.text("--rig", &options.rig);
  reader.value("--set", [&](const std::string& value) {
    if (value.find('=') == std::string::npos) {
      throw UsageError("--set " + value + ": KEY=VALUE is wanted");
    }
    options.overrides.push_back(value);
  });
  reader.choice<bool>("--truth", {{"visibility", true}}, &options.true_visibility);
  reader.flag("--all", &options.all);
  reader.flag("--tf", &options.tf);
  reader.flag("--print-rig", &options.print_rig);
  std::vector<std::string> files = reader.read(arguments);
  if (options.help || options.version) return options;
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

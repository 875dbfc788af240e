// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/fuse_bag_options.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <thread>

namespace semantic_lidar_fusion {
namespace {

constexpr unsigned kMostJobs = 64;
constexpr double kLongestBagS = 1e9;

}  // namespace

const char kFuseBagUsage[] =
    R"(usage: fuse_bag IN.bag [IN.bag ...] OUT.bag --rig FILE [options]
       fuse_bag --print-rig --rig FILE [--set KEY=VALUE]

Transfers camera semantics to the lidar points of a bag: the whole pipeline, without a ROS master,
as fast as the machine allows. The same input gives the same bytes.

  IN.bag           lidar, camera_info, tf (or odometry), images and scores; several bags are one
                   drive (rosbag record --split, images or tf_static apart)
  OUT.bag          /scan_reference, /points_compensated, /points_semantic, /class_info,
                   /configuration (the rig as used), /tf, /tf_static and for each camera
                   /<camera>/selection, LZ4-compressed

options:
  --rig FILE       the rig file (see config/usyd.yaml)
  --set KEY=VALUE  override a key of the rig file, e.g. --set occlusion.mode=paper; repeatable
  --all            also write for each camera superpixels, share, probabilities, scores (where the
                   package's own network made them), projection_overlay, uncertainty_overlay
                   and points_pixel (pixels and their covariances)
  --no-tf          leave out /tf and /tf_static, without which OUT.bag shows and maps by itself
  --truth visibility
                   let the bag's /points_truth, and no mask, say which camera sees which point
  --report FILE.html
                   also a page about OUT.bag for a browser, with all in one file: points by status
                   and class, scan by scan, a view of a scan and of the map, the settings
                   (make_report.py makes it of any fused bag)
  --also OUT2.bag  make a second output, and so on: the options --set, --truth and --report behind it
                   are its own, those before it are not. Outputs that differ in what comes after the
                   images (motion, odometry.lookup, on_missing and max_extrapolation, uncertainty,
                   occlusion, overlap, smoothing, keep_unlabelled) share the work on the bag and its
                   images
  --start S        fuse the scans recorded from S seconds after the first message on
  --end S          fuse the scans recorded before S seconds after the first message
  --jobs N         threads, 1 to 64 (default: one for each processor); no effect on the result
  --uncompressed   write OUT.bag without compression
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
  double end_s = std::numeric_limits<double>::infinity();
  reader.text("--rig", &options.rig);
  reader.value("--set", [&](const std::string& value) {
    if (value.find('=') == std::string::npos) {
      throw UsageError("--set " + value + ": KEY=VALUE is wanted");
    }
    options.outputs.back().overrides.push_back(value);
  });
  reader.value("--truth", [&](const std::string& value) {
    if (value != "visibility")
      throw UsageError("--truth is '" + value + "'; it must be visibility");
    options.outputs.back().true_visibility = true;
  });
  reader.value("--report", [&](const std::string& value) {
    constexpr char kEnding[] = ".html";
    if (value.size() < sizeof(kEnding) ||
        value.compare(value.size() + 1 - sizeof(kEnding), std::string::npos, kEnding) != 0) {
      throw UsageError("--report is '" + value + "'; it must be a file name that ends in .html");
    }
    options.outputs.back().report = value;
  });
  reader.value("--also", [&](const std::string& value) {
    if (value.empty()) throw UsageError("--also needs the name of a bag");
    options.outputs.emplace_back();
    options.outputs.back().path = value;
  });
  reader.number("--start", 0.0, kLongestBagS, &options.start_s);
  reader.number("--end", 0.0, kLongestBagS, &end_s);
  reader.wholeNumber("--jobs", 1, kMostJobs, &options.jobs);
  reader.flag("--uncompressed", &options.uncompressed);
  reader.flag("--all", &options.all);
  bool without_tf = false;
  reader.flag("--no-tf", &without_tf);
  reader.flag("--tf", &options.tf);  // the default
  reader.flag("--print-rig", &options.print_rig);
  std::vector<std::string> files = reader.read(arguments);
  options.tf = !without_tf;
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
  if (std::isfinite(end_s)) options.end_s = end_s;
  if (options.start_s >= end_s) throw UsageError("--start must come before --end");
  if (options.jobs == 0) {
    options.jobs = static_cast<int>(std::clamp(std::thread::hardware_concurrency(), 1u, kMostJobs));
  }
  options.outputs.front().path = files.back();
  files.pop_back();
  options.inputs = files;
  return options;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// fuse_bag: the whole pipeline offline. See kFuseBagUsage.
#include <malloc.h>
#include <sys/stat.h>

#include <algorithm>
#include <string>

#include "edge/version.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "tools/common/command_line.h"
#include "tools/fuse_bag/bag_fusion.h"
#include "tools/fuse_bag/fuse_bag_options.h"
#include "tools/fuse_bag/report_page.h"

namespace semantic_lidar_fusion {
namespace {

bool sameFile(const std::string& a, const std::string& b) {
  struct stat status_a {
  }, status_b{};
  if (::stat(a.c_str(), &status_a) != 0 || ::stat(b.c_str(), &status_b) != 0) return a == b;
  return status_a.st_dev == status_b.st_dev && status_a.st_ino == status_b.st_ino;
}

/// Images come and go by the second. Without this the C library gives the memory of each back to
/// the system and gets it anew, which takes a seventh of the time.
void reuseMemory() {
#ifdef __GLIBC__
  constexpr int kLargest = 32 << 20;  // the most that it takes for the first
  ::mallopt(M_MMAP_THRESHOLD, kLargest);
  ::mallopt(M_TRIM_THRESHOLD, 4 * kLargest);
  ::mallopt(M_ARENA_MAX, 2);
#endif
}

/// No output is an input or another output.
void checkNames(const FuseBagOptions& options) {
  for (auto output = options.outputs.begin(); output != options.outputs.end(); ++output) {
    for (const std::string& input : options.inputs) {
      if (sameFile(input, output->path)) throw Error(output->path + ": is the input bag itself");
    }
    for (auto other = options.outputs.begin(); other != output; ++other) {
      if (sameFile(other->path, output->path)) throw Error(output->path + ": is given twice");
    }
  }
}

bool wantsReport(const FuseBagOptions& options) {
  return std::any_of(options.outputs.begin(), options.outputs.end(),
                     [](const OutputOptions& output) { return !output.report.empty(); });
}

void fuse(const FuseBagOptions& options) {
  if (options.print_rig) {
    printText(configurationText(loadRig(options.rig, options.outputs.front().overrides)));
    return;
  }
  checkNames(options);
  const std::string report_program = wantsReport(options) ? reportProgram() : "";
  reuseMemory();
  BagFusion fusion(options, endIfInterrupted);
  fusion.run();
  if (!options.quiet) printText(fusion.summary());
  for (const OutputOptions& output : options.outputs) {
    if (output.report.empty()) continue;
    writeReport(report_program, output.path, output.report, options.quiet);
  }
  const std::string failure = fusion.whyNothingIsFused();
  if (!failure.empty()) throw Error(failure);
}

}  // namespace
}  // namespace semantic_lidar_fusion

int main(int argc, char** argv) {
  using namespace semantic_lidar_fusion;
  return runTool("fuse_bag", kFuseBagUsage, parseFuseBagOptions, fuse, argc, argv);
}

// SPDX-License-Identifier: MIT
/// fuse_bag: the whole pipeline offline. See kFuseBagUsage.
#include <console_bridge/console.h>
#include <sys/stat.h>

#include <csignal>
#include <cstdio>
#include <exception>
#include <string>
#include <vector>

#include "edge/version.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "tools/fuse_bag/bag_fusion.h"
#include "tools/fuse_bag/fuse_bag_options.h"

namespace semantic_lidar_fusion {
namespace {

volatile std::sig_atomic_t caught_signal = 0;

void rememberSignal(int signal) { caught_signal = signal; }

/// A signal asked for the end; what was written is removed on the way out.
struct Interrupted {};

void endIfInterrupted() {
  if (caught_signal != 0) throw Interrupted();
}

bool sameFile(const std::string& a, const std::string& b) {
  struct stat status_a {
  }, status_b{};
  if (::stat(a.c_str(), &status_a) != 0 || ::stat(b.c_str(), &status_b) != 0) return a == b;
  return status_a.st_dev == status_b.st_dev && status_a.st_ino == status_b.st_ino;
}

/// Throws Error where nobody takes the text: a full disk, a closed stdout.
void print(const std::string& text) {
  if (std::fputs(text.c_str(), stdout) < 0 || std::fflush(stdout) != 0) {
    throw Error("stdout: cannot be written");
  }
}

void fuse(const FuseBagOptions& options) {
  for (const std::string& input : options.inputs) {
    if (sameFile(input, options.output)) {
      throw Error(options.output + ": is the input bag itself");
    }
  }
  BagFusion fusion(options, endIfInterrupted);
  fusion.run();
  if (!options.quiet) std::fputs(fusion.summary().c_str(), stdout);
  const std::string failure = fusion.whyNothingIsFused();
  if (!failure.empty()) throw Error(failure);
}

int run(const std::vector<std::string>& arguments) {
  try {
    const FuseBagOptions options = parseFuseBagOptions(arguments);
    if (options.help) {
      print(kFuseBagUsage);
      return 0;
    }
    if (options.version) {
      print(std::string("fuse_bag ") + kVersion + "\n");
      return 0;
    }
    if (options.print_rig) {
      print(configurationText(loadRig(options.rig, options.overrides)));
      return 0;
    }
    fuse(options);
    return 0;
  } catch (const UsageError& e) {
    std::fprintf(stderr, "fuse_bag: %s\nTry: fuse_bag --help\n", e.what());
    return 2;
  } catch (const Interrupted&) {
    std::fprintf(stderr, "fuse_bag: interrupted; nothing was written\n");
    return 128 + caught_signal;
  } catch (const std::exception& e) {
    std::fprintf(stderr, "fuse_bag: error: %s\n", e.what());
    return 1;
  }
}

}  // namespace
}  // namespace semantic_lidar_fusion

int main(int argc, char** argv) {
  // Libraries below report through exceptions too; their own lines would come twice.
  console_bridge::setLogLevel(console_bridge::CONSOLE_BRIDGE_LOG_NONE);
  struct sigaction action {};
  action.sa_handler = semantic_lidar_fusion::rememberSignal;
  ::sigaction(SIGINT, &action, nullptr);
  ::sigaction(SIGTERM, &action, nullptr);
  ::signal(SIGXFSZ, SIG_IGN);  // a file size limit is then an error of the write
  return semantic_lidar_fusion::run(std::vector<std::string>(argv + 1, argv + argc));
}

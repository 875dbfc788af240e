// SPDX-License-Identifier: MIT
// Reads an ONNX network and runs it once; for SegmentationModel, which trusts no file.
#include <sys/resource.h>

#include <cstdio>
#include <cstdlib>
#include <exception>
#include <string>

#include "semantic_lidar_fusion/segmentation/network_check.h"

namespace {

using semantic_lidar_fusion::ImageSize;
using semantic_lidar_fusion::NetworkShape;

const char* const kUsage =
    "usage: check_network NETWORK.onnx WIDTH HEIGHT\n"
    "Reads a network, runs it on an empty image of that size and prints the channels, rows and\n"
    "columns of its output. Exit code 1, and a line that says why, if it cannot be used.\n";

void limit(int resource, rlim_t value) {
  const rlimit both{value, value};
  setrlimit(static_cast<decltype(RLIMIT_CPU)>(resource), &both);
}

/// A damaged network may ask for anything.
void limitResources() {
  limit(RLIMIT_CORE, 0);
  limit(RLIMIT_CPU, semantic_lidar_fusion::kCheckSeconds);
#if !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
  limit(RLIMIT_AS, rlim_t{16} << 30);  // sanitizers reserve more than there is
#endif
}

}  // namespace

int main(int argc, char** argv) {
  if (argc == 2 && std::string(argv[1]) == "--help") {
    std::fputs(kUsage, stdout);
    return 0;
  }
  const ImageSize input{argc == 4 ? std::atoi(argv[2]) : 0, argc == 4 ? std::atoi(argv[3]) : 0};
  if (input.width < 1 || input.height < 1) {
    std::fputs(kUsage, stderr);
    return 2;
  }
  limitResources();
  try {
    const NetworkShape shape = semantic_lidar_fusion::examineNetwork(argv[1], input);
    std::printf("%d %d %d\n", shape.channels, shape.rows, shape.columns);
    return 0;
  } catch (const std::exception& problem) {
    std::printf("%s\n", problem.what());
    return 1;
  }
}

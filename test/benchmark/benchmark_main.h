// SPDX-License-Identifier: MIT
#pragma once

#include <benchmark/benchmark.h>
#include <malloc.h>

namespace semantic_lidar_fusion {

/// BENCHMARK_MAIN with a heap that is warm, as that of a node which has run for a while: freed
/// memory stays with the process.
inline int runBenchmarksWithWarmHeap(int argc, char** argv) {
  mallopt(M_MMAP_THRESHOLD, 1 << 25);
  mallopt(M_TRIM_THRESHOLD, 1 << 28);
  benchmark::Initialize(&argc, argv);
  if (benchmark::ReportUnrecognizedArguments(argc, argv)) return 1;
  benchmark::RunSpecifiedBenchmarks();
  return 0;
}

}  // namespace semantic_lidar_fusion

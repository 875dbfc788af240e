// SPDX-License-Identifier: MIT
#include "time_kernels.h"

namespace semantic_lidar_fusion {
namespace {

void span(const std::int64_t* times, int count, std::int64_t* first, std::int64_t* last) {
  *first = *last = times[0];
  for (int i = 1; i < count; ++i) {
    *first = times[i] < *first ? times[i] : *first;
    *last = times[i] > *last ? times[i] : *last;
  }
}

}  // namespace

const TimeKernels kPlainTimeKernels = {"plain", span};

TimeKernelList usableTimeKernels() {
  TimeKernelList list{1, {&kPlainTimeKernels, nullptr}};
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) list.kernels[list.count++] = &kAvx2TimeKernels;
#endif
  return list;
}

}  // namespace semantic_lidar_fusion

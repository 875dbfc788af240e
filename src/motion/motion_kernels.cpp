// SPDX-License-Identifier: MIT
#include "motion_kernels.h"

namespace semantic_lidar_fusion {
namespace {

int timesWithin(const std::int64_t* times, int count, std::int64_t begin, std::uint32_t length,
                float* ns) {
  // Earlier times wrap to large numbers.
  const auto since = [&](int i) {
    return static_cast<std::uint64_t>(times[i]) - static_cast<std::uint64_t>(begin);
  };
  bool all = true;
  for (int i = 0; i < count; ++i) {
    all &= since(i) <= length;
    ns[i] = static_cast<float>(static_cast<std::int32_t>(since(i)));
  }
  if (all) return count;
  int within = 0;
  while (since(within) <= length) ++within;
  return within;
}

void move(const LinearMotion& motion, const float* ns, int count, float* __restrict x,
          float* __restrict y, float* __restrict z) {
  const float* const a = motion.start;
  const float* const r = motion.rate_per_ns;
  const auto row = [a, r](int k, float px, float py, float pz, float t) {
    const float start = (a[k] * px + a[k + 1] * py) + (a[k + 2] * pz + a[k + 3]);
    const float rate = (r[k] * px + r[k + 1] * py) + (r[k + 2] * pz + r[k + 3]);
    return start + t * rate;
  };
  for (int i = 0; i < count; ++i) {
    const float px = x[i], py = y[i], pz = z[i];
    x[i] = row(0, px, py, pz, ns[i]);
    y[i] = row(4, px, py, pz, ns[i]);
    z[i] = row(8, px, py, pz, ns[i]);
  }
}

void secondsSince(std::int64_t reference, const std::int64_t* times, int count, float* seconds) {
  for (int i = 0; i < count; ++i) {
    seconds[i] = static_cast<float>(1e-9 * static_cast<std::int32_t>(times[i] - reference));
  }
}

}  // namespace

const MotionKernels kPlainMotionKernels = {"plain", timesWithin, move, secondsSince};

MotionKernelList usableMotionKernels() {
  MotionKernelList list{1, {&kPlainMotionKernels, nullptr}};
#ifdef SLF_HAVE_AVX2
  if (__builtin_cpu_supports("avx2")) list.kernels[list.count++] = &kAvx2MotionKernels;
#endif
  return list;
}

}  // namespace semantic_lidar_fusion

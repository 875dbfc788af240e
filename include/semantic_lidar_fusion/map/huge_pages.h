// SPDX-License-Identifier: MIT
/// Memory for large tables that are read at random: asks the system for pages of 2 MiB, which spare
/// most misses of the address cache and most page faults. Where there are none, it is plain memory.
#pragma once

#include <sys/mman.h>

#include <cstddef>
#include <cstdlib>
#include <new>

namespace semantic_lidar_fusion {

constexpr std::size_t kHugePage = std::size_t{1} << 21;

/// `bytes` of memory without initial value, to be given back with std::free. Throws std::bad_alloc.
inline void* allocateHuge(std::size_t bytes) {
  const bool large = bytes >= kHugePage;
  const std::size_t whole = (bytes + kHugePage - 1) / kHugePage * kHugePage;
  void* const memory = large ? std::aligned_alloc(kHugePage, whole) : std::malloc(bytes);
  if (!memory) throw std::bad_alloc();
#ifdef MADV_HUGEPAGE
  // A refusal only costs time.
  if (large) static_cast<void>(::madvise(memory, whole, MADV_HUGEPAGE));
#endif
  return memory;
}

/// For containers.
template <typename T>
struct HugePageAllocator {
  using value_type = T;
  HugePageAllocator() = default;
  template <typename U>
  HugePageAllocator(const HugePageAllocator<U>& /*other*/) {}
  T* allocate(std::size_t count) { return static_cast<T*>(allocateHuge(count * sizeof(T))); }
  void deallocate(T* memory, std::size_t /*count*/) { std::free(memory); }
};

template <typename T, typename U>
bool operator==(const HugePageAllocator<T>& /*a*/, const HugePageAllocator<U>& /*b*/) {
  return true;
}
template <typename T, typename U>
bool operator!=(const HugePageAllocator<T>& /*a*/, const HugePageAllocator<U>& /*b*/) {
  return false;
}

}  // namespace semantic_lidar_fusion

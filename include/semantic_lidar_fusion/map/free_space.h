// SPDX-License-Identifier: MIT
/// Space that rays of a lidar crossed, in bricks of 8 x 8 x 8 voxels.
///
/// For each voxel that never held a return a brick counts, up to kMaxPasses, the scans of which a
/// ray crossed it; a voxel with returns is `claimed`, and its passes are counted in its own record
/// (voxel_map.h). A scan counts once for a voxel, however many of its rays crossed it, and not at
/// all for the voxels that hold its own returns and their 26 neighbours: there a ray grazes what
/// the scan itself saw (ground at a flat angle, leaves, an edge).
///
/// Which voxels a ray crosses is found in double precision with the digital differential analyser
/// of Amanatides and Woo, "A fast voxel traversal algorithm for ray tracing" (1987); the plain
/// numpy version in scripts/ takes the same steps.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace semantic_lidar_fusion {

/// Passes are counted up to this number; sums of more stay there.
constexpr std::uint32_t kMaxPasses = 15;

/// Passes of the voxels of a brick, in memory and, little-endian, in files. Voxel (x, y, z) of the
/// brick is bit 8 y + x of word z; plane k holds the bits of worth 2^k of the counts.
struct FreeBrick {
  static constexpr int kBits = 3;
  static constexpr int kPlanes = 4;
  std::int32_t x = 0, y = 0, z = 0;  ///< voxel index >> kBits
  std::uint32_t unused = 0;
  std::uint64_t planes[kPlanes][8] = {};
};
static_assert(sizeof(FreeBrick) == 272, "the brick is also the file's layout");

/// A voxel's index.
using VoxelKey = std::array<std::int32_t, 3>;

/// Rows (rotation, translation) of a rigid transform between voxel indices of two maps.
using MovedVoxels = std::array<std::array<double, 4>, 3>;

/// From where a point was seen to where it lies, in voxels.
struct Ray {
  double origin[3];
  double end[3];
};

/// Values with a brick's x, y, z, found by them; in order of arrival.
template <typename Value>
class BrickTable {
 public:
  Value* find(std::int32_t x, std::int32_t y, std::int32_t z);
  /// The index of the brick in values(), made if it is not there.
  std::size_t findOrMake(std::int32_t x, std::int32_t y, std::int32_t z);
  std::vector<Value>& values() { return values_; }
  const std::vector<Value>& values() const { return values_; }
  void clear();
  /// After values() were changed.
  void rebuild();
  std::size_t memoryBytes() const;

 private:
  std::size_t slotOf(std::int32_t x, std::int32_t y, std::int32_t z) const;
  std::vector<Value> values_;
  std::vector<std::uint32_t> slots_;  ///< index + 1; 0 = free
};

class FreeSpace {
 public:
  /// The voxel has a record: its count goes there and is given back.
  std::uint32_t claim(const VoxelKey& voxel);

  /// Marks what a ray crosses, no further than `reach` (voxels) from its origin.
  void cast(const Ray& ray, double reach);
  /// Spares a voxel with a return of the scan, and its neighbours.
  void spare(const VoxelKey& voxel);
  /// Ends the scan: counts what was marked and not spared, and appends to `passed` those of it that
  /// are claimed.
  void finishScan(std::vector<VoxelKey>* passed);

  /// Adds a brick of a later map, and appends its claimed voxels with passes to `passed`, the
  /// counts to `counts`.
  void add(const FreeBrick& brick, std::vector<VoxelKey>* passed,
           std::vector<std::uint32_t>* counts);
  /// Adds bricks of a map whose voxels lie elsewhere, `theirs_ours`: a voxel gets the count of
  /// theirs at its centre, unless it is claimed.
  void addMoved(const std::vector<FreeBrick>& bricks, const MovedVoxels& theirs_ours);
  /// Bricks with passes, in order of tile, x, y, z if `sorted`.
  std::vector<FreeBrick> bricks(bool sorted) const;

  /// Forgets the voxels outside [min, max], and all claims.
  void keepInside(const VoxelKey& min, const VoxelKey& max);
  void clear();
  std::size_t memoryBytes() const;

 private:
  struct Counted : FreeBrick {
    std::uint64_t claimed[8] = {};
  };
  void addPasses(const VoxelKey& voxel, std::uint32_t count);
  struct Marked {
    std::int32_t x = 0, y = 0, z = 0;
    std::uint64_t crossed[8] = {}, spared[8] = {};
  };
  BrickTable<Counted> counted_;
  BrickTable<Marked> marked_;  ///< of the scan
};

}  // namespace semantic_lidar_fusion

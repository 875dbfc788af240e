// SPDX-License-Identifier: MIT
/// Voxel map of class distributions: a flat hash table over records of whole numbers.
///
/// Everything in a record is a sum, a least or a greatest value of integers, so that a map does not
/// depend on the order of its points, and maps of parts of a drive add up to the map of the whole,
/// bit for bit. Nothing is clamped or normalised here; readers of a record do that.
///
/// Voxel (x, y, z) spans [x, x + 1) * voxel_size_m in the map frame; indices come from coordinates
/// in double precision, so that a map may lie at UTM coordinates. Points of dynamic classes have a
/// layer of their own. A record takes 72 + 8 * classes bytes (168 for 12 classes), its place in the
/// table 16 bytes at a load of 3/8 to 3/4.
///
/// Not thread safe.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/map/evidence.h"
#include "semantic_lidar_fusion/map/huge_pages.h"

namespace semantic_lidar_fusion {

struct PlacementConstants;  // of the kernels
struct PlacedPoints;

enum class DynamicPoints { kApart, kExclude, kKeep };

struct VoxelMapConfig {
  double voxel_size_m = 0.2;
  EvidenceConfig evidence;
  double min_range_m = 0.0;           ///< of the point from the lidar; 0 = no limit
  double max_range_m = 0.0;           ///< 0 = no limit
  std::vector<std::uint8_t> dynamic;  ///< one per class, 1 = moves by itself; empty = none
  DynamicPoints dynamic_points = DynamicPoints::kApart;
};

/// The begin of a voxel's record in memory and, little-endian, in files; 64-bit evidence of each
/// class follows it.
struct VoxelHeader {
  std::int32_t x = 0, y = 0, z = 0;  ///< voxel index
  std::uint32_t layer = 0;           ///< 0 static, 1 dynamic
  std::uint32_t observations = 0;    ///< points of status 0 to 3; stays at its greatest value
  std::uint32_t labelled = 0;        ///< those of status 0, whose evidence is in the sums
  std::int64_t sum_x = 0, sum_y = 0, sum_z = 0;  ///< offset from the voxel's corner, 2^-20 m
  std::int64_t sum_intensity = 0;                ///< 2^-20
  std::int64_t first_ns = 0, last_ns = 0;        ///< stamps of the first and last cloud
};
static_assert(sizeof(VoxelHeader) == 72, "the record is also the file's layout");

/// A column of values that lie `stride` bytes apart.
struct Column {
  const std::uint8_t* data = nullptr;
  std::ptrdiff_t stride = 0;
};

/// A semantic cloud in the lidar frame, as it lies in its message.
struct SemanticPoints {
  std::size_t count = 0;
  Column x, y, z;        ///< float, m
  Column intensity;      ///< float; data may be null
  Column status, label;  ///< uint8
  Column probabilities;  ///< float, one row of classes each
};

/// What became of the points of a cloud.
struct IntegrationCounts {
  std::size_t labelled = 0;      ///< evidence added
  std::size_t occupied = 0;      ///< status 1 to 3 (or 0 with a broken distribution): counted only
  std::size_t no_odometry = 0;   ///< status 4 or unknown
  std::size_t out_of_range = 0;  ///< range limits, and voxels beyond 2^29
  std::size_t excluded = 0;      ///< dynamic and to be left out
  std::size_t invalid = 0;       ///< of all: position or distribution not finite
};

class VoxelMap {
 public:
  /// Throws ConfigError naming every value that breaks its rule.
  explicit VoxelMap(const VoxelMapConfig& config);

  const VoxelMapConfig& config() const { return config_; }
  int classCount() const { return evidence_.classCount(); }
  std::size_t size() const { return size_; }
  /// Bytes of a record.
  std::size_t recordSize() const { return words_ * sizeof(std::int64_t); }
  /// Bytes allocated for records and table.
  std::size_t memoryBytes() const;

  /// Adds a cloud, seen from the pose T_map_lidar at `stamp`.
  IntegrationCounts integrate(const SemanticPoints& points, const Transform& T_map_lidar,
                              StampNs stamp);

  /// Adds voxels of a map with the same evidence, as `records` gives them. Throws DataError unless
  /// `bytes` is a whole number of records.
  void add(const std::uint8_t* records, std::size_t bytes);
  /// All records, in canonical order if `sorted`: by tile in x, tile in y, layer, then voxel in x,
  /// y, z. Equal maps give equal bytes.
  std::vector<std::uint8_t> records(bool sorted = true) const;

  /// Forgets the voxels outside [min, max], in voxel indices.
  void keepInside(const std::array<std::int32_t, 3>& min, const std::array<std::int32_t, 3>& max);
  void clear();

  /// The tile of a voxel index: 256 voxels wide.
  static std::int32_t tileOf(std::int32_t index) { return index >> kTileBits; }
  static constexpr int kTileBits = 8;

 private:
  struct Slot {
    std::uint64_t xy = 0;
    std::uint32_t z_layer = 0;
    std::uint32_t index = 0;  ///< of the record, plus 1; 0 = free
  };
  struct Batch;

  std::int64_t* record(std::size_t index) const {
    return chunks_[index >> kChunkBits] + (index & (kChunkSize - 1)) * words_;
  }
  static std::uint64_t hashOf(std::uint64_t xy, std::uint32_t z_layer);
  void place(const Slot& slot);
  std::int64_t* findOrMake(std::uint64_t xy, std::uint32_t z_layer, std::uint64_t hash);
  void grow();
  void addBlock();
  std::size_t chunksOfBlock(std::size_t first_chunk) const;
  std::size_t bytesOfBlock(std::size_t chunks) const;
  void integrateBatch(const PlacementConstants& pose, StampNs stamp, Batch* batch,
                      IntegrationCounts* counts);

  static constexpr int kChunkBits = 9;
  static constexpr std::size_t kChunkSize = std::size_t{1} << kChunkBits;

  VoxelMapConfig config_;
  EvidenceModel evidence_;
  void (*add_evidence_)(const std::int32_t*, int, std::int64_t*);
  void (*place_points_)(const PlacementConstants&, PlacedPoints*);
  std::size_t words_ = 0;  ///< of a record
  std::size_t size_ = 0;
  int shift_ = 0;  ///< 64 - log2 of the number of slots
  std::vector<Slot, HugePageAllocator<Slot>> slots_;
  struct Free {
    void operator()(void* memory) const { std::free(memory); }
  };
  /// Own the chunks: one each for the first ones, so that small maps stay small, then as many as
  /// fit a huge page.
  std::vector<std::unique_ptr<std::int64_t, Free>> blocks_;
  std::vector<std::int64_t*> chunks_;       ///< of kChunkSize records, which never move
  std::vector<float> rows_;                 ///< distributions of a batch
  std::vector<std::int32_t> row_evidence_;  ///< their evidence
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Voxel map of class distributions: a flat hash table over records of whole numbers, and the space
/// that rays crossed (free_space.h).
///
/// All points of a cloud in one voxel are one look at it: their distributions are averaged, without
/// the classes that no return can be of, and the mean gives evidence once. How densely a lidar
/// samples does not matter, then, nor that neighbouring pixels of one image err together.
///
/// What points leave in a record is a sum, a least or a greatest value of integers, so that it does
/// not depend on the order of clouds, and maps of parts of a drive add up to the map of the whole,
/// bit for bit. Rays count what happened after the last return in a voxel: clouds, and maps that
/// are added, come in the order of time. Nothing is clamped, normalised or judged here; readers of
/// a record do that.
///
/// Voxel (x, y, z) spans [x, x + 1) * voxel_size_m in the map frame; indices come from coordinates
/// in double precision, so that a map may lie at UTM coordinates. A record takes 80 + 8 * classes
/// bytes (176 for 12 classes), its place in the table 20 bytes at a load of 3/8 to 3/4.
///
/// Not thread safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/map/evidence.h"
#include "semantic_lidar_fusion/map/free_space.h"
#include "semantic_lidar_fusion/map/huge_pages.h"

namespace semantic_lidar_fusion {

struct PlacementConstants;  // of the kernels
struct PlacedPoints;

struct VoxelMapConfig {
  double voxel_size_m = 0.2;
  EvidenceConfig evidence;
  double min_range_m = 0.0;  ///< of the point from the lidar; 0 = no limit
  double max_range_m = 0.0;  ///< 0 = no limit
  double ray_range_m = 0.0;  ///< how far rays clear; 0 = no rays
  /// One per class, 0 = no return can be of it (sky): it takes no part in a look. Empty = all can.
  std::vector<std::uint8_t> returns;
};

/// The begin of a voxel's record in memory and, little-endian, in files; 64-bit evidence of each
/// class follows it.
struct VoxelHeader {
  std::int32_t x = 0, y = 0, z = 0;  ///< voxel index
  /// Clouds of which rays crossed the voxel and ended elsewhere, since the last return in it; at
  /// most kMaxPasses.
  std::uint32_t passes_after = 0;
  std::uint32_t observations = 0;  ///< points of status 0 to 3; stays at its greatest value
  std::uint32_t looks = 0;         ///< clouds with such points
  std::uint32_t labelled = 0;      ///< looks with a distribution, whose evidence is in the sums
  std::uint32_t passes = 0;        ///< as passes_after, from the begin; at most kMaxPasses
  std::int64_t sum_x = 0, sum_y = 0, sum_z = 0;  ///< offset from the voxel's corner, 2^-20 m
  std::int64_t sum_intensity = 0;                ///< 2^-20
  std::int64_t first_ns = 0, last_ns = 0;        ///< stamps of the first and last cloud
};
static_assert(sizeof(VoxelHeader) == 80, "the record is also the file's layout");

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
  Column status;         ///< uint8
  Column probabilities;  ///< float, one row of classes each
  /// Where the lidar was when it measured each point, 3 values each, m in the map frame. Null: at
  /// the cloud's pose for all.
  const double* origins = nullptr;
  /// uint8, as VoxelMap::passesAt gave them: clouds whose rays crossed the place since its last
  /// return. Data null: this cloud's rays are cast; else nothing is cast, and a voxel has passed
  /// the least of its points (of all clouds).
  Column passes;
};

/// What became of the points of a cloud.
struct IntegrationCounts {
  std::size_t labelled = 0;      ///< took part in a look with a distribution
  std::size_t occupied = 0;      ///< status 1 to 3 (or 0 with a broken distribution): counted only
  std::size_t no_odometry = 0;   ///< status 4 or unknown
  std::size_t out_of_range = 0;  ///< range limits, and voxels beyond 2^29
  std::size_t invalid = 0;  ///< of all: no return (0, 0, 0), position or distribution not finite
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

  /// Adds the voxels and bricks of a later map with the same evidence, as `records` and `bricks`
  /// give them. Throws DataError unless both are whole numbers of them.
  void add(const std::uint8_t* records, std::size_t bytes, const std::uint8_t* bricks = nullptr,
           std::size_t brick_bytes = 0);
  /// Adds bricks of a map whose frame lies elsewhere, T_theirs_ours: a voxel here was crossed as
  /// often as theirs at its centre. Voxels with a record stay as they are. Throws DataError
  /// likewise.
  void addMoved(const std::uint8_t* bricks, std::size_t bytes, const Transform& T_theirs_ours);
  /// passes_after of the voxel of each point, 0 without one; `passes` holds points.count.
  void passesAt(const SemanticPoints& points, const Transform& T_map_lidar,
                std::uint8_t* passes) const;
  /// All records, in canonical order if `sorted`: by tile in x, tile in y, then voxel in x, y, z.
  /// Equal maps give equal bytes.
  std::vector<std::uint8_t> records(bool sorted = true) const;
  /// FreeBricks of the crossed voxels without a record, likewise.
  std::vector<std::uint8_t> bricks(bool sorted = true) const;

  /// Forgets the voxels outside [min, max], in voxel indices.
  void keepInside(const VoxelKey& min, const VoxelKey& max);
  void clear();

  /// The tile of a voxel index: 256 voxels wide.
  static std::int32_t tileOf(std::int32_t index) { return index >> kTileBits; }
  static constexpr int kTileBits = 8;

 private:
  struct Slot {
    std::uint64_t xy = 0;
    std::uint32_t z = 0;
    std::uint32_t index = 0;  ///< of the record, plus 1; 0 = free
  };
  /// All points of the cloud in one voxel; its sums lie in look_sums_.
  struct Look {
    std::uint32_t record = 0;
    std::uint32_t labelled = 0;
  };
  struct Batch;

  std::int64_t* record(std::size_t index) const {
    return chunks_[index >> kChunkBits] + (index & (kChunkSize - 1)) * words_;
  }
  static std::uint64_t hashOf(std::uint64_t xy, std::uint32_t z);
  void place(const Slot& slot);
  std::uint32_t findOrMake(std::uint64_t xy, std::uint32_t z, std::uint64_t hash);
  std::int64_t* find(const VoxelKey& voxel) const;
  void grow();
  void addBlock();
  std::size_t chunksOfBlock(std::size_t first_chunk) const;
  std::size_t bytesOfBlock(std::size_t chunks) const;
  void integrateBatch(const PlacementConstants& pose, Batch* batch, IntegrationCounts* counts);
  Look& lookAt(std::uint32_t record, std::size_t* index);
  void finishLooks(StampNs stamp);
  int meanOfLook(std::size_t look, float* mean) const;
  void addRay(const PlacementConstants& pose, const Batch& batch, int i);
  void castRays();
  static void addPasses(std::uint32_t count, std::int64_t* record);
  void addRecord(const std::uint8_t* at);

  static constexpr int kChunkBits = 9;
  static constexpr std::size_t kChunkSize = std::size_t{1} << kChunkBits;

  VoxelMapConfig config_;
  EvidenceModel evidence_;
  void (*add_evidence_)(const std::int32_t*, int, std::int64_t*);
  void (*place_points_)(const PlacementConstants&, PlacedPoints*);
  void (*quantise_)(const float*, std::size_t, const EvidenceConstants&, const std::int32_t*,
                    std::int32_t*);
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
  std::vector<std::int64_t*> chunks_;  ///< of kChunkSize records, which never move
  FreeSpace free_;
  std::vector<float> rows_;                 ///< distributions of a batch
  std::vector<std::int32_t> row_evidence_;  ///< what they give
  // Of the cloud that is being integrated.
  bool casts_ = false;  ///< its rays tell what they cross
  std::vector<Look> looks_;
  std::vector<std::int64_t> look_sums_;        ///< of probabilities, 2^-20
  std::vector<std::uint32_t> look_of_record_;  ///< holds where looks_ says so, too
  std::vector<Ray> rays_;
};

}  // namespace semantic_lidar_fusion

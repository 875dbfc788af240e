// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/map/voxel_map.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <string>
#include <tuple>

#include "map_kernels.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

constexpr std::size_t kHeaderWords = sizeof(VoxelHeader) / sizeof(std::int64_t);
constexpr int kFirstSlotBits = 12;
constexpr std::size_t kMaxLoad[2] = {3, 4};  // 3/4 of the slots
constexpr double kIntensityUnit = 1048576.0;
constexpr float kMaxIntensity = 1e6f;
constexpr std::size_t kPointsAhead = 24;  // to fetch into the cache

template <typename Value>
Value valueAt(const Column& column, std::size_t row) {
  Value value;
  std::memcpy(&value, column.data + static_cast<std::ptrdiff_t>(row) * column.stride, sizeof value);
  return value;
}

/// floor() of |value| < 2^62; the library's is a call on processors before SSE 4.1.
inline std::int64_t floorOf(double value) {
  const std::int64_t whole = static_cast<std::int64_t>(value);
  return whole - (value < static_cast<double>(whole) ? 1 : 0);
}

std::uint64_t packXy(std::int32_t x, std::int32_t y) {
  return static_cast<std::uint64_t>(static_cast<std::uint32_t>(x)) << 32 |
         static_cast<std::uint32_t>(y);
}

std::uint32_t packZ(std::int32_t z, std::uint32_t layer) {
  return static_cast<std::uint32_t>(z) << 1 | layer;
}

std::uint32_t saturatingSum(std::uint32_t a, std::uint32_t b) {
  return b > std::numeric_limits<std::uint32_t>::max() - a
             ? std::numeric_limits<std::uint32_t>::max()
             : a + b;
}

VoxelHeader* header(std::int64_t* record) { return reinterpret_cast<VoxelHeader*>(record); }

/// Copies a row of floats; false if one of them is not finite.
bool copyFinite(const std::uint8_t* from, int count, float* to) {
  constexpr std::uint32_t kExponent = 0x7f800000;
  std::uint32_t wrong = 0;
  for (int c = 0; c < count; ++c) {
    std::uint32_t bits;
    std::memcpy(&bits, from + sizeof(float) * c, sizeof bits);
    std::memcpy(to + c, &bits, sizeof bits);
    wrong |= (bits & kExponent) == kExponent ? 1U : 0U;
  }
  return wrong == 0;
}

/// Canonical order; see VoxelMap::records.
bool isBefore(const VoxelHeader& a, const VoxelHeader& b) {
  const auto key = [](const VoxelHeader& v) {
    return std::make_tuple(VoxelMap::tileOf(v.x), VoxelMap::tileOf(v.y), v.layer, v.x, v.y, v.z);
  };
  return key(a) < key(b);
}

void check(const VoxelMapConfig& config) {
  std::vector<std::string> problems;
  const auto problem = [&](const std::string& name, double value, const std::string& rule) {
    problems.push_back(name + " = " + std::to_string(value) + ": must be " + rule);
  };
  if (!(config.voxel_size_m >= 1e-3 && config.voxel_size_m <= 1e3))
    problem("voxel_size_m", config.voxel_size_m, "from 0.001 to 1000");
  if (!(config.min_range_m >= 0.0)) problem("min_range_m", config.min_range_m, "0 or more");
  if (!(config.max_range_m >= 0.0)) problem("max_range_m", config.max_range_m, "0 or more");
  if (config.max_range_m > 0.0 && config.max_range_m <= config.min_range_m)
    problem("max_range_m", config.max_range_m, "0 or above min_range_m");
  if (!config.dynamic.empty() && config.dynamic.size() != config.evidence.prior.size())
    problem("dynamic", static_cast<double>(config.dynamic.size()), "of as many classes as prior");
  if (!problems.empty()) throw ConfigError(problems);
}

}  // namespace

/// Points that enter the map.
struct VoxelMap::Batch {
  static constexpr int kSize = EvidenceModel::kMaxRows;
  static_assert(kSize == PlacedPoints::kMaxPoints, "one batch for all kernels");
  int count = 0;
  PlacedPoints placed = {};
  std::int64_t intensity[kSize];
  const std::uint8_t* probabilities[kSize];  ///< null = occupied only
  std::uint32_t layer[kSize];
};

VoxelMap::VoxelMap(const VoxelMapConfig& config)
    : config_(config),
      evidence_(config.evidence),
      add_evidence_(addEvidence()),
      place_points_(placePoints()) {
  check(config_);
  if (config_.dynamic.empty()) config_.dynamic.assign(config_.evidence.prior.size(), 0);
  words_ = kHeaderWords + static_cast<std::size_t>(evidence_.classCount());
  const std::size_t values = EvidenceModel::kMaxRows * config_.evidence.prior.size();
  rows_.resize(values);
  row_evidence_.resize(values);
  clear();
}

void VoxelMap::clear() {
  size_ = 0;
  shift_ = 64 - kFirstSlotBits;
  slots_.assign(std::size_t{1} << kFirstSlotBits, Slot{});
  slots_.shrink_to_fit();
  chunks_.clear();
  blocks_.clear();
}

std::size_t VoxelMap::memoryBytes() const {
  std::size_t bytes = slots_.capacity() * sizeof(Slot);
  for (std::size_t chunk = 0; chunk < chunks_.size();) {
    const std::size_t count = chunksOfBlock(chunk);
    bytes += bytesOfBlock(count);
    chunk += count;
  }
  return bytes;
}

inline std::uint64_t VoxelMap::hashOf(std::uint64_t xy, std::uint32_t z_layer) {
  std::uint64_t hash = (xy ^ (xy >> 29)) * 0x9e3779b97f4a7c15ULL;
  hash = (hash ^ (hash >> 32) ^ z_layer) * 0xbf58476d1ce4e5b9ULL;
  return hash ^ (hash << 21);
}

inline void VoxelMap::place(const Slot& slot) {
  const std::size_t mask = slots_.size() - 1;
  std::size_t at = hashOf(slot.xy, slot.z_layer) >> shift_;
  while (slots_[at].index != 0) at = (at + 1) & mask;
  slots_[at] = slot;
}

void VoxelMap::grow() {
  decltype(slots_) old(slots_.size() * 2);
  old.swap(slots_);
  --shift_;
  for (const Slot& slot : old) {
    if (slot.index != 0) place(slot);
  }
}

std::size_t VoxelMap::chunksOfBlock(std::size_t first_chunk) const {
  const std::size_t fit = kHugePage / (kChunkSize * recordSize());
  return first_chunk < fit ? 1 : std::max<std::size_t>(fit, 1);
}

std::size_t VoxelMap::bytesOfBlock(std::size_t chunks) const {
  const std::size_t bytes = chunks * kChunkSize * recordSize();
  return chunks == 1 ? bytes : std::max(bytes, kHugePage);
}

void VoxelMap::addBlock() {
  const std::size_t count = chunksOfBlock(chunks_.size());
  const std::size_t words = kChunkSize * words_;
  blocks_.emplace_back(static_cast<std::int64_t*>(allocateHuge(bytesOfBlock(count))));
  for (std::size_t i = 0; i < count; ++i) chunks_.push_back(blocks_.back().get() + i * words);
}

inline std::int64_t* VoxelMap::findOrMake(std::uint64_t xy, std::uint32_t z_layer,
                                          std::uint64_t hash) {
  const std::size_t mask = slots_.size() - 1;
  std::size_t at = hash >> shift_;
  for (; slots_[at].index != 0; at = (at + 1) & mask) {
    const Slot& slot = slots_[at];
    if (slot.xy == xy && slot.z_layer == z_layer) return record(slot.index - 1);
  }
  if (size_ >= std::numeric_limits<std::uint32_t>::max() - 1)
    throw DataError("voxel map: more than 2^32 voxels; use larger ones, or more tiles");
  if (size_ == chunks_.size() * kChunkSize) addBlock();
  std::int64_t* const made = record(size_);
  std::memset(made, 0, recordSize());
  VoxelHeader* const voxel = header(made);
  voxel->x = static_cast<std::int32_t>(xy >> 32);
  voxel->y = static_cast<std::int32_t>(xy & 0xffffffffU);
  voxel->z = static_cast<std::int32_t>(z_layer) >> 1;
  voxel->layer = z_layer & 1U;
  voxel->first_ns = std::numeric_limits<std::int64_t>::max();
  voxel->last_ns = std::numeric_limits<std::int64_t>::min();
  slots_[at] = Slot{xy, z_layer, static_cast<std::uint32_t>(++size_)};
  if (size_ * kMaxLoad[1] > slots_.size() * kMaxLoad[0]) grow();
  return made;
}

IntegrationCounts VoxelMap::integrate(const SemanticPoints& points, const Transform& T_map_lidar,
                                      StampNs stamp) {
  IntegrationCounts counts;
  PlacementConstants pose;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 4; ++column) pose.rows[row][column] = T_map_lidar(row, column);
  }
  pose.voxel_size_m = config_.voxel_size_m;
  const double least = config_.min_range_m * config_.min_range_m;
  const double most = config_.max_range_m > 0.0 ? config_.max_range_m * config_.max_range_m
                                                : std::numeric_limits<double>::infinity();
  const std::size_t classes = config_.dynamic.size();
  Batch batch;
  for (std::size_t i = 0; i < points.count; ++i) {
    // A point takes one or two cache lines of its message.
    const std::size_t ahead = std::min(i + kPointsAhead, points.count - 1);
    __builtin_prefetch(points.x.data + static_cast<std::ptrdiff_t>(ahead) * points.x.stride);
    __builtin_prefetch(points.status.data +
                       static_cast<std::ptrdiff_t>(ahead) * points.status.stride);
    const std::uint8_t status = valueAt<std::uint8_t>(points.status, i);
    if (status > static_cast<std::uint8_t>(PointStatus::kNoImage)) {
      ++counts.no_odometry;
      continue;
    }
    const int row = batch.count;
    const float x = valueAt<float>(points.x, i), y = valueAt<float>(points.y, i);
    const float z = valueAt<float>(points.z, i);
    const double squared_range =
        static_cast<double>(x) * x + static_cast<double>(y) * y + static_cast<double>(z) * z;
    if (!(squared_range <= std::numeric_limits<double>::max())) {
      ++counts.invalid;
      continue;
    }
    if (squared_range < least || squared_range > most) {
      ++counts.out_of_range;
      continue;
    }
    batch.layer[row] = 0;
    batch.probabilities[row] = nullptr;
    if (status == static_cast<std::uint8_t>(PointStatus::kFused)) {
      const std::uint8_t label = valueAt<std::uint8_t>(points.label, i);
      if (label < classes && config_.dynamic[label] != 0) {
        if (config_.dynamic_points == DynamicPoints::kExclude) {
          ++counts.excluded;
          continue;
        }
        batch.layer[row] = config_.dynamic_points == DynamicPoints::kApart ? 1 : 0;
      }
      batch.probabilities[row] =
          points.probabilities.data + static_cast<std::ptrdiff_t>(i) * points.probabilities.stride;
    }
    float intensity = points.intensity.data ? valueAt<float>(points.intensity, i) : 0.0f;
    if (!(std::abs(intensity) <= kMaxIntensity)) intensity = 0.0f;
    batch.intensity[row] = floorOf(static_cast<double>(intensity) * kIntensityUnit + 0.5);
    batch.placed.x[row] = x;
    batch.placed.y[row] = y;
    batch.placed.z[row] = z;
    if (++batch.count == Batch::kSize) integrateBatch(pose, stamp, &batch, &counts);
  }
  integrateBatch(pose, stamp, &batch, &counts);
  return counts;
}

void VoxelMap::integrateBatch(const PlacementConstants& pose, StampNs stamp, Batch* batch,
                              IntegrationCounts* counts) {
  const int classes = evidence_.classCount();
  PlacedPoints& placed = batch->placed;
  std::uint64_t xy[Batch::kSize], hashes[Batch::kSize];
  std::uint32_t z_layer[Batch::kSize];
  std::int64_t* records[Batch::kSize];
  bool has_evidence[Batch::kSize];
  int labelled = 0;
  place_points_(pose, &placed);
  for (int i = 0; i < batch->count; ++i) {
    xy[i] = packXy(placed.index[0][i], placed.index[1][i]);
    z_layer[i] = packZ(placed.index[2][i], batch->layer[i]);
    hashes[i] = hashOf(xy[i], z_layer[i]);
    __builtin_prefetch(&slots_[hashes[i] >> shift_], 1);
  }
  for (int i = 0; i < batch->count; ++i) {
    if (!placed.inside[i]) continue;
    records[i] = findOrMake(xy[i], z_layer[i], hashes[i]);
    const char* const lines = reinterpret_cast<const char*>(records[i]);
    for (std::size_t byte = 0; byte < recordSize(); byte += 64) __builtin_prefetch(lines + byte, 1);
    __builtin_prefetch(lines + recordSize() - 1, 1);
    has_evidence[i] = false;
    if (!batch->probabilities[i]) continue;
    has_evidence[i] =
        copyFinite(batch->probabilities[i], classes, rows_.data() + labelled * classes);
    labelled += has_evidence[i] ? 1 : 0;
    counts->invalid += has_evidence[i] ? 0 : 1;
  }
  evidence_.compute(rows_.data(), labelled, row_evidence_.data());
  const std::int32_t* next = row_evidence_.data();
  for (int i = 0; i < batch->count; ++i) {
    if (!placed.inside[i]) {
      ++counts->out_of_range;
      continue;
    }
    VoxelHeader* const voxel = header(records[i]);
    voxel->observations = saturatingSum(voxel->observations, 1);
    voxel->sum_x += placed.offset[0][i];
    voxel->sum_y += placed.offset[1][i];
    voxel->sum_z += placed.offset[2][i];
    voxel->sum_intensity += batch->intensity[i];
    voxel->first_ns = std::min<std::int64_t>(voxel->first_ns, stamp);
    voxel->last_ns = std::max<std::int64_t>(voxel->last_ns, stamp);
    if (!has_evidence[i]) {
      ++counts->occupied;
      continue;
    }
    ++counts->labelled;
    voxel->labelled = saturatingSum(voxel->labelled, 1);
    add_evidence_(next, classes, records[i] + kHeaderWords);
    next += classes;
  }
  batch->count = 0;
}

void VoxelMap::add(const std::uint8_t* records, std::size_t bytes) {
  if (bytes % recordSize() != 0)
    throw DataError("voxel map: " + std::to_string(bytes) +
                    " bytes are no whole number of records of " + std::to_string(recordSize()) +
                    " bytes");
  for (const std::uint8_t* at = records; at != records + bytes; at += recordSize()) {
    VoxelHeader other;
    std::memcpy(&other, at, sizeof other);
    const std::uint64_t xy = packXy(other.x, other.y);
    const std::uint32_t z_layer = packZ(other.z, other.layer & 1U);
    std::int64_t* const ours = findOrMake(xy, z_layer, hashOf(xy, z_layer));
    VoxelHeader* const voxel = header(ours);
    voxel->observations = saturatingSum(voxel->observations, other.observations);
    voxel->labelled = saturatingSum(voxel->labelled, other.labelled);
    voxel->sum_x += other.sum_x;
    voxel->sum_y += other.sum_y;
    voxel->sum_z += other.sum_z;
    voxel->sum_intensity += other.sum_intensity;
    voxel->first_ns = std::min(voxel->first_ns, other.first_ns);
    voxel->last_ns = std::max(voxel->last_ns, other.last_ns);
    for (std::size_t word = kHeaderWords; word < words_; ++word) {
      std::int64_t value;
      std::memcpy(&value, at + word * sizeof value, sizeof value);
      ours[word] += value;
    }
  }
}

std::vector<std::uint8_t> VoxelMap::records(bool sorted) const {
  std::vector<const std::int64_t*> order(size_);
  for (std::size_t i = 0; i < size_; ++i) order[i] = record(i);
  if (sorted) {
    std::sort(order.begin(), order.end(), [](const std::int64_t* a, const std::int64_t* b) {
      return isBefore(*reinterpret_cast<const VoxelHeader*>(a),
                      *reinterpret_cast<const VoxelHeader*>(b));
    });
  }
  std::vector<std::uint8_t> result(size_ * recordSize());
  for (std::size_t i = 0; i < size_; ++i)
    std::memcpy(result.data() + i * recordSize(), order[i], recordSize());
  return result;
}

void VoxelMap::keepInside(const std::array<std::int32_t, 3>& min,
                          const std::array<std::int32_t, 3>& max) {
  const auto inside = [&](const VoxelHeader& v) {
    return v.x >= min[0] && v.x <= max[0] && v.y >= min[1] && v.y <= max[1] && v.z >= min[2] &&
           v.z <= max[2];
  };
  std::size_t kept = 0;
  for (std::size_t i = 0; i < size_; ++i) {
    std::int64_t* const from = record(i);
    if (!inside(*header(from))) continue;
    if (kept != i) std::memcpy(record(kept), from, recordSize());
    ++kept;
  }
  size_ = kept;
  std::size_t chunks = 0, blocks = 0;
  for (; chunks * kChunkSize < kept; ++blocks) chunks += chunksOfBlock(chunks);
  chunks_.resize(chunks);
  blocks_.resize(blocks);
  int bits = kFirstSlotBits;
  while (kept * kMaxLoad[1] > (std::size_t{1} << bits) * kMaxLoad[0]) ++bits;
  shift_ = 64 - bits;
  slots_.assign(std::size_t{1} << bits, Slot{});
  slots_.shrink_to_fit();
  for (std::size_t i = 0; i < size_; ++i) {
    const VoxelHeader& voxel = *header(record(i));
    place(Slot{packXy(voxel.x, voxel.y), packZ(voxel.z, voxel.layer),
               static_cast<std::uint32_t>(i + 1)});
  }
}

}  // namespace semantic_lidar_fusion

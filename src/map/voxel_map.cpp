// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/map/voxel_map.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <string>
#include <tuple>

#include "floor.h"
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
constexpr float kProbabilityUnit = 1048576.0f;
// A look whose points are, but for this share, of classes that no return can be of says nothing.
constexpr double kLeastShare = 1e-3;
constexpr double kMaxVoxel = 536870912.0;  // as in the kernels

template <typename Value>
Value valueAt(const Column& column, std::size_t row) {
  Value value;
  std::memcpy(&value, column.data + static_cast<std::ptrdiff_t>(row) * column.stride, sizeof value);
  return value;
}

std::uint64_t packXy(std::int32_t x, std::int32_t y) {
  return static_cast<std::uint64_t>(static_cast<std::uint32_t>(x)) << 32 |
         static_cast<std::uint32_t>(y);
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
    return std::make_tuple(VoxelMap::tileOf(v.x), VoxelMap::tileOf(v.y), v.x, v.y, v.z);
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
  if (!(config.ray_range_m >= 0.0 && config.ray_range_m <= 1e4))
    problem("ray_range_m", config.ray_range_m, "from 0 to 10000");
  if (!config.returns.empty() && config.returns.size() != config.evidence.prior.size())
    problem("returns", static_cast<double>(config.returns.size()), "of as many classes as prior");
  if (!config.returns.empty() && std::count(config.returns.begin(), config.returns.end(), 0) ==
                                     static_cast<std::ptrdiff_t>(config.returns.size()))
    problem("returns", 0.0, "1 for one class at least");
  if (!problems.empty()) throw ConfigError(problems);
}

PlacementConstants placementOf(const Transform& T_map_lidar, double voxel_size_m) {
  PlacementConstants result;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 4; ++column) result.rows[row][column] = T_map_lidar(row, column);
  }
  result.voxel_size_m = voxel_size_m;
  return result;
}

void checkWhole(std::size_t size, std::size_t unit, const char* what) {
  if (size % unit != 0)
    throw DataError("voxel map: " + std::to_string(size) + " bytes are no whole number of " + what +
                    " of " + std::to_string(unit) + " bytes");
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
  std::uint8_t passes[kSize];                ///< as SemanticPoints tells them
  const double* origins[kSize];              ///< null = the pose's
};

VoxelMap::VoxelMap(const VoxelMapConfig& config)
    : config_(config),
      evidence_(config.evidence),
      add_evidence_(addEvidence()),
      place_points_(placePoints()),
      quantise_(countEvidence()) {
  check(config_);
  if (config_.returns.empty()) config_.returns.assign(config_.evidence.prior.size(), 1);
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
  free_.clear();
  look_of_record_.clear();
}

std::size_t VoxelMap::memoryBytes() const {
  std::size_t bytes = slots_.capacity() * sizeof(Slot);
  for (std::size_t chunk = 0; chunk < chunks_.size();) {
    const std::size_t count = chunksOfBlock(chunk);
    bytes += bytesOfBlock(count);
    chunk += count;
  }
  bytes += look_of_record_.capacity() * sizeof(std::uint32_t);
  return bytes + free_.memoryBytes();
}

inline std::uint64_t VoxelMap::hashOf(std::uint64_t xy, std::uint32_t z) {
  std::uint64_t hash = (xy ^ (xy >> 29)) * 0x9e3779b97f4a7c15ULL;
  hash = (hash ^ (hash >> 32) ^ z) * 0xbf58476d1ce4e5b9ULL;
  return hash ^ (hash << 21);
}

inline void VoxelMap::place(const Slot& slot) {
  const std::size_t mask = slots_.size() - 1;
  std::size_t at = hashOf(slot.xy, slot.z) >> shift_;
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

std::int64_t* VoxelMap::find(const VoxelKey& voxel) const {
  const std::uint64_t xy = packXy(voxel[0], voxel[1]);
  const auto z = static_cast<std::uint32_t>(voxel[2]);
  const std::size_t mask = slots_.size() - 1;
  for (std::size_t at = hashOf(xy, z) >> shift_; slots_[at].index != 0; at = (at + 1) & mask) {
    if (slots_[at].xy == xy && slots_[at].z == z) return record(slots_[at].index - 1);
  }
  return nullptr;
}

inline std::uint32_t VoxelMap::findOrMake(std::uint64_t xy, std::uint32_t z, std::uint64_t hash) {
  const std::size_t mask = slots_.size() - 1;
  std::size_t at = hash >> shift_;
  for (; slots_[at].index != 0; at = (at + 1) & mask) {
    const Slot& slot = slots_[at];
    if (slot.xy == xy && slot.z == z) return slot.index - 1;
  }
  if (size_ >= std::numeric_limits<std::uint32_t>::max() - 1)
    throw DataError("voxel map: more than 2^32 voxels; use larger ones, or more tiles");
  if (size_ == chunks_.size() * kChunkSize) addBlock();
  std::int64_t* const made = record(size_);
  std::memset(made, 0, recordSize());
  VoxelHeader* const voxel = header(made);
  voxel->x = static_cast<std::int32_t>(xy >> 32);
  voxel->y = static_cast<std::int32_t>(xy & 0xffffffffU);
  voxel->z = static_cast<std::int32_t>(z);
  voxel->first_ns = std::numeric_limits<std::int64_t>::max();
  voxel->last_ns = std::numeric_limits<std::int64_t>::min();
  if (config_.ray_range_m > 0.0) voxel->passes = free_.claim({voxel->x, voxel->y, voxel->z});
  voxel->passes_after = voxel->passes;
  slots_[at] = Slot{xy, z, static_cast<std::uint32_t>(++size_)};
  if (size_ * kMaxLoad[1] > slots_.size() * kMaxLoad[0]) grow();
  return static_cast<std::uint32_t>(size_ - 1);
}

IntegrationCounts VoxelMap::integrate(const SemanticPoints& points, const Transform& T_map_lidar,
                                      StampNs stamp) {
  IntegrationCounts counts;
  const PlacementConstants pose = placementOf(T_map_lidar, config_.voxel_size_m);
  casts_ = config_.ray_range_m > 0.0 && !points.passes.data;
  const double least = config_.min_range_m * config_.min_range_m;
  const double most = config_.max_range_m > 0.0 ? config_.max_range_m * config_.max_range_m
                                                : std::numeric_limits<double>::infinity();
  looks_.clear();
  look_sums_.clear();
  rays_.clear();
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
    if (!(squared_range > 0.0 && squared_range <= std::numeric_limits<double>::max())) {
      ++counts.invalid;
      continue;
    }
    if (squared_range < least || squared_range > most) {
      ++counts.out_of_range;
      continue;
    }
    batch.probabilities[row] = nullptr;
    if (status == static_cast<std::uint8_t>(PointStatus::kFused)) {
      batch.probabilities[row] =
          points.probabilities.data + static_cast<std::ptrdiff_t>(i) * points.probabilities.stride;
    }
    batch.origins[row] = points.origins ? points.origins + 3 * i : nullptr;
    float intensity = points.intensity.data ? valueAt<float>(points.intensity, i) : 0.0f;
    if (!(std::abs(intensity) <= kMaxIntensity)) intensity = 0.0f;
    batch.passes[row] = points.passes.data ? valueAt<std::uint8_t>(points.passes, i) : 0;
    batch.intensity[row] =
        floorTo<std::int64_t>(static_cast<double>(intensity) * kIntensityUnit + 0.5);
    batch.placed.x[row] = x;
    batch.placed.y[row] = y;
    batch.placed.z[row] = z;
    if (++batch.count == Batch::kSize) integrateBatch(pose, &batch, &counts);
  }
  integrateBatch(pose, &batch, &counts);
  finishLooks(stamp);
  if (casts_) castRays();
  return counts;
}

VoxelMap::Look& VoxelMap::lookAt(std::uint32_t record, std::size_t* index) {
  if (look_of_record_.size() <= record) look_of_record_.resize(chunks_.size() * kChunkSize, 0);
  *index = look_of_record_[record];
  if (*index >= looks_.size() || looks_[*index].record != record) {
    *index = looks_.size();
    look_of_record_[record] = static_cast<std::uint32_t>(*index);
    looks_.push_back({record, 0});
    look_sums_.resize(look_sums_.size() + static_cast<std::size_t>(classCount()), 0);
  }
  return looks_[*index];
}

void VoxelMap::integrateBatch(const PlacementConstants& pose, Batch* batch,
                              IntegrationCounts* counts) {
  const auto classes = static_cast<std::size_t>(evidence_.classCount());
  PlacedPoints& placed = batch->placed;
  std::uint64_t xy[Batch::kSize], hashes[Batch::kSize];
  std::uint32_t z[Batch::kSize], found[Batch::kSize];
  bool has_distribution[Batch::kSize];
  std::size_t labelled = 0;
  place_points_(pose, &placed);
  for (int i = 0; i < batch->count; ++i) {
    xy[i] = packXy(placed.index[0][i], placed.index[1][i]);
    z[i] = static_cast<std::uint32_t>(placed.index[2][i]);
    hashes[i] = hashOf(xy[i], z[i]);
    __builtin_prefetch(&slots_[hashes[i] >> shift_], 1);
  }
  for (int i = 0; i < batch->count; ++i) {
    if (!placed.inside[i]) continue;
    found[i] = findOrMake(xy[i], z[i], hashes[i]);
    __builtin_prefetch(record(found[i]), 1);
    has_distribution[i] = false;
    if (!batch->probabilities[i]) continue;
    has_distribution[i] = copyFinite(batch->probabilities[i], static_cast<int>(classes),
                                     rows_.data() + labelled * classes);
    labelled += has_distribution[i] ? 1 : 0;
    counts->invalid += has_distribution[i] ? 0 : 1;
  }
  quantise_(rows_.data(), labelled * classes, EvidenceConstants{0.0f, kProbabilityUnit, 0}, nullptr,
            row_evidence_.data());
  const std::int32_t* next = row_evidence_.data();
  for (int i = 0; i < batch->count; ++i) {
    if (!placed.inside[i]) {
      ++counts->out_of_range;
      continue;
    }
    VoxelHeader* const voxel = header(record(found[i]));
    if (!casts_ && (voxel->observations == 0 || batch->passes[i] < voxel->passes))
      voxel->passes = voxel->passes_after = batch->passes[i];
    voxel->observations = saturatingSum(voxel->observations, 1);
    voxel->sum_x += placed.offset[0][i];
    voxel->sum_y += placed.offset[1][i];
    voxel->sum_z += placed.offset[2][i];
    voxel->sum_intensity += batch->intensity[i];
    std::size_t index = 0;
    const std::size_t looks = looks_.size();
    Look& look = lookAt(found[i], &index);
    // Rays to one voxel cross the same ones.
    if (index == looks && casts_) addRay(pose, *batch, i);
    if (!has_distribution[i]) {
      ++counts->occupied;
      continue;
    }
    ++counts->labelled;
    ++look.labelled;
    add_evidence_(next, static_cast<int>(classes), look_sums_.data() + index * classes);
    next += classes;
  }
  batch->count = 0;
}

void VoxelMap::addRay(const PlacementConstants& pose, const Batch& batch, int i) {
  const double x = batch.placed.x[i], y = batch.placed.y[i], z = batch.placed.z[i];
  Ray ray;
  for (int axis = 0; axis < 3; ++axis) {
    const double* const row = pose.rows[axis];
    ray.end[axis] = (row[0] * x + row[1] * y + row[2] * z + row[3]) / config_.voxel_size_m;
    const double from = batch.origins[i] ? batch.origins[i][axis] : row[3];
    ray.origin[axis] = from / config_.voxel_size_m;
    if (!(std::abs(ray.origin[axis]) < kMaxVoxel)) return;
  }
  rays_.push_back(ray);
}

/// The look's mean distribution over the classes that returns can be of; 0 if it says nothing.
int VoxelMap::meanOfLook(std::size_t look, float* mean) const {
  const std::size_t classes = config_.returns.size();
  const std::int64_t* const sums = look_sums_.data() + look * classes;
  std::int64_t all = 0, kept = 0;
  for (std::size_t c = 0; c < classes; ++c) {
    all += sums[c];
    kept += config_.returns[c] != 0 ? sums[c] : 0;
  }
  if (static_cast<double>(kept) <= kLeastShare * static_cast<double>(all)) return 0;
  for (std::size_t c = 0; c < classes; ++c) {
    mean[c] = config_.returns[c] != 0
                  ? static_cast<float>(static_cast<double>(sums[c]) / static_cast<double>(kept))
                  : 0.0f;
  }
  return 1;
}

void VoxelMap::finishLooks(StampNs stamp) {
  const std::size_t classes = config_.returns.size();
  for (std::size_t begin = 0; begin < looks_.size(); begin += EvidenceModel::kMaxRows) {
    const std::size_t end = std::min<std::size_t>(begin + EvidenceModel::kMaxRows, looks_.size());
    int rows = 0;
    std::int64_t* records[EvidenceModel::kMaxRows];
    for (std::size_t i = begin; i < end; ++i) {
      std::int64_t* const at = record(looks_[i].record);
      VoxelHeader* const voxel = header(at);
      voxel->looks = saturatingSum(voxel->looks, 1);
      voxel->first_ns = std::min<std::int64_t>(voxel->first_ns, stamp);
      voxel->last_ns = std::max<std::int64_t>(voxel->last_ns, stamp);
      if (casts_) voxel->passes_after = 0;
      if (looks_[i].labelled == 0) continue;
      records[rows] = at;
      rows += meanOfLook(i, rows_.data() + static_cast<std::size_t>(rows) * classes);
    }
    evidence_.compute(rows_.data(), rows, row_evidence_.data());
    for (int row = 0; row < rows; ++row) {
      std::int32_t* const evidence = row_evidence_.data() + static_cast<std::size_t>(row) * classes;
      for (std::size_t c = 0; c < classes; ++c) evidence[c] = config_.returns[c] ? evidence[c] : 0;
      VoxelHeader* const voxel = header(records[row]);
      voxel->labelled = saturatingSum(voxel->labelled, 1);
      add_evidence_(evidence, static_cast<int>(classes), records[row] + kHeaderWords);
    }
  }
}

void VoxelMap::castRays() {
  if (rays_.empty()) return;
  const double reach = config_.ray_range_m / config_.voxel_size_m;
  for (const Ray& ray : rays_) free_.cast(ray, reach);
  for (const Look& look : looks_) {
    const VoxelHeader& voxel = *header(record(look.record));
    free_.spare({voxel.x, voxel.y, voxel.z});
  }
  std::vector<VoxelKey> passed;
  free_.finishScan(&passed);
  for (const VoxelKey& key : passed) addPasses(1, find(key));
}

void VoxelMap::addPasses(std::uint32_t count, std::int64_t* record) {
  VoxelHeader* const voxel = header(record);
  voxel->passes = std::min(voxel->passes + count, kMaxPasses);
  voxel->passes_after = std::min(voxel->passes_after + count, kMaxPasses);
}

void VoxelMap::add(const std::uint8_t* records, std::size_t bytes, const std::uint8_t* bricks,
                   std::size_t brick_bytes) {
  checkWhole(bytes, recordSize(), "records");
  checkWhole(brick_bytes, sizeof(FreeBrick), "bricks");
  for (const std::uint8_t* at = records; at != records + bytes; at += recordSize()) addRecord(at);
  if (!(config_.ray_range_m > 0.0)) return;
  std::vector<VoxelKey> passed;
  std::vector<std::uint32_t> counts;
  for (const std::uint8_t* at = bricks; at != bricks + brick_bytes; at += sizeof(FreeBrick)) {
    FreeBrick brick;
    std::memcpy(&brick, at, sizeof brick);
    free_.add(brick, &passed, &counts);
  }
  for (std::size_t i = 0; i < passed.size(); ++i) addPasses(counts[i], find(passed[i]));
}

void VoxelMap::addMoved(const std::uint8_t* bricks, std::size_t bytes,
                        const Transform& T_theirs_ours) {
  checkWhole(bytes, sizeof(FreeBrick), "bricks");
  if (!(config_.ray_range_m > 0.0)) return;
  std::vector<FreeBrick> theirs(bytes / sizeof(FreeBrick));
  if (bytes > 0) std::memcpy(theirs.data(), bricks, bytes);
  MovedVoxels theirs_ours;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 4; ++column) {
      theirs_ours[static_cast<std::size_t>(row)][static_cast<std::size_t>(column)] =
          column < 3 ? T_theirs_ours(row, column) : T_theirs_ours(row, 3) / config_.voxel_size_m;
    }
  }
  free_.addMoved(theirs, theirs_ours);
}

void VoxelMap::passesAt(const SemanticPoints& points, const Transform& T_map_lidar,
                        std::uint8_t* passes) const {
  const PlacementConstants pose = placementOf(T_map_lidar, config_.voxel_size_m);
  PlacedPoints placed = {};
  for (std::size_t begin = 0; begin < points.count; begin += Batch::kSize) {
    const std::size_t count = std::min<std::size_t>(points.count - begin, Batch::kSize);
    for (std::size_t i = 0; i < count; ++i) {
      placed.x[i] = valueAt<float>(points.x, begin + i);
      placed.y[i] = valueAt<float>(points.y, begin + i);
      placed.z[i] = valueAt<float>(points.z, begin + i);
    }
    place_points_(pose, &placed);
    for (std::size_t i = 0; i < count; ++i) {
      const std::int64_t* const found =
          placed.inside[i] ? find({placed.index[0][i], placed.index[1][i], placed.index[2][i]})
                           : nullptr;
      passes[begin + i] =
          found
              ? static_cast<std::uint8_t>(reinterpret_cast<const VoxelHeader*>(found)->passes_after)
              : std::uint8_t{0};
    }
  }
}

void VoxelMap::addRecord(const std::uint8_t* at) {
  VoxelHeader other;
  std::memcpy(&other, at, sizeof other);
  const std::uint64_t xy = packXy(other.x, other.y);
  const auto z = static_cast<std::uint32_t>(other.z);
  std::int64_t* const ours = record(findOrMake(xy, z, hashOf(xy, z)));
  VoxelHeader* const voxel = header(ours);
  voxel->observations = saturatingSum(voxel->observations, other.observations);
  voxel->looks = saturatingSum(voxel->looks, other.looks);
  voxel->labelled = saturatingSum(voxel->labelled, other.labelled);
  voxel->passes = std::min(voxel->passes + std::min(other.passes, kMaxPasses), kMaxPasses);
  voxel->passes_after = std::min(other.passes_after, kMaxPasses);
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

std::vector<std::uint8_t> VoxelMap::bricks(bool sorted) const {
  const std::vector<FreeBrick> bricks = free_.bricks(sorted);
  std::vector<std::uint8_t> result(bricks.size() * sizeof(FreeBrick));
  if (!bricks.empty()) std::memcpy(result.data(), bricks.data(), result.size());
  return result;
}

void VoxelMap::keepInside(const VoxelKey& min, const VoxelKey& max) {
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
    place(Slot{packXy(voxel.x, voxel.y), static_cast<std::uint32_t>(voxel.z),
               static_cast<std::uint32_t>(i + 1)});
  }
  look_of_record_.resize(std::min(look_of_record_.size(), chunks_.size() * kChunkSize));
  look_of_record_.shrink_to_fit();
  looks_.clear();
  if (!(config_.ray_range_m > 0.0)) return;
  free_.keepInside(min, max);
  // They hold no pass: claiming gives back 0.
  for (std::size_t i = 0; i < size_; ++i) {
    const VoxelHeader& voxel = *header(record(i));
    free_.claim({voxel.x, voxel.y, voxel.z});
  }
}

}  // namespace semantic_lidar_fusion

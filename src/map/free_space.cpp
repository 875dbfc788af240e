// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/map/free_space.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <tuple>

#include "floor.h"
#include "semantic_lidar_fusion/map/voxel_map.h"

namespace semantic_lidar_fusion {
namespace {

constexpr int kBits = FreeBrick::kBits;
constexpr int kWide = 1 << kBits, kWithin = kWide - 1;
constexpr std::size_t kFirstSlots = 1024;
// A ray crosses a voxel if it runs through it for this part of an edge at least: one that cuts a
// corner says little about what is there.
constexpr double kLeastChord = 0.8;

std::uint64_t bitOf(std::int32_t x, std::int32_t y) {
  return std::uint64_t{1} << ((y & kWithin) << kBits | (x & kWithin));
}

/// planes += added, bit by bit, up to kMaxPasses.
void addSaturating(const std::uint64_t added, int word, FreeBrick* brick) {
  std::uint64_t carry = added;
  for (auto& plane : brick->planes) {
    const std::uint64_t next = plane[word] & carry;
    plane[word] ^= carry;
    carry = next;
  }
  for (auto& plane : brick->planes) plane[word] |= carry;
}

std::uint32_t countAt(const FreeBrick& brick, int word, std::uint64_t bit) {
  std::uint32_t count = 0;
  for (int k = 0; k < FreeBrick::kPlanes; ++k)
    count |= (brick.planes[k][word] & bit) != 0 ? 1U << k : 0U;
  return count;
}

std::uint64_t anyOf(const FreeBrick& brick, int word) {
  std::uint64_t any = 0;
  for (const auto& plane : brick.planes) any |= plane[word];
  return any;
}

template <typename Visit>
void forEachBit(std::uint64_t bits, Visit visit) {
  for (; bits != 0; bits &= bits - 1) visit(__builtin_ctzll(bits));
}

/// planes = count, up to kMaxPasses.
void setCount(std::uint32_t count, int word, std::uint64_t bit, FreeBrick* brick) {
  for (int k = 0; k < FreeBrick::kPlanes; ++k) {
    if ((count >> k & 1U) != 0)
      brick->planes[k][word] |= bit;
    else
      brick->planes[k][word] &= ~bit;
  }
}

/// The voxel of theirs at the centre of ours; the plain numpy version takes the same sums.
VoxelKey movedVoxel(const VoxelKey& ours, const MovedVoxels& theirs_ours) {
  VoxelKey result;
  for (std::size_t axis = 0; axis < 3; ++axis) {
    const auto& t = theirs_ours[axis];
    const double rest = t[1] * (ours[1] + 0.5) + t[2] * (ours[2] + 0.5) + t[3];
    result[axis] = floorTo<std::int32_t>(t[0] * (ours[0] + 0.5) + rest);
  }
  return result;
}

VoxelKey voxelOf(const FreeBrick& brick, int word, int bit) {
  return {brick.x * kWide + (bit & kWithin), brick.y * kWide + (bit >> kBits),
          brick.z * kWide + word};
}

}  // namespace

template <typename Value>
std::size_t BrickTable<Value>::slotOf(std::int32_t x, std::int32_t y, std::int32_t z) const {
  std::uint64_t hash = (static_cast<std::uint64_t>(static_cast<std::uint32_t>(x)) << 32 |
                        static_cast<std::uint32_t>(y)) *
                       0x9e3779b97f4a7c15ULL;
  hash = (hash ^ (hash >> 32) ^ static_cast<std::uint32_t>(z)) * 0xbf58476d1ce4e5b9ULL;
  const std::size_t mask = slots_.size() - 1;
  for (std::size_t at = (hash ^ hash >> 31) & mask;; at = (at + 1) & mask) {
    if (slots_[at] == 0) return at;
    const Value& value = values_[slots_[at] - 1];
    if (value.x == x && value.y == y && value.z == z) return at;
  }
}

template <typename Value>
Value* BrickTable<Value>::find(std::int32_t x, std::int32_t y, std::int32_t z) {
  if (values_.empty()) return nullptr;
  const std::uint32_t index = slots_[slotOf(x, y, z)];
  return index == 0 ? nullptr : &values_[index - 1];
}

template <typename Value>
std::size_t BrickTable<Value>::findOrMake(std::int32_t x, std::int32_t y, std::int32_t z) {
  if (2 * (values_.size() + 1) > slots_.size()) rebuild();
  const std::size_t slot = slotOf(x, y, z);
  if (slots_[slot] == 0) {
    values_.emplace_back();
    values_.back().x = x;
    values_.back().y = y;
    values_.back().z = z;
    slots_[slot] = static_cast<std::uint32_t>(values_.size());
  }
  return slots_[slot] - 1;
}

template <typename Value>
void BrickTable<Value>::rebuild() {
  std::size_t count = kFirstSlots;
  while (count < 4 * (values_.size() + 1)) count *= 2;
  slots_.assign(count, 0);
  for (std::size_t i = 0; i < values_.size(); ++i)
    slots_[slotOf(values_[i].x, values_[i].y, values_[i].z)] = static_cast<std::uint32_t>(i + 1);
}

template <typename Value>
void BrickTable<Value>::clear() {
  values_.clear();
  std::fill(slots_.begin(), slots_.end(), 0);
}

template <typename Value>
std::size_t BrickTable<Value>::memoryBytes() const {
  return values_.capacity() * sizeof(Value) + slots_.capacity() * sizeof(slots_[0]);
}

std::uint32_t FreeSpace::claim(const VoxelKey& voxel) {
  const std::size_t index =
      counted_.findOrMake(voxel[0] >> kBits, voxel[1] >> kBits, voxel[2] >> kBits);
  Counted& brick = counted_.values()[index];
  const int word = voxel[2] & kWithin;
  const std::uint64_t bit = bitOf(voxel[0], voxel[1]);
  const std::uint32_t count = countAt(brick, word, bit);
  for (auto& plane : brick.planes) plane[word] &= ~bit;
  brick.claimed[word] |= bit;
  return count;
}

void FreeSpace::cast(const Ray& ray, double reach) {
  constexpr double kNever = std::numeric_limits<double>::infinity();
  std::int32_t at[3], step[3];
  double next[3], delta[3], squared = 0.0;
  for (int axis = 0; axis < 3; ++axis) {
    const double origin = ray.origin[axis], way = ray.end[axis] - origin;
    squared += way * way;
    const double cell = std::floor(origin);
    at[axis] = static_cast<std::int32_t>(cell);
    step[axis] = way > 0.0 ? 1 : -1;
    delta[axis] = way != 0.0 ? 1.0 / std::abs(way) : kNever;
    const double first = way > 0.0 ? cell + 1.0 - origin : origin - cell;
    next[axis] = way != 0.0 ? first * delta[axis] : kNever;
  }
  const double length = std::sqrt(squared);
  const double last = length > reach ? reach / length : 1.0;
  std::int32_t bx = at[0] >> kBits, by = at[1] >> kBits, bz = at[2] >> kBits;
  Marked* brick = &marked_.values()[marked_.findOrMake(bx, by, bz)];
  double entered = 0.0;
  const double least = kLeastChord / length;
  for (;;) {
    const double leaves = std::min(std::min(next[0], next[1]), std::min(next[2], last));
    if (leaves - entered >= least) brick->crossed[at[2] & kWithin] |= bitOf(at[0], at[1]);
    entered = leaves;
    const int axis =
        next[0] <= next[1] ? (next[0] <= next[2] ? 0 : 2) : (next[1] <= next[2] ? 1 : 2);
    if (!(next[axis] < last)) return;
    next[axis] += delta[axis];
    at[axis] += step[axis];
    if ((at[axis] & kWithin) == (step[axis] > 0 ? 0 : kWithin)) {
      bx = at[0] >> kBits;
      by = at[1] >> kBits;
      bz = at[2] >> kBits;
      brick = &marked_.values()[marked_.findOrMake(bx, by, bz)];
    }
  }
}

void FreeSpace::spare(const VoxelKey& voxel) {
  for (int dz = -1; dz <= 1; ++dz) {
    for (int dy = -1; dy <= 1; ++dy) {
      Marked* brick = nullptr;
      std::int32_t of = 0;
      for (int dx = -1; dx <= 1; ++dx) {
        const std::int32_t x = voxel[0] + dx, y = voxel[1] + dy, z = voxel[2] + dz;
        if (dx == -1 || x >> kBits != of) {
          of = x >> kBits;
          brick = marked_.find(of, y >> kBits, z >> kBits);
        }
        if (brick) brick->spared[z & kWithin] |= bitOf(x, y);
      }
    }
  }
}

void FreeSpace::finishScan(std::vector<VoxelKey>* passed) {
  for (const Marked& marked : marked_.values()) {
    std::uint64_t free[8], any = 0;
    for (int word = 0; word < 8; ++word)
      any |= free[word] = marked.crossed[word] & ~marked.spared[word];
    if (any == 0) continue;
    Counted& brick = counted_.values()[counted_.findOrMake(marked.x, marked.y, marked.z)];
    for (int word = 0; word < 8; ++word) {
      addSaturating(free[word] & ~brick.claimed[word], word, &brick);
      forEachBit(free[word] & brick.claimed[word],
                 [&](int bit) { passed->push_back(voxelOf(brick, word, bit)); });
    }
  }
  marked_.clear();
}

void FreeSpace::add(const FreeBrick& other, std::vector<VoxelKey>* passed,
                    std::vector<std::uint32_t>* counts) {
  Counted& brick = counted_.values()[counted_.findOrMake(other.x, other.y, other.z)];
  for (int word = 0; word < 8; ++word) {
    forEachBit(anyOf(other, word), [&](int bit) {
      const std::uint64_t mask = std::uint64_t{1} << bit;
      const std::uint32_t count = countAt(other, word, mask);
      if ((brick.claimed[word] & mask) != 0) {
        passed->push_back(voxelOf(brick, word, bit));
        counts->push_back(count);
        return;
      }
      setCount(std::min(countAt(brick, word, mask) + count, kMaxPasses), word, mask, &brick);
    });
  }
}

void FreeSpace::addMoved(const std::vector<FreeBrick>& bricks, const MovedVoxels& theirs_ours) {
  // A voxel of ours whose centre lies in one of theirs is no further from that one's centre here
  // than half the extent of the turned cube.
  double reach[3];
  for (std::size_t axis = 0; axis < 3; ++axis) {
    reach[axis] = 1e-3;
    for (const auto& row : theirs_ours) reach[axis] += 0.5 * std::abs(row[axis]);
  }
  for (const FreeBrick& brick : bricks) {
    for (int word = 0; word < 8; ++word) {
      forEachBit(anyOf(brick, word), [&](int bit) {
        const VoxelKey theirs = voxelOf(brick, word, bit);
        const std::uint32_t count = countAt(brick, word, std::uint64_t{1} << bit);
        std::int32_t low[3], high[3];
        for (std::size_t axis = 0; axis < 3; ++axis) {
          double here = -0.5;
          for (std::size_t row = 0; row < 3; ++row)
            here += theirs_ours[row][axis] * (theirs[row] + 0.5 - theirs_ours[row][3]);
          low[axis] = -floorTo<std::int32_t>(reach[axis] - here);
          high[axis] = floorTo<std::int32_t>(here + reach[axis]);
        }
        for (std::int32_t z = low[2]; z <= high[2]; ++z) {
          for (std::int32_t y = low[1]; y <= high[1]; ++y) {
            for (std::int32_t x = low[0]; x <= high[0]; ++x) {
              if (movedVoxel({x, y, z}, theirs_ours) == theirs) addPasses({x, y, z}, count);
            }
          }
        }
      });
    }
  }
}

void FreeSpace::addPasses(const VoxelKey& voxel, std::uint32_t count) {
  const std::size_t index =
      counted_.findOrMake(voxel[0] >> kBits, voxel[1] >> kBits, voxel[2] >> kBits);
  Counted& brick = counted_.values()[index];
  const int word = voxel[2] & kWithin;
  const std::uint64_t bit = bitOf(voxel[0], voxel[1]);
  if ((brick.claimed[word] & bit) != 0) return;
  setCount(std::min(countAt(brick, word, bit) + count, kMaxPasses), word, bit, &brick);
}

std::vector<FreeBrick> FreeSpace::bricks(bool sorted) const {
  std::vector<FreeBrick> result;
  for (const Counted& brick : counted_.values()) {
    std::uint64_t any = 0;
    for (int word = 0; word < 8; ++word) any |= anyOf(brick, word);
    if (any != 0) result.push_back(brick);
  }
  if (sorted) {
    const auto key = [](const FreeBrick& b) {
      return std::make_tuple(VoxelMap::tileOf(b.x * kWide), VoxelMap::tileOf(b.y * kWide), b.x, b.y,
                             b.z);
    };
    std::sort(result.begin(), result.end(),
              [&](const FreeBrick& a, const FreeBrick& b) { return key(a) < key(b); });
  }
  return result;
}

void FreeSpace::keepInside(const VoxelKey& min, const VoxelKey& max) {
  const auto inside = [&](const VoxelKey& voxel) {
    for (int axis = 0; axis < 3; ++axis) {
      if (voxel[axis] < min[axis] || voxel[axis] > max[axis]) return false;
    }
    return true;
  };
  std::vector<Counted> kept;
  for (const Counted& old : counted_.values()) {
    const VoxelKey low = voxelOf(old, 0, 0), high = voxelOf(old, kWithin, 63);
    bool apart = false;
    for (int axis = 0; axis < 3; ++axis) apart |= high[axis] < min[axis] || low[axis] > max[axis];
    if (apart) continue;
    Counted brick = old;
    for (int word = 0; word < 8; ++word) {
      brick.claimed[word] = 0;
      if (inside(low) && inside(high)) continue;
      forEachBit(anyOf(old, word), [&](int bit) {
        if (inside(voxelOf(old, word, bit))) return;
        for (auto& plane : brick.planes) plane[word] &= ~(std::uint64_t{1} << bit);
      });
    }
    kept.push_back(brick);
  }
  counted_.values() = std::move(kept);
  counted_.rebuild();
}

void FreeSpace::clear() {
  counted_ = {};
  marked_ = {};
}

std::size_t FreeSpace::memoryBytes() const {
  return counted_.memoryBytes() + marked_.memoryBytes();
}

}  // namespace semantic_lidar_fusion

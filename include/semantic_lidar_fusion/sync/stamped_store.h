// SPDX-License-Identifier: MIT
#pragma once

#include <algorithm>
#include <cstddef>
#include <map>
#include <utility>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

/// The values of the newest few stamps. Not thread-safe.
template <typename T>
class StampedStore {
 public:
  explicit StampedStore(std::size_t capacity) : capacity_(capacity) {}

  /// A larger capacity; a smaller one changes nothing.
  void grow(std::size_t capacity) { capacity_ = std::max(capacity_, capacity); }
  /// Replaces the value of a known stamp. Returns the number of values that were pushed out: of a
  /// full store the oldest, which is the new value itself if none is older.
  std::size_t put(StampNs stamp, T value) {
    values_[stamp] = std::move(value);
    std::size_t dropped = 0;
    while (values_.size() > capacity_) {
      values_.erase(values_.begin());
      ++dropped;
    }
    return dropped;
  }
  /// Null if unknown, also right after a `put` into a full store; valid until the next change.
  const T* find(StampNs stamp) const {
    const auto found = values_.find(stamp);
    return found == values_.end() ? nullptr : &found->second;
  }
  T* find(StampNs stamp) {
    const auto found = values_.find(stamp);
    return found == values_.end() ? nullptr : &found->second;
  }
  void erase(StampNs stamp) { values_.erase(stamp); }
  /// Erases everything older than `stamp`.
  std::size_t eraseBefore(StampNs stamp) {
    const std::size_t before = values_.size();
    values_.erase(values_.begin(), values_.lower_bound(stamp));
    return before - values_.size();
  }
  /// Erases the oldest values, but never the newest, until the rest has at most `most` bytes;
  /// `bytes(value)` tells those of one. Returns their number.
  template <typename Bytes>
  std::size_t trim(std::size_t most, const Bytes& bytes) {
    std::size_t total = 0;
    for (const auto& value : values_) total += bytes(value.second);
    std::size_t dropped = 0;
    for (; total > most && values_.size() > 1; ++dropped) {
      total -= bytes(values_.begin()->second);
      values_.erase(values_.begin());
    }
    return dropped;
  }
  void clear() { values_.clear(); }
  std::size_t size() const { return values_.size(); }
  const std::map<StampNs, T>& values() const { return values_; }

 private:
  std::size_t capacity_;
  std::map<StampNs, T> values_;
};

}  // namespace semantic_lidar_fusion

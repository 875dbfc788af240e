// SPDX-License-Identifier: MIT
/// What a fuzzed parser gives: seeds made by code, and one run on arbitrary bytes that throws
/// Violation where a promise is broken. fuzz_<name>.cpp defines one target each; engine.cpp runs it
/// under libFuzzer, replay.cpp runs all of them as gtests on seeds and seeded mutations.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <functional>
#include <stdexcept>
#include <string>
#include <vector>

namespace semantic_lidar_fusion {
namespace fuzz {

using Bytes = std::vector<std::uint8_t>;

struct Target {
  const char* name;
  std::vector<Bytes> (*seeds)();
  void (*run)(const std::uint8_t* data, std::size_t size);
  const char* const* words;  ///< what mutations insert; ends with null
};

inline std::vector<Target>& targets() {
  static std::vector<Target> all;
  return all;
}

struct Registration {
  explicit Registration(const Target& target) { targets().push_back(target); }
};

/// A promise of the parser that an input breaks.
class Violation : public std::logic_error {
 public:
  using std::logic_error::logic_error;
};

inline void expect(bool holds, const char* promise) {
  if (!holds) throw Violation(promise);
}

template <typename Values>
void expectFinite(const Values& values, const char* promise) {
  expect(
      std::all_of(values.begin(), values.end(), [](double value) { return std::isfinite(value); }),
      promise);
}

/// An error's text is a line for a user.
inline void expectMessage(const std::exception& error) {
  const std::string text = error.what();
  expect(!text.empty(), "an error says why");
  expect(text.find('\n') == std::string::npos, "an error is one line");
}

/// Takes an input apart; what is missing at its end is zero.
class Reader {
 public:
  Reader(const std::uint8_t* data, std::size_t size) : data_(data), size_(size) {}

  template <typename T>
  T take() {
    T value{};
    const std::size_t n = std::min(sizeof(T), size_);
    if (n > 0) std::memcpy(&value, data_, n);
    skip(n);
    return value;
  }
  /// 0..below-1.
  unsigned choice(unsigned below) { return take<std::uint8_t>() % below; }
  bool flag() { return take<std::uint8_t>() & 1u; }
  std::string text(std::size_t length) {
    const std::size_t n = std::min(length, size_);
    const std::string result(reinterpret_cast<const char*>(data_), n);
    skip(n);
    return result;
  }
  Bytes rest() {
    Bytes result(data_, data_ + size_);
    skip(size_);
    return result;
  }
  std::size_t left() const { return size_; }

 private:
  void skip(std::size_t n) {
    data_ += n;
    size_ -= n;
  }

  const std::uint8_t* data_;
  std::size_t size_;
};

/// Puts a seed together, in the order in which Reader takes it apart.
class Writer {
 public:
  template <typename T>
  Writer& put(const T& value) {
    const auto* bytes = reinterpret_cast<const std::uint8_t*>(&value);
    bytes_.insert(bytes_.end(), bytes, bytes + sizeof(T));
    return *this;
  }
  Writer& byte(unsigned value) { return put(static_cast<std::uint8_t>(value)); }
  Writer& text(const std::string& value) {
    bytes_.insert(bytes_.end(), value.begin(), value.end());
    return *this;
  }
  Writer& raw(const void* data, std::size_t size) {
    const auto* bytes = static_cast<const std::uint8_t*>(data);
    bytes_.insert(bytes_.end(), bytes, bytes + size);
    return *this;
  }
  const Bytes& bytes() const { return bytes_; }

 private:
  Bytes bytes_;
};

}  // namespace fuzz
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Reads numpy .npz archives (zip with stored or deflated .npy members, little-endian, C order).
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <iterator>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace semantic_lidar_fusion {

struct NpyArray {
  std::string dtype;  ///< numpy's, e.g. "<f8", "|u1"
  std::vector<std::size_t> shape;
  std::vector<std::uint8_t> bytes;

  std::size_t size() const {
    std::size_t count = 1;
    for (const std::size_t extent : shape) count *= extent;
    return count;
  }
  /// All elements; throws unless T has the size of the dtype.
  template <typename T>
  std::vector<T> as() const {
    if (bytes.size() != size() * sizeof(T)) throw std::runtime_error("npy of dtype " + dtype);
    std::vector<T> values(size());
    std::memcpy(values.data(), bytes.data(), bytes.size());
    return values;
  }
};

namespace npz_detail {

inline std::uint32_t get(const std::vector<std::uint8_t>& file, std::size_t at, int bytes) {
  std::uint32_t value = 0;
  for (int i = 0; i < bytes; ++i) value |= std::uint32_t{file.at(at + i)} << (8 * i);
  return value;
}

/// A canonical Huffman code of RFC 1951, 3.2.2, as counts of codes by length and symbols in order.
struct HuffmanCode {
  std::array<int, 16> count{};
  std::vector<int> symbols;

  explicit HuffmanCode(const std::vector<int>& lengths) {
    for (int length = 1; length < 16; ++length) {
      for (std::size_t symbol = 0; symbol < lengths.size(); ++symbol) {
        if (lengths[symbol] != length) continue;
        ++count[length];
        symbols.push_back(static_cast<int>(symbol));
      }
    }
  }
};

/// Decoder of RFC 1951 data; slow and small.
class Inflater {
 public:
  Inflater(const std::uint8_t* data, std::size_t size) : data_(data), size_(size) {}

  std::vector<std::uint8_t> run() {
    bool last = false;
    while (!last) {
      last = bits(1) == 1;
      const int type = bits(2);
      if (type == 0) {
        stored();
      } else if (type == 1) {
        std::vector<int> lengths(288, 8);
        std::fill(lengths.begin() + 144, lengths.begin() + 256, 9);
        std::fill(lengths.begin() + 256, lengths.begin() + 280, 7);
        compressed(HuffmanCode(lengths), HuffmanCode(std::vector<int>(30, 5)));
      } else if (type == 2) {
        dynamic();
      } else {
        throw std::runtime_error("deflate: unknown block type");
      }
    }
    return std::move(out_);
  }

 private:
  int bits(int count) {
    int value = 0;
    for (int i = 0; i < count; ++i, ++bit_) {
      if (bit_ / 8 >= size_) throw std::runtime_error("deflate: data end too early");
      value |= (data_[bit_ / 8] >> (bit_ % 8) & 1) << i;
    }
    return value;
  }

  int symbol(const HuffmanCode& code) {
    int value = 0, first = 0, index = 0;
    for (int length = 1; length < 16; ++length) {
      value |= bits(1);
      const int count = code.count[length];
      if (value - count < first) return code.symbols.at(index + value - first);
      index += count;
      first = (first + count) << 1;
      value <<= 1;
    }
    throw std::runtime_error("deflate: unknown code");
  }

  void stored() {
    bit_ = (bit_ + 7) / 8 * 8;
    const int length = bits(16);
    bits(16);  // the complement
    for (int i = 0; i < length; ++i) out_.push_back(static_cast<std::uint8_t>(bits(8)));
  }

  void dynamic() {
    const int literal_count = bits(5) + 257;
    const int distance_count = bits(5) + 1;
    const int length_count = bits(4) + 4;
    const int order[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
    std::vector<int> code_lengths(19, 0);
    for (int i = 0; i < length_count; ++i) code_lengths[order[i]] = bits(3);
    const HuffmanCode code(code_lengths);
    std::vector<int> lengths;
    while (static_cast<int>(lengths.size()) < literal_count + distance_count) {
      const int s = symbol(code);
      if (s < 16) {
        lengths.push_back(s);
      } else if (s == 16) {
        lengths.insert(lengths.end(), bits(2) + 3, int{lengths.at(lengths.size() - 1)});
      } else {
        lengths.insert(lengths.end(), s == 17 ? bits(3) + 3 : bits(7) + 11, 0);
      }
    }
    compressed(HuffmanCode({lengths.begin(), lengths.begin() + literal_count}),
               HuffmanCode({lengths.begin() + literal_count, lengths.end()}));
  }

  void compressed(const HuffmanCode& literals, const HuffmanCode& distances) {
    for (int s = symbol(literals); s != 256; s = symbol(literals)) {
      if (s < 256) {
        out_.push_back(static_cast<std::uint8_t>(s));
        continue;
      }
      int length = 258;  // symbol 285
      if (s < 265) {
        length = s - 254;
      } else if (s < 285) {
        const int extra = (s - 261) / 4;
        length = (((s - 265) % 4 + 4) << extra) + 3 + bits(extra);
      }
      const int d = symbol(distances);
      int distance = d + 1;
      if (d > 3) {
        const int extra = d / 2 - 1;
        distance = ((d % 2 + 2) << extra) + 1 + bits(extra);
      }
      for (int i = 0; i < length; ++i) {
        out_.push_back(std::uint8_t{out_.at(out_.size() - static_cast<std::size_t>(distance))});
      }
    }
  }

  const std::uint8_t* data_;
  std::size_t size_;
  std::size_t bit_ = 0;
  std::vector<std::uint8_t> out_;
};

inline NpyArray parseNpy(const std::vector<std::uint8_t>& npy) {
  const std::size_t length_bytes = npy.at(6) == 1 ? 2 : 4;
  const std::size_t begin = 8 + length_bytes;
  const std::size_t length = get(npy, 8, static_cast<int>(length_bytes));
  const std::string header(npy.begin() + begin, npy.begin() + begin + length);
  if (header.find("'fortran_order': False") == std::string::npos) {
    throw std::runtime_error("npy: not in C order");
  }
  NpyArray array;
  const std::size_t descr = header.find('\'', header.find("'descr':") + 8) + 1;
  array.dtype = header.substr(descr, header.find('\'', descr) - descr);
  std::size_t at = header.find('(', header.find("'shape':")) + 1;
  while (header.at(at) != ')') {
    std::size_t used = 0;
    array.shape.push_back(std::stoul(header.substr(at), &used));
    at += used;
    while (header.at(at) == ',' || header.at(at) == ' ') ++at;
  }
  array.bytes.assign(npy.begin() + begin + length, npy.end());
  return array;
}

}  // namespace npz_detail

/// The members by name, without ".npy". Throws std::runtime_error for anything else than such a
/// file.
inline std::map<std::string, NpyArray> readNpz(const std::string& path) {
  using npz_detail::get;
  std::ifstream stream(path, std::ios::binary);
  const std::vector<std::uint8_t> file((std::istreambuf_iterator<char>(stream)),
                                       std::istreambuf_iterator<char>());
  if (file.size() < 22) throw std::runtime_error("npz: cannot read " + path);
  std::size_t end = file.size() - 22;
  while (get(file, end, 4) != 0x06054b50) {
    if (end-- == 0) throw std::runtime_error("npz: no zip directory in " + path);
  }
  const std::uint32_t count = get(file, end + 10, 2);
  std::size_t entry = get(file, end + 16, 4);
  std::map<std::string, NpyArray> arrays;
  for (std::uint32_t i = 0; i < count; ++i) {
    const std::uint32_t method = get(file, entry + 10, 2);
    const std::uint32_t packed_size = get(file, entry + 20, 4);
    const std::uint32_t size = get(file, entry + 24, 4);
    const std::uint32_t name_length = get(file, entry + 28, 2);
    const std::size_t local = get(file, entry + 42, 4);
    const std::string name(file.begin() + entry + 46, file.begin() + entry + 46 + name_length);
    const std::size_t data = local + 30 + get(file, local + 26, 2) + get(file, local + 28, 2);
    if (data + packed_size > file.size() || (method != 0 && method != 8)) {
      throw std::runtime_error("npz: member " + name + " of " + path);
    }
    const std::vector<std::uint8_t> npy =
        method == 8
            ? npz_detail::Inflater(file.data() + data, packed_size).run()
            : std::vector<std::uint8_t>(file.begin() + data, file.begin() + data + packed_size);
    if (npy.size() != size) throw std::runtime_error("npz: size of " + name + " in " + path);
    arrays[name.substr(0, name.rfind(".npy"))] = npz_detail::parseNpy(npy);
    entry += 46 + name_length + get(file, entry + 30, 2) + get(file, entry + 32, 2);
  }
  return arrays;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Reads numpy .npz archives (zip with stored or deflated .npy members, little-endian, C order).
/// Link with zlib.
#pragma once

#include <zlib.h>

#include <cstdint>
#include <cstring>
#include <fstream>
#include <iterator>
#include <map>
#include <stdexcept>
#include <string>
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

inline std::vector<std::uint8_t> inflated(const std::uint8_t* data, std::size_t size,
                                          std::size_t inflated_size) {
  std::vector<std::uint8_t> result(inflated_size);
  z_stream stream{};
  stream.next_in = const_cast<Bytef*>(data);
  stream.avail_in = static_cast<uInt>(size);
  stream.next_out = result.data();
  stream.avail_out = static_cast<uInt>(inflated_size);
  const bool good = inflateInit2(&stream, -MAX_WBITS) == Z_OK &&
                    inflate(&stream, Z_FINISH) == Z_STREAM_END && stream.avail_out == 0;
  inflateEnd(&stream);
  if (!good) throw std::runtime_error("npz: cannot inflate");
  return result;
}

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
            ? npz_detail::inflated(file.data() + data, packed_size, size)
            : std::vector<std::uint8_t>(file.begin() + data, file.begin() + data + packed_size);
    arrays[name.substr(0, name.rfind(".npy"))] = npz_detail::parseNpy(npy);
    entry += 46 + name_length + get(file, entry + 30, 2) + get(file, entry + 32, 2);
  }
  return arrays;
}

}  // namespace semantic_lidar_fusion

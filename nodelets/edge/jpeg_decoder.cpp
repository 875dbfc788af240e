// SPDX-License-Identifier: MIT
#include "edge/jpeg_decoder.h"

#include <algorithm>
#include <cstdlib>
#include <string>

#ifdef SLF_HAVE_TURBOJPEG
#include <turbojpeg.h>

#include <memory>
#endif

namespace semantic_lidar_fusion {
namespace {

using Data = std::vector<std::uint8_t>;

bool startsWith(const Data& data, const std::initializer_list<std::uint8_t>& start) {
  return data.size() >= start.size() && std::equal(start.begin(), start.end(), data.begin());
}

/// `bytes` bytes from `at` on, the most significant first. What is not there counts as 0.
std::int64_t bigEndian(const Data& data, std::size_t at, int bytes) {
  std::int64_t value = 0;
  for (int i = 0; i < bytes; ++i, ++at) value = value << 8 | (at < data.size() ? data[at] : 0);
  return value;
}

/// The same, the least significant first.
std::int64_t littleEndian(const Data& data, std::size_t at, int bytes) {
  std::int64_t value = 0;
  for (int i = 0; i < bytes; ++i, ++at) {
    value |= (at < data.size() ? std::int64_t{data[at]} : 0) << 8 * i;
  }
  return value;
}

/// Declared sizes reach 2^32; the package's are int.
ImageSize imageSize(std::int64_t width, std::int64_t height) {
  constexpr std::int64_t kMost = 1 << 30;
  return {static_cast<int>(std::min(width, kMost)), static_cast<int>(std::min(height, kMost))};
}

/// From the first frame header; libjpeg too passes over bytes that are no marker.
std::optional<ImageSize> jpegSize(const Data& data) {
  for (std::size_t at = 2; at + 9 < data.size();) {
    const std::uint8_t marker = data[at + 1];
    if (data[at] != 0xFF || marker == 0xFF || marker == 0) {
      ++at;
      continue;
    }
    const bool is_frame =
        marker >= 0xC0 && marker <= 0xCF && marker != 0xC4 && marker != 0xC8 && marker != 0xCC;
    if (is_frame) return imageSize(bigEndian(data, at + 7, 2), bigEndian(data, at + 5, 2));
    at += 2 + static_cast<std::size_t>(bigEndian(data, at + 2, 2));
  }
  return std::nullopt;
}

/// From the first directory, whose entries are tag, type (3: 16 bits, 4: 32 bits), count and value.
std::optional<ImageSize> tiffSize(const Data& data) {
  const auto number = data[0] == 'M' ? bigEndian : littleEndian;
  const auto directory = static_cast<std::size_t>(number(data, 4, 4));
  const std::int64_t entries = number(data, directory, 2);
  std::int64_t width = 0, height = 0;
  for (std::int64_t i = 0; i < entries; ++i) {
    const std::size_t entry = directory + 2 + 12 * static_cast<std::size_t>(i);
    const std::int64_t tag = number(data, entry, 2);
    const std::int64_t value = number(data, entry + 8, number(data, entry + 2, 2) == 3 ? 2 : 4);
    if (tag == 256) width = value;
    if (tag == 257) height = value;
  }
  if (width == 0 || height == 0) return std::nullopt;
  return imageSize(width, height);
}

/// Lossy, lossless and extended files hold it in different places.
std::optional<ImageSize> webpSize(const Data& data) {
  const std::string kind(data.begin() + 12, data.begin() + 16);
  if (kind == "VP8 ") {
    return imageSize(littleEndian(data, 26, 2) & 0x3FFF, littleEndian(data, 28, 2) & 0x3FFF);
  }
  if (kind == "VP8L") {
    const std::int64_t bits = littleEndian(data, 21, 4);
    return imageSize((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1);
  }
  if (kind != "VP8X") return std::nullopt;
  return imageSize(littleEndian(data, 24, 3) + 1, littleEndian(data, 27, 3) + 1);
}

}  // namespace

std::optional<ImageSize> encodedSize(const std::vector<std::uint8_t>& data) {
  if (startsWith(data, {0xFF, 0xD8})) return jpegSize(data);
  if (startsWith(data, {0x89, 'P', 'N', 'G'}) && data.size() >= 24) {
    return imageSize(bigEndian(data, 16, 4), bigEndian(data, 20, 4));
  }
  if (startsWith(data, {'B', 'M'}) && data.size() >= 26) {
    const auto height = static_cast<std::int32_t>(littleEndian(data, 22, 4));  // < 0: top down
    return imageSize(littleEndian(data, 18, 4), std::abs(std::int64_t{height}));
  }
  if (startsWith(data, {'I', 'I', 42, 0}) || startsWith(data, {'M', 'M', 0, 42})) {
    return tiffSize(data);
  }
  if (startsWith(data, {'R', 'I', 'F', 'F'}) && data.size() >= 30) return webpSize(data);
  return std::nullopt;
}

#ifdef SLF_HAVE_TURBOJPEG

cv::Mat decodedJpeg(const std::vector<std::uint8_t>& data) {
  if (data.size() < 2 || data[0] != 0xFF || data[1] != 0xD8) return {};
  const std::unique_ptr<void, int (*)(tjhandle)> decoder(tjInitDecompress(), tjDestroy);
  const auto length = static_cast<unsigned long>(data.size());
  int width = 0, height = 0, subsampling = 0, colours = 0;
  if (!decoder || tjDecompressHeader3(decoder.get(), data.data(), length, &width, &height,
                                      &subsampling, &colours) != 0) {
    return {};
  }
  const bool gray = colours == TJCS_GRAY;
  if ((!gray && colours != TJCS_YCbCr) || std::int64_t{width} * height > kMostPixels) return {};
  cv::Mat image(height, width, gray ? CV_8UC1 : CV_8UC3);
  if (tjDecompress2(decoder.get(), data.data(), length, image.data, width,
                    static_cast<int>(image.step), height, gray ? TJPF_GRAY : TJPF_BGR, 0) != 0) {
    return {};
  }
  return image;
}

#else

cv::Mat decodedJpeg(const std::vector<std::uint8_t>&) { return {}; }

#endif

bool jpegIsCutOff(const std::vector<std::uint8_t>& data) {
  constexpr std::uint8_t kMarker = 0xFF, kStart = 0xD8, kScan = 0xDA, kEnd = 0xD9;
  if (data.size() < 2 || data[0] != kMarker || data[1] != kStart) return false;
  // No marker of a thumbnail comes after the last scan begins, and none lies in its data.
  for (std::size_t i = data.size() - 1; i > 0; --i) {
    if (data[i - 1] != kMarker) continue;
    if (data[i] == kEnd) return false;
    if (data[i] == kScan) break;
  }
  return true;
}

}  // namespace semantic_lidar_fusion

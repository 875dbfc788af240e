// SPDX-License-Identifier: MIT
#include "edge/jpeg_decoder.h"

#ifdef SLF_HAVE_TURBOJPEG
#include <turbojpeg.h>

#include <memory>
#endif

namespace semantic_lidar_fusion {

#ifdef SLF_HAVE_TURBOJPEG

cv::Mat decodedJpeg(const std::vector<std::uint8_t>& data) {
  constexpr std::int64_t kMostPixels = 1 << 26;  // of any camera; no header allocates more here
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

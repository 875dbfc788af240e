// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <opencv2/core.hpp>
#include <optional>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

/// Pixels that a picture may have: more than any camera's.
constexpr std::int64_t kMostPixels = 1 << 26;

/// The size that the header of a JPEG, PNG, BMP, TIFF or WebP declares; empty for anything else.
std::optional<ImageSize> encodedSize(const std::vector<std::uint8_t>& data);

/// The pixels of a JPEG image as cv::imdecode gives them, CV_8UC1 or CV_8UC3 in BGR order, without
/// its detour over RGB, which takes a quarter of the time of compressed streams. Empty if the data
/// is something else, unusual or damaged in any way, or if the package is built without
/// libjpeg-turbo: then cv::imdecode is to judge.
cv::Mat decodedJpeg(const std::vector<std::uint8_t>& data);

/// Whether a JPEG ends before its end marker. libjpeg and the versions of OpenCV fill what is
/// missing in different ways, some with whatever the memory holds.
bool jpegIsCutOff(const std::vector<std::uint8_t>& data);

}  // namespace semantic_lidar_fusion

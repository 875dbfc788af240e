// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>

namespace semantic_lidar_fusion {

/// Where the readout of an image goes, as it is seen in the image.
enum class ShutterDirection : std::uint8_t { kDown, kUp, kRight, kLeft };
/// Which row (column, for kRight and kLeft) is exposed at the image's stamp.
enum class StampRow : std::uint8_t { kFirst, kMiddle, kLast };

/// A shutter that exposes row after row. With H rows of the sensor, row i of the readout (0 is the
/// first) is exposed (i - s) readout_s / H after the stamp, where s = 0, (H - 1) / 2 or H - 1 after
/// `stamp_row`. Rows are the sensor's: binning and ROI take rows away and do not quicken the
/// others.
struct ShutterConfig {
  double readout_s = 0.0;  ///< of the whole sensor; 0 = all rows at one time
  ShutterDirection direction = ShutterDirection::kDown;
  StampRow stamp_row = StampRow::kFirst;
};

/// When the rows of an image, after binning and ROI, are exposed; s after the image's time.
struct RowTimes {
  bool down = true;      ///< rows run down or up; else columns run across
  double at_zero_s = 0;  ///< of pixel coordinate 0
  double per_px_s = 0;

  double at(double u, double v) const { return at_zero_s + per_px_s * (down ? v : u); }
};

}  // namespace semantic_lidar_fusion

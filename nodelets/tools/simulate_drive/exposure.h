// SPDX-License-Identifier: MIT
/// When each row or column of an image is exposed.
#pragma once

#include <Eigen/Core>
#include <cstdint>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {
namespace simulator {

/// Where the readout goes, as it is seen in the image.
enum class ReadoutWay : std::uint8_t { kDown, kUp, kRight, kLeft };

struct Shutter {
  double readout_s = 0.0;  ///< from the first line to the one after the last; 0 = all at one time
  ReadoutWay way = ReadoutWay::kDown;
  double stamp_at = 0.0;  ///< of the lines: 0 the first is exposed at the image's time, 1 the last
};

/// Of one image. A line is a row (readout down or up) or a column, numbered as pixels are; all of a
/// global shutter is one line.
class Exposure {
 public:
  Exposure(const Shutter& shutter, const ImageSize& size, double time_s)
      : time_s_(time_s),
        rows_(shutter.way == ReadoutWay::kDown || shutter.way == ReadoutWay::kUp),
        rolling_(shutter.readout_s > 0.0),
        lines_(!rolling_ ? 1
               : rows_   ? size.height
                         : size.width) {
    const bool rising = shutter.way == ReadoutWay::kDown || shutter.way == ReadoutWay::kRight;
    const double stamped = (rising ? shutter.stamp_at : 1.0 - shutter.stamp_at) * (lines_ - 1);
    s_per_line_ = (rising ? 1.0 : -1.0) * shutter.readout_s / lines_;
    zero_s_ = time_s_ - stamped * s_per_line_;
  }

  bool rolling() const { return rolling_; }
  bool linesAreRows() const { return rows_; }
  int lines() const { return lines_; }
  /// Of the image.
  double time() const { return time_s_; }
  double timeOf(int line) const { return rolling_ ? zero_s_ + line * s_per_line_ : time_s_; }
  double timeAt(const Eigen::Vector2d& pixel) const {
    return rolling_ ? zero_s_ + (rows_ ? pixel.y() : pixel.x()) * s_per_line_ : time_s_;
  }

 private:
  double time_s_;
  bool rows_, rolling_;
  int lines_;
  double s_per_line_ = 0.0, zero_s_ = 0.0;
};

}  // namespace simulator
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// SLIC superpixels (Achanta et al., "SLIC Superpixels Compared to State-of-the-Art Superpixel
/// Methods", PAMI 2012): local k-means in colour and position, then one region per superpixel.
///
/// Made for video on few cores: distances are 8-bit sums in an opponent colour space, an iteration
/// visits every third row, and the clusters of one image can start from those of the one before.
#pragma once

#include <memory>
#include <opencv2/core.hpp>
#include <optional>

#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/superpixel/superpixel_map.h"

namespace semantic_lidar_fusion {

struct SlicConfig {
  int count = 1000;           ///< wanted superpixels, >= 1; clamped to 1..pixels / 64
  double compactness = 10.0;  ///< weight of position against colour, > 0: 10 as in CIELab units
  int iterations = 10;        ///< of the k-means at most, 1..100; it ends once the clusters rest
  /// Start from the clusters of the image before. Less work, and superpixels that follow the scene,
  /// but the map then depends on the images before. Falls back to a cold start on a scene cut,
  /// another size or number of channels, and a stamp that goes back or jumps.
  bool warm_start = false;
  /// The part of the map that is clustered, 0..1, with its part of `count`: the blocks of 16 rows
  /// that hold it. The other rows repeat the nearest of them. Superpixels in it are those of the
  /// whole map as far as those at its border do not push them.
  RowBand rows;
};

/// Number of superpixels that `cluster` aims at: `config.count` clamped to 1..pixels / 64.
int clampedSuperpixelCount(const SlicConfig& config, const ImageSize& map_size);

/// Clusters images of one camera. Not thread-safe; one instance per camera.
class Slic {
 public:
  /// Throws ConfigError.
  explicit Slic(const SlicConfig& config);
  ~Slic();
  Slic(Slic&&) noexcept;
  Slic& operator=(Slic&&) noexcept;

  /// `image`: CV_8UC1 or CV_8UC3 (BGR), any size from 1x1. The map has `map_size`, the image being
  /// brought to it by averaging over each map pixel's box (exact, also for a map that is larger).
  /// `stamp`, if given, is the image's time (ns) and limits the warm start to images that follow
  /// each other within kMaxWarmGapNs. Obtains clampedSuperpixelCount within 10 % (that part of it
  /// which `rows` are of the map); ids are in raster order of first appearance. Deterministic:
  /// equal sequences of images give equal maps on every machine. Throws DataError on an empty
  /// image, another type, or a map size below 1x1.
  SuperpixelMap cluster(const cv::Mat& image, const ImageSize& map_size,
                        std::optional<StampNs> stamp = std::nullopt);

  /// Other `rows` from the next image on, which starts cold if they are other blocks. Throws
  /// ConfigError.
  void setRows(const RowBand& rows);

  /// Forgets the image before: the next one starts cold.
  void reset();

  /// Whether the last map started from the image before.
  bool startedWarm() const;

  static constexpr StampNs kMaxWarmGapNs = kNsPerSecond / 2;

 private:
  class Engine;
  SlicConfig config_;
  std::unique_ptr<Engine> engine_;
};

}  // namespace semantic_lidar_fusion

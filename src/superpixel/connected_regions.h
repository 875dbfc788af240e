// SPDX-License-Identifier: MIT
/// From cluster labels to superpixels: each a 4-connected region, in a number near the wanted one.
///
/// Works on runs (maximal stretches of one label within a row), joined by union-find; an image of
/// superpixels has some twenty times fewer runs than pixels.
#pragma once

#include <vector>

#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/superpixel/superpixel_map.h"

namespace semantic_lidar_fusion {

/// Cluster labels of an image as runs in raster order. The runs of row y are
/// row_first[y]..row_first[y + 1] - 1; a run ends where the next of its row, or the row, does.
struct RunImage {
  ImageSize size;
  std::vector<int> row_first;  ///< size.height + 1 entries
  std::vector<int> begin;      ///< first column of each run
  std::vector<int> label;      ///< any integer, equal within a cluster
};

/// Keeps the large 4-connected regions of equal labels (at least a quarter of the mean superpixel)
/// and joins the others to a neighbour. The obtained count is within 5 % of `wanted` (rounded
/// inwards), for any labels: regions are kept or joined by size to that end and, if there are too
/// few, the largest are split. Needs `wanted` in 1..pixels.
SuperpixelMap connectedRegions(const RunImage& runs, int wanted);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// From cluster labels to superpixels: each a 4-connected region, in a number near the wanted one.
///
/// Works on runs (maximal stretches of one label within a row), joined by union-find; an image of
/// superpixels has some ten times fewer runs than pixels.
#pragma once

#include <vector>

#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/superpixel/superpixel_map.h"

namespace semantic_lidar_fusion {

struct Run {
  int begin;  ///< first column; the next run of the row begins where this one ends
  int label;  ///< equal within a cluster, not negative
};

/// Cluster labels of an image as runs in raster order. Row y holds runs[row_first[y]] up to but
/// without runs[row_first[y + 1] - 1], which is its end mark: begin = width, label = -1.
struct RunImage {
  ImageSize size;
  std::vector<int> row_first;  ///< size.height + 1 entries
  std::vector<Run> runs;
};

/// Keeps the large 4-connected regions of equal labels (at least a quarter of the mean superpixel)
/// and joins the others to a neighbour. The obtained count is within 5 % of `wanted` (rounded
/// inwards), for any labels: regions are kept or joined by size to that end and, if there are too
/// few, the largest are split. Needs `wanted` in 1..pixels. Keeps its buffers between images.
class RegionConnector {
 public:
  SuperpixelMap connect(const RunImage& image, int wanted);

 private:
  void findComponents(const RunImage& image);
  void chooseKept(int min_size, int lowest, int highest);
  void joinSmall(const RunImage& image);
  SuperpixelMap paint(const RunImage& image);

  /// A set of runs that were found connected before the row under work; the earliest of a
  /// component's sets stands for it.
  struct Component {
    int parent;     ///< an earlier set of the same component, or itself
    int size;       ///< pixels
    int first_run;  ///< in raster order
    int row;        ///< of the first run
    int owner;      ///< the kept component that its pixels go to
    bool kept;
    int id;  ///< of the superpixel, once known
  };
  int root(int component);

  std::vector<int> component_of_run_;
  std::vector<Component> components_;
};

}  // namespace semantic_lidar_fusion

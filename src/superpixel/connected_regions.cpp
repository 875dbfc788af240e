// SPDX-License-Identifier: MIT
#include "connected_regions.h"

#include <algorithm>
#include <cstdint>
#include <numeric>
#include <utility>

namespace semantic_lidar_fusion {
namespace {

/// Root of a set; halves the path on the way. Parents never have a larger index than their
/// children, so a root is the first run of its set.
int findRoot(std::vector<int>* parent, int run) {
  while ((*parent)[run] != run) {
    (*parent)[run] = (*parent)[(*parent)[run]];
    run = (*parent)[run];
  }
  return run;
}

void unite(std::vector<int>* parent, int a, int b) {
  a = findRoot(parent, a);
  b = findRoot(parent, b);
  (*parent)[std::max(a, b)] = std::min(a, b);
}

/// Calls `visit(upper, lower)` for each pair of runs of neighbouring rows that share a column.
template <typename Visit>
void forEachVerticalContact(const RunImage& runs, const Visit& visit) {
  for (int y = 1; y < runs.size.height; ++y) {
    int upper = runs.row_first[y - 1];
    const int upper_end = runs.row_first[y];
    for (int lower = runs.row_first[y]; lower < runs.row_first[y + 1]; ++lower) {
      const int end = lower + 1 < runs.row_first[y + 1] ? runs.begin[lower + 1] : runs.size.width;
      while (upper + 1 < upper_end && runs.begin[upper + 1] <= runs.begin[lower]) ++upper;
      visit(upper, lower);
      while (upper + 1 < upper_end && runs.begin[upper + 1] < end) visit(++upper, lower);
    }
  }
}

struct Components {
  std::vector<int> of_run;     ///< component of each run; components in raster order
  std::vector<int> first_run;  ///< of each component
  std::vector<int> size;       ///< pixels of each component
};

Components connectedComponents(const RunImage& runs) {
  const int run_count = static_cast<int>(runs.begin.size());
  std::vector<int> parent(run_count);
  std::iota(parent.begin(), parent.end(), 0);
  forEachVerticalContact(runs, [&](int upper, int lower) {
    if (runs.label[upper] == runs.label[lower]) unite(&parent, upper, lower);
  });

  Components components;
  components.of_run.resize(run_count);
  for (int y = 0; y < runs.size.height; ++y) {
    for (int run = runs.row_first[y]; run < runs.row_first[y + 1]; ++run) {
      if (parent[run] == run) {
        components.of_run[run] = static_cast<int>(components.size.size());
        components.first_run.push_back(run);
        components.size.push_back(0);
      } else {
        components.of_run[run] = components.of_run[parent[run]];
      }
      const int end = run + 1 < runs.row_first[y + 1] ? runs.begin[run + 1] : runs.size.width;
      components.size[components.of_run[run]] += end - runs.begin[run];
    }
  }
  return components;
}

struct CountRange {
  int lowest, highest;
};

CountRange toleratedCounts(int wanted) { return {wanted - wanted / 20, wanted + wanted / 20}; }

/// The components that become superpixels: all of at least `min_size` pixels, but as many of the
/// largest as the tolerated counts ask for; the earlier of equal ones.
std::vector<char> chooseKept(const std::vector<int>& sizes, int min_size, const CountRange& range) {
  const int component_count = static_cast<int>(sizes.size());
  std::vector<char> kept(component_count, 0);
  int large = 0;
  for (int c = 0; c < component_count; ++c) large += kept[c] = sizes[c] >= min_size;
  const int wanted =
      std::min(std::max(large, range.lowest), std::min(range.highest, component_count));
  if (wanted == large) return kept;

  std::vector<int> by_size(component_count);
  std::iota(by_size.begin(), by_size.end(), 0);
  std::stable_sort(by_size.begin(), by_size.end(),
                   [&](int a, int b) { return sizes[a] > sizes[b]; });
  for (int i = 0; i < component_count; ++i) kept[by_size[i]] = i < wanted;
  return kept;
}

/// For each component the kept one that it belongs to: itself, or the one that its first pixel's
/// left or upper neighbour belongs to.
std::vector<int> joinSmall(const RunImage& runs, const Components& components,
                           const std::vector<char>& kept) {
  const int component_count = static_cast<int>(components.size.size());
  // Neighbours to the left and above are earlier components, so that one pass resolves all but
  // those that end in a small component 0.
  std::vector<int> owner(component_count);
  std::vector<int> row_of_first(component_count);
  for (int y = 0; y < runs.size.height; ++y) {
    for (int run = runs.row_first[y]; run < runs.row_first[y + 1]; ++run) {
      const int c = components.of_run[run];
      if (components.first_run[c] == run) row_of_first[c] = y;
    }
  }
  for (int c = 0; c < component_count; ++c) {
    owner[c] = c;
    if (kept[c] || c == 0) continue;
    const int run = components.first_run[c];
    const int y = row_of_first[c];
    int neighbour = run - 1;
    if (runs.begin[run] == 0) neighbour = runs.row_first[y - 1];
    owner[c] = owner[components.of_run[neighbour]];
  }
  if (kept[0]) return owner;

  // The first contact of component 0's followers with a kept one decides for all of them.
  int adopter = -1;
  const auto consider = [&](int run_a, int run_b) {
    const int a = owner[components.of_run[run_a]];
    const int b = owner[components.of_run[run_b]];
    if (adopter < 0 && (a == 0) != (b == 0)) adopter = a == 0 ? b : a;
  };
  for (int y = 0; y < runs.size.height; ++y) {
    for (int run = runs.row_first[y] + 1; run < runs.row_first[y + 1]; ++run) {
      consider(run - 1, run);
    }
  }
  forEachVerticalContact(runs, consider);
  std::replace(owner.begin(), owner.end(), 0, adopter);
  return owner;
}

/// Writes the owners as ids in raster order of first appearance.
SuperpixelMap paint(const RunImage& runs, const Components& components,
                    const std::vector<int>& owner) {
  SuperpixelMap map;
  map.ids.create(runs.size.height, runs.size.width, CV_32SC1);
  std::vector<int> id_of(owner.size(), -1);
  for (int y = 0; y < runs.size.height; ++y) {
    int* row = map.ids.ptr<int>(y);
    for (int run = runs.row_first[y]; run < runs.row_first[y + 1]; ++run) {
      int& id = id_of[owner[components.of_run[run]]];
      if (id < 0) {
        id = map.count++;
        map.sizes.push_back(0);
      }
      const int end = run + 1 < runs.row_first[y + 1] ? runs.begin[run + 1] : runs.size.width;
      std::fill(row + runs.begin[run], row + end, id);
      map.sizes[id] += end - runs.begin[run];
    }
  }
  return map;
}

/// Gives a connected part of superpixel `split`, near half of it, the id map->count: a subtree of
/// the breadth-first tree from its first pixel (a cut tree falls into two connected parts).
void splitRegion(int split, SuperpixelMap* map) {
  cv::Mat& ids = map->ids;
  const int width = ids.cols;
  std::vector<int> order, parent;  // of the tree's nodes: pixel index, and node index of the parent
  std::vector<char> seen(ids.total(), 0);
  const auto push = [&](int pixel, int from) {
    if (seen[pixel] || ids.at<int>(pixel / width, pixel % width) != split) return;
    seen[pixel] = 1;
    order.push_back(pixel);
    parent.push_back(from);
  };
  for (int pixel = 0; order.empty(); ++pixel) push(pixel, -1);
  for (int node = 0; node < static_cast<int>(order.size()); ++node) {
    const int pixel = order[node];
    if (pixel % width > 0) push(pixel - 1, node);
    if (pixel % width + 1 < width) push(pixel + 1, node);
    if (pixel >= width) push(pixel - width, node);
    if (pixel + width < static_cast<int>(ids.total())) push(pixel + width, node);
  }

  const int node_count = static_cast<int>(order.size());
  std::vector<int> below(node_count, 1);
  int cut = 1;
  for (int node = node_count - 1; node > 0; --node) {
    below[parent[node]] += below[node];
    if (std::abs(2 * below[node] - node_count) < std::abs(2 * below[cut] - node_count)) cut = node;
  }
  std::vector<char> moved(node_count, 0);
  for (int node = cut; node < node_count; ++node) {
    moved[node] = node == cut || moved[parent[node]];
    if (moved[node]) ids.at<int>(order[node] / width, order[node] % width) = map->count;
  }
  map->sizes[split] -= below[cut];
  map->sizes.push_back(below[cut]);
  ++map->count;
}

void renumberInRasterOrder(SuperpixelMap* map) {
  std::vector<int> id_of(map->count, -1);
  std::vector<int> sizes;
  for (int y = 0; y < map->ids.rows; ++y) {
    int* row = map->ids.ptr<int>(y);
    for (int x = 0; x < map->ids.cols; ++x) {
      int& id = id_of[row[x]];
      if (id < 0) {
        id = static_cast<int>(sizes.size());
        sizes.push_back(map->sizes[row[x]]);
      }
      row[x] = id;
    }
  }
  map->sizes = std::move(sizes);
}

}  // namespace

SuperpixelMap connectedRegions(const RunImage& runs, int wanted) {
  const Components components = connectedComponents(runs);
  const CountRange range = toleratedCounts(wanted);
  const std::int64_t pixels = static_cast<std::int64_t>(runs.size.width) * runs.size.height;
  const int min_size = static_cast<int>(std::max<std::int64_t>(1, pixels / wanted / 4));
  const std::vector<char> kept = chooseKept(components.size, min_size, range);
  SuperpixelMap map = paint(runs, components, joinSmall(runs, components, kept));

  if (map.count >= range.lowest) return map;
  while (map.count < range.lowest) {
    splitRegion(
        static_cast<int>(std::max_element(map.sizes.begin(), map.sizes.end()) - map.sizes.begin()),
        &map);
  }
  renumberInRasterOrder(&map);
  return map;
}

}  // namespace semantic_lidar_fusion

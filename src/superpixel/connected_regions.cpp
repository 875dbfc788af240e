// SPDX-License-Identifier: MIT
#include "connected_regions.h"

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <utility>

namespace semantic_lidar_fusion {
namespace {

/// Calls `visit(upper, lower)` for each pair of runs of neighbouring rows that share a column.
template <typename Visit>
void forEachVerticalContact(const RunImage& image, const Visit& visit) {
  for (int y = 1; y < image.size.height; ++y) {
    int upper = image.row_first[y - 1];
    for (int lower = image.row_first[y]; lower + 1 < image.row_first[y + 1]; ++lower) {
      const int end = image.runs[lower + 1].begin;
      while (image.runs[upper + 1].begin <= image.runs[lower].begin) ++upper;
      for (int u = upper; image.runs[u].begin < end; ++u) visit(u, lower);
    }
  }
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

int RegionConnector::root(int component) {
  while (components_[component].parent != component) {
    const int parent = components_[component].parent;
    component = components_[component].parent = components_[parent].parent;
  }
  return component;
}

void RegionConnector::findComponents(const RunImage& image) {
  component_of_run_.resize(image.runs.size());
  components_.clear();
  const Run* runs = image.runs.data();
  int* component_of = component_of_run_.data();
  for (int y = 0; y < image.size.height; ++y) {
    // Above row 0 there is only an end mark.
    int upper = y > 0 ? image.row_first[y - 1] : image.row_first[1] - 1;
    const int upper_end = y > 0 ? image.row_first[y] - 1 : upper;
    for (int run = image.row_first[y]; run + 1 < image.row_first[y + 1]; ++run) {
      const int begin = runs[run].begin, end = runs[run + 1].begin, label = runs[run].label;
      int component = -1;
      while (upper < upper_end && runs[upper + 1].begin <= begin) ++upper;
      for (int u = upper; u < upper_end && runs[u].begin < end; ++u) {
        if (runs[u].label != label || component_of[u] == component) continue;
        if (component < 0) {
          component = component_of[u];
          continue;
        }
        const int a = root(component), b = root(component_of[u]);
        components_[std::max(a, b)].parent = std::min(a, b);
      }
      if (component < 0) {
        component = static_cast<int>(components_.size());
        components_.push_back({component, 0, run, y, component, false, -1});
      }
      component_of[run] = component;
      components_[component].size += end - begin;
    }
  }
  for (Component& component : components_) {
    // A parent is earlier, so that its own parent is a root by now.
    component.parent = components_[component.parent].parent;
    Component& first = components_[component.parent];
    if (&first != &component) first.size += std::exchange(component.size, 0);
  }
}

/// The components that become superpixels: all of at least `min_size` pixels, but as many of the
/// largest as `lowest` and `highest` ask for; the earlier of equal ones.
void RegionConnector::chooseKept(int min_size, int lowest, int highest) {
  int large = 0, whole = 0;
  for (Component& component : components_) {
    component.kept = component.size >= min_size;
    large += component.kept;
    whole += component.size > 0;
  }
  const int wanted = std::min(std::max(large, lowest), std::min(highest, whole));
  if (wanted == large) return;

  std::vector<int> by_size;
  for (int c = 0; c < static_cast<int>(components_.size()); ++c) {
    if (components_[c].size > 0) by_size.push_back(c);
  }
  std::stable_sort(by_size.begin(), by_size.end(),
                   [&](int a, int b) { return components_[a].size > components_[b].size; });
  for (int i = 0; i < whole; ++i) components_[by_size[i]].kept = i < wanted;
}

/// The owner of a component that is not kept is that of its first pixel's left or else upper
/// neighbour.
void RegionConnector::joinSmall(const RunImage& image) {
  // Those neighbours are in earlier components: one pass resolves all but what ends in a small
  // component 0.
  for (int c = 1; c < static_cast<int>(components_.size()); ++c) {
    Component& component = components_[c];
    if (component.size == 0 || component.kept) continue;
    const int neighbour = image.runs[component.first_run].begin > 0
                              ? component.first_run - 1
                              : image.row_first[component.row - 1];
    component.owner = components_[components_[component_of_run_[neighbour]].parent].owner;
  }
  if (components_[0].kept) return;

  // The first contact of component 0's followers with a kept one decides for all of them.
  int adopter = -1;
  const auto owner = [&](int run) {
    return components_[components_[component_of_run_[run]].parent].owner;
  };
  const auto consider = [&](int run_a, int run_b) {
    const int a = owner(run_a), b = owner(run_b);
    if (adopter < 0 && (a == 0) != (b == 0)) adopter = a == 0 ? b : a;
  };
  for (int y = 0; y < image.size.height; ++y) {
    for (int run = image.row_first[y] + 1; run + 1 < image.row_first[y + 1]; ++run) {
      consider(run - 1, run);
    }
  }
  forEachVerticalContact(image, consider);
  for (Component& component : components_) {
    if (component.owner == 0) component.owner = adopter;
  }
}

/// Writes the owners as ids in raster order of first appearance.
SuperpixelMap RegionConnector::paint(const RunImage& image) {
  SuperpixelMap map;
  // Components are in that order themselves.
  for (Component& component : components_) {
    Component& first = components_[component.parent];
    Component& owner = components_[first.owner];
    if (owner.id < 0) {
      owner.id = map.count++;
      map.sizes.push_back(0);
    }
    map.sizes[owner.id] += component.size;
    component.id = owner.id;
  }

  map.ids.create(image.size.height, image.size.width, CV_32SC1);
  constexpr int kStep = 8;
  int* const ids_end = map.ids.ptr<int>() + map.ids.total();
  for (int y = 0; y < image.size.height; ++y) {
    int* row = map.ids.ptr<int>(y);
    // Whole steps may write beyond a run: what comes after it is written after it.
    const bool room = ids_end - (row + image.size.width) >= kStep;
    for (int run = image.row_first[y]; run + 1 < image.row_first[y + 1]; ++run) {
      const int id = components_[component_of_run_[run]].id;
      const int begin = image.runs[run].begin, end = image.runs[run + 1].begin;
      if (room) {
        for (int x = begin; x < end; x += kStep) {
          for (int i = 0; i < kStep; ++i) row[x + i] = id;
        }
      } else {
        std::fill(row + begin, row + end, id);
      }
    }
  }
  return map;
}

SuperpixelMap RegionConnector::connect(const RunImage& image, int wanted) {
  const int lowest = wanted - wanted / 20, highest = wanted + wanted / 20;
  const std::int64_t pixels = static_cast<std::int64_t>(image.size.width) * image.size.height;
  findComponents(image);
  chooseKept(static_cast<int>(std::max<std::int64_t>(1, pixels / wanted / 4)), lowest, highest);
  joinSmall(image);
  SuperpixelMap map = paint(image);
  if (map.count >= lowest) return map;

  while (map.count < lowest) {
    splitRegion(
        static_cast<int>(std::max_element(map.sizes.begin(), map.sizes.end()) - map.sizes.begin()),
        &map);
  }
  renumberInRasterOrder(&map);
  return map;
}

}  // namespace semantic_lidar_fusion

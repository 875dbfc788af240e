// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/projection/beam_grid.h"

#include <utility>

#include "beam_steps.h"
#include "ground_plane.h"
#include "range_image.h"
#include "semantic_lidar_fusion/common/thread_pool.h"
#include "surface_linker.h"

namespace semantic_lidar_fusion {
namespace {

/// Links by places of the range image as links by cloud index.
std::vector<BeamGrid::Links> linksOfCloud(const RangeImage& image,
                                          const std::vector<BeamGrid::Links>& of_places,
                                          std::size_t cloud_size, ThreadPool* pool) {
  constexpr std::int32_t kNone = BeamGrid::kNoLink;
  std::vector<BeamGrid::Links> links(cloud_size, {kNone, kNone, kNone, kNone});
  const auto indexOf = [&](std::int32_t place) {
    return place == kNone ? kNone : static_cast<std::int32_t>(image.index[place]);
  };
  forEach(pool, image.rows(), [&](int row) {
    for (std::uint32_t place = image.row_begin[row]; place < image.row_begin[row + 1]; ++place) {
      const BeamGrid::Links& own = of_places[place];
      links[image.index[place]] = {indexOf(own.left), indexOf(own.right), indexOf(own.up),
                                   indexOf(own.down)};
    }
  });
  return links;
}

}  // namespace

BeamGrid beamGrid(const Cloud& cloud, const OcclusionConfig& config, ThreadPool* pool,
                  bool with_links) {
  using Needs = OcclusionMode::Needs;
  BeamGrid grid;
  const Needs needs = config.mode->needs;
  with_links = with_links || needs == Needs::kLinks;
  if (needs == Needs::kNothing && !with_links) return grid;
  const bool vertical_given = config.vertical_step_deg > 0.0;
  const bool horizontal_given = config.horizontal_step_deg > 0.0;
  if (with_links || !vertical_given || !horizontal_given) {
    RangeImage image = rangeImage(cloud, config, pool);
    measureSteps(image, config, pool, &grid);
    if (with_links) {
      grid.links = linksOfCloud(image, linkSurfaces(image, config, grid, pool), cloud.size(), pool);
      grid.ground = groundPlane(image, grid);
      grid.ring = std::move(image.row_of);
      grid.note = std::move(image.note);
    }
  }
  if (vertical_given) grid.vertical_step_rad = radians(config.vertical_step_deg);
  if (horizontal_given) grid.horizontal_step_rad = radians(config.horizontal_step_deg);
  return grid;
}

}  // namespace semantic_lidar_fusion

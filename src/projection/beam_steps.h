// SPDX-License-Identifier: MIT
/// The angles between a lidar's beams, measured from its returns.
#pragma once

#include "range_image.h"
#include "semantic_lidar_fusion/projection/beam_grid.h"

namespace semantic_lidar_fusion {

/// Fills `rings`, `vertical_step_rad` and `horizontal_step_rad` of `grid`; steps that `config`
/// gives override the data. The result does not depend on `pool`.
void measureSteps(const RangeImage& image, const OcclusionConfig& config, ThreadPool* pool,
                  BeamGrid* grid);

/// For each turn its rows with returns, by elevation; ring numbers of some drivers are not in that
/// order.
std::vector<std::vector<int>> rowsUpwards(const RangeImage& image, const BeamGrid& grid);

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Several turns of a lidar in one scan.
///
/// Drivers that count packets put several turns into a message when the field of view is reduced,
/// and some put two full turns. Between turns the vehicle moves on, so neighbours in azimuth would
/// be returns of different moments and places.
#pragma once

#include <cstdint>
#include <vector>

#include "semantic_lidar_fusion/common/point_cloud.h"

namespace semantic_lidar_fusion {

/// The number of turns; one unless some ring sweeps more than a turn and a quarter, gaps in the
/// field of view included. Where there are more, the rows of turn k become k * ring_count + ring;
/// the last row numbers hold what does not fit. `rows`: by cloud index the ring, kNoRing = not
/// used. Points count in the order of their times. A cloud without times, or that is in no order
/// of azimuth, is one turn.
int splitTurns(const Cloud& cloud, const std::vector<float>& azimuth, int ring_count,
               std::vector<std::uint16_t>* rows);

}  // namespace semantic_lidar_fusion

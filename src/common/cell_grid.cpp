// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/common/cell_grid.h"

#include <cstddef>
#include <cstdint>

namespace semantic_lidar_fusion {

std::vector<int> cellsUnderCentres(int source_count, int target_count) {
  if (source_count <= 0) return {};
  std::vector<int> cells(static_cast<std::size_t>(source_count));
  // (2 i + 1) * target / (2 * source) as quotient and remainder, one step at a time.
  const std::int64_t divisor = 2 * static_cast<std::int64_t>(source_count);
  const std::int64_t step = 2 * static_cast<std::int64_t>(target_count);
  const int whole = static_cast<int>(step / divisor);
  const std::int64_t part = step % divisor;
  int cell = static_cast<int>(target_count / divisor);
  std::int64_t remainder = target_count % divisor;
  for (int& out : cells) {
    out = cell;
    cell += whole;
    remainder += part;
    if (remainder >= divisor) {
      remainder -= divisor;
      ++cell;
    }
  }
  return cells;
}

}  // namespace semantic_lidar_fusion

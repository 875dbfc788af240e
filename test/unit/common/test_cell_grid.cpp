// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include "semantic_lidar_fusion/common/cell_grid.h"
#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {
namespace {

TEST(CellsUnderCentres, AreThoseOfTheDefinition) {
  for (const int source : {1, 2, 3, 7, 64, 402, 603, 640, 1208, 1920, 32767}) {
    for (const int target : {1, 2, 3, 5, 63, 402, 640, 641, 1928, 32767}) {
      const std::vector<int> cells = cellsUnderCentres(source, target);
      ASSERT_EQ(cells.size(), static_cast<std::size_t>(source));
      for (int i = 0; i < source; ++i) {
        ASSERT_EQ(cells[static_cast<std::size_t>(i)], cellUnderCentre(i, source, target))
            << i << " of " << source << " into " << target;
      }
    }
  }
  EXPECT_TRUE(cellsUnderCentres(0, 5).empty());
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <string>

#include "semantic_lidar_fusion/sync/stamped_store.h"

namespace semantic_lidar_fusion {
namespace {

std::size_t length(const std::string& text) { return text.size(); }

TEST(StampedStore, KeepsTheNewestWithinSoManyBytes) {
  StampedStore<std::string> store(8);
  store.put(30, "ccc");
  store.put(10, "a");
  store.put(40, "dddd");
  store.put(20, "bb");
  EXPECT_EQ(store.trim(10, length), 0u);
  EXPECT_EQ(store.size(), 4u);
  EXPECT_EQ(store.trim(9, length), 1u);  // the oldest makes 10 bytes 9
  EXPECT_EQ(store.find(10), nullptr);
  EXPECT_EQ(store.trim(6, length), 2u);  // without the next one there are still 7
  ASSERT_NE(store.find(40), nullptr);
  EXPECT_EQ(store.size(), 1u);
  EXPECT_EQ(store.trim(1, length), 0u);  // the newest stays, whatever its size
  EXPECT_EQ(*store.find(40), "dddd");
}

}  // namespace
}  // namespace semantic_lidar_fusion

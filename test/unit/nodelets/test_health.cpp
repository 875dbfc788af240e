// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include "base/health.h"

namespace semantic_lidar_fusion {
namespace {

constexpr auto kEver = std::chrono::duration<double>::max();

std::string shown(Health* health, const std::string& key) {
  diagnostic_updater::DiagnosticStatusWrapper status;
  health->fill(status);
  for (const auto& value : status.values) {
    if (value.key == key) return value.value;
  }
  return {};
}

TEST(Health, CountsOfAnInputOutliveItsSubscription) {
  Health health;
  for (int round = 0; round < 3; ++round) {
    health.expectInput("/points");
    for (int i = 0; i < 5; ++i) health.received("/points");
    health.retireInput("/points");
    health.received("/points");  // on its way when the subscription ended
  }
  EXPECT_EQ(shown(&health, "input /points messages"), "18");
}

TEST(Health, AnInputIsMissedOnlyWhileItIsSubscribed) {
  Health health;
  health.expectInput("/points");
  EXPECT_EQ(health.silentInputs(kEver).size(), 1u);
  health.retireInput("/points");
  EXPECT_TRUE(health.silentInputs(kEver).empty());
  health.expectInput("/points");
  health.received("/points");
  EXPECT_TRUE(health.silentInputs(kEver).empty());
}

}  // namespace
}  // namespace semantic_lidar_fusion

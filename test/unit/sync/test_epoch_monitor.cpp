// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <map>
#include <set>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/sync/epoch_monitor.h"
#include "stamps.h"

namespace semantic_lidar_fusion {
namespace {

/// What a monitor let through, in order.
struct Seen {
  explicit Seen(EpochConfig config = {"lidar", 2, 0})
      : monitor(
            config,
            [this](StampNs stamp) {
              epochs.push_back(stamp);
              used.clear();
            },
            [this](const DiscardedMessage& message) { ++discarded[message.source]; }) {}
  void add(const std::string& source, StampNs stamp, StampNs tolerance_ns = 0) {
    const auto use = [=] {
      used[source].push_back(stamp);
      ++taken[source];
    };
    monitor.observe(source, stamp, use, tolerance_ns);
  }

  std::vector<StampNs> epochs;                       ///< where each epoch but the first starts
  std::map<std::string, std::vector<StampNs>> used;  ///< of this epoch, by source
  std::map<std::string, int> taken, discarded;       ///< of all epochs
  EpochMonitor monitor;
};

/// One scan of 10 Hz and three images of each camera, the scan last, as a bag holds them.
void addScan(Seen* seen, StampNs first, const std::vector<std::string>& cameras = {"image"}) {
  for (int k = 0; k < 3; ++k) {
    for (const std::string& camera : cameras) seen->add(camera, first + k * 33 * kMs);
  }
  seen->add("lidar", first);
}

TEST(EpochMonitor, OrdinaryDisorderIsOneEpoch) {
  Seen seen;
  for (int i = 0; i < 300; ++i) {
    seen.add("lidar", kStart + i * 100 * kMs);
    // A network that lags by 0.9 s, with neighbours swapped; a source that always lags by 3 s.
    seen.add("scores", kStart + (i - 9) * 100 * kMs + (i % 2 ? -150 : 150) * kMs);
    seen.add("slow", kStart + i * 100 * kMs - 3 * kNsPerSecond);
  }
  EXPECT_TRUE(seen.epochs.empty());
  EXPECT_TRUE(seen.discarded.empty());
  for (const char* source : {"lidar", "scores", "slow"}) EXPECT_EQ(seen.taken[source], 300);
}

TEST(EpochMonitor, BagLoopGivesOneNewEpochThatIsWholeAndWithoutStragglers) {
  for (const int scans : {6, 14, 100}) {  // 0.6 s too
    Seen seen;
    for (int loop = 0; loop < 3; ++loop) {
      for (int i = 0; i < scans; ++i) {
        addScan(&seen, kStart + i * 100 * kMs);
        // The last image of the pass before comes late.
        if (loop > 0 && i == 0) seen.add("other", kStart + scans * 100 * kMs);
        if (loop > 0 && i == 1) {
          EXPECT_EQ(seen.used["image"].front(), kStart);
          EXPECT_EQ(seen.used["lidar"].front(), kStart);
        }
        seen.add("other", kStart + i * 100 * kMs + 50 * kMs);
      }
      EXPECT_EQ(seen.epochs.size(), static_cast<std::size_t>(loop)) << scans << " scans";
      EXPECT_EQ(seen.taken["lidar"], (loop + 1) * scans) << scans << " scans";
      EXPECT_EQ(seen.taken["image"], (loop + 1) * scans * 3) << scans << " scans";
    }
  }
}

TEST(EpochMonitor, AForwardJumpIsANewEpochAndAGapIsNot) {
  Seen seen;
  addScan(&seen, kStart);
  addScan(&seen, kStart + 4 * kNsPerSecond);
  EXPECT_TRUE(seen.epochs.empty());
  const StampNs later = kStart + 3600 * kNsPerSecond;
  addScan(&seen, later);
  EXPECT_TRUE(seen.epochs.empty());
  addScan(&seen, later + 100 * kMs);
  EXPECT_EQ(seen.epochs, std::vector<StampNs>{later});
  EXPECT_EQ(seen.used["lidar"].front(), later);
  EXPECT_EQ(seen.used["image"].size(), 6u);
}

TEST(EpochMonitor, OneWildStampOfTheLeadIsDiscardedAlone) {
  for (const StampNs off : {-3600 * kNsPerSecond, -kNsPerSecond, -kNsPerSecond / 2,
                            10 * kNsPerSecond, 3600 * kNsPerSecond}) {
    Seen seen;
    for (int i = 0; i < 20; ++i) addScan(&seen, kStart + i * 100 * kMs + (i == 10 ? off : 0));
    EXPECT_TRUE(seen.epochs.empty()) << off;
    EXPECT_EQ(seen.taken["lidar"], 19) << off;
    EXPECT_EQ(seen.discarded["lidar"], 1) << off;
  }
}

TEST(EpochMonitor, NoOtherSourceStartsAnEpochOrStopsTheRest) {
  for (const StampNs off :
       {-3600 * kNsPerSecond, -10 * kNsPerSecond, 10 * kNsPerSecond, 3600 * kNsPerSecond}) {
    for (const int every : {1, 2, 7}) {  // always off, flapping, now and then
      Seen seen;
      seen.add("lidar", kStart - 100 * kMs);
      for (int i = 0; i < 100; ++i) {
        const StampNs stamp = kStart + i * 100 * kMs;
        seen.add("wrong", stamp + (i % every == 0 ? off : 0));
        addScan(&seen, stamp);
      }
      EXPECT_TRUE(seen.epochs.empty()) << off << " every " << every;
      EXPECT_EQ(seen.taken["lidar"], 101);
      EXPECT_EQ(seen.taken["image"], 300);
      const int wrong = (100 + every - 1) / every;
      EXPECT_EQ(seen.taken["wrong"], 100 - wrong) << off << " every " << every;
      EXPECT_GE(seen.discarded["wrong"] + static_cast<int>(seen.monitor.held()), wrong);
      EXPECT_LE(seen.monitor.held(), EpochMonitor::kMaxHeld);
    }
  }
}

TEST(EpochMonitor, ASourceThatWasSetBackALittleIsTakenUpAgain) {
  Seen seen;
  for (int i = 0; i < 40; ++i) {
    seen.add("image", kStart + i * 100 * kMs - (i < 20 ? 0 : 2 * kNsPerSecond));
    seen.add("lidar", kStart + i * 100 * kMs);
  }
  EXPECT_TRUE(seen.epochs.empty());
  EXPECT_EQ(seen.taken["image"], 40);
}

TEST(EpochMonitor, ALeadThatIsCheckedBeforeNeedsNoSecondMessage) {
  Seen seen({"lidar", 1, 0});
  addScan(&seen, kStart + 10 * kNsPerSecond);
  addScan(&seen, kStart);
  EXPECT_EQ(seen.epochs, std::vector<StampNs>{kStart});
  EXPECT_EQ(seen.used["image"].size(), 3u);
}

TEST(EpochMonitor, AMessageOfTheLeadWhoseTimeIsRoughNeitherStartsNorHoldsUpAnEpoch) {
  // Stamps of drivers for a scan without points: its end or begin, late by the way of a message.
  for (const StampNs off : {-300 * kMs, StampNs{0}, 100 * kMs, 300 * kMs}) {
    Seen seen;
    for (int i = 0; i < 40; ++i) {
      const bool empty = i % 3 == 1 || (i > 20 && i < 30);
      seen.add("lidar", kStart + i * 100 * kMs + (empty ? off : 0), empty ? kNsPerSecond : 0);
    }
    EXPECT_TRUE(seen.epochs.empty()) << off;
    EXPECT_EQ(seen.taken["lidar"], 40) << off;
  }
}

TEST(EpochMonitor, RoughTimesAloneTellAJumpAndWhereTheLeadIs) {
  for (const StampNs jump : {-20 * kNsPerSecond, 20 * kNsPerSecond}) {
    Seen seen;
    for (int i = 0; i < 5; ++i) addScan(&seen, kStart + i * 100 * kMs);
    for (int i = 0; i < 100; ++i) {
      seen.add("image", kStart + jump + i * 100 * kMs);
      seen.add("lidar", kStart + jump + i * 100 * kMs, kNsPerSecond);
    }
    EXPECT_EQ(seen.epochs, std::vector<StampNs>{kStart + jump});
    EXPECT_EQ(seen.used["lidar"].size(), 100u);
    EXPECT_EQ(seen.used["image"].size(), 100u);
    // With points again, a little before the header of the last one without.
    seen.add("lidar", kStart + jump + 9850 * kMs);
    EXPECT_EQ(seen.epochs.size(), 1u);
    EXPECT_EQ(seen.used["lidar"].size(), 101u);
  }
}

TEST(EpochMonitor, MessagesOfALeadMayOvertakeEachOtherWhereThatIsAllowed) {
  Seen seen({"tf", 2, kNsPerSecond});
  for (int i = 0; i < 100; ++i) seen.add("tf", kStart + (i % 2 ? i - 5 : i + 4) * 100 * kMs);
  EXPECT_TRUE(seen.epochs.empty());
  EXPECT_EQ(seen.taken["tf"], 100);
}

}  // namespace
}  // namespace semantic_lidar_fusion

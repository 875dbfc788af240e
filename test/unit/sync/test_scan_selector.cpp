// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>
#include <limits>
#include <map>
#include <random>
#include <string>
#include <tuple>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/sync/scan_selector.h"
#include "stamps.h"

namespace semantic_lidar_fusion {
namespace {

SelectorConfig cameras(std::size_t count) {
  SelectorConfig config;
  config.cameras.resize(count);
  return config;
}

SelectorScan scanAt(StampNs first_ns, StampNs length_ns = 100 * kMs) {
  SelectorScan scan;
  scan.interval = {first_ns, first_ns + length_ns};
  return scan;
}

std::string describe(const SelectorDecisions& decisions) {
  std::string text;
  for (const ReferenceDecision& d : decisions.references) {
    text += "scan " + std::to_string(d.scan_ns - kStart) + " t_ref " +
            std::to_string(d.reference_ns - kStart) + (d.timed_out ? " timed out\n" : "\n");
  }
  for (const SelectionDecision& d : decisions.selections) {
    text += "scan " + std::to_string(d.scan_ns - kStart) + " camera " + std::to_string(d.camera) +
            (d.image_stamp ? " image " + std::to_string(*d.image_stamp - kStart) : " none") +
            (d.timed_out ? " timed out\n" : "\n");
  }
  for (const DroppedScan& d : decisions.dropped) {
    text += "scan " + std::to_string(d.scan_ns - kStart) + " dropped " +
            std::to_string(static_cast<int>(d.reason)) + "\n";
  }
  return text;
}

void append(SelectorDecisions more, SelectorDecisions* all) {
  all->references.insert(all->references.end(), more.references.begin(), more.references.end());
  all->selections.insert(all->selections.end(), more.selections.begin(), more.selections.end());
  all->dropped.insert(all->dropped.end(), more.dropped.begin(), more.dropped.end());
}

void sortByScan(SelectorDecisions* decisions) {
  std::sort(decisions->references.begin(), decisions->references.end(),
            [](const auto& a, const auto& b) { return a.scan_ns < b.scan_ns; });
  std::sort(decisions->selections.begin(), decisions->selections.end(),
            [](const auto& a, const auto& b) {
              return std::tie(a.scan_ns, a.camera) < std::tie(b.scan_ns, b.camera);
            });
}

// ---- Single rules.

TEST(ScanSelectorTest, SettlesWithTheFirstImageAtOrAfterTheMiddle) {
  ScanSelector selector(cameras(1));
  selector.addImage(0, kStart + 20 * kMs);
  selector.addScan(scanAt(kStart), 0);
  EXPECT_EQ(describe(selector.advance(0)), "");
  selector.addImage(0, kStart + 49 * kMs);
  EXPECT_EQ(describe(selector.advance(0)), "");
  selector.addImage(0, kStart + 60 * kMs);
  EXPECT_EQ(describe(selector.advance(0)),
            "scan 0 t_ref 49000000\nscan 0 camera 0 image 49000000\n");
  EXPECT_EQ(describe(selector.advance(0)), "");
  EXPECT_EQ(selector.pendingScans(), 0u);
}

TEST(ScanSelectorTest, AnImageAtTheMiddleSettlesAtOnce) {
  ScanSelector selector(cameras(1));
  selector.addImage(0, kStart + 50 * kMs);
  selector.addScan(scanAt(kStart), 0);
  EXPECT_EQ(describe(selector.advance(0)),
            "scan 0 t_ref 50000000\nscan 0 camera 0 image 50000000\n");
}

TEST(ScanSelectorTest, OfTwoEquallyCloseImagesTheEarlierWins) {
  ScanSelector selector(cameras(1));
  selector.addScan(scanAt(kStart), 0);
  selector.addImage(0, kStart + 40 * kMs);
  selector.addImage(0, kStart + 60 * kMs);
  EXPECT_EQ(describe(selector.advance(0)),
            "scan 0 t_ref 40000000\nscan 0 camera 0 image 40000000\n");
  // The middle of an odd interval is rounded down: 49999999 is 1 ns nearer to 40 ms.
  selector.addScan(scanAt(kStart + 100 * kMs, 99999999), 0);
  selector.addImage(0, kStart + 140 * kMs);
  selector.addImage(0, kStart + 160 * kMs - 2);
  EXPECT_EQ(describe(selector.advance(0)),
            "scan 100000000 t_ref 140000000\nscan 100000000 camera 0 image 140000000\n");
}

TEST(ScanSelectorTest, ReferenceNeverWaitsForOtherCameras) {
  ScanSelector selector(cameras(2));
  selector.addScan(scanAt(kStart), 0);
  selector.addImage(0, kStart + 50 * kMs);
  EXPECT_EQ(describe(selector.advance(0)),
            "scan 0 t_ref 50000000\nscan 0 camera 0 image 50000000\n");
  EXPECT_EQ(selector.pendingScans(), 1u);
  selector.addImage(1, kStart + 51 * kMs);
  EXPECT_EQ(describe(selector.advance(0)), "scan 0 camera 1 image 51000000\n");
}

TEST(ScanSelectorTest, TrueTimeIsStampPlusOffsetAndImagesAreNamedByRawStamp) {
  SelectorConfig config = cameras(2);
  config.cameras[0].time_offset_ns = -18 * kNsPerSecond;
  config.cameras[1].time_offset_ns = 7 * kMs;
  ScanSelector selector(config);
  selector.addScan(scanAt(kStart), 0);
  selector.addImage(0, kStart + 18 * kNsPerSecond + 52 * kMs);
  selector.addImage(1, kStart + 45 * kMs);
  EXPECT_EQ(describe(selector.advance(0)),
            "scan 0 t_ref 52000000\nscan 0 camera 0 image 18052000000\n"
            "scan 0 camera 1 image 45000000\n");
}

TEST(ScanSelectorTest, AnotherTimeOffsetHoldsForImagesThatAreKnown) {
  ScanSelector selector(cameras(1));
  selector.addImage(0, kStart + 40 * kMs);
  selector.addImage(0, kStart + 60 * kMs);
  selector.setTimeOffset(0, -9 * kMs);
  selector.addScan(scanAt(kStart), 0);
  // The middle is at 50 ms: the images were taken at 31 and 51 ms.
  EXPECT_EQ(describe(selector.advance(0)),
            "scan 0 t_ref 51000000\nscan 0 camera 0 image 60000000\n");
  EXPECT_THROW(selector.setTimeOffset(1, 0), DataError);
  EXPECT_THROW(selector.setTimeOffset(0, StampNs{1} << 62), DataError);
}

TEST(ScanSelectorTest, NothingWithinTheLimitIsNone) {
  SelectorConfig config = cameras(2);
  ScanSelector selector(config);
  selector.addScan(scanAt(kStart), 0);
  selector.addImage(0, kStart + 50 * kMs);
  selector.addImage(1, kStart + 100 * kMs + 1);
  EXPECT_EQ(describe(selector.advance(0)),
            "scan 0 t_ref 50000000\nscan 0 camera 0 image 50000000\nscan 0 camera 1 none\n");
  selector.addScan(scanAt(kStart + 100 * kMs), 0);
  selector.addImage(0, kStart + 150 * kMs);
  selector.addImage(1, kStart + 200 * kMs);
  EXPECT_EQ(describe(selector.advance(0)),
            "scan 100000000 t_ref 150000000\nscan 100000000 camera 0 image 150000000\n"
            "scan 100000000 camera 1 image 100000001\n");
  EXPECT_EQ(selector.counters().camera_none, (std::vector<std::uint64_t>{0, 1}));
}

TEST(ScanSelectorTest, ReferenceTimeoutTakesTheClosestImageThatIsKnown) {
  ScanSelector selector(cameras(2));
  selector.addImage(0, kStart + 30 * kMs);
  selector.addImage(1, kStart + 30 * kMs);
  selector.addScan(scanAt(kStart), 1000);
  EXPECT_EQ(describe(selector.advance(1000 + 200 * kMs - 1)), "");
  EXPECT_EQ(describe(selector.advance(1000 + 200 * kMs)),
            "scan 0 t_ref 30000000\nscan 0 camera 0 image 30000000\n"
            "scan 0 camera 1 image 30000000\n");
  EXPECT_EQ(selector.counters().reference_timeouts, 0u);
}

TEST(ScanSelectorTest, ReferenceTimeoutGivesTheMiddleWithoutAnImageInTime) {
  ScanSelector selector(cameras(2));
  selector.addImage(0, kStart + 50 * kMs - 200 * kMs - 1);
  selector.addImage(1, kStart + 30 * kMs);
  selector.addScan(scanAt(kStart), 1000);
  EXPECT_EQ(describe(selector.advance(1000 + 200 * kMs - 1)), "");
  EXPECT_EQ(describe(selector.advance(1000 + 200 * kMs)),
            "scan 0 t_ref 50000000 timed out\nscan 0 camera 0 none timed out\n"
            "scan 0 camera 1 image 30000000 timed out\n");
  EXPECT_EQ(selector.counters().reference_timeouts, 1u);
  EXPECT_EQ(selector.counters().camera_timeouts, (std::vector<std::uint64_t>{1, 1}));
  // The image that would have been chosen, then one that would not.
  selector.addImage(0, kStart + 63 * kMs);
  selector.addImage(0, kStart + 96 * kMs);
  EXPECT_EQ(selector.counters().images_late, 1u);
}

TEST(ScanSelectorTest, AnImageBeyondTheReferenceTimeoutIsNotInTimeEvenIfKnown) {
  ScanSelector selector(cameras(1));
  selector.addImage(0, kStart - 1000 * kMs);
  selector.addImage(0, kStart + 50 * kMs + 200 * kMs + 1);
  selector.addScan(scanAt(kStart), 0);
  EXPECT_EQ(describe(selector.advance(0)),
            "scan 0 t_ref 50000000 timed out\nscan 0 camera 0 none\n");
}

TEST(ScanSelectorTest, EachCameraHasItsOwnTimeout) {
  SelectorConfig config = cameras(3);
  config.cameras[1].timeout_ns = 50 * kMs;
  config.cameras[2].timeout_ns = 300 * kMs;
  ScanSelector selector(config);
  selector.addScan(scanAt(kStart), 0);
  selector.addImage(0, kStart + 50 * kMs);
  EXPECT_EQ(describe(selector.advance(49 * kMs)),
            "scan 0 t_ref 50000000\nscan 0 camera 0 image 50000000\n");
  EXPECT_EQ(describe(selector.advance(50 * kMs)), "scan 0 camera 1 none timed out\n");
  EXPECT_EQ(describe(selector.advance(299 * kMs)), "");
  EXPECT_EQ(describe(selector.advance(300 * kMs)), "scan 0 camera 2 none timed out\n");
}

TEST(ScanSelectorTest, OtherReferencesNeedNoImage) {
  for (const auto& choice :
       std::map<ReferenceChoice, StampNs>{{ReferenceChoice::kScanStart, 0},
                                          {ReferenceChoice::kScanMiddle, 50 * kMs},
                                          {ReferenceChoice::kScanEnd, 100 * kMs}}) {
    SelectorConfig config = cameras(1);
    config.choose = choice.first;
    ScanSelector selector(config);
    selector.addScan(scanAt(kStart), 0);
    EXPECT_EQ(describe(selector.advance(0)),
              "scan 0 t_ref " + std::to_string(choice.second) + "\n");
    selector.addImage(0, kStart + 10 * kMs);
    selector.addImage(0, kStart + 110 * kMs);
    const StampNs image = choice.first == ReferenceChoice::kScanEnd ? 110 * kMs : 10 * kMs;
    EXPECT_EQ(describe(selector.advance(0)),
              "scan 0 camera 0 image " + std::to_string(image) + "\n");
  }
}

TEST(ScanSelectorTest, WithoutCamerasTheMiddleSettlesAtOnce) {
  ScanSelector selector(cameras(0));
  selector.addScan(scanAt(kStart), 0);
  EXPECT_EQ(describe(selector.advance(0)), "scan 0 t_ref 50000000\n");
  EXPECT_EQ(selector.pendingScans(), 0u);
  EXPECT_EQ(selector.counters().reference_timeouts, 0u);
}

TEST(ScanSelectorTest, SweepTargetsAreEachCamerasOwn) {
  SelectorConfig config = cameras(3);
  config.image_choice = ImageChoice::kClosestToSweep;
  ScanSelector selector(config);
  SelectorScan scan = scanAt(kStart);
  scan.sweep_ns = {kStart + 80 * kMs, kStart + 20 * kMs, std::nullopt};
  selector.addScan(scan, 0);
  for (int camera = 0; camera < 3; ++camera) {
    for (const StampNs ms : {15, 48, 81}) selector.addImage(camera, kStart + ms * kMs);
  }
  EXPECT_EQ(describe(selector.advance(0)),
            "scan 0 t_ref 48000000\nscan 0 camera 0 image 81000000\n"
            "scan 0 camera 1 image 15000000\nscan 0 camera 2 image 48000000\n");
}

TEST(ScanSelectorTest, FinishSettlesEverythingWithWhatIsKnown) {
  ScanSelector selector(cameras(2));
  selector.addImage(0, kStart + 30 * kMs);
  selector.addScan(scanAt(kStart), 0);
  selector.addScan(scanAt(kStart + 300 * kMs), 0);
  EXPECT_EQ(describe(selector.finish()),
            "scan 0 t_ref 30000000\nscan 300000000 t_ref 350000000 timed out\n"
            "scan 0 camera 0 image 30000000\nscan 0 camera 1 none timed out\n"
            "scan 300000000 camera 0 none timed out\nscan 300000000 camera 1 none timed out\n");
  EXPECT_EQ(selector.pendingScans(), 0u);
}

TEST(ScanSelectorTest, TheLastScanIsTheSameAfterTheTimeoutAndAtTheEndOfABag) {
  for (const StampNs last_image : {-160, -140, 0, 30, 49}) {
    ScanSelector live(cameras(2)), offline(cameras(2));
    for (ScanSelector* selector : {&live, &offline}) {
      for (int camera = 0; camera < 2; ++camera) {
        selector->addImage(camera, kStart - 300 * kMs);
        selector->addImage(camera, kStart + last_image * kMs);
      }
      selector->addScan(scanAt(kStart), 1000);
    }
    const std::string decided = describe(live.advance(1000 + 200 * kMs));
    EXPECT_EQ(decided, describe(offline.finish())) << last_image;
    EXPECT_NE(decided, "");
  }
}

TEST(ScanSelectorTest, ReorderWindowWaitsForImagesThatAreOvertaken) {
  SelectorConfig config = cameras(1);
  config.cameras[0].reorder_window_ns = 40 * kMs;
  ScanSelector selector(config);
  selector.addScan(scanAt(kStart), 0);
  selector.addImage(0, kStart + 83 * kMs);
  EXPECT_EQ(describe(selector.advance(0)), "");
  selector.addImage(0, kStart + 53 * kMs);
  EXPECT_EQ(describe(selector.advance(0)), "");
  selector.addImage(0, kStart + 93 * kMs);
  EXPECT_EQ(describe(selector.advance(0)).find("scan 0 t_ref 53000000\n"), 0u);
  // At the timeout an image after the middle is enough, though the window is not over.
  selector.addScan(scanAt(kStart + 100 * kMs), 0);
  selector.addImage(0, kStart + 155 * kMs);
  EXPECT_EQ(describe(selector.advance(199 * kMs)), "");
  EXPECT_EQ(describe(selector.advance(200 * kMs)).find("scan 100000000 t_ref 155000000\n"), 0u);
}

TEST(ScanSelectorTest, DuplicatesAreCountedAndChangeNothing) {
  ScanSelector selector(cameras(1));
  selector.addScan(scanAt(kStart), 0);
  selector.addScan(scanAt(kStart), 0);
  selector.addImage(0, kStart + 50 * kMs);
  selector.addImage(0, kStart + 50 * kMs);
  SelectorDecisions decisions = selector.advance(0);
  selector.addScan(scanAt(kStart), 0);
  append(selector.finish(), &decisions);
  EXPECT_EQ(describe(decisions), "scan 0 t_ref 50000000\nscan 0 camera 0 image 50000000\n");
  EXPECT_EQ(selector.counters().scans, 1u);
  EXPECT_EQ(selector.counters().scans_duplicate, 2u);
  EXPECT_EQ(selector.counters().images, 1u);
  EXPECT_EQ(selector.counters().images_duplicate, 1u);
}

/// At 10 Hz no more than four scans of it wait.
SelectorConfig impatient(std::size_t count) {
  SelectorConfig config = cameras(count);
  config.reference_timeout_ns = 150 * kMs;
  for (SelectorCamera& camera : config.cameras) camera.timeout_ns = 150 * kMs;
  return config;
}

TEST(ScanSelectorTest, AFullQueueDropsTheOldestScanThatHasNoReference) {
  ScanSelector selector(impatient(1));
  SelectorDecisions decisions;
  for (int i = 0; i < 6; ++i) {
    selector.addScan(scanAt(kStart + i * 100 * kMs), 0);
    append(selector.advance(0), &decisions);
    EXPECT_LE(selector.pendingScans(), 4u);
  }
  EXPECT_EQ(describe(decisions), "scan 0 dropped 0\nscan 100000000 dropped 0\n");
  EXPECT_EQ(selector.counters().scans_dropped_pending, 2u);
}

TEST(ScanSelectorTest, AFullQueueAnswersTheOldestScanThatHasAReference) {
  ScanSelector selector(impatient(2));
  SelectorDecisions decisions;
  for (int i = 0; i < 5; ++i) {
    selector.addScan(scanAt(kStart + i * 100 * kMs), 0);
    selector.addImage(0, kStart + (50 + i * 100) * kMs);
    append(selector.advance(0), &decisions);
  }
  EXPECT_EQ(decisions.dropped.size(), 0u);
  ASSERT_EQ(decisions.selections.size(), 6u);
  EXPECT_EQ(decisions.selections.back().scan_ns, kStart + 400 * kMs);
  const auto forced = std::find_if(decisions.selections.begin(), decisions.selections.end(),
                                   [](const SelectionDecision& d) { return d.camera == 1; });
  ASSERT_NE(forced, decisions.selections.end());
  EXPECT_EQ(forced->scan_ns, kStart);
  EXPECT_FALSE(forced->image_stamp);
  EXPECT_TRUE(forced->timed_out);
}

TEST(ScanSelectorTest, ABurstOfScansWhoseImagesAreKnownLosesNone) {
  SelectorConfig config = cameras(1);
  ScanSelector selector(config);
  for (int i = 0; i < 60; ++i) selector.addImage(0, kStart + i * 33 * kMs);
  for (int i = 0; i < 15; ++i) selector.addScan(scanAt(kStart + i * 100 * kMs), 0);
  EXPECT_EQ(selector.advance(0).references.size(), 15u);
  EXPECT_EQ(selector.counters().scans_dropped_pending, 0u);
}

TEST(ScanSelectorTest, AnEmptyScanIsAnInstant) {
  ScanSelector selector(cameras(1));
  selector.addScan(scanAt(kStart, 0), 0);
  selector.addImage(0, kStart + kMs);
  EXPECT_EQ(describe(selector.advance(0)), "scan 0 t_ref 1000000\nscan 0 camera 0 image 1000000\n");
}

// ---- Epochs.

/// Feeds `count` scans of 10 Hz and the images of two 30 Hz cameras as a bag would play them.
SelectorDecisions playBag(ScanSelector* selector, int count, StampNs now_ns) {
  SelectorDecisions decisions;
  for (int i = 0; i < count * 3; ++i) {
    const StampNs time_ns = kStart + i * 33333333LL;
    selector->addImage(0, time_ns);
    append(selector->advance(now_ns + time_ns - kStart), &decisions);
    selector->addImage(1, time_ns + kMs);
    append(selector->advance(now_ns + time_ns - kStart), &decisions);
    if (i % 3 == 2) {
      selector->addScan(scanAt(kStart + (i / 3) * 100 * kMs), now_ns + time_ns - kStart);
      append(selector->advance(now_ns + time_ns - kStart), &decisions);
    }
  }
  return decisions;
}

TEST(ScanSelectorTest, EveryPassAfterAResetGivesTheSame) {
  ScanSelector selector(cameras(2));
  const std::string first = describe(playBag(&selector, 30, 0));
  EXPECT_EQ(std::count(first.begin(), first.end(), '\n'), 90);
  for (int loop = 1; loop < 4; ++loop) {
    selector.reset();
    // The clock goes on, or goes back with the stamps.
    EXPECT_EQ(describe(playBag(&selector, 30, loop == 3 ? 0 : loop * 3 * kNsPerSecond)), first);
  }
  EXPECT_EQ(selector.counters().scans, 120u);
}

TEST(ScanSelectorTest, WildStampsOfOneCameraCostOnlyItsOwnImages) {
  for (const StampNs off :
       {-3600 * kNsPerSecond, -3 * kNsPerSecond, 3 * kNsPerSecond, 3600 * kNsPerSecond}) {
    for (const int every : {1, 2, 15}) {
      ScanSelector selector(cameras(2));
      int references = 0, images_of_0 = 0;
      for (int i = 0; i < 300; ++i) {
        const StampNs time_ns = kStart + i * 33333333LL;
        selector.addImage(0, time_ns);
        selector.addImage(1, i % every == 0 ? time_ns + off : time_ns + kMs);
        if (i % 3 == 2) selector.addScan(scanAt(kStart + (i / 3) * 100 * kMs), time_ns);
        const SelectorDecisions decisions = selector.advance(time_ns);
        references += static_cast<int>(decisions.references.size());
        for (const SelectionDecision& decision : decisions.selections) {
          images_of_0 += decision.camera == 0 && decision.image_stamp ? 1 : 0;
        }
        EXPECT_TRUE(decisions.dropped.empty());
      }
      EXPECT_EQ(references, 100) << off << " every " << every;
      EXPECT_EQ(images_of_0, 100) << off << " every " << every;
    }
  }
}

TEST(ScanSelectorTest, AFastLidarWithADeadCameraLosesNothing) {
  for (const StampNs period : {100 * kMs, 10 * kMs, 1326 * kMs / 1000}) {  // to a packet a cloud
    ScanSelector selector(cameras(2));
    std::size_t settled = 0;
    constexpr int kScans = 1600;
    StampNs next_image = kStart;
    for (int i = 0; i < kScans; ++i) {
      const StampNs now = i * period;
      for (; next_image <= kStart + now; next_image += 33 * kMs) selector.addImage(0, next_image);
      selector.addScan(scanAt(kStart + now, period), now);
      settled += selector.advance(now).selections.size();
    }
    settled += selector.finish().selections.size();
    EXPECT_EQ(selector.counters().scans_dropped_pending, 0u) << period;
    EXPECT_EQ(settled, 2u * kScans) << period;
  }
}

TEST(ScanSelectorTest, AScanAsOldAsThoseThatAreForgottenIsNamedAndNeverDecidedTwice) {
  ScanSelector selector(cameras(0));
  for (int i = 0; i <= 64; ++i) selector.addScan(scanAt(kStart + i * kNsPerSecond), 0);
  EXPECT_EQ(selector.advance(0).references.size(), 65u);
  for (int twice = 0; twice < 2; ++twice) {
    selector.addScan(scanAt(kStart), 0);
    EXPECT_EQ(describe(selector.advance(0)), "scan 0 dropped 2\n");
  }
  EXPECT_EQ(selector.counters().scans_dropped_old, 2u);
}

TEST(ScanSelectorTest, ResetForgetsAndNamesWhatWasPending) {
  ScanSelector selector(cameras(1));
  selector.addImage(0, kStart + 60 * kMs);
  selector.addScan(scanAt(kStart + 200 * kMs), 0);
  selector.reset();
  EXPECT_EQ(selector.pendingScans(), 0u);
  EXPECT_EQ(describe(selector.advance(0)), "scan 200000000 dropped 1\n");
  selector.addScan(scanAt(kStart), 0);
  EXPECT_EQ(describe(selector.advance(0)), "");  // the image is forgotten
  EXPECT_EQ(selector.counters().scans, 2u);
}

TEST(ScanSelectorTest, AClockThatGoesBackMakesNoScanWaitForEver) {
  ScanSelector selector(cameras(1));
  selector.addScan(scanAt(kStart), 1000 * kNsPerSecond);
  EXPECT_EQ(describe(selector.advance(5 * kNsPerSecond)), "");
  EXPECT_NE(describe(selector.advance(5 * kNsPerSecond + 200 * kMs)), "");
}

// ---- Bad input.

TEST(ScanSelectorTest, RefusesBadConfigurationsWithEveryProblem) {
  SelectorConfig config = cameras(2);
  config.reference_camera = 2;
  config.reference_timeout_ns = -1;
  config.cameras[1].timeout_ns = -1;
  config.cameras[1].max_time_difference_ns = -1;
  config.cameras[1].reorder_window_ns = -1;
  config.max_pending_scans = 0;
  config.image_history_ns = 0;
  try {
    ScanSelector selector(config);
    ADD_FAILURE() << "accepted";
  } catch (const ConfigError& error) {
    EXPECT_EQ(error.problems().size(), 7u) << error.what();
  }
}

TEST(ScanSelectorTest, RefusesBadStampsAndLivesOn) {
  SelectorConfig config = cameras(1);
  config.image_choice = ImageChoice::kClosestToSweep;
  ScanSelector selector(config);
  constexpr StampNs kHuge = std::numeric_limits<StampNs>::max();
  EXPECT_THROW(selector.addImage(1, kStart), DataError);
  EXPECT_THROW(selector.addImage(-1, kStart), DataError);
  EXPECT_THROW(selector.addImage(0, kHuge), DataError);
  EXPECT_THROW(selector.addImage(0, -kHuge), DataError);
  SelectorScan scan = scanAt(kStart);
  EXPECT_THROW(selector.addScan(scan, 0), DataError);  // no sweep times
  scan.sweep_ns = {kHuge};
  EXPECT_THROW(selector.addScan(scan, 0), DataError);
  scan.sweep_ns = {kStart};
  scan.interval.last_ns = kStart - 1;
  EXPECT_THROW(selector.addScan(scan, 0), DataError);
  scan.interval.last_ns = kStart;
  selector.addScan(scan, 0);
  selector.addImage(0, kStart);
  EXPECT_EQ(describe(selector.advance(0)), "scan 0 t_ref 0\nscan 0 camera 0 image 0\n");
}

TEST(ScanSelectorTest, ExtremeStampsDoNotOverflow) {
  SelectorConfig config = cameras(1);
  config.cameras[0].time_offset_ns = 1000000000 * kNsPerSecond;
  ScanSelector selector(config);
  for (const StampNs stamp : {-ScanSelector::kMaxStampNs, ScanSelector::kMaxStampNs, StampNs{0}}) {
    selector.addImage(0, stamp);
    selector.addScan(scanAt(stamp, 0), stamp);
    selector.advance(stamp);
  }
  selector.finish();
  EXPECT_EQ(selector.pendingScans(), 0u);
}

// ---- Against plain references, written from the rules.

struct World {
  SelectorConfig config;
  std::vector<SelectorScan> scans;
  std::vector<std::vector<StampNs>> stamps;  ///< raw, per camera, in order
};

/// Scans of one rate, cameras of different rates, phases, offsets, jitter and gaps.
World randomWorld(std::mt19937* random) {
  const auto below = [&](StampNs n) { return static_cast<StampNs>((*random)()) % n; };
  World world;
  world.config.cameras.resize(static_cast<std::size_t>(1 + below(4)));
  world.config.reference_camera =
      static_cast<int>(below(static_cast<StampNs>(world.config.cameras.size())));
  world.config.choose = static_cast<ReferenceChoice>(below(3) == 0 ? 1 + below(3) : 0);
  world.config.image_choice = static_cast<ImageChoice>(below(2));
  world.config.image_history_ns = 100 * kNsPerSecond;
  world.config.reference_timeout_ns = (20 + below(200)) * kMs + 1;
  const StampNs scan_period = (50 + below(100)) * kMs;
  for (int i = 0; i < 20; ++i) {
    if (below(8) == 0) continue;
    SelectorScan scan = scanAt(kStart + i * scan_period + below(kMs), scan_period - below(5 * kMs));
    for (std::size_t camera = 0; camera < world.config.cameras.size(); ++camera) {
      scan.sweep_ns.push_back(
          below(5) == 0 ? std::nullopt
                        : std::optional<StampNs>(scan.interval.first_ns + below(scan_period)));
    }
    world.scans.push_back(scan);
  }
  for (SelectorCamera& camera : world.config.cameras) {
    camera.time_offset_ns = (below(2000) - 1000) * kMs;
    camera.max_time_difference_ns = below(60 * kMs);
    const StampNs period = (10 + below(110)) * kMs;
    // Whole-millisecond grids make ties frequent.
    const StampNs jitter = below(2) == 0 ? 1 : 3 * kMs;
    std::vector<StampNs> stamps;
    const StampNs phase = below(period / kMs) * kMs;
    for (StampNs time = -period; time < 21 * scan_period; time += period) {
      if (below(6) == 0) continue;
      stamps.push_back(kStart + phase + time + below(jitter) - camera.time_offset_ns);
    }
    std::sort(stamps.begin(), stamps.end());
    stamps.erase(std::unique(stamps.begin(), stamps.end()), stamps.end());
    world.stamps.push_back(std::move(stamps));
  }
  return world;
}

/// The stamp whose true time is closest to the target, the first of equals; by linear search.
std::optional<StampNs> closestStamp(const std::vector<StampNs>& stamps, StampNs offset,
                                    StampNs target) {
  std::optional<StampNs> best;
  for (const StampNs stamp : stamps) {
    if (!best || std::abs(stamp + offset - target) < std::abs(*best + offset - target) ||
        (std::abs(stamp + offset - target) == std::abs(*best + offset - target) && stamp < *best)) {
      best = stamp;
    }
  }
  return best;
}

/// All decisions of a world whose stamps are all known and whose timeouts never pass.
SelectorDecisions offlineDecisions(const World& world) {
  SelectorDecisions decisions;
  for (const SelectorScan& scan : world.scans) {
    const StampNs first = scan.interval.first_ns, last = scan.interval.last_ns;
    ReferenceDecision reference{first, first + (last - first) / 2, false};
    if (world.config.choose == ReferenceChoice::kScanStart) reference.reference_ns = first;
    if (world.config.choose == ReferenceChoice::kScanEnd) reference.reference_ns = last;
    if (world.config.choose == ReferenceChoice::kClosestImage) {
      const auto camera = static_cast<std::size_t>(world.config.reference_camera);
      const StampNs offset = world.config.cameras[camera].time_offset_ns;
      const std::optional<StampNs> stamp =
          closestStamp(world.stamps[camera], offset, reference.reference_ns);
      if (stamp &&
          std::abs(*stamp + offset - reference.reference_ns) <= world.config.reference_timeout_ns) {
        reference.reference_ns = *stamp + offset;
      } else {
        reference.timed_out = true;
      }
    }
    decisions.references.push_back(reference);
    for (std::size_t c = 0; c < world.config.cameras.size(); ++c) {
      const SelectorCamera& camera = world.config.cameras[c];
      StampNs target = reference.reference_ns;
      if (world.config.image_choice == ImageChoice::kClosestToSweep && scan.sweep_ns[c]) {
        target = *scan.sweep_ns[c];
      }
      SelectionDecision selection{first, static_cast<int>(c), {}, true};
      for (const StampNs stamp : world.stamps[c]) {
        if (stamp + camera.time_offset_ns >= target) selection.timed_out = false;
      }
      const std::optional<StampNs> stamp =
          closestStamp(world.stamps[c], camera.time_offset_ns, target);
      if (stamp &&
          std::abs(*stamp + camera.time_offset_ns - target) <= camera.max_time_difference_ns) {
        selection.image_stamp = stamp;
      }
      decisions.selections.push_back(selection);
    }
  }
  return decisions;
}

/// One arrival: of an image, or of a scan (camera -1).
struct Arrival {
  StampNs now_ns = 0;
  int camera = -1;
  StampNs stamp = 0;
  std::size_t scan = 0;
};

/// Random latencies that keep the order within each stream, with duplicates.
std::vector<Arrival> arrivals(const World& world, StampNs max_latency_ns, std::mt19937* random) {
  const auto below = [&](StampNs n) { return static_cast<StampNs>((*random)()) % n; };
  std::vector<Arrival> all;
  for (std::size_t c = 0; c < world.stamps.size(); ++c) {
    StampNs now = 0;
    for (const StampNs stamp : world.stamps[c]) {
      const StampNs time = stamp + world.config.cameras[c].time_offset_ns;
      now = std::max(now, time + below(max_latency_ns));
      all.push_back({now, static_cast<int>(c), stamp, 0});
      if (below(10) == 0) all.push_back({now + below(kMs), static_cast<int>(c), stamp, 0});
    }
  }
  StampNs now = 0;
  for (std::size_t i = 0; i < world.scans.size(); ++i) {
    now = std::max(now, world.scans[i].interval.last_ns + below(max_latency_ns));
    all.push_back({now, -1, 0, i});
    if (below(10) == 0) all.push_back({now, -1, 0, i});
  }
  std::stable_sort(all.begin(), all.end(),
                   [](const Arrival& a, const Arrival& b) { return a.now_ns < b.now_ns; });
  // No two at once, so that the references need no order beside time.
  for (std::size_t i = 1; i < all.size(); ++i) {
    all[i].now_ns = std::max(all[i].now_ns, all[i - 1].now_ns + 1);
  }
  return all;
}

SelectorDecisions feed(ScanSelector* selector, const World& world,
                       const std::vector<Arrival>& arrivals, bool clock_runs) {
  SelectorDecisions decisions;
  for (const Arrival& arrival : arrivals) {
    const StampNs now = clock_runs ? arrival.now_ns : 0;
    append(selector->advance(now), &decisions);
    if (arrival.camera >= 0) {
      selector->addImage(arrival.camera, arrival.stamp);
    } else {
      selector->addScan(world.scans[arrival.scan], now);
    }
    append(selector->advance(now), &decisions);
  }
  append(selector->finish(), &decisions);
  sortByScan(&decisions);
  return decisions;
}

TEST(ScanSelectorPropertyTest, DecisionsAreAFunctionOfStampsAlone) {
  std::mt19937 random(1);
  std::size_t images = 0, none = 0, middles = 0;
  for (int round = 0; round < 300; ++round) {
    World world = randomWorld(&random);
    world.config.max_pending_scans = 100;
    const SelectorDecisions expected = offlineDecisions(world);
    for (const StampNs latency : {kMs, 100 * kMs, 700 * kMs}) {
      ScanSelector selector(world.config);
      const SelectorDecisions decisions =
          feed(&selector, world, arrivals(world, latency, &random), false);
      ASSERT_EQ(describe(decisions), describe(expected)) << "round " << round;
      EXPECT_EQ(selector.counters().images_late, 0u);
    }
    for (const SelectionDecision& d : expected.selections) ++(d.image_stamp ? images : none);
    for (const ReferenceDecision& d : expected.references) middles += d.timed_out;
  }
  // The worlds hold what they are meant to hold.
  EXPECT_GT(images, 1000u);
  EXPECT_GT(none, 1000u);
  EXPECT_GT(middles, 10u);
}

TEST(ScanSelectorPropertyTest, ImagesMayOvertakeEachOtherWithinTheWindow) {
  std::mt19937 random(2);
  std::size_t overtaken = 0;
  for (int round = 0; round < 200; ++round) {
    World world = randomWorld(&random);
    world.config.max_pending_scans = 100;
    const SelectorDecisions expected = offlineDecisions(world);
    constexpr StampNs kWindow = 120 * kMs;
    for (SelectorCamera& camera : world.config.cameras) camera.reorder_window_ns = kWindow;
    std::vector<Arrival> all;
    for (Arrival arrival : arrivals(world, kMs, &random)) {
      // Images are late by up to the window, each by its own amount.
      if (arrival.camera >= 0) {
        arrival.now_ns =
            arrival.stamp +
            world.config.cameras[static_cast<std::size_t>(arrival.camera)].time_offset_ns +
            static_cast<StampNs>(random()) % kWindow;
      }
      all.push_back(arrival);
    }
    std::stable_sort(all.begin(), all.end(),
                     [](const Arrival& a, const Arrival& b) { return a.now_ns < b.now_ns; });
    std::map<int, StampNs> newest;
    for (const Arrival& arrival : all) {
      if (arrival.camera < 0) continue;
      const auto found = newest.emplace(arrival.camera, arrival.stamp).first;
      overtaken += arrival.stamp < found->second;
      found->second = std::max(found->second, arrival.stamp);
    }
    ScanSelector selector(world.config);
    ASSERT_EQ(describe(feed(&selector, world, all, false)), describe(expected))
        << "round " << round;
    EXPECT_EQ(selector.counters().images_late, 0u);
  }
  EXPECT_GT(overtaken, 1000u);
}

/// Decisions with timeouts: each from the table of arrivals, written from the rules.
SelectorDecisions timedDecisions(const World& world, const std::vector<Arrival>& all) {
  constexpr StampNs kNever = std::numeric_limits<StampNs>::max();
  // Stamps of a camera that have arrived before `now` (or at all times up to it, if `inclusive`).
  const auto arrived = [&](std::size_t camera, StampNs now, bool inclusive) {
    std::vector<StampNs> stamps;
    for (const Arrival& a : all) {
      if (a.camera != static_cast<int>(camera)) continue;
      if (a.now_ns < now || (inclusive && a.now_ns == now)) stamps.push_back(a.stamp);
    }
    return stamps;
  };
  // When a stamp at or after the target arrives.
  const auto reached = [&](std::size_t camera, StampNs target) {
    StampNs now = kNever;
    for (const Arrival& a : all) {
      if (a.camera != static_cast<int>(camera)) continue;
      const StampNs time = a.stamp + world.config.cameras[camera].time_offset_ns;
      if (time >= target) now = std::min(now, a.now_ns);
    }
    return now;
  };
  const StampNs end = all.back().now_ns;  // finish() follows: nothing waits longer

  SelectorDecisions decisions;
  std::vector<bool> seen(world.scans.size(), false);
  for (const Arrival& arrival : all) {
    if (arrival.camera >= 0 || seen[arrival.scan]) continue;
    seen[arrival.scan] = true;
    const SelectorScan& scan = world.scans[arrival.scan];
    const StampNs first = scan.interval.first_ns, last = scan.interval.last_ns;
    const StampNs middle = first + (last - first) / 2;
    ReferenceDecision reference{first, middle, false};
    StampNs reference_settled = arrival.now_ns;
    bool reference_by_deadline = false;
    if (world.config.choose == ReferenceChoice::kScanStart) reference.reference_ns = first;
    if (world.config.choose == ReferenceChoice::kScanEnd) reference.reference_ns = last;
    if (world.config.choose == ReferenceChoice::kClosestImage) {
      const auto c = static_cast<std::size_t>(world.config.reference_camera);
      const StampNs offset = world.config.cameras[c].time_offset_ns;
      const StampNs deadline = arrival.now_ns + world.config.reference_timeout_ns;
      const StampNs known = std::max(arrival.now_ns, reached(c, middle));
      reference_settled = std::min({known, deadline, end});
      reference_by_deadline = known >= deadline && deadline <= end;
      const std::optional<StampNs> stamp =
          closestStamp(arrived(c, reference_settled, !reference_by_deadline), offset, middle);
      if (stamp && std::abs(*stamp + offset - middle) <= world.config.reference_timeout_ns) {
        reference.reference_ns = *stamp + offset;
      } else {
        reference.timed_out = true;
      }
    }
    decisions.references.push_back(reference);
    for (std::size_t c = 0; c < world.config.cameras.size(); ++c) {
      const SelectorCamera& camera = world.config.cameras[c];
      StampNs target = reference.reference_ns;
      if (world.config.image_choice == ImageChoice::kClosestToSweep && scan.sweep_ns[c]) {
        target = *scan.sweep_ns[c];
      }
      const StampNs known = std::max(reference_settled, reached(c, target));
      const StampNs deadline = std::max(reference_settled, arrival.now_ns + camera.timeout_ns);
      const bool in_time = known <= reference_settled || known < deadline;
      // Images that arrive at the very moment of a deadline come after it.
      const StampNs settled = std::min({known, deadline, end});
      const bool by_deadline =
          !in_time && deadline <= end && (settled > reference_settled || reference_by_deadline);
      const std::vector<StampNs> stamps = arrived(c, settled, !by_deadline);
      SelectionDecision selection{first, static_cast<int>(c), {}, true};
      for (const StampNs stamp : stamps) {
        if (stamp + camera.time_offset_ns >= target) selection.timed_out = false;
      }
      const std::optional<StampNs> stamp = closestStamp(stamps, camera.time_offset_ns, target);
      if (stamp &&
          std::abs(*stamp + camera.time_offset_ns - target) <= camera.max_time_difference_ns) {
        selection.image_stamp = stamp;
      }
      decisions.selections.push_back(selection);
    }
  }
  sortByScan(&decisions);
  return decisions;
}

TEST(ScanSelectorPropertyTest, TimeoutsFollowTheRules) {
  std::mt19937 random(3);
  std::size_t reference_timeouts = 0, camera_timeouts = 0, in_time = 0;
  for (int round = 0; round < 150; ++round) {
    World world = randomWorld(&random);
    world.config.max_pending_scans = 100;
    for (SelectorCamera& camera : world.config.cameras) {
      camera.timeout_ns = static_cast<StampNs>(10 + random() % 300) * kMs + 3;
    }
    const std::vector<Arrival> all = arrivals(world, 400 * kMs, &random);
    ScanSelector selector(world.config);
    const SelectorDecisions decisions = feed(&selector, world, all, true);
    ASSERT_EQ(describe(decisions), describe(timedDecisions(world, all))) << "round " << round;
    for (const ReferenceDecision& d : decisions.references) reference_timeouts += d.timed_out;
    for (const SelectionDecision& d : decisions.selections) {
      ++(d.timed_out ? camera_timeouts : in_time);
    }
  }
  EXPECT_GT(reference_timeouts, 100u);
  EXPECT_GT(camera_timeouts, 100u);
  EXPECT_GT(in_time, 100u);
}

TEST(ScanSelectorPropertyTest, AnyStampsAtAllGiveEachScanOneAnswer) {
  std::mt19937 random(4);
  for (int round = 0; round < 200; ++round) {
    SelectorConfig config = cameras(3);
    config.choose = static_cast<ReferenceChoice>(random() % 4);
    ScanSelector selector(config);
    std::map<StampNs, int> references, selections, dropped;
    const auto take = [&](const SelectorDecisions& decisions) {
      for (const auto& d : decisions.references) ++references[d.scan_ns];
      for (const auto& d : decisions.selections) ++selections[d.scan_ns];
      for (const auto& d : decisions.dropped) ++dropped[d.scan_ns];
    };
    const StampNs spread = round % 2 ? 2 * kNsPerSecond : 20 * kNsPerSecond;
    std::map<StampNs, int> added;
    StampNs now = 0;
    for (int i = 0; i < 300; ++i) {
      now += static_cast<StampNs>(random() % 60) * kMs;
      const StampNs stamp = kStart + static_cast<StampNs>(random()) * 1000 % spread;
      if (random() % 4 == 0) {
        const std::uint64_t scans = selector.counters().scans;
        selector.addScan(scanAt(stamp), now);
        if (selector.counters().scans > scans) ++added[stamp];
      } else {
        selector.addImage(static_cast<int>(random() % 3), stamp);
      }
      take(selector.advance(now));
      ASSERT_LE(selector.pendingScans(), 1024u);
    }
    take(selector.finish());
    EXPECT_EQ(selector.pendingScans(), 0u);
    for (const auto& scan : added) {
      // Complete, or dropped and reported.
      EXPECT_LE(references[scan.first], scan.second);
      if (dropped[scan.first] == 0) {
        EXPECT_EQ(references[scan.first], scan.second);
        EXPECT_EQ(selections[scan.first], 3 * scan.second);
      } else {
        EXPECT_LT(selections[scan.first], 3 * scan.second);
      }
    }
    const SelectorCounters& counters = selector.counters();
    std::size_t drops = 0;
    for (const auto& drop : dropped) drops += static_cast<std::size_t>(drop.second);
    EXPECT_EQ(drops, counters.scans_dropped_pending + counters.scans_dropped_epoch +
                         counters.scans_dropped_old);
  }
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
// Sequences of calls on the classes that hold messages by stamp. Whatever comes: nothing is given
// out twice or backwards within an epoch, what goes in comes out or is counted, memory is bounded.
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <set>

#include "fuzz_target.h"
#include "semantic_lidar_fusion/sync/epoch_monitor.h"
#include "semantic_lidar_fusion/sync/fusion_queue.h"
#include "semantic_lidar_fusion/sync/scan_selector.h"
#include "semantic_lidar_fusion/sync/stamped_store.h"

namespace semantic_lidar_fusion {
namespace fuzz {
namespace {

enum Kind : unsigned { kStore, kMonitor, kQueue, kSelector, kKinds };

constexpr StampNs kMs = 1000000;
constexpr StampNs kStart = 1500000000 * kNsPerSecond;
constexpr std::size_t kMostScans = 4096;

/// Near one another as a rule, anywhere in 146 years now and then.
StampNs takeStamp(Reader* reader) {
  if (reader->choice(16) == 0) return reader->take<StampNs>() >> 2;
  return kStart + reader->take<std::int16_t>() * kMs;
}

void runStore(Reader* reader) {
  const std::size_t capacity = 1 + reader->choice(8);
  StampedStore<int> store(capacity);
  std::size_t grown = capacity;
  while (reader->left() > 0) {
    const StampNs stamp = takeStamp(reader);
    switch (reader->choice(4)) {
      case 0:
        store.erase(stamp);
        break;
      case 1:
        store.eraseBefore(stamp);
        break;
      case 2:
        grown = std::max(grown, static_cast<std::size_t>(reader->choice(12)));
        store.grow(grown);
        break;
      default: {
        const std::size_t before = store.size() + (store.find(stamp) == nullptr ? 1 : 0);
        const int value = reader->choice(100);
        const std::size_t dropped = store.put(stamp, value);
        expect(store.size() + dropped == before, "what is pushed out is counted");
        const int* kept = store.find(stamp);
        expect(
            kept == nullptr ? dropped > 0 && store.values().begin()->first > stamp : *kept == value,
            "a value is kept unless all others are newer");
      }
    }
    expect(store.size() <= grown, "a store is bounded");
  }
}

void runMonitor(Reader* reader) {
  static const char* const kSources[] = {"lidar", "front", "left", "scores"};
  EpochConfig config{"lidar", 1 + static_cast<int>(reader->choice(3)), 0};
  if (reader->flag()) config.lead_disorder_ns = kNsPerSecond;
  std::size_t in = 0, used = 0, discarded = 0, epochs = 0;
  std::set<std::size_t> used_numbers;
  std::optional<StampNs> lead;
  EpochMonitor monitor(
      config,
      [&](StampNs) {
        ++epochs;
        lead.reset();
      },
      [&](const DiscardedMessage& message) {
        ++discarded;
        expect(!message.source.empty(), "what is discarded has a name");
      });
  while (reader->left() > 0) {
    const unsigned kind = reader->choice(5);
    const std::string source = kSources[kind % 4];
    const StampNs stamp = takeStamp(reader);
    const StampNs tolerance = kind == 4 ? kNsPerSecond : 0;  // a scan without points
    const std::size_t epochs_before = epochs;
    const auto use = [&, source, stamp, tolerance, number = in] {
      ++used;
      expect(used_numbers.insert(number).second, "a message is used once");
      if (source != config.lead) return;
      const StampNs least = stamp - tolerance;
      expect(!lead || stamp + tolerance >= *lead - config.lead_disorder_ns,
             "an epoch does not go back");
      expect(!lead || least <= *lead + EpochMonitor::kForwardNs, "an epoch has no leaps");
      lead = lead ? std::max(*lead, least) : least;
    };
    monitor.observe(source, stamp, use, tolerance);
    ++in;
    expect(used + discarded + monitor.held() == in, "messages are used, discarded or held");
    expect(monitor.held() <= 4 * EpochMonitor::kMaxHeld, "what is held is bounded");
    expect(epochs == epochs_before || source == config.lead, "the lead alone starts an epoch");
  }
}

/// Before every stamp.
constexpr StampNs kNever = std::numeric_limits<StampNs>::min();

struct QueueCheck {
  std::size_t in = 0, out = 0, forgotten = 0;
  StampNs first_point = kNever, stamp = kNever;  ///< of the last scan with points of this epoch

  void take(const std::vector<CompletedScan>& scans) {
    for (const CompletedScan& scan : scans) {
      ++out;
      for (const CompletedScan::View& view : scan.views) {
        expect(view.state != ViewState::kExpected, "a complete scan expects nothing");
      }
      if (scan.cloud->empty()) continue;
      expect(scan.cloud->first_point_ns > first_point, "no scan comes out twice");
      expect(scan.cloud->stamp >= stamp, "scans are not stamped backwards");
      first_point = scan.cloud->first_point_ns;
      stamp = scan.cloud->stamp;
    }
  }
};

void runQueue(Reader* reader) {
  FusionQueueConfig config;
  for (unsigned i = reader->choice(4); i > 0; --i) {
    config.timeout_ns.push_back(reader->choice(250) * kMs);
  }
  const unsigned cameras = static_cast<unsigned>(config.timeout_ns.size());
  FusionQueue queue(config);
  QueueCheck check;
  StampNs now = 0;
  while (reader->left() > 0) {
    const StampNs key = takeStamp(reader);
    const StampNs other = key + reader->take<std::int8_t>() * kMs;
    now += reader->choice(40) * kMs;
    switch (reader->choice(16)) {
      case 0:
        check.forgotten += queue.pending();
        queue.reset();
        check.first_point = check.stamp = kNever;
        break;
      case 1:
      case 2:
      case 3:
        queue.addReference(key, other);
        break;
      case 4:
      case 5:
      case 6:
        if (cameras == 0) break;
        queue.addSelection(key, static_cast<int>(reader->choice(cameras)),
                           reader->flag() ? std::optional<StampNs>(other) : std::nullopt, now);
        break;
      case 7:
      case 8:
        if (cameras == 0) break;
        queue.setSemantics(static_cast<int>(reader->choice(cameras)), other, reader->flag());
        break;
      default: {
        auto cloud = std::make_shared<Cloud>();
        cloud->first_point_ns = key;
        cloud->stamp = other;
        cloud->resize(reader->choice(8) == 0 ? 0 : 1);
        queue.addCloud(cloud, now);
        ++check.in;
      }
    }
    check.take(queue.advance(now));
    const FusionQueueCounters& counters = queue.counters();
    expect(check.in == check.out + check.forgotten + queue.pending() + counters.overflow +
                           counters.out_of_order,
           "clouds come out or are counted");
    expect(queue.pending() <= kMostScans, "what waits is bounded");
  }
  check.take(queue.advance(now + 3600 * kNsPerSecond));
  expect(queue.pending() == 0, "every deadline passes");
}

struct SelectorCheck {
  struct Answers {
    int references = 0, selections = 0, dropped = 0;
  };
  explicit SelectorCheck(int camera_count) : cameras(camera_count) {}

  const int cameras;
  std::size_t complete = 0, dropped = 0;
  std::map<StampNs, Answers> scans;  ///< of this epoch

  void take(const SelectorDecisions& decisions) {
    for (const ReferenceDecision& decision : decisions.references) {
      expect(++scans[decision.scan_ns].references == 1, "one t_ref for each scan");
      if (cameras == 0) ++complete;
    }
    for (const SelectionDecision& decision : decisions.selections) {
      Answers& answers = scans[decision.scan_ns];
      expect(++answers.selections <= cameras, "one image of each camera");
      expect(answers.references == 1, "no image without t_ref");
      if (answers.selections == cameras) ++complete;
    }
    for (const DroppedScan& scan : decisions.dropped) {
      ++dropped;
      if (scan.reason == DropReason::kTooOld) continue;
      Answers& answers = scans[scan.scan_ns];
      expect(++answers.dropped == 1 && (cameras == 0 || answers.selections < cameras),
             "a scan that is dropped was not complete");
    }
  }
};

void runSelector(Reader* reader) {
  SelectorConfig config;
  config.cameras.resize(reader->choice(4));
  for (SelectorCamera& camera : config.cameras) camera.timeout_ns = reader->choice(250) * kMs;
  config.choose = static_cast<ReferenceChoice>(reader->choice(4));
  ScanSelector selector(config);
  SelectorCheck check(static_cast<int>(config.cameras.size()));
  StampNs now = 0;
  while (reader->left() > 0) {
    const StampNs stamp = takeStamp(reader);
    now += reader->choice(40) * kMs;
    switch (reader->choice(8)) {
      case 0:
        selector.reset();
        check.take(selector.advance(now));
        check.scans.clear();
        break;
      case 1:
      case 2:
      case 3: {
        SelectorScan scan;
        scan.interval = {stamp, stamp + reader->choice(200) * kMs};
        selector.addScan(scan, now);
        break;
      }
      default:
        if (config.cameras.empty()) break;
        selector.addImage(
            static_cast<int>(reader->choice(static_cast<unsigned>(config.cameras.size()))), stamp);
    }
    check.take(selector.advance(now));
    expect(selector.pendingScans() <= kMostScans, "what waits is bounded");
  }
  check.take(selector.finish());
  expect(selector.pendingScans() == 0, "everything is settled in the end");
  expect(selector.counters().scans == check.complete + check.dropped,
         "scans are answered whole or named as dropped");
}

std::vector<Bytes> seeds() {
  std::vector<Bytes> all{Bytes{}};
  for (unsigned kind = 0; kind < kKinds; ++kind) {
    for (unsigned step : {1u, 33u, 100u}) {
      Writer writer;
      writer.byte(kind).byte(2).byte(100).byte(100).byte(0);
      for (unsigned i = 0; i < 120; ++i) {
        const auto near = static_cast<std::int16_t>(i * step % 30000);
        if (kind == kMonitor) writer.byte(i % 4);
        writer.byte(1).put(near);
        if (kind == kStore) {
          writer.byte(3).byte(i);
        } else if (kind == kQueue) {
          writer.byte(50).byte(10).byte(i * 7).byte(i % 2).byte(i);
        } else if (kind == kSelector) {
          writer.byte(10).byte(i % 4 == 0 ? 1 : 5).byte(i);
        }
      }
      all.push_back(writer.bytes());
    }
  }
  return all;
}

void run(const std::uint8_t* data, std::size_t size) {
  Reader reader(data, size);
  switch (reader.choice(kKinds)) {
    case kStore:
      return runStore(&reader);
    case kMonitor:
      return runMonitor(&reader);
    case kQueue:
      return runQueue(&reader);
    default:
      return runSelector(&reader);
  }
}

const char* const kWords[] = {nullptr};
const Registration kRegistered({"sync", seeds, run, kWords});

}  // namespace
}  // namespace fuzz
}  // namespace semantic_lidar_fusion

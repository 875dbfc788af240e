// SPDX-License-Identifier: MIT
#include "packet_times.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <optional>

namespace semantic_lidar_fusion {
namespace {

constexpr std::size_t kClockOffset = 1200;
constexpr StampNs kHourNs = 3600 * kNsPerSecond;
/// Stamps that keep step with the packets' own clock as well as this are better than it: they count
/// from the epoch. 50 us are 1 mm at 20 m/s.
constexpr StampNs kInStepNs = 50000;
/// Stamps of a host that works at its limit are late by this at most. It is also the longest pause
/// between two packets of a scan: a turn at 5 Hz.
constexpr StampNs kLatestNs = 200000000;
/// Stamps that are multiples of this were rounded.
constexpr StampNs kCoarseNs = 100000;
/// With fewer packets nothing can be said of a clock.
constexpr std::size_t kFewest = 4;

/// The value that `share` of the values do not exceed.
StampNs quantile(std::vector<StampNs> values, double share) {
  const auto place =
      values.begin() + static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), place, values.end());
  return *place;
}

/// ns since the hour, by the packet's own clock.
StampNs clockOf(const Packet& packet) {
  const std::uint8_t* const bytes = packet.data.data() + kClockOffset;
  const std::uint32_t us =
      bytes[0] | bytes[1] << 8U | bytes[2] << 16U | static_cast<std::uint32_t>(bytes[3]) << 24U;
  return StampNs{us} * 1000;
}

/// Each packet's own clock relative to that of the middle one; empty if it does not run as a clock
/// that counts packets does: nearly all differ, at steps that are much alike, within a scan.
std::vector<StampNs> clocks(const std::vector<const Packet*>& packets, StampNs longest_scan_ns) {
  if (packets.size() < kFewest) return {};
  const StampNs middle = clockOf(*packets[packets.size() / 2]);
  std::vector<StampNs> clock;
  clock.reserve(packets.size());
  for (const Packet* const packet : packets) {
    StampNs since = clockOf(*packet) - middle;
    if (since > kHourNs / 2) since -= kHourNs;
    if (since < -kHourNs / 2) since += kHourNs;
    clock.push_back(since);
  }
  if (quantile(clock, 0.95) - quantile(clock, 0.05) > longest_scan_ns) return {};
  std::vector<StampNs> steps = clock;
  std::sort(steps.begin(), steps.end());
  std::adjacent_difference(steps.begin(), steps.end(), steps.begin());
  steps.erase(steps.begin());
  // 0.1 to 4 ms: from a packet of an Alpha Prime to one of a Puck with one loss or two.
  const bool runs = quantile(steps, 0.1) >= 20000 && quantile(steps, 0.5) <= 4000000;
  return runs ? clock : std::vector<StampNs>();
}

/// Whether nearly all stamps are multiples of a large unit.
bool areCoarse(const std::vector<const Packet*>& packets) {
  const auto coarse = std::count_if(packets.begin(), packets.end(), [](const Packet* packet) {
    return packet->stamp % kCoarseNs == 0;
  });
  return packets.size() >= kFewest && static_cast<double>(coarse) >= 0.9 * packets.size();
}

void add(const Packet* packet, StampNs stamp, PacketTimes* times) {
  times->packets.push_back({packet, stamp});
}

void byStamps(const std::vector<const Packet*>& packets, StampNs longest_scan_ns,
              PacketTimes* times) {
  // The middle stamp's neighbourhood: up to the first long pause before and behind it.
  const std::size_t middle = packets.size() / 2;
  const auto joined = [&](std::size_t a, std::size_t b) {
    return packets[b]->stamp - packets[a]->stamp <= kLatestNs;
  };
  std::size_t first = middle, last = middle;
  while (first > 0 && joined(first - 1, first)) --first;
  while (last + 1 < packets.size() && joined(last, last + 1)) ++last;
  for (std::size_t i = 0; i < packets.size(); ++i) {
    const bool near = std::abs(packets[i]->stamp - packets[middle]->stamp) <= longest_scan_ns;
    if (i < first || i > last || !near) {
      ++times->outliers;
    } else {
      add(packets[i], packets[i]->stamp, times);
    }
  }
  times->decision.text = "packet times: their stamps";
  if (packets.size() > 1 && packets[first]->stamp == packets[last]->stamp) {
    times->decision.warning = true;
    times->decision.instant = true;
    times->decision.text +=
        ", which are all equal, and the packets' own clock does not run: the scan is taken as an "
        "instant";
  }
}

/// Stamps of which nearly all are equal tell one moment: that of the first packet.
std::optional<StampNs> commonStamp(const std::vector<const Packet*>& packets) {
  const StampNs middle = packets[packets.size() / 2]->stamp;
  const auto equal = std::count_if(packets.begin(), packets.end(),
                                   [&](const Packet* packet) { return packet->stamp == middle; });
  if (static_cast<double>(equal) < 0.9 * packets.size()) return std::nullopt;
  return middle;
}

void byClock(const std::vector<const Packet*>& packets, const std::vector<StampNs>& clock,
             PacketTimes* times) {
  const std::optional<StampNs> common = commonStamp(packets);
  const StampNs base = packets[packets.size() / 2]->stamp;
  std::vector<StampNs> ahead(packets.size());  // of each stamp before the packet's own clock
  for (std::size_t i = 0; i < packets.size(); ++i) ahead[i] = packets[i]->stamp - base - clock[i];
  const StampNs usual = quantile(ahead, 0.5);

  std::vector<bool> kept(packets.size());
  StampNs worst = 0, most = std::numeric_limits<StampNs>::min();
  for (std::size_t i = 0; i < packets.size(); ++i) {
    kept[i] = std::abs(common ? packets[i]->stamp - *common : ahead[i] - usual) <= kLatestNs;
    if (!kept[i]) {
      ++times->outliers;
      continue;
    }
    worst = std::max(worst, std::abs(ahead[i] - usual));
    most = std::max(most, ahead[i]);
  }
  const bool stamps_serve = !common && worst <= kInStepNs;
  const bool coarse = !common && areCoarse(packets);
  // Rounded stamps are early, by up to a unit; a busy host's are late, now more and now less.
  const StampNs origin = base + (common || coarse ? most : usual);
  for (std::size_t i = 0; i < packets.size(); ++i) {
    if (kept[i]) add(packets[i], stamps_serve ? packets[i]->stamp : origin + clock[i], times);
  }
  std::stable_sort(
      times->packets.begin(), times->packets.end(),
      [](const StampedPacket& a, const StampedPacket& b) { return a.stamp < b.stamp; });
  times->decision.text =
      stamps_serve ? "packet times: their stamps"
      : common     ? "packet times: their own clock, from their common stamp on; all packets of a "
                     "scan carry one stamp, taken as the first packet's"
      : coarse     ? "packet times: their own clock; the stamps are rounded"
               : "packet times: their own clock; the stamps are late by more than 50 us now and "
                 "then, as a busy host sets them";
  times->decision.warning = common || coarse;
}

}  // namespace

PacketTimes packetTimes(const std::vector<const Packet*>& packets, StampNs longest_scan_ns) {
  PacketTimes times;
  times.packets.reserve(packets.size());
  if (packets.empty()) return times;
  const std::vector<StampNs> clock = clocks(packets, longest_scan_ns);
  if (clock.empty()) {
    byStamps(packets, longest_scan_ns, &times);
  } else {
    byClock(packets, clock, &times);
  }
  return times;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/lidar/packet_decoder.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <utility>

#include "range_limits.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/lidar/firing_times.h"

namespace semantic_lidar_fusion {
namespace {

constexpr std::size_t kBlockBytes = 100;
constexpr std::size_t kReturnBytes = 3;
constexpr std::size_t kModeOffset = 1204;
constexpr std::size_t kFactoryOffset = 1205;
constexpr int kFullTurn = 36000;  ///< 0.01 deg
constexpr double kRadPerUnit = kPi / 18000.0;
constexpr std::size_t kMaxPointsPerPacket = kBlocksPerPacket * kReturnsPerBlock;

unsigned littleEndian16(const std::uint8_t* bytes) { return bytes[0] | bytes[1] << 8; }

std::string hex(std::uint8_t byte) {
  char text[5];
  std::snprintf(text, sizeof(text), "0x%02X", static_cast<unsigned>(byte));
  return text;
}

std::optional<LidarModel> modelOf(std::uint8_t factory_byte) {
  switch (factory_byte) {
    case 0x22:
      return LidarModel::kVlp16;
    case 0x24:
      return LidarModel::kPuckHiRes;
    case 0x28:
      return LidarModel::kVlp32c;
    case 0x21:
      return LidarModel::kHdl32e;
    default:
      return std::nullopt;
  }
}

struct CosSin {
  double cos = 1.0;
  double sin = 0.0;
};

CosSin cosSin(double angle) { return {std::cos(angle), std::sin(angle)}; }

/// Exact to 1e-12 for the angles between two blocks, where it needs no library call.
CosSin cosSinSmall(double angle) {
  if (std::abs(angle) > 0.03) return cosSin(angle);
  const double s = angle * angle;
  return {1.0 - s * (0.5 - s * (1.0 / 24.0)), angle * (1.0 - s * (1.0 / 6.0 - s * (1.0 / 120.0)))};
}

/// Of the sum of two angles.
CosSin sum(const CosSin& a, const CosSin& b) {
  return {a.cos * b.cos - a.sin * b.sin, a.sin * b.cos + a.cos * b.sin};
}

/// A laser with the products that every point needs.
struct LaserTable {
  double cos_elevation;
  double sin_elevation;
  CosSin azimuth_offset;
  double vertical_offset_m;
  StampNs time_ns;
  std::uint16_t ring;
};

struct ModelTable {
  const FiringTimes* times = nullptr;
  std::array<LaserTable, 32> lasers{};
};

ModelTable makeTable(LidarModel model, const std::vector<double>& vertical_offsets_m) {
  ModelTable table;
  table.times = &firingTimes(model);
  for (int i = 0; i < table.times->laser_count; ++i) {
    const Laser& laser = table.times->lasers[i];
    table.lasers[i] = {std::cos(laser.elevation_rad),
                       std::sin(laser.elevation_rad),
                       cosSin(laser.azimuth_offset_rad),
                       vertical_offsets_m.empty() ? 0.0 : vertical_offsets_m[laser.ring],
                       laser.time_ns,
                       laser.ring};
  }
  return table;
}

/// Blocks that tell one and the same firings: one block, or two in dual return mode.
struct Slot {
  bool valid = false;
  int azimuth = 0;           ///< 0.01 deg, at the begin of the first firing
  double rate_per_ns = 0.0;  ///< rad
};

/// Signed difference of two azimuths, the shorter way round.
int azimuthStep(int from, int to) {
  return (to - from + kFullTurn + kFullTurn / 2) % kFullTurn - kFullTurn / 2;
}

/// Decodes the packets of one scan, in order, to the end of a cloud.
class ScanWriter {
 public:
  ScanWriter(const PacketDecoderConfig& config, std::size_t packet_count, DecodedScan& scan)
      : config_(config), cloud_(scan.cloud), counters_(scan.counters) {
    resizeCloud(packet_count * kMaxPointsPerPacket);
    cloud_.firings.reserve(packet_count * kBlocksPerPacket * 2);
  }

  void write(const Packet& packet, std::uint32_t packet_index) {
    const std::uint8_t mode = packet.data[kModeOffset];
    const std::uint8_t factory = packet.data[kFactoryOffset];
    const std::optional<LidarModel> model = config_.model ? config_.model : modelOf(factory);
    if (!model) {
      ++counters_.unknown_packets["factory byte " + hex(factory) +
                                  " is none of 0x21, 0x22, 0x24, 0x28; set lidar.model"];
      return;
    }
    if (mode != 0x37 && mode != 0x38 && mode != 0x39) {
      ++counters_.unknown_packets["return mode byte " + hex(mode) +
                                  " is none of 0x37 strongest, 0x38 last, 0x39 dual"];
      return;
    }
    const ModelTable* const table = tableOf(*model);
    if (!table) {
      ++counters_.unknown_packets["vertical_offsets_m has " +
                                  std::to_string(config_.vertical_offsets_m.size()) +
                                  " entries, factory byte " + hex(factory) + " means " +
                                  std::to_string(firingTimes(*model).laser_count) + " lasers"];
      return;
    }
    writeKnown(packet, packet_index, *table, mode == 0x39);
  }

  void finish() { resizeCloud(size_); }

 private:
  void resizeCloud(std::size_t size) {
    cloud_.x.resize(size);
    cloud_.y.resize(size);
    cloud_.z.resize(size);
    cloud_.intensity.resize(size);
    cloud_.ring.resize(size);
    cloud_.time_ns.resize(size);
    cloud_.firing.resize(size);
  }

  /// Null if the configured vertical offsets do not fit the model.
  const ModelTable* tableOf(LidarModel model) {
    ModelTable& table = tables_[static_cast<std::size_t>(model)];
    if (!table.times) {
      const std::size_t offsets = config_.vertical_offsets_m.size();
      if (offsets != 0 && offsets != static_cast<std::size_t>(firingTimes(model).laser_count)) {
        return nullptr;
      }
      table = makeTable(model, config_.vertical_offsets_m);
    }
    return &table;
  }

  StampNs startOf(const Packet& packet, const FiringTimes& times, bool dual) const {
    const StampNs stamp = packet.stamp + config_.time_offset_ns;
    switch (config_.packet_stamp) {
      case PacketStamp::kMiddle:
        return stamp - times.packetNs(dual) / 2;
      case PacketStamp::kEnd:
        return stamp - times.packetNs(dual);
      case PacketStamp::kStart:
        break;
    }
    return stamp;
  }

  bool checkBlock(const std::uint8_t* block) {
    const bool good = block[0] == 0xFF && block[1] == 0xEE && littleEndian16(block + 2) < kFullTurn;
    if (!good) ++counters_.bad_blocks;
    return good;
  }

  /// Rates from each valid slot to the next; the last takes the previous one, also that of an
  /// earlier packet.
  void fillRates(std::array<Slot, kBlocksPerPacket>& slots, int slot_count, StampNs slot_ns) {
    int from = -1;
    for (int i = 0; i < slot_count; ++i) {
      if (!slots[i].valid) continue;
      if (from >= 0) {
        rate_per_ns_ = azimuthStep(slots[from].azimuth, slots[i].azimuth) * kRadPerUnit /
                       static_cast<double>((i - from) * slot_ns);
        slots[from].rate_per_ns = rate_per_ns_;
      }
      from = i;
    }
    if (from >= 0) slots[from].rate_per_ns = rate_per_ns_;
  }

  void writeKnown(const Packet& packet, std::uint32_t packet_index, const ModelTable& table,
                  bool dual) {
    const FiringTimes& times = *table.times;
    const StampNs start = startOf(packet, times, dual);
    const int blocks_per_slot = dual ? 2 : 1;
    const int slot_count = kBlocksPerPacket / blocks_per_slot;

    std::array<bool, kBlocksPerPacket> good{};
    std::array<Slot, kBlocksPerPacket> slots{};
    for (int b = 0; b < kBlocksPerPacket; ++b) {
      const std::uint8_t* const block = packet.data.data() + b * kBlockBytes;
      good[b] = checkBlock(block);
      Slot& slot = slots[b / blocks_per_slot];
      if (good[b] && !slot.valid) {
        slot.valid = true;
        slot.azimuth = static_cast<int>(littleEndian16(block + 2));
      }
    }
    fillRates(slots, slot_count, times.blockNs());

    for (int s = 0; s < slot_count; ++s) {
      if (!slots[s].valid) continue;
      const CosSin slot_azimuth = cosSin(slots[s].azimuth * kRadPerUnit);
      const StampNs slot_start = start + s * times.blockNs();
      // The firings of this slot: -1 until one has a point.
      std::array<std::int64_t, 2> firing_index{{-1, -1}};
      const std::uint8_t* first_returns = nullptr;
      for (int b = s * blocks_per_slot; b < (s + 1) * blocks_per_slot; ++b) {
        if (!good[b]) continue;
        const std::uint8_t* const returns = packet.data.data() + b * kBlockBytes + 4;
        for (int f = 0; f < times.firings_per_block; ++f) {
          const std::size_t offset = f * times.laser_count * kReturnBytes;
          writeFiring(returns + offset, first_returns ? first_returns + offset : nullptr, table,
                      slot_azimuth, slots[s].rate_per_ns, f * times.firing_ns, slot_start,
                      packet_index, firing_index[f]);
        }
        first_returns = returns;
      }
    }
  }

  void writeFiring(const std::uint8_t* returns, const std::uint8_t* first_returns,
                   const ModelTable& table, const CosSin& slot_azimuth, double rate_per_ns,
                   StampNs firing_ns, StampNs slot_start, std::uint32_t packet_index,
                   std::int64_t& firing_index) {
    const double unit = table.times->distance_unit_m;
    for (int l = 0; l < table.times->laser_count; ++l) {
      const std::uint8_t* const data = returns + l * kReturnBytes;
      const unsigned raw_distance = littleEndian16(data);
      if (raw_distance == 0) continue;
      if (first_returns &&
          std::equal(data, data + kReturnBytes, first_returns + l * kReturnBytes)) {
        ++counters_.equal_returns;
        continue;
      }
      const double distance = raw_distance * unit;
      if (outOfRange(distance, config_.min_range_m, config_.max_range_m)) {
        ++counters_.out_of_range_points;
        continue;
      }
      const LaserTable& laser = table.lasers[l];
      const StampNs in_slot = firing_ns + laser.time_ns;
      const CosSin azimuth =
          sum(sum(slot_azimuth, cosSinSmall(rate_per_ns * static_cast<double>(in_slot))),
              laser.azimuth_offset);
      const double horizontal = distance * laser.cos_elevation;
      const StampNs time = slot_start + in_slot;
      cloud_.x[size_] = static_cast<float>(horizontal * azimuth.cos);
      cloud_.y[size_] = static_cast<float>(-horizontal * azimuth.sin);
      cloud_.z[size_] =
          static_cast<float>(distance * laser.sin_elevation + laser.vertical_offset_m);
      cloud_.intensity[size_] = static_cast<float>(data[2]);
      cloud_.ring[size_] = laser.ring;
      cloud_.time_ns[size_] = time;
      if (firing_index < 0) {
        firing_index = static_cast<std::int64_t>(cloud_.firings.size());
        cloud_.firings.push_back({time, time, packet_index});
      }
      Firing& firing = cloud_.firings[static_cast<std::size_t>(firing_index)];
      firing.begin_ns = std::min(firing.begin_ns, time);
      firing.end_ns = std::max(firing.end_ns, time);
      cloud_.firing[size_] = static_cast<std::uint32_t>(firing_index);
      ++size_;
    }
  }

  const PacketDecoderConfig& config_;
  TimedCloud& cloud_;
  PacketCounters& counters_;
  std::array<ModelTable, 4> tables_{};
  double rate_per_ns_ = 0.0;
  std::size_t size_ = 0;
};

/// The packets in order of their stamps, without duplicates and zero-filled ones.
std::vector<const Packet*> cleaned(const std::vector<Packet>& packets, PacketCounters& counters) {
  std::vector<const Packet*> sorted;
  sorted.reserve(packets.size());
  for (const Packet& packet : packets) {
    if (std::all_of(packet.data.begin(), packet.data.end(),
                    [](std::uint8_t b) { return b == 0; })) {
      ++counters.zero_packets;
    } else {
      sorted.push_back(&packet);
    }
  }
  std::stable_sort(sorted.begin(), sorted.end(),
                   [](const Packet* a, const Packet* b) { return a->stamp < b->stamp; });
  std::vector<const Packet*> kept;
  kept.reserve(sorted.size());
  for (const Packet* const packet : sorted) {
    bool duplicate = false;
    for (auto other = kept.rbegin();
         other != kept.rend() && (*other)->stamp == packet->stamp && !duplicate; ++other) {
      duplicate = (*other)->data == packet->data;
    }
    if (duplicate) {
      ++counters.duplicate_packets;
    } else {
      kept.push_back(packet);
    }
  }
  return kept;
}

}  // namespace

PacketDecoder::PacketDecoder(PacketDecoderConfig config) : config_(std::move(config)) {
  std::vector<std::string> problems;
  checkRangeLimits(config_.min_range_m, config_.max_range_m, problems);
  const std::size_t offsets = config_.vertical_offsets_m.size();
  if (config_.model) {
    const FiringTimes& times = firingTimes(*config_.model);
    if (offsets != 0 && offsets != static_cast<std::size_t>(times.laser_count)) {
      problems.push_back("lidar.vertical_offsets_m has " + std::to_string(offsets) +
                         " entries, must have one for each of the " +
                         std::to_string(times.laser_count) + " rings of the " + times.model_name);
    }
  } else if (offsets != 0 && offsets != 16 && offsets != 32) {
    problems.push_back("lidar.vertical_offsets_m has " + std::to_string(offsets) +
                       " entries, must have 16 or 32, one for each ring");
  }
  for (const double offset : config_.vertical_offsets_m) {
    if (!std::isfinite(offset)) {
      problems.push_back("lidar.vertical_offsets_m has an entry that is not finite");
      break;
    }
  }
  if (!problems.empty()) throw ConfigError(std::move(problems));
}

DecodedScan PacketDecoder::decode(const std::vector<Packet>& packets, StampNs header_stamp,
                                  const std::string& frame_id) const {
  DecodedScan scan;
  scan.cloud.header_stamp = header_stamp;
  scan.cloud.frame_id = frame_id;
  scan.counters.packets = packets.size();
  const std::vector<const Packet*> kept = cleaned(packets, scan.counters);
  ScanWriter writer(config_, kept.size(), scan);
  for (std::size_t i = 0; i < kept.size(); ++i) {
    writer.write(*kept[i], static_cast<std::uint32_t>(i));
  }
  writer.finish();
  return scan;
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/lidar/packet_decoder.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <deque>
#include <optional>
#include <utility>

#include "packet_times.h"
#include "range_limits.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/lidar/lidar_spec.h"

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
  const LidarSpec* spec = nullptr;
  std::vector<LaserTable> lasers;
};

ModelTable makeTable(const LidarSpec& spec, const std::vector<double>& vertical_offsets_m) {
  ModelTable table;
  table.spec = &spec;
  for (const Laser& laser : spec.lasers) {
    table.lasers.push_back({std::cos(laser.elevation_rad), std::sin(laser.elevation_rad),
                            cosSin(laser.azimuth_offset_rad),
                            vertical_offsets_m.empty() ? 0.0 : vertical_offsets_m[laser.ring],
                            laser.time_ns, laser.ring});
  }
  return table;
}

unsigned flagOf(const Packet& packet, int block) {
  return littleEndian16(packet.data.data() + block * kBlockBytes);
}

int azimuthOf(const Packet& packet, int block) {
  return static_cast<int>(littleEndian16(packet.data.data() + block * kBlockBytes + 2));
}

/// HDL-64E: lasers 0 to 31 and 32 to 63 in blocks of two flags by turns, and status bytes where
/// others tell their model.
bool looksLikeHdl64e(const Packet& packet) {
  for (int b = 0; b < kBlocksPerPacket; ++b) {
    if (flagOf(packet, b) != (b % 2 == 0 ? 0xEEFFu : 0xDDFFu)) return false;
  }
  return true;
}

/// The return mode by the blocks: in dual return mode two follow each other with one flag and one
/// azimuth. Of a sensor that stands still all azimuths are equal, which tells nothing.
bool looksDual(const Packet& packet, const LidarSpec& spec) {
  bool turns = spec.bankCount() > 1;
  const int blocks = spec.slotsPerPacket(true) * spec.blocksPerSlot(true);
  for (int b = 0; b + 1 < blocks; b += 2) {
    if (flagOf(packet, b) != flagOf(packet, b + 1)) return false;
    if (azimuthOf(packet, b) != azimuthOf(packet, b + 1)) return false;
    turns = turns || azimuthOf(packet, b) != azimuthOf(packet, 0);
  }
  return turns;
}

/// One azimuth and the firings that belong to it; see LidarSpec.
struct Slot {
  bool valid = false;
  int azimuth = 0;           ///< 0.01 deg, at the begin of the first firing
  double rate_per_ns = 0.0;  ///< rad
  StampNs gap_ns = 0;        ///< that the sensor turned on without a word, before it
};

/// A packet that can be decoded.
struct KnownPacket {
  const Packet* packet = nullptr;
  const ModelTable* table = nullptr;
  bool dual = false;
  StampNs stamp = 0;  ///< true time
  std::array<bool, kBlocksPerPacket> good{};
  std::array<int, kBlocksPerPacket> bank{};
  std::array<Slot, kBlocksPerPacket> slots{};
  StampNs gap_ns = 0;  ///< of all slots

  const LidarSpec& spec() const { return *table->spec; }
  int slotCount() const { return spec().slotsPerPacket(dual); }
};

/// Model and return mode of each packet.
class PacketKinds {
 public:
  PacketKinds(const PacketDecoderConfig& config, PacketCounters& counters)
      : config_(config), counters_(counters) {}

  /// Sets `table` and `dual`; false, counted with the reason, for packets of unknown kind.
  bool find(KnownPacket& known) {
    const Packet& packet = *known.packet;
    const std::uint8_t mode = packet.data[kModeOffset];
    const std::uint8_t factory = packet.data[kFactoryOffset];
    const LidarSpec* const spec = config_.model ? config_.model : findLidarSpec(factory);
    if (!spec && looksLikeHdl64e(packet)) {
      return refuse(
          "the blocks of an HDL-64E, whose angles are those of a single sensor and stand in no "
          "public table; use the cloud of its driver (lidar.input: points)");
    }
    if (!spec) {
      return refuse("factory byte " + hex(factory) + " is none of " + factoryBytes() +
                    "; set lidar.model");
    }
    const bool mode_is_known = mode == 0x37 || mode == 0x38 || mode == 0x39;
    if (!mode_is_known && !config_.model) {
      return refuse("return mode byte " + hex(mode) +
                    " is none of 0x37 strongest, 0x38 last, 0x39 dual; set lidar.model, then the "
                    "blocks tell the mode");
    }
    const std::size_t offsets = config_.vertical_offsets_m.size();
    if (offsets != 0 && offsets != static_cast<std::size_t>(spec->laserCount())) {
      return refuse("vertical_offsets_m has " + std::to_string(offsets) +
                    " entries, factory byte " + hex(factory) + " means " +
                    std::to_string(spec->laserCount()) + " lasers");
    }
    known.dual = mode_is_known ? mode == 0x39 : looksDual(packet, *spec);
    known.table = &tableOf(*spec);
    return true;
  }

 private:
  const ModelTable& tableOf(const LidarSpec& spec) {
    for (const ModelTable& table : tables_) {
      if (table.spec == &spec) return table;
    }
    tables_.push_back(makeTable(spec, config_.vertical_offsets_m));
    return tables_.back();
  }

  bool refuse(const std::string& reason) {
    ++counters_.unknown_packets[reason];
    return false;
  }

  static std::string factoryBytes() {
    std::string bytes;
    for (const LidarSpec& spec : lidarSpecs()) {
      bytes += (bytes.empty() ? "" : ", ") + hex(spec.factory_byte) + " " + spec.name;
    }
    return bytes;
  }

  const PacketDecoderConfig& config_;
  PacketCounters& counters_;
  std::deque<ModelTable> tables_;  ///< of the models that were met; they stay where they are
};

/// Signed difference of two azimuths, the shorter way round.
int azimuthStep(int from, int to) {
  return (to - from + kFullTurn + kFullTurn / 2) % kFullTurn - kFullTurn / 2;
}

/// Finds the bank and the azimuth of each block.
void readBlocks(KnownPacket& known, PacketCounters& counters) {
  const std::vector<std::uint16_t>& flags = known.spec().bank_flags;
  const int blocks_per_slot = known.spec().blocksPerSlot(known.dual);
  for (int b = 0; b < known.slotCount() * blocks_per_slot; ++b) {
    const auto flag = std::find(flags.begin(), flags.end(), flagOf(*known.packet, b));
    const int azimuth = azimuthOf(*known.packet, b);
    if (flag == flags.end() || azimuth >= kFullTurn) {
      ++counters.bad_blocks;
      continue;
    }
    known.good[b] = true;
    known.bank[b] = static_cast<int>(flag - flags.begin());
    Slot& slot = known.slots[b / blocks_per_slot];
    if (slot.valid) continue;
    slot.valid = true;
    slot.azimuth = azimuth;
  }
}

/// How fast the sensor turns, slot by slot. A motor keeps its rate from one slot to the next: a
/// step that says otherwise leads across a part of the turn that the sensor leaves out (a reduced
/// field of view), where it goes on turning without sending.
class TurnRates {
 public:
  explicit TurnRates(std::vector<KnownPacket>& packets) : packets_(packets) {
    std::vector<double> rates;
    for (std::size_t p = 0; p < packets.size(); ++p) {
      forEachStep(p, [&](int from, int to) { rates.push_back(rateOf(packets[p], from, to)); });
      if (const auto rate = rateToNext(p)) rates.push_back(*rate);
    }
    rates.erase(std::remove_if(rates.begin(), rates.end(),
                               [](double rate) { return std::abs(rate) > kFastestPerNs; }),
                rates.end());
    if (rates.empty()) return;
    const auto middle = rates.begin() + static_cast<std::ptrdiff_t>((rates.size() - 1) / 2);
    std::nth_element(rates.begin(), middle, rates.end());
    usual_per_ns_ = *middle;
  }

  /// Rates from each valid slot to the next; the last takes the previous one, also that of an
  /// earlier packet.
  void fill() {
    double rate_per_ns = usual_per_ns_;
    for (std::size_t p = 0; p < packets_.size(); ++p) {
      KnownPacket& known = packets_[p];
      int last = -1;
      StampNs gap_ns = 0;
      forEachStep(p, [&](int from, int to) {
        const double rate = rateOf(known, from, to);
        if (isPlausible(rate, known)) {
          rate_per_ns = rate;
        } else {
          gap_ns += gapOf(known, from, to);
        }
        known.slots[from].rate_per_ns = rate_per_ns;
        known.slots[to].gap_ns = gap_ns;
        last = to;
      });
      const auto to_next = rateToNext(p);
      if (to_next && isPlausible(*to_next, known)) rate_per_ns = *to_next;
      for (int s = std::max(last, 0); s < known.slotCount(); ++s) {
        known.slots[s].rate_per_ns = rate_per_ns;
      }
      settleGap(p, gap_ns);
    }
  }

 private:
  /// No spinning lidar turns faster than 30 times a second.
  static constexpr double kFastestPerNs = 30.0 * 2.0 * kPi * 1e-9;
  /// Steps may differ by the rounding of two azimuths and as much again, 0.01 deg.
  static constexpr double kRounding = 3.0;

  template <typename Use>
  void forEachStep(std::size_t p, const Use& use) const {
    const KnownPacket& known = packets_[p];
    int from = -1;
    for (int s = 0; s < known.slotCount(); ++s) {
      if (!known.slots[s].valid) continue;
      if (from >= 0) use(from, s);
      from = s;
    }
  }

  static double rateOf(const KnownPacket& known, int from, int to) {
    return azimuthStep(known.slots[from].azimuth, known.slots[to].azimuth) * kRadPerUnit /
           static_cast<double>((to - from) * known.spec().slotNs());
  }

  /// From the only slot of a packet to that of the next, if no packet is lost between them.
  std::optional<double> rateToNext(std::size_t p) const {
    if (packets_[p].slotCount() > 1 || p + 1 == packets_.size()) return std::nullopt;
    const KnownPacket& a = packets_[p];
    const KnownPacket& b = packets_[p + 1];
    const StampNs packet_ns = a.spec().packetNs(a.dual);
    if (!a.slots[0].valid || !b.slots[0].valid || b.stamp - a.stamp > packet_ns * 3 / 2) {
      return std::nullopt;
    }
    return azimuthStep(a.slots[0].azimuth, b.slots[0].azimuth) * kRadPerUnit /
           static_cast<double>(packet_ns);
  }

  bool isPlausible(double rate, const KnownPacket& known) const {
    return std::abs(rate - usual_per_ns_) <=
           0.5 * std::abs(usual_per_ns_) +
               kRounding * kRadPerUnit / static_cast<double>(known.spec().slotNs());
  }

  /// How long the sensor turned from one slot to the next beyond what the slots themselves take.
  StampNs gapOf(const KnownPacket& known, int from, int to) const {
    if (usual_per_ns_ <= 0.0) return 0;
    const int turn = (known.slots[to].azimuth - known.slots[from].azimuth + kFullTurn) % kFullTurn;
    const StampNs turned_ns = std::llround(turn * kRadPerUnit / usual_per_ns_);
    return std::max<StampNs>(turned_ns - (to - from) * known.spec().slotNs(), 0);
  }

  /// Damaged azimuths look like gaps too: those of a packet add up to less than a turn, and end
  /// before the next packet begins.
  void settleGap(std::size_t p, StampNs gap_ns) {
    if (gap_ns == 0) return;
    KnownPacket& known = packets_[p];
    const StampNs packet_ns = known.spec().packetNs(known.dual);
    const bool less_than_a_turn =
        static_cast<double>(gap_ns + packet_ns / 2) * usual_per_ns_ < kFullTurn * kRadPerUnit;
    const bool fits =
        p + 1 == packets_.size() || packets_[p + 1].stamp - known.stamp > gap_ns + packet_ns / 2;
    if (less_than_a_turn && fits) {
      known.gap_ns = gap_ns;
    } else {
      for (Slot& slot : known.slots) slot.gap_ns = 0;
    }
  }

  std::vector<KnownPacket>& packets_;
  double usual_per_ns_ = 0.0;
};

/// Decodes the packets of one scan, in order, to the end of a cloud.
class ScanWriter {
 public:
  ScanWriter(const PacketDecoderConfig& config, std::size_t packet_count, DecodedScan& scan)
      : config_(config), cloud_(scan.cloud), counters_(scan.counters) {
    resizeCloud(packet_count * kMaxPointsPerPacket);
    cloud_.firings.reserve(packet_count * kBlocksPerPacket * 2);
  }

  void write(const KnownPacket& known, std::uint32_t packet_index) {
    const LidarSpec& spec = known.spec();
    const int blocks_per_slot = spec.blocksPerSlot(known.dual);
    const StampNs start = startOf(known);
    cloud_.packet_begin_ns.push_back(start);
    for (int s = 0; s < known.slotCount(); ++s) {
      const Slot& slot = known.slots[s];
      if (!slot.valid) continue;
      slot_azimuth_ = cosSin(slot.azimuth * kRadPerUnit);
      rate_per_ns_ = slot.rate_per_ns;
      slot_start_ = start + s * spec.slotNs() + slot.gap_ns;
      packet_index_ = packet_index;
      firing_index_.fill(-1);
      std::array<const std::uint8_t*, kMostBanks> first_returns{};
      for (int b = s * blocks_per_slot; b < (s + 1) * blocks_per_slot; ++b) {
        if (!known.good[b]) continue;
        const std::uint8_t* const returns = known.packet->data.data() + b * kBlockBytes + 4;
        const std::uint8_t*& first = first_returns[known.bank[b]];
        for (int first_in_block = 0; first_in_block < kReturnsPerBlock;
             first_in_block += std::min(spec.laserCount(), kReturnsPerBlock)) {
          const int in_slot = known.bank[b] * kReturnsPerBlock + first_in_block;
          const std::size_t offset = first_in_block * kReturnBytes;
          writeFiring(returns + offset, first ? first + offset : nullptr, *known.table,
                      in_slot / spec.laserCount(), in_slot % spec.laserCount());
        }
        first = returns;
      }
    }
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

  StampNs startOf(const KnownPacket& known) const {
    const StampNs packet_ns = known.spec().packetNs(known.dual) + known.gap_ns;
    switch (config_.packet_stamp) {
      case PacketStamp::kMiddle:
        return known.stamp - packet_ns / 2;
      case PacketStamp::kEnd:
        return known.stamp - packet_ns;
      case PacketStamp::kStart:
        break;
    }
    return known.stamp;
  }

  /// The returns of one firing in one block, from laser `first_laser` on.
  void writeFiring(const std::uint8_t* returns, const std::uint8_t* first_returns,
                   const ModelTable& table, int firing, int first_laser) {
    const double unit = table.spec->distance_unit_m;
    const StampNs firing_ns = firing * table.spec->firing_ns;
    std::int64_t& firing_index = firing_index_[firing];
    const int count = std::min(table.spec->laserCount(), kReturnsPerBlock);
    for (int l = 0; l < count; ++l) {
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
      const LaserTable& laser = table.lasers[first_laser + l];
      const StampNs in_slot = firing_ns + laser.time_ns;
      const CosSin azimuth =
          sum(sum(slot_azimuth_, cosSinSmall(rate_per_ns_ * static_cast<double>(in_slot))),
              laser.azimuth_offset);
      const double horizontal = distance * laser.cos_elevation;
      const StampNs time = slot_start_ + in_slot;
      cloud_.x[size_] = static_cast<float>(horizontal * azimuth.cos);
      cloud_.y[size_] = static_cast<float>(-horizontal * azimuth.sin);
      cloud_.z[size_] =
          static_cast<float>(distance * laser.sin_elevation + laser.vertical_offset_m);
      cloud_.intensity[size_] = static_cast<float>(data[2]);
      cloud_.ring[size_] = laser.ring;
      cloud_.time_ns[size_] = time;
      if (firing_index < 0) {
        firing_index = static_cast<std::int64_t>(cloud_.firings.size());
        cloud_.firings.push_back({time, time, packet_index_});
      }
      Firing& entry = cloud_.firings[static_cast<std::size_t>(firing_index)];
      entry.begin_ns = std::min(entry.begin_ns, time);
      entry.end_ns = std::max(entry.end_ns, time);
      cloud_.firing[size_] = static_cast<std::uint32_t>(firing_index);
      ++size_;
    }
  }

  const PacketDecoderConfig& config_;
  TimedCloud& cloud_;
  PacketCounters& counters_;
  // Of the slot that is being written.
  CosSin slot_azimuth_;
  double rate_per_ns_ = 0.0;
  StampNs slot_start_ = 0;
  std::uint32_t packet_index_ = 0;
  std::array<std::int64_t, kReturnsPerBlock> firing_index_{};  ///< -1 until a firing has a point
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
  if (config_.longest_scan_ns <= 0) {
    problems.push_back("lidar.longest_scan_s is " + std::to_string(config_.longest_scan_ns) +
                       " ns, must be more than 0");
  }
  if (config_.model && offsets != 0 &&
      offsets != static_cast<std::size_t>(config_.model->laserCount())) {
    problems.push_back("lidar.vertical_offsets_m has " + std::to_string(offsets) +
                       " entries, must have one for each of the " +
                       std::to_string(config_.model->laserCount()) + " rings of the " +
                       config_.model->name);
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
  PacketTimes times = packetTimes(cleaned(packets, scan.counters), config_.longest_scan_ns);
  scan.counters.outlier_packets = times.outliers;
  scan.time = std::move(times.decision);

  std::vector<KnownPacket> known;
  known.reserve(times.packets.size());
  PacketKinds kinds(config_, scan.counters);
  for (const StampedPacket& stamped : times.packets) {
    KnownPacket packet;
    packet.packet = stamped.packet;
    packet.stamp = stamped.stamp + config_.time_offset_ns;
    if (!kinds.find(packet)) continue;
    readBlocks(packet, scan.counters);
    known.push_back(packet);
  }
  TurnRates(known).fill();
  ScanWriter writer(config_, known.size(), scan);
  for (std::size_t i = 0; i < known.size(); ++i) {
    writer.write(known[i], static_cast<std::uint32_t>(i));
  }
  writer.finish();
  return scan;
}

}  // namespace semantic_lidar_fusion

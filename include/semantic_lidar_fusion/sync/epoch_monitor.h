// SPDX-License-Identifier: MIT
/// Tells a jump of time (a bag that starts anew, a clock that was set) from stamps that are merely
/// late, wrong or left over. No clock: stamps alone.
///
/// One source leads: the lidar, or what is derived from its scans. Only the lead starts a new
/// epoch, and only with `confirmations` messages in a row that agree with each other and not with
/// the current epoch; so neither a single wild stamp nor any other source stops the rest.
///
/// What is in doubt is held, in the order in which it came, at most `kMaxHeld` messages of a
/// source:
///   - a message of the lead that goes back, or more than kForwardNs ahead;
///   - a message of another source that is more than kForwardNs off the lead's newest, goes back
///     behind its own newest by more than kBackwardNs, or goes on after a jump back as if there had
///     been none.
/// A new epoch takes up what is held and lies near it. Where the lead goes on for kLeadsToSettle
/// messages instead, what only went back is taken up late, and the rest is discarded.
///
/// A message of the lead may know its time only roughly (a scan without points has its header's):
/// it follows if any time within its tolerance does, and later messages need not be after it.
///
/// Not thread-safe. The work of a message runs within `observe` of that or of a later message.
#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

struct EpochConfig {
  std::string lead;       ///< name of the leading source
  int confirmations = 2;  ///< messages of the lead that make an epoch; 1 if it is checked before
  StampNs lead_disorder_ns = 0;  ///< how far messages of the lead may overtake each other
};

/// A message that is not used.
struct DiscardedMessage {
  std::string source;
  StampNs stamp = 0;
  StampNs ahead_ns = 0;  ///< of the lead's newest; negative = behind it
};

class EpochMonitor {
 public:
  using Work = std::function<void()>;

  /// A stamp further ahead of the lead's newest is a jump or an error, not a gap to bridge.
  static constexpr StampNs kForwardNs = 5000000000;
  /// A source that goes back by more may have jumped; what overtakes each other is closer.
  static constexpr StampNs kBackwardNs = 300000000;
  static constexpr std::size_t kMaxHeld = 16;
  static constexpr int kLeadsToSettle = 2;

  /// `started_anew`: forget what is buffered; gets the stamp that the epoch starts with.
  /// `discarded`: a message whose work never runs.
  EpochMonitor(EpochConfig config, std::function<void(StampNs)> started_anew,
               std::function<void(const DiscardedMessage&)> discarded);

  /// A message of `source` (a name for messages that come in one order, e.g. the topic) with its
  /// true time. `work` uses it and does not throw: it runs now, later, or never. `tolerance_ns`:
  /// how far the true time of a message of the lead may be off `stamp`.
  void observe(const std::string& source, StampNs stamp, Work work, StampNs tolerance_ns = 0);

  std::size_t held() const { return held_.size(); }

 private:
  struct Source {
    std::optional<StampNs> newest;  ///< of this epoch
    std::optional<StampNs> before;  ///< newest of the epoch before, if time went back since
  };
  enum class Doubt : std::uint8_t { kNone, kWentBack, kElsewhere };
  struct Held {
    std::string source;
    StampNs stamp = 0;
    StampNs tolerance_ns = 0;
    Doubt doubt = Doubt::kNone;
    int leads = 0;  ///< messages of the lead that went on since
    Work work;

    StampNs earliest() const { return stamp - tolerance_ns; }
  };

  void observeLead(Held message);
  Doubt doubt(const Source& source, StampNs stamp) const;
  void hold(Held message);
  void use(const Held& message);
  void useLate(const Held& message);
  void discard(const Held& message);
  /// Takes out of `held_` what `is_meant` says.
  std::vector<Held> take(const std::function<bool(const Held&)>& is_meant);
  void goOn();
  void startAnew();

  EpochConfig config_;
  std::function<void(StampNs)> started_anew_;
  std::function<void(const DiscardedMessage&)> discarded_;
  std::map<std::string, Source> sources_;
  std::optional<StampNs> lead_newest_;
  std::deque<Held> held_;
};

}  // namespace semantic_lidar_fusion

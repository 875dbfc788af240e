// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/sync/epoch_monitor.h"

#include <algorithm>
#include <utility>

namespace semantic_lidar_fusion {

constexpr StampNs EpochMonitor::kForwardNs;
constexpr StampNs EpochMonitor::kBackwardNs;
constexpr std::size_t EpochMonitor::kMaxHeld;
constexpr int EpochMonitor::kLeadsToSettle;

EpochMonitor::EpochMonitor(EpochConfig config, std::function<void(StampNs)> started_anew,
                           std::function<void(const DiscardedMessage&)> discarded)
    : config_(std::move(config)),
      started_anew_(std::move(started_anew)),
      discarded_(std::move(discarded)) {}

void EpochMonitor::observe(const std::string& source, StampNs stamp, Work work,
                           StampNs tolerance_ns) {
  if (source == config_.lead) {
    observeLead({source, stamp, tolerance_ns, Doubt::kElsewhere, 0, std::move(work)});
    return;
  }
  Held message{source, stamp, 0, doubt(sources_[source], stamp), 0, std::move(work)};
  if (message.doubt == Doubt::kNone) {
    use(message);
  } else {
    hold(std::move(message));
  }
}

void EpochMonitor::observeLead(Held message) {
  const auto follows = [&](StampNs newest) {
    return message.stamp + message.tolerance_ns >= newest - config_.lead_disorder_ns &&
           message.earliest() <= newest + kForwardNs;
  };
  const auto is_lead = [&](const Held& held) { return held.source == config_.lead; };
  if (!lead_newest_ || follows(*lead_newest_)) {
    for (const Held& wrong : take(is_lead)) discard(wrong);
    use(message);
    goOn();
    return;
  }
  std::optional<StampNs> newest_held;
  for (const Held& held : held_) {
    if (!is_lead(held)) continue;
    newest_held = std::max(newest_held.value_or(held.earliest()), held.earliest());
  }
  if (newest_held && !follows(*newest_held)) {
    for (const Held& wrong : take(is_lead)) discard(wrong);
  }
  hold(std::move(message));
  if (std::count_if(held_.begin(), held_.end(), is_lead) >= config_.confirmations) startAnew();
}

EpochMonitor::Doubt EpochMonitor::doubt(const Source& source, StampNs stamp) const {
  if (!lead_newest_) return Doubt::kNone;
  if (stamp > *lead_newest_ + kForwardNs || stamp < *lead_newest_ - kForwardNs) {
    return Doubt::kElsewhere;
  }
  if (source.newest) {
    return stamp < *source.newest - kBackwardNs ? Doubt::kWentBack : Doubt::kNone;
  }
  const bool goes_on = source.before && stamp > *source.before;
  return goes_on && stamp > *lead_newest_ + kBackwardNs ? Doubt::kElsewhere : Doubt::kNone;
}

void EpochMonitor::hold(Held message) {
  const std::string source = message.source;
  const auto is_same = [&](const Held& held) { return held.source == source; };
  held_.push_back(std::move(message));
  if (static_cast<std::size_t>(std::count_if(held_.begin(), held_.end(), is_same)) <= kMaxHeld) {
    return;
  }
  const auto oldest = std::find_if(held_.begin(), held_.end(), is_same);
  const Held wrong = std::move(*oldest);
  held_.erase(oldest);
  discard(wrong);
}

void EpochMonitor::use(const Held& message) {
  std::optional<StampNs>& newest = sources_[message.source].newest;
  newest = std::max(newest.value_or(message.earliest()), message.earliest());
  if (message.source == config_.lead) lead_newest_ = newest;
  message.work();
}

/// The source goes on from here: its clock may have been set back for good.
void EpochMonitor::useLate(const Held& message) {
  sources_[message.source].newest = message.stamp;
  message.work();
}

void EpochMonitor::discard(const Held& message) {
  const StampNs lead = lead_newest_.value_or(message.stamp);
  discarded_({message.source, message.stamp, message.stamp - lead});
}

std::vector<EpochMonitor::Held> EpochMonitor::take(
    const std::function<bool(const Held&)>& is_meant) {
  std::vector<Held> taken;
  std::deque<Held> kept;
  for (Held& held : held_) {
    if (is_meant(held)) {
      taken.push_back(std::move(held));
    } else {
      kept.push_back(std::move(held));
    }
  }
  held_ = std::move(kept);
  return taken;
}

void EpochMonitor::goOn() {
  for (Held& held : held_) ++held.leads;
  for (const Held& held : take([](const Held& h) { return h.leads >= kLeadsToSettle; })) {
    if (held.doubt == Doubt::kWentBack) {
      useLate(held);
    } else {
      discard(held);
    }
  }
}

void EpochMonitor::startAnew() {
  const std::vector<Held> messages = take([](const Held&) { return true; });
  const auto first = std::find_if(messages.begin(), messages.end(),
                                  [&](const Held& held) { return held.source == config_.lead; });
  const bool went_back = lead_newest_ && first->stamp < *lead_newest_;
  for (auto& [name, source] : sources_) {
    source.before = went_back ? source.newest : std::nullopt;
    source.newest.reset();
  }
  started_anew_(first->stamp);
  lead_newest_ = first->earliest();
  for (const Held& held : messages) {
    if (held.source != config_.lead && doubt(sources_[held.source], held.stamp) != Doubt::kNone) {
      discard(held);
    } else {
      use(held);
    }
  }
}

}  // namespace semantic_lidar_fusion

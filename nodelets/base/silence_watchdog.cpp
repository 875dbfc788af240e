// SPDX-License-Identifier: MIT
#include "base/silence_watchdog.h"

#include <algorithm>

#include "semantic_lidar_fusion/common/edit_distance.h"

namespace semantic_lidar_fusion {

constexpr std::chrono::seconds SilenceWatchdog::kSilence;
const char* const kSilentClock = "use_sim_time is true but /clock is silent; play with --clock";

namespace {

constexpr auto kEver = std::chrono::duration<double>::max();

std::string lastName(const std::string& topic) { return topic.substr(topic.rfind('/') + 1); }

bool contains(const std::vector<std::string>& names, const std::string& name) {
  return std::find(names.begin(), names.end(), name) != names.end();
}

}  // namespace

std::string describeSilentTopic(const std::string& topic,
                                const std::vector<std::string>& advertised) {
  if (contains(advertised, topic)) return "no message on " + topic + ", which is advertised";
  std::string similar;
  for (const std::string& name : advertised) {
    if (lastName(name) == lastName(topic) ||
        editDistance(name, topic) <= std::max<std::size_t>(2, topic.size() / 5)) {
      similar += (similar.empty() ? "" : ", ") + name;
    }
  }
  return "no message on " + topic + ", which nobody advertises" +
         (similar.empty() ? "" : "; advertised similar: " + similar);
}

std::optional<SilenceWatchdog::Report> SilenceWatchdog::look(const Health& health,
                                                             const Surroundings& surroundings,
                                                             Health::Clock::time_point now) {
  if (now - looked_ < kSilence) return std::nullopt;
  looked_ = now;
  const bool is_silent = !health.publishedWithin(kSilence);
  const bool is_halted = surroundings.clock_is_stalled;
  if (is_silent && surroundings.clock_is_silent) return Report{"clock", kSilentClock};
  const std::string idle = surroundings.explain_silence();
  if (is_silent && !is_halted && !idle.empty()) {
    return Report{"idle", "nothing published for 5 s: " + idle};
  }
  // A bag that is paused or has ended is no news; what it never held is.
  const std::vector<std::string> silent =
      health.silentInputs(is_halted ? kEver : std::chrono::duration<double>(kSilence));
  if (silent.empty()) return std::nullopt;
  const std::vector<std::string> advertised = surroundings.advertised();
  std::string reasons;
  for (const std::string& topic : silent) {
    // While something is published, only what nobody advertises is worth a line: a camera that is
    // merely late is counted where it is missed.
    if ((!is_silent || is_halted) && contains(advertised, topic)) continue;
    reasons += (reasons.empty() ? "" : "; ") + describeSilentTopic(topic, advertised);
  }
  if (reasons.empty()) return std::nullopt;
  return Report{"silence " + reasons,
                std::string(is_silent ? "nothing published for 5 s: " : "") + reasons};
}

}  // namespace semantic_lidar_fusion

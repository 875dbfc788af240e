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

SilenceWatchdog::Look SilenceWatchdog::look(const Health& health, const Surroundings& surroundings,
                                            Health::Clock::time_point now) {
  if (now - looked_ < kSilence) return {};
  looked_ = now;
  Question question;
  question.nothing_is_published = !health.publishedWithin(kSilence);
  question.clock_is_stalled = surroundings.clock_is_stalled;
  if (question.nothing_is_published && surroundings.clock_is_silent) {
    return {Report{"clock", kSilentClock}, std::nullopt};
  }
  const std::string idle = surroundings.explain_silence();
  if (question.nothing_is_published && !question.clock_is_stalled && !idle.empty()) {
    return {Report{"idle", "nothing published for 5 s: " + idle}, std::nullopt};
  }
  // A bag that is paused or has ended is no news; what it never held is.
  question.silent = health.silentInputs(
      question.clock_is_stalled ? kEver : std::chrono::duration<double>(kSilence));
  if (question.silent.empty()) return {};
  return {std::nullopt, question};
}

std::optional<SilenceWatchdog::Report> SilenceWatchdog::answer(
    const Question& question, const std::vector<std::string>& advertised) {
  std::string reasons;
  for (const std::string& topic : question.silent) {
    // While something is published, only what nobody advertises is worth a line: a camera that is
    // merely late is counted where it is missed.
    if ((!question.nothing_is_published || question.clock_is_stalled) &&
        contains(advertised, topic)) {
      continue;
    }
    reasons += (reasons.empty() ? "" : "; ") + describeSilentTopic(topic, advertised);
  }
  if (reasons.empty()) return std::nullopt;
  return Report{
      "silence " + reasons,
      std::string(question.nothing_is_published ? "nothing published for 5 s: " : "") + reasons};
}

}  // namespace semantic_lidar_fusion

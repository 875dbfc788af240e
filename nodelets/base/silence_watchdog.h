// SPDX-License-Identifier: MIT
/// Says why nothing is published: nobody listens, simulated time does not run, or an input is
/// silent, with the names of topics that may be meant.
#pragma once

#include <chrono>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "base/health.h"

namespace semantic_lidar_fusion {

/// "no message on /a/b, which is advertised", or with the advertised topics that look like it:
/// those of the same last name, and those that few letters away.
std::string describeSilentTopic(const std::string& topic,
                                const std::vector<std::string>& advertised);

class SilenceWatchdog {
 public:
  /// Silence after which the watchdog speaks.
  static constexpr std::chrono::seconds kSilence{5};

  /// What the watchdog looks at; the function is asked only where its answer counts.
  struct Surroundings {
    bool clock_is_silent = false;   ///< simulated time has never run
    bool clock_is_stalled = false;  ///< simulated time has ended, or is paused
    std::function<std::string()>
        explain_silence;  ///< why nothing has to be published; mostly empty
  };
  struct Report {
    std::string key;  ///< the same for the same trouble
    std::string text;
  };
  /// Inputs that are silent: what is said of them depends on who advertises them.
  struct Question {
    std::vector<std::string> silent;
    bool nothing_is_published = false;
    bool clock_is_stalled = false;
  };
  /// At most one of the two.
  struct Look {
    std::optional<Report> report;
    std::optional<Question> question;
  };

  explicit SilenceWatchdog(Health::Clock::time_point started = Health::Clock::now())
      : looked_(started) {}

  /// What is to be said or asked at `now`, at most once in kSilence.
  Look look(const Health& health, const Surroundings& surroundings,
            Health::Clock::time_point now = Health::Clock::now());
  /// What is to be said once it is known which topics are advertised.
  static std::optional<Report> answer(const Question& question,
                                      const std::vector<std::string>& advertised);

 private:
  Health::Clock::time_point looked_;
};

/// What the watchdog says of a clock that has never run.
extern const char* const kSilentClock;

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// What a nodelet tells about itself: counts, rates, stage times, the last error. Thread-safe.
#pragma once

#include <diagnostic_updater/DiagnosticStatusWrapper.h>

#include <chrono>
#include <cstdint>
#include <map>
#include <mutex>
#include <string>
#include <utility>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"

namespace semantic_lidar_fusion {

class Health {
 public:
  using Clock = std::chrono::steady_clock;

  enum class Expect : std::uint8_t {
    kStream,  ///< missed when it falls silent
    kOnce,    ///< missed only until its first message, e.g. a latched camera_info
  };
  /// Declares an input so that it is shown, and missed, before its first message.
  void expectInput(const std::string& topic, Expect expect = Expect::kStream);
  /// An input that is no longer subscribed: not missed; its count stays.
  void retireInput(const std::string& topic);
  void received(const std::string& topic);
  void published(const std::string& topic);
  /// Counts an event under `reason`, e.g. "dropped: queue full". Reasons that start with "dropped"
  /// raise the level to WARN while they grow.
  void count(const std::string& reason, std::uint64_t events = 1);
  /// Counts an event that raises the level to WARN while it grows, whatever its name.
  void problem(const std::string& reason, std::uint64_t events = 1);
  /// Wall time of one step of the work.
  void stage(const std::string& name, double milliseconds);
  /// A value to show as it is (queue length, age, image size).
  void set(const std::string& key, const std::string& value);
  /// Something that looks wrong until somebody mends it: shown, and the level is WARN for good.
  void doubt(const std::string& subject, const std::string& text);
  /// The last error; the level is ERROR for `kErrorHold` after it.
  void error(const std::string& text);

  std::uint64_t counted(const std::string& reason) const;
  /// Expected inputs that have had no message for `age`, or never; with the longest age only these.
  std::vector<std::string> silentInputs(std::chrono::duration<double> age) const;
  bool publishedWithin(std::chrono::duration<double> age) const;

  /// Writes all of it, rates over the time since the last call.
  void fill(diagnostic_updater::DiagnosticStatusWrapper& status);

 private:
  static constexpr std::chrono::seconds kErrorHold{10};

  struct Flow {
    Expect expect = Expect::kStream;
    bool is_subscribed = true;
    std::uint64_t messages = 0;
    std::uint64_t at_last_fill = 0;
    Clock::time_point last{};
  };
  struct Stage {
    std::uint64_t runs = 0;  ///< since the last fill
    double sum_ms = 0;
    double max_ms = 0;
  };
  struct Event {
    bool is_problem = false;
    std::uint64_t total = 0;
    std::uint64_t at_last_fill = 0;
  };

  mutable std::mutex mutex_;
  std::map<std::string, Flow> inputs_, outputs_;
  std::map<std::string, Event> events_;
  std::map<std::string, Stage> stages_;
  std::map<std::string, std::string> values_;
  std::vector<std::pair<std::string, std::string>> doubts_;
  std::string last_error_;
  Clock::time_point last_error_time_{};
  Clock::time_point last_fill_ = Clock::now();
};

/// Adds the wall time of its life to a stage.
class StageTimer {
 public:
  StageTimer(Health& health, std::string name)
      : health_(health), name_(std::move(name)), start_(Health::Clock::now()) {}
  ~StageTimer() {
    health_.stage(name_,
                  std::chrono::duration<double, std::milli>(Health::Clock::now() - start_).count());
  }
  StageTimer(const StageTimer&) = delete;
  StageTimer& operator=(const StageTimer&) = delete;

 private:
  Health& health_;
  std::string name_;
  Health::Clock::time_point start_;
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "base/health.h"

#include <algorithm>

#include "semantic_lidar_fusion/common/plain_text.h"

namespace semantic_lidar_fusion {

constexpr std::chrono::seconds Health::kErrorHold;

namespace {

/// Texts of messages may hold anything.
constexpr std::size_t kLongestText = 2000;

}  // namespace

void Health::expectInput(const std::string& topic, Expect expect) {
  std::lock_guard<std::mutex> lock(mutex_);
  Flow& flow = inputs_[topic];
  flow.expect = expect;
  if (!flow.is_subscribed) flow.last = Clock::now();  // not missed at once
  flow.is_subscribed = true;
}

void Health::retireInput(const std::string& topic) {
  std::lock_guard<std::mutex> lock(mutex_);
  const auto found = inputs_.find(topic);
  if (found != inputs_.end()) found->second.is_subscribed = false;
}

void Health::received(const std::string& topic) {
  std::lock_guard<std::mutex> lock(mutex_);
  Flow& flow = inputs_[topic];
  ++flow.messages;
  flow.last = Clock::now();
}

void Health::published(const std::string& topic) {
  std::lock_guard<std::mutex> lock(mutex_);
  Flow& flow = outputs_[topic];
  ++flow.messages;
  flow.last = Clock::now();
}

void Health::count(const std::string& reason, std::uint64_t events) {
  if (events == 0) return;
  std::lock_guard<std::mutex> lock(mutex_);
  Event& event = events_[reason];
  event.total += events;
  event.is_problem = event.is_problem || reason.compare(0, 7, "dropped") == 0;
}

void Health::problem(const std::string& reason, std::uint64_t events) {
  if (events == 0) return;
  std::lock_guard<std::mutex> lock(mutex_);
  Event& event = events_[reason];
  event.total += events;
  event.is_problem = true;
}

void Health::stage(const std::string& name, double milliseconds) {
  std::lock_guard<std::mutex> lock(mutex_);
  Stage& stage = stages_[name];
  ++stage.runs;
  stage.sum_ms += milliseconds;
  stage.max_ms = std::max(stage.max_ms, milliseconds);
}

void Health::set(const std::string& key, const std::string& value) {
  std::lock_guard<std::mutex> lock(mutex_);
  values_[key] = plainText(value, kLongestText);
}

void Health::doubt(const std::string& subject, const std::string& text) {
  std::lock_guard<std::mutex> lock(mutex_);
  doubts_.emplace_back(plainText(subject, kLongestText), plainText(text, kLongestText));
}

void Health::error(const std::string& text) {
  std::lock_guard<std::mutex> lock(mutex_);
  last_error_ = plainText(text, kLongestText);
  last_error_time_ = Clock::now();
}

std::uint64_t Health::counted(const std::string& reason) const {
  std::lock_guard<std::mutex> lock(mutex_);
  const auto found = events_.find(reason);
  return found == events_.end() ? 0 : found->second.total;
}

std::vector<std::string> Health::silentInputs(std::chrono::duration<double> age) const {
  std::lock_guard<std::mutex> lock(mutex_);
  std::vector<std::string> silent;
  for (const auto& [topic, flow] : inputs_) {
    const bool is_stale = flow.expect == Expect::kStream && Clock::now() - flow.last > age;
    if (flow.is_subscribed && (flow.messages == 0 || is_stale)) silent.push_back(topic);
  }
  return silent;
}

bool Health::publishedWithin(std::chrono::duration<double> age) const {
  std::lock_guard<std::mutex> lock(mutex_);
  return std::any_of(outputs_.begin(), outputs_.end(), [&](const auto& output) {
    return output.second.messages > 0 && Clock::now() - output.second.last <= age;
  });
}

void Health::fill(diagnostic_updater::DiagnosticStatusWrapper& status) {
  using diagnostic_msgs::DiagnosticStatus;
  std::lock_guard<std::mutex> lock(mutex_);
  const Clock::time_point now = Clock::now();
  const double elapsed_s = std::max(1e-3, std::chrono::duration<double>(now - last_fill_).count());
  last_fill_ = now;

  status.summary(DiagnosticStatus::OK, "running");
  const auto flows = [&](const std::string& kind, std::map<std::string, Flow>& all) {
    for (auto& [topic, flow] : all) {
      status.addf(kind + " " + topic + " rate (Hz)", "%.2f",
                  static_cast<double>(flow.messages - flow.at_last_fill) / elapsed_s);
      status.add(kind + " " + topic + " messages", flow.messages);
      if (flow.messages > 0) {
        status.addf(kind + " " + topic + " age (s)", "%.2f",
                    std::chrono::duration<double>(now - flow.last).count());
      }
      flow.at_last_fill = flow.messages;
    }
  };
  flows("input", inputs_);
  flows("output", outputs_);
  for (auto& [name, stage] : stages_) {
    if (stage.runs > 0) {
      status.addf(name + " mean (ms)", "%.3f", stage.sum_ms / static_cast<double>(stage.runs));
      status.addf(name + " max (ms)", "%.3f", stage.max_ms);
    }
    stage = Stage();
  }
  for (auto& [reason, event] : events_) {
    status.add(reason, event.total);
    if (event.total > event.at_last_fill && event.is_problem) {
      status.mergeSummary(DiagnosticStatus::WARN, reason);
    }
    event.at_last_fill = event.total;
  }
  for (const auto& [key, value] : values_) status.add(key, value);
  for (const auto& [subject, text] : doubts_) {
    status.add("check " + subject, text);
    status.mergeSummary(DiagnosticStatus::WARN, "check " + subject);
  }
  if (!last_error_.empty()) {
    status.add("last error", last_error_);
    if (now - last_error_time_ < kErrorHold) {
      status.mergeSummary(DiagnosticStatus::ERROR, last_error_);
    }
  }
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "base/fusion_nodelet.h"

#include <nodelet/detail/callback_queue.h>
#include <std_msgs/String.h>

#include <algorithm>
#include <string>
#include <vector>

#include "base/parameters.h"
#include "edge/version.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/plain_text.h"

namespace semantic_lidar_fusion {
namespace {

const ros::WallDuration kTickPeriod(0.005);
const ros::WallDuration kDiagnosticsPeriod(1.0);
constexpr std::chrono::seconds kReportPeriod{30};
constexpr std::chrono::seconds kJumpReportPeriod{1};
/// Silence after which the watchdog speaks.
constexpr std::chrono::seconds kSilence{5};
/// How long a nodelet works on after its last listener has left.
constexpr std::chrono::milliseconds kLinger{2000};
/// How long an answer of the master is waited for.
constexpr std::chrono::milliseconds kMasterPatience{1000};
constexpr auto kEver = std::chrono::duration<double>::max();
/// A clock that stands still for longer is taken for the end of a bag.
constexpr StampNs kClockStall = 3 * kNsPerSecond;

/// Lines hold texts of messages, which may hold anything.
constexpr std::size_t kLongestLine = 2000;

constexpr std::size_t kMaxReports = 1000;

const char* const kSilentClock = "use_sim_time is true but /clock is silent; play with --clock";

bool clockIsSilent() { return ros::Time::isSimTime() && ros::Time::now().isZero(); }

/// Number of single-letter edits that make b of a (Levenshtein).
std::size_t editDistance(const std::string& a, const std::string& b) {
  std::vector<std::size_t> row(b.size() + 1);
  for (std::size_t j = 0; j <= b.size(); ++j) row[j] = j;
  for (std::size_t i = 1; i <= a.size(); ++i) {
    std::size_t diagonal = row[0];
    row[0] = i;
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t above = row[j];
      row[j] = std::min({row[j] + 1, row[j - 1] + 1, diagonal + (a[i - 1] == b[j - 1] ? 0 : 1)});
      diagonal = above;
    }
  }
  return row.back();
}

std::string lastName(const std::string& topic) { return topic.substr(topic.rfind('/') + 1); }

bool isAdvertised(const std::string& topic, const ros::master::V_TopicInfo& topics) {
  return std::any_of(topics.begin(), topics.end(),
                     [&](const auto& info) { return info.name == topic; });
}

/// "no message on /a/b, which is advertised", or with the advertised topics that look like it.
std::string describeSilentTopic(const std::string& topic, const ros::master::V_TopicInfo& topics) {
  if (isAdvertised(topic, topics)) return "no message on " + topic + ", which is advertised";
  std::string similar;
  for (const auto& info : topics) {
    if (lastName(info.name) == lastName(topic) ||
        editDistance(info.name, topic) <= std::max<std::size_t>(2, topic.size() / 5)) {
      similar += (similar.empty() ? "" : ", ") + info.name;
    }
  }
  return "no message on " + topic + ", which nobody advertises" +
         (similar.empty() ? "" : "; advertised similar: " + similar);
}

}  // namespace

FusionNodelet::~FusionNodelet() { stop(); }

void FusionNodelet::stop() {
  diagnostics_timer_.stop();
  tick_timer_.stop();
  gate_->close();
}

void FusionNodelet::takeQueues() {
  ros::CallbackQueueInterface* const queues[] = {getNodeHandle().getCallbackQueue(),
                                                 getMTNodeHandle().getCallbackQueue()};
  for (int i = 0; i < 2; ++i) {
    if (auto* queue = dynamic_cast<nodelet::detail::CallbackQueue*>(queues[i])) {
      kept_queues_[i] = std::shared_ptr<void>(nullptr, [q = queue->shared_from_this()](void*) {});
      // nodelet 1.10.0 has them disabled until onInit ends, and forgets callbacks of that time: a
      // latched message never arrives then, and a timer that was due is dead for good.
      queue->enable();
    }
  }
}

void FusionNodelet::onInit() {
  takeQueues();
  try {
    for (const std::string& problem : unknownParameters(getPrivateNodeHandle())) {
      NODELET_WARN_STREAM(problem);
    }
    rig_ = loadRigFromParameters(getPrivateNodeHandle());
    publishConfiguration();
    diagnostics_ = std::make_unique<diagnostic_updater::Updater>(getNodeHandle(),
                                                                 getPrivateNodeHandle(), getName());
    diagnostics_->setHardwareID(rig_.name.empty() ? "none" : rig_.name);
    diagnostics_->add("fusion", [this](diagnostic_updater::DiagnosticStatusWrapper& status) {
      fillDiagnostics(status);
    });
    {
      // Listeners may connect while publishers are still being set up.
      std::lock_guard<std::mutex> lock(connect_mutex_);
      initialize();
      initialized_ = true;
      updateSubscriptions();
    }
    // Wall time: ROS timers stand still while /clock is silent, which is one thing to report.
    diagnostics_timer_ = getMTNodeHandle().createWallTimer(
        kDiagnosticsPeriod, [this, gate = gate_](const ros::WallTimerEvent&) {
          gate->pass([this] { guard("watchdog", [this] { watch(); }); });
        });
  } catch (const ConfigError& problem) {
    NODELET_FATAL_STREAM(problem.what());
  } catch (const std::exception& problem) {
    NODELET_FATAL_STREAM("cannot start: " << problem.what());
  }
}

void FusionNodelet::publishConfiguration() {
  configuration_ = getPrivateNodeHandle().advertise<std_msgs::String>("configuration", 1, true);
  configuration_.publish(configurationMessage(rig_));
  health_.set("version", kVersion);
}

void FusionNodelet::startTicking() {
  tick_timer_ = getNodeHandle().createWallTimer(
      kTickPeriod, [this, gate = gate_](const ros::WallTimerEvent&) {
        gate->pass([this] { guard("tick", [this] { tick(now()); }); });
      });
}

StampNs FusionNodelet::now() const {
  if (!ros::Time::isSimTime()) return static_cast<StampNs>(ros::SteadyTime::now().toNSec());
  const auto [elapsed_ns, stood_still_ns] = simulatedClock();
  return elapsed_ns + std::max<StampNs>(0, stood_still_ns - kClockStall);
}

std::pair<StampNs, StampNs> FusionNodelet::simulatedClock() const {
  const auto steady_ns = static_cast<StampNs>(ros::SteadyTime::now().toNSec());
  const auto clock_ns = static_cast<StampNs>(ros::Time::now().toNSec());
  std::lock_guard<std::mutex> lock(clock_mutex_);
  if (clock_ns != clock_ns_) {
    // A jump is no time that passes: no deadline is due because of it.
    const StampNs step_ns = clock_ns - clock_ns_;
    if (step_ns > 0 && step_ns < EpochMonitor::kForwardNs) elapsed_ns_ += step_ns;
    clock_ns_ = clock_ns;
    clock_changed_ns_ = steady_ns;
  }
  return {elapsed_ns_, steady_ns - clock_changed_ns_};
}

void FusionNodelet::guard(const std::string& where, const std::function<void()>& work) {
  try {
    work();
  } catch (const std::exception& problem) {
    health_.count("dropped: error in " + where);
    error(where, where + ": " + problem.what());
  } catch (...) {
    health_.count("dropped: error in " + where);
    error(where, where + ": unknown exception");
  }
}

bool FusionNodelet::isWanted(const ros::Publisher& publisher) const {
  if (!publisher) return false;
  if (publisher.getNumSubscribers() > 0) return true;
  std::lock_guard<std::mutex> lock(demand_mutex_);
  const auto left = farewell_.find(publisher.getTopic());
  return left != farewell_.end() && Health::Clock::now() - left->second < kLinger;
}

void FusionNodelet::demandChanged(const std::string& topic, bool has_left) {
  if (has_left) {
    std::lock_guard<std::mutex> lock(demand_mutex_);
    farewell_[topic] = Health::Clock::now();
  }
  const auto update = [this, gate = gate_] {
    gate->pass([this] {
      guard("connection", [this] {
        std::lock_guard<std::mutex> lock(connect_mutex_);
        if (initialized_) updateSubscriptions();
      });
    });
  };
  master_->run(update, has_left ? kLinger : std::chrono::milliseconds::zero());
}

std::string FusionNodelet::idleReason() const {
  std::vector<ros::Publisher> advertised;
  {
    std::lock_guard<std::mutex> lock(demand_mutex_);
    advertised = advertised_;
  }
  for (const ros::Publisher& publisher : advertised) {
    if (isWanted(publisher)) return {};
  }
  return advertised.empty() ? "" : "nobody listens to " + advertised.front().getTopic();
}

void FusionNodelet::fillDiagnostics(diagnostic_updater::DiagnosticStatusWrapper& status) {
  health_.fill(status);
  const std::string idle = idleReason();
  if (status.level == diagnostic_msgs::DiagnosticStatus::OK && !idle.empty()) {
    status.summary(diagnostic_msgs::DiagnosticStatus::OK, "idle: " + idle);
  }
  if (clockIsSilent()) {
    status.mergeSummary(diagnostic_msgs::DiagnosticStatus::STALE, kSilentClock);
  }
}

std::unique_ptr<EpochMonitor> FusionNodelet::watchedEpochs(const EpochConfig& config,
                                                           const std::function<void()>& forget) {
  const auto started_anew = [this, forget](StampNs stamp) {
    health_.count("clock jumps");
    if (mayReport("jump", kJumpReportPeriod)) {  // one line, not one for each camera
      NODELET_INFO_STREAM("time jumped to " << std::to_string(toSeconds(stamp))
                                            << " s: starting anew");
    }
    forget();
  };
  const auto discarded = [this, lead = config.lead](const DiscardedMessage& message) {
    health_.count("dropped: " + message.source + ", stamp disagrees with " + lead);
    const double ahead_s = toSeconds(message.ahead_ns);
    warn("stamps " + message.source,
         message.source + ": stamp " + std::to_string(toSeconds(message.stamp)) + " s is " +
             std::to_string(std::abs(ahead_s)) + " s " + (ahead_s < 0 ? "behind" : "ahead of") +
             " the newest of " + lead + "; dropped: is one of their clocks wrong, or " + lead +
             " silent?");
  };
  return std::make_unique<EpochMonitor>(config, started_anew, discarded);
}

void FusionNodelet::admit(EpochMonitor* epochs, const std::string& source, StampNs true_ns,
                          const std::function<void()>& work) {
  epochs->observe(source, true_ns, [this, source, work] { guard(source, work); });
}

void FusionNodelet::reportOverflow(const std::string& topic) {
  health_.count("dropped: queue full, " + topic);
  warn("overflow " + topic, topic +
                                ": messages come faster than they are worked off; the oldest "
                                "are dropped");
}

bool FusionNodelet::mayReport(const std::string& key, std::chrono::seconds period) {
  std::lock_guard<std::mutex> lock(report_mutex_);
  const auto now = Health::Clock::now();
  if (reported_.size() >= kMaxReports) reported_.clear();  // keys hold texts of messages
  const auto [entry, first] = reported_.emplace(key, now);
  if (!first && now - entry->second < period) return false;
  entry->second = now;
  return true;
}

void FusionNodelet::warn(const std::string& key, const std::string& text) {
  if (mayReport(key, kReportPeriod)) NODELET_WARN_STREAM(plainText(text, kLongestLine));
}

void FusionNodelet::error(const std::string& key, const std::string& text) {
  health_.error(text);
  if (mayReport(key, kReportPeriod)) NODELET_ERROR_STREAM(plainText(text, kLongestLine));
}

void FusionNodelet::watch() {
  diagnostics_->force_update();
  const bool is_halted = ros::Time::isSimTime() && simulatedClock().second > kClockStall;
  const auto now = Health::Clock::now();
  if (now - started_ < kSilence || now - watched_ < kSilence) return;
  watched_ = now;
  const bool is_silent = !health_.publishedWithin(kSilence);
  if (is_silent && clockIsSilent()) {
    warn("clock", kSilentClock);
    return;
  }
  const std::string idle = idleReason();
  if (is_silent && !is_halted && !idle.empty()) {
    warn("idle", "nothing published for 5 s: " + idle);
    return;
  }
  // A bag that is paused or has ended is no news; what it never held is.
  const std::vector<std::string> silent =
      health_.silentInputs(is_halted ? kEver : std::chrono::duration<double>(kSilence));
  if (silent.empty() || is_asking_.exchange(true)) return;
  master_->run([this, gate = gate_, silent, is_silent, is_halted] {
    gate->pass([&] {
      guard("watchdog", [&] { tellSilence(silent, is_silent, is_halted); });
      is_asking_ = false;
    });
  });
}

void FusionNodelet::tellSilence(const std::vector<std::string>& silent, bool is_silent,
                                bool is_halted) {
  const std::optional<ros::master::V_TopicInfo> topics = advertisedTopics(kMasterPatience);
  if (!topics) {
    health_.problem("the ROS master does not answer");
    warn("master", "the ROS master at " + ros::master::getURI() +
                       " does not answer: connections that exist go on, new ones cannot be made; "
                       "start it and this node again");
    return;
  }
  std::string reasons;
  for (const auto& topic : silent) {
    // While something is published, only what nobody advertises is worth a line: a camera that is
    // merely late is counted where it is missed.
    if ((!is_silent || is_halted) && isAdvertised(topic, *topics)) continue;
    reasons += (reasons.empty() ? "" : "; ") + describeSilentTopic(topic, *topics);
  }
  if (reasons.empty()) return;
  warn("silence " + reasons, std::string(is_silent ? "nothing published for 5 s: " : "") + reasons);
}

}  // namespace semantic_lidar_fusion

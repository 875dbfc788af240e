// SPDX-License-Identifier: MIT
#include "base/fusion_nodelet.h"

#include <nodelet/detail/callback_queue.h>
#include <yaml-cpp/yaml.h>

#include <exception>
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
constexpr std::chrono::seconds kJumpReportPeriod{1};
/// How long an answer of the master is waited for.
constexpr std::chrono::milliseconds kMasterPatience{1000};
/// The rig as it was changed while it runs, from the nodelet that takes the changes.
constexpr char kTunedRig[] = "tuned_rig";
/// Lines hold texts of messages, which may hold anything.
constexpr std::size_t kLongestLine = 2000;

/// Simulated time that has never run.
bool clockIsSilent() { return ros::Time::isSimTime() && ros::Time::now().isZero(); }

}  // namespace

FusionNodelet::FusionNodelet()
    : connections_(
          health_,
          [this](const std::string& where, const std::function<void()>& work) {
            guard(where, work);
          },
          [this](const std::string& topic) { reportOverflow(topic); }) {}

FusionNodelet::~FusionNodelet() { stop(); }

void FusionNodelet::stop() {
  diagnostics_timer_.stop();
  tick_timer_.stop();
  connections_.close();
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
    rig_watch_ = std::make_unique<RigWatch>(rig_);
    publishConfiguration();
    {
      // Listeners may connect while publishers are still being set up.
      std::lock_guard<std::mutex> lock(connect_mutex_);
      initialize();
      initialized_ = true;
      updateSubscriptions();
    }
    startDiagnostics();
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

void FusionNodelet::tune(const Rig& tuned) {
  rig_.retune(tuned);
  rigChanged();
  const std_msgs::String message = configurationMessage(rig_);
  configuration_.publish(message);
  if (!tuned_) tuned_ = getNodeHandle().advertise<std_msgs::String>(kTunedRig, 1, true);
  tuned_.publish(message);
}

void FusionNodelet::followTuning() {
  tuned_subscriber_ = subscribe<std_msgs::String>(
      getNodeHandle(), kTunedRig, 4,
      [this](const std_msgs::StringConstPtr& message) { onTuned(message); }, Health::Expect::kOnce);
  // Mostly nobody tunes.
  health_.retireInput(tuned_subscriber_.getTopic());
}

void FusionNodelet::onTuned(const std_msgs::StringConstPtr& message) {
  const Rig tuned = rigFromYaml(YAML::Load(message->data), ".", kTunedRig);
  const auto names = [](const Rig& rig) {
    std::vector<std::string> result;
    for (const CameraConfig& camera : rig.cameras) result.push_back(camera.name);
    return result;
  };
  if (names(tuned) != names(rig_)) {
    throw DataError(std::string(kTunedRig) + ": has other cameras than this nodelet's rig");
  }
  rig_.retune(tuned);
  rigChanged();
  configuration_.publish(configurationMessage(rig_));
}

void FusionNodelet::startTicking() {
  const auto run = connections_.runner("tick", [this] { tick(now()); });
  tick_timer_ =
      getNodeHandle().createWallTimer(kTickPeriod, [run](const ros::WallTimerEvent&) { run(); });
}

void FusionNodelet::startDiagnostics() {
  diagnostics_ = std::make_unique<diagnostic_updater::Updater>(getNodeHandle(),
                                                               getPrivateNodeHandle(), getName());
  diagnostics_->setHardwareID(rig_.name.empty() ? "none" : rig_.name);
  diagnostics_->add("fusion", [this](diagnostic_updater::DiagnosticStatusWrapper& status) {
    fillDiagnostics(status);
  });
  // Wall time: ROS timers stand still while /clock is silent, which is one thing to report.
  const auto run = connections_.runner("watchdog", [this] { watch(); });
  diagnostics_timer_ = getMTNodeHandle().createWallTimer(
      kDiagnosticsPeriod, [run](const ros::WallTimerEvent&) { run(); });
}

void FusionNodelet::fillDiagnostics(diagnostic_updater::DiagnosticStatusWrapper& status) {
  health_.fill(status);
  const std::string idle = connections_.demand().idleReason();
  if (status.level == diagnostic_msgs::DiagnosticStatus::OK && !idle.empty()) {
    status.summary(diagnostic_msgs::DiagnosticStatus::OK, "idle: " + idle);
  }
  if (clockIsSilent()) {
    status.mergeSummary(diagnostic_msgs::DiagnosticStatus::STALE, kSilentClock);
  }
}

void FusionNodelet::demandChanged() {
  const auto update = connections_.runner("connection", [this] {
    std::lock_guard<std::mutex> lock(connect_mutex_);
    if (initialized_) updateSubscriptions();
  });
  // At once for one that comes, and when the one that left may be gone for good.
  master_->run(update);
  master_->run(update, Demand::kLinger);
}

void FusionNodelet::lookAtArrival(const std::string& topic, StampNs stamp) {
  if (ros::Time::isSimTime()) return;
  rig_watch_->lookAtArrival(topic, stamp, static_cast<StampNs>(ros::Time::now().toNSec()));
}

void FusionNodelet::tellDoubts() {
  for (const RigDoubt& doubt : rig_watch_->takeDoubts()) {
    health_.doubt(doubt.subject, doubt.text);
    NODELET_WARN_STREAM(plainText(
        "check: " + doubt.subject + ": " + doubt.text + "; " + kCheckCommand, kLongestLine));
  }
}

void FusionNodelet::watch() {
  tellDoubts();
  diagnostics_->force_update();
  SilenceWatchdog::Surroundings surroundings;
  surroundings.clock_is_silent = clockIsSilent();
  surroundings.clock_is_stalled = clock_.isStalled();
  surroundings.explain_silence = [this] { return connections_.demand().idleReason(); };
  const SilenceWatchdog::Look look = watchdog_.look(health_, surroundings);
  if (look.report) warn(look.report->key, look.report->text);
  if (!look.question || is_asking_.exchange(true)) return;
  master_->run(connections_.runner("watchdog", [this, question = *look.question] {
    is_asking_ = false;
    tellSilence(question);
  }));
}

void FusionNodelet::tellSilence(const SilenceWatchdog::Question& question) {
  const std::optional<ros::master::V_TopicInfo> topics = advertisedTopics(kMasterPatience);
  if (!topics) {
    health_.problem("the ROS master does not answer");
    warn("master", "the ROS master at " + ros::master::getURI() +
                       " does not answer: connections that exist go on, new ones cannot be made; "
                       "start it and this node again");
    return;
  }
  std::vector<std::string> names;
  for (const ros::master::TopicInfo& topic : *topics) names.push_back(topic.name);
  if (const auto report = SilenceWatchdog::answer(question, names)) {
    warn(report->key, report->text);
  }
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

std::unique_ptr<EpochMonitor> FusionNodelet::watchedEpochs(const EpochConfig& config,
                                                           const std::function<void()>& forget) {
  const auto started_anew = [this, forget](StampNs stamp) {
    health_.count("clock jumps");
    if (reports_.mayReport("jump", ReportThrottle::Clock::now(),
                           kJumpReportPeriod)) {  // one line, not one for each camera
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
                          const std::function<void()>& work, StampNs tolerance_ns) {
  const auto guarded = [this, source, work] { guard(source, work); };
  epochs->observe(source, true_ns, guarded, tolerance_ns);
}

StampNs FusionNodelet::timeTolerance(const TimedCloud& scan) const {
  return scan.empty() ? toNs(rig_.lidar.longest_scan_s) : 0;
}

void FusionNodelet::reportOverflow(const std::string& topic) {
  health_.count("dropped: queue full, " + topic);
  warn("overflow " + topic, topic +
                                ": messages come faster than they are worked off; the oldest "
                                "are dropped");
}

void FusionNodelet::warn(const std::string& key, const std::string& text) {
  if (reports_.mayReport(key)) NODELET_WARN_STREAM(plainText(text, kLongestLine));
}

void FusionNodelet::error(const std::string& key, const std::string& text) {
  health_.error(text);
  if (reports_.mayReport(key)) NODELET_ERROR_STREAM(plainText(text, kLongestLine));
}

}  // namespace semantic_lidar_fusion

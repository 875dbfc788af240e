// SPDX-License-Identifier: MIT
#include "base/fusion_nodelet.h"

#include <nodelet/detail/callback_queue.h>
#include <ros/master.h>
#include <std_msgs/String.h>

#include <exception>
#include <string>
#include <vector>

#include "base/parameters.h"
#include "edge/version.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

const ros::WallDuration kTickPeriod(0.005);
const ros::WallDuration kDiagnosticsPeriod(1.0);

/// Simulated time that has never run.
bool clockIsSilent() { return ros::Time::isSimTime() && ros::Time::now().isZero(); }

std::vector<std::string> advertisedTopics() {
  ros::master::V_TopicInfo topics;
  ros::master::getTopics(topics);
  std::vector<std::string> names;
  for (const ros::master::TopicInfo& topic : topics) names.push_back(topic.name);
  return names;
}

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
    health_.fill(status);
    if (clockIsSilent()) {
      status.mergeSummary(diagnostic_msgs::DiagnosticStatus::STALE, kSilentClock);
    }
  });
  // Wall time: ROS timers stand still while /clock is silent, which is one thing to report.
  const auto run = connections_.runner("watchdog", [this] { watch(); });
  diagnostics_timer_ = getMTNodeHandle().createWallTimer(
      kDiagnosticsPeriod, [run](const ros::WallTimerEvent&) { run(); });
}

void FusionNodelet::watch() {
  diagnostics_->force_update();
  SilenceWatchdog::Surroundings surroundings;
  surroundings.clock_is_silent = clockIsSilent();
  surroundings.clock_is_stalled = clock_.isStalled();
  surroundings.explain_silence = [this] { return explainSilence(); };
  surroundings.advertised = advertisedTopics;
  if (const auto report = watchdog_.look(health_, surroundings)) warn(report->key, report->text);
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

void FusionNodelet::reportOverflow(const std::string& topic) {
  health_.count("dropped: queue full, " + topic);
  warn("overflow " + topic, topic +
                                ": messages come faster than they are worked off; the oldest "
                                "are dropped");
}

void FusionNodelet::warn(const std::string& key, const std::string& text) {
  if (reports_.mayReport(key)) NODELET_WARN_STREAM(text);
}

void FusionNodelet::error(const std::string& key, const std::string& text) {
  health_.error(text);
  if (reports_.mayReport(key)) NODELET_ERROR_STREAM(text);
}

}  // namespace semantic_lidar_fusion

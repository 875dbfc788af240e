// SPDX-License-Identifier: MIT
/// What all nodelets of this package share: their life, the rig, and one catch-all boundary around
/// every callback. The parts have files of their own: connections, clock, watchdog, throttle.
///
/// Threads: callbacks given to `subscribe` with getNodeHandle() run one at a time; timers of this
/// class run on the multi-threaded queue and touch only Health, which locks for itself. Whatever
/// asks the master runs on the MasterThread.
#pragma once

#include <diagnostic_updater/diagnostic_updater.h>
#include <nodelet/nodelet.h>
#include <ros/ros.h>
#include <std_msgs/String.h>

#include <atomic>
#include <chrono>
#include <functional>
#include <memory>
#include <mutex>
#include <string>

#include "base/deadline_clock.h"
#include "base/health.h"
#include "base/master_thread.h"
#include "base/report_throttle.h"
#include "base/silence_watchdog.h"
#include "base/topic_connections.h"
#include "semantic_lidar_fusion/check/rig_watch.h"
#include "semantic_lidar_fusion/common/point_cloud.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/sync/epoch_monitor.h"

namespace semantic_lidar_fusion {

class FusionNodelet : public nodelet::Nodelet {
 public:
  FusionNodelet();
  ~FusionNodelet() override;

 protected:
  /// Sets up publishers, then subscribers; runs inside the boundary. A ConfigError ends the
  /// nodelet's life: it is reported once and nothing is subscribed.
  virtual void initialize() = 0;
  /// Demand has changed (see isWanted): subscribe on the first listener, shut down after the last.
  /// Called with `connectMutex` held, on the MasterThread once `initialize` is over.
  virtual void updateSubscriptions() {}
  /// rig() has other values of what may change while it runs (see Rig::retune); called one at a
  /// time with the callbacks of getNodeHandle().
  virtual void rigChanged() {}
  /// Called every `kTickPeriod` with now(), one at a time with the callbacks of getNodeHandle().
  virtual void tick(StampNs /*now_ns*/) {}
  /// Ends all callbacks and waits for those that run. Every destructor of a derived class calls it
  /// first: its members are gone when this class's destructor runs.
  void stop();
  /// Asks for `tick`; call in initialize.
  void startTicking();

  /// Runs with another rig from here on, and has the nodelets that follow do so.
  void tune(const Rig& tuned);
  /// Follows the nodelet of the same namespace that tunes; call in initialize.
  void followTuning();

  const Rig& rig() const { return rig_; }
  Health& health() { return health_; }
  /// Shown what passes through. What it doubts is told once in the log, and in the diagnostics from
  /// then on.
  RigWatch& rigWatch() { return *rig_watch_; }
  /// Shows the watch that a message arrives, unless time is simulated: it is no time of arrival.
  void lookAtArrival(const std::string& topic, StampNs stamp);
  std::mutex& connectMutex() { return connect_mutex_; }

  /// The clock of deadlines; see DeadlineClock.
  StampNs now() { return clock_.now(); }

  /// Runs `work`; no exception leaves. Errors are counted, reported (throttled) and shown.
  void guard(const std::string& where, const std::function<void()>& work);

  /// Subscribes a member function; see TopicConnections.
  template <class M, class T>
  ros::Subscriber subscribe(ros::NodeHandle& handle, const std::string& topic, int queue_size,
                            void (T::*callback)(const boost::shared_ptr<const M>&)) {
    T* self = static_cast<T*>(this);
    return subscribe<M>(handle, topic, queue_size,
                        [self, callback](const boost::shared_ptr<const M>& message) {
                          (self->*callback)(message);
                        });
  }
  template <class M>
  ros::Subscriber subscribe(ros::NodeHandle& handle, const std::string& topic, int queue_size,
                            const std::function<void(const boost::shared_ptr<const M>&)>& callback,
                            Health::Expect expect = Health::Expect::kStream) {
    // Taken off the network on the manager's threads, whatever this nodelet is busy with.
    return connections_.subscribe<M>(handle, getMTNodeHandle(), topic, queue_size, callback,
                                     expect);
  }
  void unsubscribe(ros::Subscriber* subscriber) { connections_.unsubscribe(subscriber); }

  /// Advertises a topic whose first listener and last farewell call updateSubscriptions (the latter
  /// after Demand::kLinger).
  template <class M>
  ros::Publisher advertise(ros::NodeHandle& handle, const std::string& topic, int queue_size) {
    return connections_.advertise<M>(handle, topic, queue_size, [this] { demandChanged(); });
  }

  /// Whether somebody listens, or did until a moment ago; see Demand.
  bool isWanted(const ros::Publisher& publisher) const {
    return connections_.demand().isWanted(publisher);
  }

  template <class M>
  void publish(const ros::Publisher& publisher, const boost::shared_ptr<M>& message) {
    connections_.publish(publisher, message);
  }

  /// A monitor that counts and reports jumps of time and what it discards. `forget` drops what is
  /// buffered.
  std::unique_ptr<EpochMonitor> watchedEpochs(const EpochConfig& config,
                                              const std::function<void()>& forget);
  /// Hands a message to the monitor; `work` runs guarded, at once or when its epoch is clear.
  void admit(EpochMonitor* epochs, const std::string& source, StampNs true_ns,
             const std::function<void()>& work, StampNs tolerance_ns = 0);
  /// How far a scan's time may be off: one without points has its header's, which drivers set to
  /// any time of the scan.
  StampNs timeTolerance(const TimedCloud& scan) const;

  /// Reports at once, then at most every 30 s for the same `key`.
  void warn(const std::string& key, const std::string& text);
  void error(const std::string& key, const std::string& text);

 private:
  void onInit() final;
  void demandChanged();
  void fillDiagnostics(diagnostic_updater::DiagnosticStatusWrapper& status);
  /// Asks the master which of the silent topics are advertised, and says what that means.
  void tellSilence(const SilenceWatchdog::Question& question);
  void takeQueues();
  void onTuned(const std_msgs::StringConstPtr& message);
  /// Tells, latched, which version runs with which rig.
  void publishConfiguration();
  void startDiagnostics();
  void watch();
  void tellDoubts();
  void reportOverflow(const std::string& topic);

  /// A callback that runs while the nodelet is unloaded holds it until it returns, and the manager
  /// has destroyed the queues by then, into which timers and publishers reach as they end.
  std::shared_ptr<void> kept_queues_[2];
  Rig rig_;
  std::unique_ptr<RigWatch> rig_watch_;
  Health health_;
  TopicConnections connections_;
  std::shared_ptr<MasterThread> master_ = MasterThread::shared();
  std::atomic<bool> is_asking_{false};  ///< a question to the master is under way
  std::mutex connect_mutex_;
  bool initialized_ = false;  ///< guarded by connect_mutex_
  DeadlineClock clock_;
  ReportThrottle reports_;
  SilenceWatchdog watchdog_;
  std::unique_ptr<diagnostic_updater::Updater> diagnostics_;
  ros::Publisher configuration_, tuned_;
  ros::Subscriber tuned_subscriber_;
  ros::WallTimer diagnostics_timer_, tick_timer_;
};

}  // namespace semantic_lidar_fusion

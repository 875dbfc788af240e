// SPDX-License-Identifier: MIT
/// What all nodelets of this package share: loading the rig, one catch-all boundary around every
/// callback, lazy subscriptions, throttled reports, diagnostics, and a watchdog that says why
/// nothing is published.
///
/// Threads: callbacks given to `subscribe` with getNodeHandle() run one at a time; timers of this
/// class run on the multi-threaded queue and touch only Health, which locks for itself. Whatever
/// asks the master runs on the MasterThread.
#pragma once

#include <diagnostic_updater/diagnostic_updater.h>
#include <nodelet/nodelet.h>
#include <ros/ros.h>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <exception>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <utility>
#include <vector>

#include "base/health.h"
#include "base/inbox.h"
#include "base/master_thread.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/sync/epoch_monitor.h"

namespace semantic_lidar_fusion {

/// Lets callbacks in until it is closed. Unloading disables a nodelet's queues, but does not wait
/// for a callback that runs on another thread.
class CallbackGate {
 public:
  /// Runs `work`, unless the gate is closed.
  template <class Work>
  void pass(const Work& work) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      if (closed_) return;
      ++inside_;
    }
    work();  // does not throw: guarded
    std::lock_guard<std::mutex> lock(mutex_);
    if (--inside_ == 0) empty_.notify_all();
  }
  /// Returns when nothing is inside any more.
  void close() {
    std::unique_lock<std::mutex> lock(mutex_);
    closed_ = true;
    empty_.wait(lock, [this] { return inside_ == 0; });
  }

 private:
  std::mutex mutex_;
  std::condition_variable empty_;
  int inside_ = 0;
  bool closed_ = false;
};

class FusionNodelet : public nodelet::Nodelet {
 public:
  ~FusionNodelet() override;

 protected:
  /// Sets up publishers, then subscribers; runs inside the boundary. A ConfigError ends the
  /// nodelet's life: it is reported once and nothing is subscribed.
  virtual void initialize() = 0;
  /// Demand has changed (see isWanted): subscribe on the first listener, shut down after the last.
  /// Called with `connectMutex` held, on the MasterThread once `initialize` is over.
  virtual void updateSubscriptions() {}
  /// Called every `kTickPeriod` with now(), one at a time with the callbacks of getNodeHandle().
  virtual void tick(StampNs /*now_ns*/) {}
  /// Ends all callbacks and waits for those that run. Every destructor of a derived class calls it
  /// first: its members are gone when this class's destructor runs.
  void stop();
  /// Asks for `tick`; call in initialize.
  void startTicking();

  const Rig& rig() const { return rig_; }
  Health& health() { return health_; }
  std::mutex& connectMutex() { return connect_mutex_; }

  /// The clock of deadlines, from an origin of its own: ROS time in simulation, else steady time.
  /// Jumps of a simulated clock do not count. One that stands still goes on with wall time after
  /// 3 s, so that the last scans of a bag, which wait for what it does not hold, come out.
  StampNs now() const;

  /// Runs `work`; no exception leaves. Errors are counted, reported (throttled) and shown.
  void guard(const std::string& where, const std::function<void()>& work);

  /// Subscribes a member function: counted, guarded, without Nagle's delay. `queue_size` > 0
  /// messages wait for their turn on the handle's queue; see Inbox.
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
    using Pointer = boost::shared_ptr<const M>;
    const std::string resolved = handle.resolveName(topic);
    health_.expectInput(resolved, expect);
    const auto inbox = boost::make_shared<Inbox<Pointer>>(
        handle.getCallbackQueue(), static_cast<std::size_t>(queue_size),
        [this, gate = gate_, resolved, callback](const Pointer& message) {
          gate->pass([&] { guard(resolved, [&] { callback(message); }); });
        },
        [this, resolved] { reportOverflow(resolved); },
        [this, gate = gate_, resolved](std::size_t messages) {
          gate->pass(
              [&] { health_.count("dropped: no longer subscribed, " + resolved, messages); });
        });
    const boost::function<void(const Pointer&)> store = [this, gate = gate_, resolved,
                                                         inbox](const Pointer& message) {
      gate->pass([&] {
        health_.received(resolved);
        inbox->add(message);
      });
    };
    // On the manager's threads, whatever this nodelet is busy with.
    return getMTNodeHandle().subscribe<M>(resolved, kTransportQueue, store, ros::VoidConstPtr(),
                                          ros::TransportHints().tcpNoDelay());
  }

  /// Ends a subscription, if it is one; what it waited for is no longer missed.
  void unsubscribe(ros::Subscriber* subscriber) {
    if (!*subscriber) return;
    health_.retireInput(subscriber->getTopic());
    subscriber->shutdown();
  }

  /// Advertises a topic whose first listener and last farewell call updateSubscriptions.
  template <class M>
  ros::Publisher advertise(ros::NodeHandle& handle, const std::string& topic, int queue_size) {
    const auto changed = [this, gate = gate_](bool has_left) {
      return [this, gate, has_left](const ros::SingleSubscriberPublisher& link) {
        gate->pass([&] { guard("connection", [&] { demandChanged(link.getTopic(), has_left); }); });
      };
    };
    const ros::Publisher publisher = handle.advertise<M>(
        topic, static_cast<uint32_t>(queue_size), ros::SubscriberStatusCallback(changed(false)),
        ros::SubscriberStatusCallback(changed(true)));
    std::lock_guard<std::mutex> lock(demand_mutex_);
    advertised_.push_back(publisher);
    return publisher;
  }

  /// Whether somebody listens, or did until a moment ago: a listener that comes back finds
  /// everything running.
  bool isWanted(const ros::Publisher& publisher) const;

  /// Publishes by pointer and counts; the message must not be touched afterwards.
  template <class M>
  void publish(const ros::Publisher& publisher, const boost::shared_ptr<M>& message) {
    publisher.publish(message);
    health_.published(publisher.getTopic());
  }

  /// A monitor that counts and reports jumps of time and what it discards. `forget` drops what is
  /// buffered.
  std::unique_ptr<EpochMonitor> watchedEpochs(const EpochConfig& config,
                                              const std::function<void()>& forget);
  /// Hands a message to the monitor; `work` runs guarded, at once or when its epoch is clear.
  void admit(EpochMonitor* epochs, const std::string& source, StampNs true_ns,
             const std::function<void()>& work);

  /// Reports at once, then at most every 30 s for the same `key`.
  void warn(const std::string& key, const std::string& text);
  void error(const std::string& key, const std::string& text);

 private:
  void onInit() final;
  bool mayReport(const std::string& key, std::chrono::seconds period);
  void demandChanged(const std::string& topic, bool has_left);
  /// Why nothing has to be published, in words; empty = something should be.
  std::string idleReason() const;
  void fillDiagnostics(diagnostic_updater::DiagnosticStatusWrapper& status);
  void watch();
  /// Says which topics are missing; asks the master.
  void tellSilence(const std::vector<std::string>& silent, bool is_silent, bool is_halted);
  /// How far the simulated clock has run, jumps apart, and how long it has stood still, both in ns.
  std::pair<StampNs, StampNs> simulatedClock() const;
  void reportOverflow(const std::string& topic);
  void takeQueues();
  /// Tells, latched, which version runs with which rig.
  void publishConfiguration();

  /// Messages between roscpp and an Inbox, which takes them at once: never reached unless all
  /// threads of the manager are busy for long.
  static constexpr uint32_t kTransportQueue = 64;

  /// A callback that runs while the nodelet is unloaded holds it until it returns, and the manager
  /// has destroyed the queues by then, into which timers and publishers reach as they end.
  std::shared_ptr<void> kept_queues_[2];
  std::shared_ptr<CallbackGate> gate_ = std::make_shared<CallbackGate>();
  Rig rig_;
  Health health_;
  std::shared_ptr<MasterThread> master_ = MasterThread::shared();
  std::atomic<bool> is_asking_{false};  ///< a question to the master is under way
  mutable std::mutex demand_mutex_;
  std::vector<ros::Publisher> advertised_;                     ///< guarded by demand_mutex_
  std::map<std::string, Health::Clock::time_point> farewell_;  ///< by topic; likewise
  std::mutex connect_mutex_;
  bool initialized_ = false;  ///< guarded by connect_mutex_
  mutable std::mutex clock_mutex_;
  // The simulated clock, guarded by clock_mutex_: its last time, when that came, and how far it has
  // gone without jumps.
  mutable StampNs clock_ns_ = 0, clock_changed_ns_ = 0, elapsed_ns_ = 0;
  std::mutex report_mutex_;
  std::map<std::string, Health::Clock::time_point> reported_;
  Health::Clock::time_point started_ = Health::Clock::now();
  Health::Clock::time_point watched_ = started_;
  std::unique_ptr<diagnostic_updater::Updater> diagnostics_;
  ros::Publisher configuration_;
  ros::WallTimer diagnostics_timer_, tick_timer_;
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// What asks the ROS master, on a thread of its own.
///
/// roscpp waits for a master that is gone, for subscriptions without limit. None of the manager's
/// threads may do so: while the master is away, messages go on over the connections that exist.
#pragma once

#include <ros/master.h>

#include <chrono>
#include <condition_variable>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <thread>

namespace semantic_lidar_fusion {

class MasterThread {
 public:
  using Clock = std::chrono::steady_clock;

  /// The thread of this process; it ends when nobody holds it any more.
  static std::shared_ptr<MasterThread> shared();
  MasterThread();
  /// Waits for the work that runs; forgets the rest.
  ~MasterThread();
  MasterThread(const MasterThread&) = delete;
  MasterThread& operator=(const MasterThread&) = delete;

  /// Runs `work`, which does not throw, on the thread and not before `delay` has passed; in the
  /// order of the times at which it is due. Returns at once.
  void run(std::function<void()> work, Clock::duration delay = Clock::duration::zero());

 private:
  void serve();

  std::mutex mutex_;
  std::condition_variable wake_;
  std::multimap<Clock::time_point, std::function<void()>> due_;  ///< guarded by mutex_
  bool stopping_ = false;                                        ///< guarded by mutex_
  std::thread thread_;
};

/// The advertised topics; empty where the master does not answer within `patience`.
std::optional<ros::master::V_TopicInfo> advertisedTopics(std::chrono::milliseconds patience);

}  // namespace semantic_lidar_fusion

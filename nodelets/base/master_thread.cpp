// SPDX-License-Identifier: MIT
#include "base/master_thread.h"

#include <ros/this_node.h>
#include <xmlrpcpp/XmlRpc.h>

#include <utility>

namespace semantic_lidar_fusion {

std::shared_ptr<MasterThread> MasterThread::shared() {
  static std::mutex mutex;
  static std::weak_ptr<MasterThread> known;
  std::lock_guard<std::mutex> lock(mutex);
  std::shared_ptr<MasterThread> thread = known.lock();
  if (!thread) {
    thread = std::make_shared<MasterThread>();
    known = thread;
  }
  return thread;
}

MasterThread::MasterThread() : thread_([this] { serve(); }) {}

MasterThread::~MasterThread() {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    stopping_ = true;
  }
  wake_.notify_all();
  thread_.join();
}

void MasterThread::run(std::function<void()> work, Clock::duration delay) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    due_.emplace(Clock::now() + delay, std::move(work));
  }
  wake_.notify_all();
}

void MasterThread::serve() {
  std::unique_lock<std::mutex> lock(mutex_);
  while (!stopping_) {
    if (due_.empty()) {
      wake_.wait(lock);
    } else if (due_.begin()->first > Clock::now()) {
      wake_.wait_until(lock, due_.begin()->first);
    } else {
      const std::function<void()> work = std::move(due_.begin()->second);
      due_.erase(due_.begin());
      lock.unlock();
      work();
      lock.lock();
    }
  }
}

std::optional<ros::master::V_TopicInfo> advertisedTopics(std::chrono::milliseconds patience) {
  using XmlRpc::XmlRpcDispatch;
  using XmlRpc::XmlRpcValue;
  constexpr double kStepS = 0.05;
  const auto deadline = MasterThread::Clock::now() + patience;
  XmlRpc::XmlRpcClient client(ros::master::getHost().c_str(),
                              static_cast<int>(ros::master::getPort()), "/");
  XmlRpcValue request, answer;
  request[0] = ros::this_node::getName();
  request[1] = "";
  if (!client.executeNonBlock("getPublishedTopics", request)) return std::nullopt;
  XmlRpcDispatch dispatch;
  dispatch.addSource(&client, XmlRpcDispatch::WritableEvent | XmlRpcDispatch::Exception);
  bool is_done = false;
  while (!is_done && MasterThread::Clock::now() < deadline) {
    dispatch.work(kStepS);
    is_done = client.executeCheckDone(answer);
  }
  dispatch.removeSource(&client);
  client.close();
  // [code, text, [[topic, type], ...]]
  if (!is_done || client.isFault() || answer.getType() != XmlRpcValue::TypeArray ||
      answer.size() != 3 || answer[2].getType() != XmlRpcValue::TypeArray) {
    return std::nullopt;
  }
  ros::master::V_TopicInfo topics;
  for (int i = 0; i < answer[2].size(); ++i) {
    topics.emplace_back(std::string(answer[2][i][0]), std::string(answer[2][i][1]));
  }
  return topics;
}

}  // namespace semantic_lidar_fusion

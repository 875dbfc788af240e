// SPDX-License-Identifier: MIT
#pragma once

#include <ros/ros.h>

#include <boost/make_shared.hpp>
#include <functional>
#include <memory>
#include <string>
#include <utility>

#include "base/callback_gate.h"
#include "base/demand.h"
#include "base/health.h"
#include "base/inbox.h"
#include "edge/declared_lengths.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {

/// Subscribes and advertises for one nodelet: every callback passes the nodelet's gate and guard,
/// and every message is counted. What holds on to it must end before it does: close() first.
class TopicConnections {
 public:
  /// `guard` runs work, and lets no exception out, for the place it names. `overflowed` is told the
  /// topic of each message that a slow consumer has no time for.
  TopicConnections(Health& health,
                   std::function<void(const std::string&, const std::function<void()>&)> guard,
                   std::function<void(const std::string&)> overflowed)
      : health_(health), guard_(std::move(guard)), overflowed_(std::move(overflowed)) {}

  /// Runs `work` guarded unless the gate is closed; may outlive this object.
  std::function<void()> runner(std::string where, std::function<void()> work) {
    return [this, gate = gate_, where = std::move(where), work = std::move(work)] {
      gate->pass([&] { guard_(where, work); });
    };
  }
  /// Ends all callbacks and waits for those that run.
  void close() { gate_->close(); }

  /// Without Nagle's delay. `queue_size` > 0 messages wait for their turn on the queue of `handle`;
  /// see Inbox. `transport`: a handle whose queue is served whatever the nodelet is busy with.
  template <class M>
  ros::Subscriber subscribe(ros::NodeHandle& handle, ros::NodeHandle& transport,
                            const std::string& topic, int queue_size,
                            const std::function<void(const boost::shared_ptr<const M>&)>& callback,
                            Health::Expect expect) {
    using Pointer = boost::shared_ptr<const M>;
    const std::string resolved = handle.resolveName(topic);
    health_.expectInput(resolved, expect);
    const auto inbox = boost::make_shared<Inbox<Pointer>>(
        handle.getCallbackQueue(), static_cast<std::size_t>(queue_size),
        [this, gate = gate_, resolved, callback](const Pointer& message) {
          gate->pass([&] { guard_(resolved, [&] { callback(message); }); });
        },
        [this, resolved] { overflowed_(resolved); },
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
    const auto damaged = [this, gate = gate_, resolved](const std::string& reason) {
      gate->pass([&] { guard_(resolved, [&] { throw DataError(reason); }); });
    };
    return subscribeChecked<M>(transport, resolved, kTransportQueue, store, damaged);
  }

  /// Ends a subscription, if it is one; what it waited for is no longer missed.
  void unsubscribe(ros::Subscriber* subscriber) {
    if (!*subscriber) return;
    health_.retireInput(subscriber->getTopic());
    subscriber->shutdown();
  }

  /// `changed` runs guarded when a listener comes or leaves, on the thread that served it.
  template <class M>
  ros::Publisher advertise(ros::NodeHandle& handle, const std::string& topic, int queue_size,
                           const std::function<void()>& changed) {
    const auto run = [this, changed](bool has_left) {
      return [this, gate = gate_, changed, has_left](const ros::SingleSubscriberPublisher& link) {
        gate->pass([&] {
          if (has_left) demand_.left(link.getTopic());
          guard_("connection", changed);
        });
      };
    };
    const ros::Publisher publisher = handle.advertise<M>(topic, static_cast<uint32_t>(queue_size),
                                                         ros::SubscriberStatusCallback(run(false)),
                                                         ros::SubscriberStatusCallback(run(true)));
    demand_.add(publisher);
    return publisher;
  }
  const Demand& demand() const { return demand_; }

  /// Publishes by pointer and counts; the message must not be touched afterwards.
  template <class M>
  void publish(const ros::Publisher& publisher, const boost::shared_ptr<M>& message) {
    publisher.publish(message);
    health_.published(publisher.getTopic());
  }

 private:
  /// Messages between roscpp and an Inbox, which takes them at once: never reached unless all
  /// threads of the manager are busy for long.
  static constexpr uint32_t kTransportQueue = 64;

  Health& health_;
  const std::function<void(const std::string&, const std::function<void()>&)> guard_;
  const std::function<void(const std::string&)> overflowed_;
  Demand demand_;
  std::shared_ptr<CallbackGate> gate_ = std::make_shared<CallbackGate>();
};

}  // namespace semantic_lidar_fusion

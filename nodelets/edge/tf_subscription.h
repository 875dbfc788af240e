// SPDX-License-Identifier: MIT
#pragma once

#include <nav_msgs/Odometry.h>
#include <ros/ros.h>
#include <tf2_msgs/TFMessage.h>

#include <functional>
#include <string>

#include "edge/conversions.h"
#include "edge/declared_lengths.h"
#include "edge/tf_pose_source.h"
#include "semantic_lidar_fusion/common/plain_text.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/sync/epoch_monitor.h"

namespace semantic_lidar_fusion {

/// Feeds a TfPoseSource from /tf, /tf_static and, where the rig says so, an odometry topic.
/// A jump of the odometry's own stamps makes it forget what moves: transforms of a bag's new pass
/// may come before the first message of any other sensor, and must outlive the jump that that one
/// shows. Only frames between the fixed frame and the vehicle can show one.
/// Callbacks run on the queue of the node handle: use the source from that queue only.
class TfSubscription {
 public:
  /// History of transforms and readings; longer than any wait.
  static constexpr StampNs kHistoryNs = 10 * kNsPerSecond;
  /// Small messages that wait while a scan is worked on: seconds of a busy tree.
  static constexpr uint32_t kQueue = 1000;

  TfSubscription(ros::NodeHandle& handle, const Rig& rig)
      : source_(tfPoseSourceConfig(rig, kHistoryNs)) {
    const auto damaged = [](const std::string& reason) {
      ROS_WARN_STREAM_THROTTLE(30.0, "tf: " << plainText(reason));
    };
    static_ = subscribeChecked<tf2_msgs::TFMessage>(
        handle, rig.tf_static_topic, kQueue,
        [this](const tf2_msgs::TFMessageConstPtr& message) { add(*message, true); }, damaged);
    moving_ = subscribeChecked<tf2_msgs::TFMessage>(
        handle, rig.tf_topic, kQueue,
        [this](const tf2_msgs::TFMessageConstPtr& message) { add(*message, false); }, damaged);
    if (rig.odometry.source == OdometrySource::kTopic) {
      odometry_ = subscribeChecked<nav_msgs::Odometry>(
          handle, rig.odometry.topic, kQueue,
          [this](const nav_msgs::OdometryConstPtr& message) {
            observe(message->header.stamp, [this, message] { source_.add(*message); });
            reportNotes();
          },
          damaged);
    }
  }

  TfPoseSource& source() { return source_; }

 private:
  /// What is said of transforms and odometry, each line once.
  void reportNotes() {
    constexpr std::size_t kLongest = 600;
    for (const std::string& note : source_.takeNotes()) {
      ROS_WARN_STREAM("tf: " << plainText(note, kLongest));
    }
  }

  void add(const tf2_msgs::TFMessage& message, bool is_static) {
    for (const auto& transform : message.transforms) {
      if (is_static || !source_.isOdometry(transform)) {
        source_.add(transform, is_static);
      } else {
        observe(transform.header.stamp, [this, transform] { source_.add(transform, false); });
      }
    }
    reportNotes();
  }

  /// Adds a reading of the odometry, at once or when its epoch is clear.
  void observe(const ros::Time& stamp, const std::function<void()>& add) {
    if (stamp.isZero()) {
      add();  // the source counts it
    } else {
      epochs_.observe("odometry", stampNs(stamp), add);
    }
  }

  TfPoseSource source_;
  /// Edges of one chain may overtake each other, and readings that are further off are two
  /// publishers' or jumps.
  EpochMonitor epochs_{{"odometry", 2, kNsPerSecond},
                       [this](StampNs) { source_.clear(); },
                       [this](const DiscardedMessage&) { source_.countRejected(); }};
  ros::Subscriber static_, moving_, odometry_;
};

}  // namespace semantic_lidar_fusion

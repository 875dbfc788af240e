// SPDX-License-Identifier: MIT
#pragma once

#include <nav_msgs/Odometry.h>
#include <ros/ros.h>
#include <tf2_msgs/TFMessage.h>

#include "semantic_lidar_fusion/config/rig.h"
#include "tf_pose_source.h"

namespace semantic_lidar_fusion {

/// Feeds a TfPoseSource from /tf, /tf_static and, where the rig says so, an odometry topic.
/// Callbacks run on the queue of the node handle: use the source from that queue only.
class TfSubscription {
 public:
  /// History of transforms and readings; longer than any wait.
  static constexpr StampNs kHistoryNs = 10 * kNsPerSecond;

  TfSubscription(ros::NodeHandle& handle, const Rig& rig)
      : source_(tfPoseSourceConfig(rig, kHistoryNs)) {
    const auto hints = ros::TransportHints().tcpNoDelay();
    static_ = handle.subscribe<tf2_msgs::TFMessage>(
        "/tf_static", 100,
        boost::function<void(const tf2_msgs::TFMessageConstPtr&)>(
            [this](const tf2_msgs::TFMessageConstPtr& message) { add(*message, true); }),
        ros::VoidConstPtr(), hints);
    moving_ = handle.subscribe<tf2_msgs::TFMessage>(
        "/tf", 100,
        boost::function<void(const tf2_msgs::TFMessageConstPtr&)>(
            [this](const tf2_msgs::TFMessageConstPtr& message) { add(*message, false); }),
        ros::VoidConstPtr(), hints);
    if (rig.odometry.source == OdometrySource::kTopic) {
      odometry_ = handle.subscribe<nav_msgs::Odometry>(
          rig.odometry.topic, 100,
          boost::function<void(const nav_msgs::OdometryConstPtr&)>(
              [this](const nav_msgs::OdometryConstPtr& message) { source_.add(*message); }),
          ros::VoidConstPtr(), hints);
    }
  }

  TfPoseSource& source() { return source_; }

 private:
  void add(const tf2_msgs::TFMessage& message, bool is_static) {
    for (const auto& transform : message.transforms) source_.add(transform, is_static);
  }

  TfPoseSource source_;
  ros::Subscriber static_, moving_, odometry_;
};

}  // namespace semantic_lidar_fusion

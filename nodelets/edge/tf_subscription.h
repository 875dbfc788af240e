// SPDX-License-Identifier: MIT
#pragma once

#include <nav_msgs/Odometry.h>
#include <ros/ros.h>
#include <tf2_msgs/TFMessage.h>

#include <string>

#include "edge/conversions.h"
#include "edge/tf_pose_source.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/sync/epoch_monitor.h"

namespace semantic_lidar_fusion {

/// Feeds a TfPoseSource from /tf, /tf_static and, where the rig says so, an odometry topic.
/// A jump of its own stamps makes it forget what moves: transforms of a bag's new pass may come
/// before the first message of any other sensor, and must outlive the jump that that one shows.
/// Callbacks run on the queue of the node handle: use the source from that queue only.
class TfSubscription {
 public:
  /// History of transforms and readings; longer than any wait.
  static constexpr StampNs kHistoryNs = 10 * kNsPerSecond;
  /// Small messages that wait while a scan is worked on: seconds of a busy tree.
  static constexpr uint32_t kQueue = 1000;

  TfSubscription(ros::NodeHandle& handle, const Rig& rig)
      : source_(tfPoseSourceConfig(rig, kHistoryNs)) {
    const auto hints = ros::TransportHints().tcpNoDelay();
    static_ = handle.subscribe<tf2_msgs::TFMessage>(
        "/tf_static", kQueue,
        boost::function<void(const tf2_msgs::TFMessageConstPtr&)>(
            [this](const tf2_msgs::TFMessageConstPtr& message) { add(*message, true); }),
        ros::VoidConstPtr(), hints);
    moving_ = handle.subscribe<tf2_msgs::TFMessage>(
        "/tf", kQueue,
        boost::function<void(const tf2_msgs::TFMessageConstPtr&)>(
            [this](const tf2_msgs::TFMessageConstPtr& message) { add(*message, false); }),
        ros::VoidConstPtr(), hints);
    if (rig.odometry.source == OdometrySource::kTopic) {
      odometry_ = handle.subscribe<nav_msgs::Odometry>(
          rig.odometry.topic, kQueue,
          boost::function<void(const nav_msgs::OdometryConstPtr&)>(
              [this](const nav_msgs::OdometryConstPtr& message) {
                if (current(message->child_frame_id, message->header.stamp)) source_.add(*message);
              }),
          ros::VoidConstPtr(), hints);
    }
  }

  TfPoseSource& source() { return source_; }

 private:
  void add(const tf2_msgs::TFMessage& message, bool is_static) {
    for (const auto& transform : message.transforms) {
      if (is_static || current(transform.child_frame_id, transform.header.stamp)) {
        source_.add(transform, is_static);
      }
    }
  }

  /// False for what is from before a jump.
  bool current(const std::string& child_frame, const ros::Time& stamp) {
    if (stamp.isZero()) return true;  // the source counts it
    const StampVerdict verdict = epoch_.observe(child_frame, stampNs(stamp));
    if (verdict == StampVerdict::kNewEpoch) source_.clear();
    return verdict != StampVerdict::kStale;
  }

  TfPoseSource source_;
  EpochMonitor epoch_;
  ros::Subscriber static_, moving_, odometry_;
};

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Plays a simulated drive in real time, for ever: a bag of a few seconds, loaded whole, whose
/// stamps are shifted and whose odometry goes on where it ended.
#pragma once

#include <geometry_msgs/TransformStamped.h>
#include <ros/ros.h>
#include <sensor_msgs/CameraInfo.h>
#include <sensor_msgs/CompressedImage.h>
#include <sensor_msgs/Image.h>
#include <tf2_msgs/TFMessage.h>

#include <cstdint>
#include <string>
#include <vector>

#include "edge/velodyne_messages.h"
#include "semantic_lidar_fusion/config/rig.h"

namespace semantic_lidar_fusion {

struct PlayerOptions {
  std::string bag;
  double seconds = 60.0;
  double score_latency_s = 0.0;  ///< from an image's stamp to its scores
  bool wait_for_listeners = true;
};

/// When what was there; steady_ns is CLOCK_MONOTONIC, which all processes share.
struct Delivery {
  std::string what;  ///< "odometry", "scan", or a camera's name for its scores
  StampNs stamp;     ///< for a scan: of its first packet
  StampNs until;     ///< last moment that it covers
  std::int64_t steady_ns;
};

/// A message that was copied since others still held it.
struct Copy {
  std::int64_t steady_ns;
  double cpu_s;
};

/// A message is published as the pointer that holds it, and again in the next round once nobody
/// else does, so that playing costs next to nothing. Images that no scan uses are fillers of the
/// same size.
class RigPlayer {
 public:
  /// Loads the bag; throws Error if something is missing in it.
  RigPlayer(const Rig& rig, const PlayerOptions& options);
  /// Publishes until the end. To be called once.
  void play();

  const std::vector<Delivery>& deliveries() const { return deliveries_; }
  int scanCount() const { return scan_count_; }
  /// What copies took: all that playing costs beyond what it costs without listeners.
  const std::vector<Copy>& copies() const { return copies_; }
  std::int64_t startSteadyNs() const { return start_steady_ns_; }
  std::int64_t largestLagNs() const { return largest_lag_ns_; }

 private:
  template <class M>
  struct Item {
    StampNs offset;  ///< since the start of the round
    boost::shared_ptr<M> message;
  };
  struct Camera {
    const CameraConfig* config;
    bool compressed;
    std::vector<Item<sensor_msgs::Image>> images, scores;
    std::vector<Item<sensor_msgs::CompressedImage>> compressed_images;
    std::vector<boost::shared_ptr<sensor_msgs::Image>> fillers;
    std::vector<boost::shared_ptr<sensor_msgs::CompressedImage>> compressed_fillers;
    sensor_msgs::CameraInfo info;
    ros::Publisher image_publisher, info_publisher, scores_publisher;
  };
  enum class Kind { kOdometry, kImage, kFiller, kScores, kScan };
  struct Event {
    StampNs at;      ///< since the start of a round
    StampNs offset;  ///< of the stamp, likewise; earlier than 0 if it is the round before's
    Kind kind;
    int camera, index;
  };

  void load(const PlayerOptions& options);
  void schedule(double score_latency_s);
  void awaitListeners() const;
  void publish(const Event& event, StampNs round_start);
  void publishImage(Camera* camera, const Event& event, StampNs stamp);
  template <class M>
  boost::shared_ptr<M> owned(boost::shared_ptr<M>* message);

  const Rig& rig_;
  PlayerOptions options_;
  std::vector<Camera> cameras_;
  std::vector<Item<VelodyneScan>> scans_;
  std::vector<Item<geometry_msgs::TransformStamped>> odometry_;
  tf2_msgs::TFMessage static_transforms_;
  Transform round_motion_ = Transform::Identity(), motion_so_far_ = Transform::Identity();
  StampNs bag_start_ = 0, round_ = 0;
  std::vector<Event> events_;

  ros::NodeHandle node_;
  ros::Publisher scan_publisher_, tf_publisher_, static_tf_publisher_;
  std::vector<Delivery> deliveries_;
  std::vector<Copy> copies_;
  int scan_count_ = 0;
  std::int64_t start_steady_ns_ = 0, largest_lag_ns_ = 0;
};

/// CLOCK_MONOTONIC.
std::int64_t steadyNs();

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// An odometry topic -> tf from the rig's fixed frame to the vehicle, for RViz and maps, which know
/// tf alone. Silent where the rig takes odometry from tf, and where somebody else tells tf where
/// the vehicle is. All callbacks run one at a time.
#include <tf2_msgs/TFMessage.h>

#include <chrono>
#include <map>
#include <memory>
#include <optional>
#include <pluginlib/class_list_macros.hpp>
#include <set>
#include <string>

#include "base/fusion_nodelet.h"
#include "edge/conversions.h"
#include "edge/declared_lengths.h"
#include "edge/tf_subscription.h"

namespace semantic_lidar_fusion {
namespace {

/// How long others have to show that they tell tf, from the first reading on.
constexpr std::chrono::milliseconds kGrace{1000};
constexpr int kDeepestTree = 100;
/// Of what was broadcast, by which it is told from what others say of the same edge.
constexpr std::size_t kOwnStamps = 10000;

}  // namespace

class OdometryTfNodelet : public FusionNodelet {
 public:
  ~OdometryTfNodelet() override { stop(); }

 private:
  void initialize() override {
    if (rig().odometry.source != OdometrySource::kTopic) {
      health().set("tf", "has the odometry already (odometry.source: tf)");
      return;
    }
    tf_ = std::make_unique<TfSubscription>(getNodeHandle(), rig());
    output_ = getNodeHandle().advertise<tf2_msgs::TFMessage>("/tf", 100);
    const auto store = [this](const tf2_msgs::TFMessageConstPtr& message) {
      guard("tf", [&] { onTransforms(*message); });
    };
    const auto damaged = [](const std::string&) {};  // TfSubscription says it
    static_ = subscribeChecked<tf2_msgs::TFMessage>(getNodeHandle(), rig().tf_static_topic, 100,
                                                    store, damaged);
    moving_ =
        subscribeChecked<tf2_msgs::TFMessage>(getNodeHandle(), rig().tf_topic, 100, store, damaged);
    startTicking();
  }

  void onTransforms(const tf2_msgs::TFMessage& message) {
    for (const auto& transform : message.transforms) {
      const std::string child = frameName(transform.child_frame_id);
      const bool is_own =
          child == told_root_ && own_stamps_.count(stampNs(transform.header.stamp)) > 0;
      if (is_own) continue;
      parents_[child] = frameName(transform.header.frame_id);
    }
  }

  /// The root of the vehicle's tree; empty if the fixed frame is above the vehicle already.
  std::string root() const {
    std::string frame = frameName(rig().vehicle_frame);
    for (int depth = 0; depth < kDeepestTree; ++depth) {
      if (frame == frameName(rig().fixed_frame)) return {};
      const auto parent = parents_.find(frame);
      if (parent == parents_.end()) return frame;
      frame = parent->second;
    }
    return {};
  }

  void tick(StampNs /*now_ns*/) override {
    if (!tf_ || is_told_elsewhere_) return;
    const auto& readings = tf_->source().odometry().readings();
    if (readings.empty()) return;
    const auto clock = Health::Clock::now();
    if (!first_reading_) first_reading_ = clock;
    if (clock - *first_reading_ < kGrace) return;
    const std::string root = this->root();
    if (root.empty()) {
      is_told_elsewhere_ = true;
      NODELET_INFO_STREAM("tf has " << rig().vehicle_frame << " in " << rig().fixed_frame
                                    << " from elsewhere; " << rig().odometry.topic
                                    << " is not broadcast");
      health().set("tf", "has the odometry from elsewhere");
      return;
    }
    broadcast(readings, root);
  }

  void broadcast(const std::deque<StampedPose>& readings, const std::string& root) {
    if (readings.back().stamp < newest_) newest_ = 0;  // a clock jump
    if (readings.back().stamp == newest_) return;
    const TransformAnswer T_vehicle_root = tf_->source().extrinsics(rig().vehicle_frame, root);
    if (!T_vehicle_root && root != frameName(rig().vehicle_frame)) return;  // not all of it came
    const Transform T = T_vehicle_root ? *T_vehicle_root.transform : Transform::Identity();
    auto output = boost::make_shared<tf2_msgs::TFMessage>();
    for (const StampedPose& reading : readings) {
      if (reading.stamp <= newest_) continue;
      own_stamps_.insert(reading.stamp);
      output->transforms.push_back(stampedTransform(frameName(rig().fixed_frame), root,
                                                    reading.stamp, reading.T_fixed_vehicle * T));
    }
    newest_ = readings.back().stamp;
    while (own_stamps_.size() > kOwnStamps) own_stamps_.erase(own_stamps_.begin());
    if (told_root_ != root) {
      told_root_ = root;
      NODELET_INFO_STREAM("tf from " << rig().fixed_frame << " to " << root << " is broadcast from "
                                     << rig().odometry.topic);
    }
    health().set("tf", rig().fixed_frame + " to " + root);
    publish(output_, output);
  }

  std::unique_ptr<TfSubscription> tf_;
  std::map<std::string, std::string> parents_;  ///< by child, but for what is broadcast here
  std::optional<Health::Clock::time_point> first_reading_;
  std::string told_root_;
  std::set<StampNs> own_stamps_;
  StampNs newest_ = 0;  ///< that was broadcast
  bool is_told_elsewhere_ = false;
  ros::Publisher output_;
  ros::Subscriber static_, moving_;
};

}  // namespace semantic_lidar_fusion

PLUGINLIB_EXPORT_CLASS(semantic_lidar_fusion::OdometryTfNodelet, nodelet::Nodelet)

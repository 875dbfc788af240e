// SPDX-License-Identifier: MIT
#include "edge/tf_pose_source.h"

#include <tf2/exceptions.h>

#include <algorithm>
#include <cinttypes>
#include <cstdio>
#include <limits>
#include <utility>

#include "edge/conversions.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

/// "For good" in tf2's terms: stamp + cache length must stay within 2^32 s.
constexpr double kEndlessCacheS = 10.0 * 365 * 86400;
/// Stamps of one edge that wait for the chain to be joined.
constexpr std::size_t kMaxUnread = 1000000;
constexpr std::size_t kMaxPendingOdometry = 100000;
/// Deeper trees are loops.
constexpr std::size_t kMaxDepth = 1000;

std::string seconds(StampNs stamp) {
  char text[40];
  std::snprintf(text, sizeof(text), "%" PRId64 ".%09" PRId64, stamp / kNsPerSecond,
                std::abs(stamp % kNsPerSecond));
  return text;
}

ros::Duration cacheLength(StampNs history_ns) {
  return ros::Duration(history_ns > 0 ? toSeconds(history_ns) : kEndlessCacheS);
}

}  // namespace

TfPoseSourceConfig tfPoseSourceConfig(const Rig& rig, StampNs history_ns) {
  TfPoseSourceConfig config;
  config.fixed_frame = rig.fixed_frame;
  config.vehicle_frame = rig.vehicle_frame;
  config.source = rig.odometry.source;
  config.time_offset_ns = toNs(rig.odometry.time_offset_s);
  config.history_ns = history_ns;
  return config;
}

TfPoseSource::TfPoseSource(TfPoseSourceConfig config)
    : config_(std::move(config)),
      buffer_(std::make_unique<tf2::BufferCore>(cacheLength(config_.history_ns))),
      odometry_(config_.history_ns) {
  config_.fixed_frame = frameName(config_.fixed_frame);
  config_.vehicle_frame = frameName(config_.vehicle_frame);
}

bool TfPoseSource::add(const geometry_msgs::TransformStamped& message, bool is_static) {
  ++counters_.transforms;
  geometry_msgs::TransformStamped clean = message;
  clean.header.frame_id = frameName(message.header.frame_id);
  clean.child_frame_id = frameName(message.child_frame_id);
  const std::string& child = clean.child_frame_id;
  const std::string& parent = clean.header.frame_id;
  const StampNs stamp = stampNs(message.header.stamp);
  try {
    const Transform T_parent_child = transform(message.transform);
    const Eigen::Quaterniond rotation(T_parent_child.linear());
    clean.transform.rotation.w = rotation.w();
    clean.transform.rotation.x = rotation.x();
    clean.transform.rotation.y = rotation.y();
    clean.transform.rotation.z = rotation.z();
  } catch (const DataError&) {
    ++counters_.rejected;
    return false;
  }
  if (child.empty() || parent.empty() || child == parent || (!is_static && stamp == 0)) {
    ++counters_.rejected;
    return false;
  }
  const auto known = edges_.find(child);
  if (known != edges_.end()) is_static = known->second.is_static;  // tf2: the first one decides
  if (known != edges_.end() && !is_static && stamp == known->second.newest) {
    ++counters_.repeated;
    return false;
  }
  try {
    if (!buffer_->setTransform(clean, "", is_static)) {
      ++counters_.rejected;
      return false;
    }
  } catch (const std::exception&) {  // a stamp beyond what ros::Time can add up
    ++counters_.rejected;
    return false;
  }

  Edge& edge = edges_[child];
  if (known == edges_.end() || edge.parent != parent) {
    edge.parent = parent;
    edge.is_static = is_static;
    chain_is_known_ = false;
  }
  if (is_static) return true;
  edge.newest = std::max(edge.newest, stamp);
  const bool off_chain =
      chain_is_known_ && std::find(moving_.begin(), moving_.end(), child) == moving_.end();
  if (config_.source == OdometrySource::kTf && !off_chain) {
    edge.unread.push_back(stamp);
    if (edge.unread.size() > kMaxUnread) edge.unread.pop_front();
    // At once: tf2 gives its newest transform exactly, an older one after an interpolation that
    // changes the last bits, and the poses must not depend on when they are asked for.
    readTf();
  }
  return true;
}

bool TfPoseSource::add(const nav_msgs::Odometry& message) {
  ++counters_.odometry;
  if (message.header.stamp.isZero()) {
    ++counters_.rejected;
    return false;
  }
  try {
    transform(message.pose.pose);
  } catch (const DataError&) {
    ++counters_.rejected;
    return false;
  }
  pending_.push_back(message);
  if (pending_.size() > kMaxPendingOdometry) pending_.pop_front();
  counters_.odometry_pending = pending_.size();
  return true;
}

bool TfPoseSource::isOdometry(const geometry_msgs::TransformStamped& message) {
  return findMovingEdges() && std::find(moving_.begin(), moving_.end(),
                                        frameName(message.child_frame_id)) != moving_.end();
}

void TfPoseSource::clear() {
  buffer_->clear();  // static transforms survive
  for (auto& edge : edges_) {
    edge.second.newest = 0;
    edge.second.unread.clear();
  }
  wanted_.clear();
  pending_.clear();
  counters_.odometry_pending = 0;
  odometry_ = PoseBuffer(config_.history_ns);
  chain_is_known_ = false;
}

TransformAnswer TfPoseSource::extrinsics(const std::string& target,
                                         const std::string& source) const {
  return lookup(frameName(target), frameName(source), ros::Time(0));
}

const PoseBuffer& TfPoseSource::odometry() {
  if (config_.source == OdometrySource::kTf) {
    readTf();
  } else {
    readPendingOdometry();
  }
  return odometry_;
}

std::string TfPoseSource::gap(StampNs from_ns, StampNs to_ns) {
  const PoseBuffer& poses = odometry();
  if (poses.covers(from_ns) && poses.covers(to_ns)) return {};
  const std::string name = config_.source == OdometrySource::kTf
                               ? "tf " + config_.fixed_frame + " <- " + config_.vehicle_frame
                               : "odometry of " + config_.vehicle_frame;
  const std::string wanted = "; wanted " + seconds(from_ns) + " to " + seconds(to_ns);
  if (!poses.empty()) {
    const StampNs first = poses.readings().front().stamp, last = poses.readings().back().stamp;
    const bool forgotten = config_.history_ns > 0 && from_ns < last - config_.history_ns;
    return name + " is known from " + seconds(first) + " to " + seconds(last) + wanted +
           (forgotten ? ", which is older than the " + seconds(config_.history_ns) +
                            " s that are kept; does the lidar's clock lag (lidar.time_offset)?"
                      : "");
  }
  if (config_.source == OdometrySource::kTopic) {
    if (pending_.empty()) return name + " was never received" + wanted;
    const std::string child = frameName(pending_.back().child_frame_id);
    return name + " waits for the transform from " + child + ": " +
           extrinsics(child, config_.vehicle_frame).message;
  }
  const TransformAnswer answer = extrinsics(config_.fixed_frame, config_.vehicle_frame);
  return name + " has no reading" + (answer ? wanted : ": " + answer.message);
}

TransformAnswer TfPoseSource::lookup(const std::string& target, const std::string& source,
                                     const ros::Time& time) const {
  TransformAnswer answer;
  try {
    answer.transform = transform(buffer_->lookupTransform(target, source, time).transform);
    return answer;
  } catch (const tf2::TransformException& e) {
    answer.message = target + " <- " + source + ": " + e.what();
    if (dynamic_cast<const tf2::ExtrapolationException*>(&e)) {
      answer.problem = TransformProblem::kNotCovered;
    } else if (dynamic_cast<const tf2::ConnectivityException*>(&e)) {
      answer.problem = TransformProblem::kNotConnected;
    } else if (dynamic_cast<const tf2::LookupException*>(&e)) {
      answer.problem = TransformProblem::kUnknownFrame;
    } else {
      answer.problem = TransformProblem::kInvalidRequest;
    }
  } catch (const DataError& e) {
    answer.message = target + " <- " + source + ": " + e.what();
    answer.problem = TransformProblem::kInvalidRequest;
  }
  return answer;
}

/// Finds the moving edges between the fixed frame and the vehicle; false if they are not joined.
bool TfPoseSource::findMovingEdges() {
  if (chain_is_known_) return true;
  const auto ancestors = [this](const std::string& frame) {
    std::vector<std::string> chain{frame};
    for (auto edge = edges_.find(frame); edge != edges_.end() && chain.size() <= kMaxDepth;
         edge = edges_.find(chain.back())) {
      chain.push_back(edge->second.parent);
    }
    return chain;
  };
  const std::vector<std::string> of_fixed = ancestors(config_.fixed_frame);
  const std::vector<std::string> of_vehicle = ancestors(config_.vehicle_frame);
  const auto joint =
      std::find_first_of(of_vehicle.begin(), of_vehicle.end(), of_fixed.begin(), of_fixed.end());
  if (joint == of_vehicle.end()) return false;
  std::vector<std::string> children(of_vehicle.begin(), joint);
  children.insert(children.end(), of_fixed.begin(),
                  std::find(of_fixed.begin(), of_fixed.end(), *joint));

  moving_.clear();
  for (const std::string& child : children) {
    if (!edges_.at(child).is_static) moving_.push_back(child);
  }
  for (auto& edge : edges_) {
    if (std::find(moving_.begin(), moving_.end(), edge.first) == moving_.end()) {
      edge.second.unread.clear();
    }
  }
  chain_is_known_ = true;
  return true;
}

/// Looks up the pose at every stamp of a moving edge that all moving edges have reached.
void TfPoseSource::readTf() {
  if (!findMovingEdges()) return;
  if (moving_.empty()) {  // the vehicle stands still in the fixed frame, at all times
    const TransformAnswer pose = lookup(config_.fixed_frame, config_.vehicle_frame, ros::Time(0));
    const bool same_frame = config_.fixed_frame == config_.vehicle_frame;
    if (!pose && !same_frame) return;
    constexpr StampNs kFar = std::numeric_limits<StampNs>::max() / 4;
    const Transform T_fixed_vehicle = pose ? *pose.transform : Transform::Identity();
    odometry_ = PoseBuffer();
    stands_still_ = true;
    odometry_.add({-kFar, T_fixed_vehicle});
    odometry_.add({kFar, T_fixed_vehicle});
    return;
  }
  if (stands_still_) {
    odometry_ = PoseBuffer(config_.history_ns);
    stands_still_ = false;
  }
  StampNs reached = std::numeric_limits<StampNs>::max();
  for (const std::string& child : moving_) {
    Edge& edge = edges_.at(child);
    wanted_.insert(edge.unread.begin(), edge.unread.end());
    edge.unread.clear();
    reached = std::min(reached, edge.newest);
  }
  while (!wanted_.empty() && *wanted_.begin() <= reached) {
    const StampNs stamp = *wanted_.begin();
    wanted_.erase(wanted_.begin());
    // A stamp before the first transform of another edge has no pose, now or later.
    const TransformAnswer pose = lookup(config_.fixed_frame, config_.vehicle_frame, rosTime(stamp));
    if (pose) odometry_.add({stamp + config_.time_offset_ns, *pose.transform});
  }
}

void TfPoseSource::readPendingOdometry() {
  while (!pending_.empty()) {
    const nav_msgs::Odometry& message = pending_.front();
    const std::string child = frameName(message.child_frame_id);
    Transform T_child_vehicle = Transform::Identity();
    if (!child.empty() && child != config_.vehicle_frame) {
      const TransformAnswer answer = extrinsics(child, config_.vehicle_frame);
      if (!answer) break;
      T_child_vehicle = *answer.transform;
    }
    odometry_.add({stampNs(message.header.stamp) + config_.time_offset_ns,
                   transform(message.pose.pose) * T_child_vehicle});
    pending_.pop_front();
  }
  counters_.odometry_pending = pending_.size();
}

}  // namespace semantic_lidar_fusion

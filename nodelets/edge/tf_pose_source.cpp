// SPDX-License-Identifier: MIT
#include "edge/tf_pose_source.h"

#include <tf2/exceptions.h>

#include <algorithm>
#include <cinttypes>
#include <cmath>
#include <cstdio>
#include <limits>
#include <set>
#include <utility>

#include "edge/conversions.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"

namespace semantic_lidar_fusion {
namespace {

/// "For good" in tf2's terms: stamp + cache length must stay within 2^32 s.
constexpr double kEndlessCacheS = 10.0 * 365 * 86400;
/// Stamps of one edge that wait for the chain to be joined.
constexpr std::size_t kMaxUnread = 1000000;
constexpr std::size_t kMaxPendingOdometry = 100000;
/// Deeper trees are loops.
constexpr std::size_t kMaxDepth = 1000;
/// tf2 seeks in a list from its newest transform on: what is older than the newest by more than
/// this (two clocks, a bag from its end) is kept and looked up here.
constexpr StampNs kOrderlyNs = 5 * kNsPerSecond;
constexpr std::size_t kMostNotes = 100;
/// Frames that move, besides those that are asked for: a node that invents names must not fill the
/// memory, and frames that are forgotten come again with their next transform.
constexpr std::size_t kMostMoving = 1000;
/// Static frames come once and are kept. Vehicles have some hundred.
constexpr std::size_t kMostStatic = 10000;
/// Frames asked for that are remembered; messages can name any.
constexpr std::size_t kMostAsked = 200;
constexpr std::size_t kLongestFrame = 256;

std::string seconds(StampNs stamp) {
  char text[40];
  std::snprintf(text, sizeof(text), "%" PRId64 ".%09" PRId64, stamp / kNsPerSecond,
                std::abs(stamp % kNsPerSecond));
  return text;
}

/// "(1.000, 0.000, 0.500) m, yaw 2.9 deg", for messages.
std::string valueText(const Transform& T) {
  const Eigen::Vector3d p = T.translation();
  char text[200];
  std::snprintf(text, sizeof(text), "(%.3f, %.3f, %.3f) m turned by %.2f deg", p.x(), p.y(), p.z(),
                Eigen::AngleAxisd(T.linear()).angle() * 180.0 / kPi);
  return text;
}

/// Farther apart than what rounding to float or to text does.
bool differ(const Transform& a, const Transform& b) {
  return (a.translation() - b.translation()).norm() > 1e-3 ||
         Eigen::Quaterniond(a.linear()).angularDistance(Eigen::Quaterniond(b.linear())) > 1e-3;
}

void checkPlace(const Eigen::Vector3d& translation, double largest_m) {
  if (translation.cwiseAbs().maxCoeff() <= largest_m) return;
  char text[120];
  std::snprintf(text, sizeof(text),
                "translation of %.3g m; at most %.3g "
                "(odometry.largest_coordinate_m) are taken",
                translation.cwiseAbs().maxCoeff(), largest_m);
  throw DataError(text);
}

/// Of one moving edge at a time that its transforms cover.
std::optional<Transform> poseOf(const std::map<StampNs, Transform>& poses, StampNs stamp) {
  const auto after = poses.lower_bound(stamp);
  if (after == poses.end()) return std::nullopt;
  if (after->first == stamp) return after->second;
  if (after == poses.begin()) return std::nullopt;
  const auto before = std::prev(after);
  return interpolate(before->second, after->second,
                     static_cast<double>(stamp - before->first) /
                         static_cast<double>(after->first - before->first));
}

std::string joined(const std::vector<std::string>& names) {
  std::string text;
  for (const std::string& name : names) text += (text.empty() ? "" : ", ") + name;
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
  config.largest_coordinate_m = rig.odometry.largest_coordinate_m;
  config.fastest_mps = rig.odometry.fastest_mps;
  return config;
}

TfPoseSource::TfPoseSource(TfPoseSourceConfig config)
    : config_(std::move(config)),
      buffer_(std::make_unique<tf2::BufferCore>(cacheLength(config_.history_ns))),
      odometry_(config_.history_ns, config_.fastest_mps) {
  config_.fixed_frame = frameName(config_.fixed_frame);
  config_.vehicle_frame = frameName(config_.vehicle_frame);
  asked_ = {config_.fixed_frame, config_.vehicle_frame};
}

std::string TransformAnswer::advice() const {
  const bool is_missing =
      problem == TransformProblem::kUnknownFrame || problem == TransformProblem::kNotConnected;
  return message + (is_missing ? std::string("; ") + kTransformCure : "");
}

bool TfPoseSource::refuse(const std::string& child, const std::string& what,
                          const std::string& reason) {
  ++counters_.rejected;
  problem_ = what + " is refused: " + reason;
  note("refused " + child, problem_);
  return false;
}

void TfPoseSource::note(const std::string& key, const std::string& text) const {
  if (noted_.size() < kMostNotes && noted_.insert(key).second) notes_.push_back(text);
}

std::vector<std::string> TfPoseSource::takeNotes() {
  std::vector<std::string> notes;
  notes.swap(notes_);
  return notes;
}

/// Tells of a static edge that comes with another value, or as a moving one. False if the message
/// must not count: /tf_static tells an edge that /tf tells otherwise.
bool TfPoseSource::noteStaticValues(const geometry_msgs::TransformStamped& message, bool is_static,
                                    const Transform& T_parent_child) {
  const auto known = edges_.find(message.child_frame_id);
  if (known == edges_.end()) return true;
  Edge& edge = known->second;
  const std::string name = message.header.frame_id + " <- " + message.child_frame_id;
  if (edge.parent != message.header.frame_id) {
    note("parent " + message.child_frame_id, "frame " + message.child_frame_id +
                                                 " has two parents, " + edge.parent + " and " +
                                                 message.header.frame_id + ": the last one counts");
    return true;
  }
  if (edge.is_static != is_static) {
    const std::string both = edge.is_static ? valueText(edge.latest) + " on /tf_static and " +
                                                  valueText(T_parent_child) + " on /tf"
                                            : valueText(edge.latest) + " on /tf and " +
                                                  valueText(T_parent_child) + " on /tf_static";
    const bool other = differ(edge.latest, T_parent_child);
    if (other || !edge.is_static) {
      note("twice " + name, name + " comes both as " + both + ": " +
                                (edge.is_static ? "/tf_static counts" : "/tf counts"));
    }
    if (edge.is_static) return false;
  } else if (is_static && differ(edge.latest, T_parent_child)) {
    note("static " + name, name + " comes on /tf_static as " + valueText(edge.latest) + " and as " +
                               valueText(T_parent_child) + ": the last one counts");
  }
  return true;
}

bool TfPoseSource::add(const geometry_msgs::TransformStamped& message, bool is_static) {
  ++counters_.transforms;
  problem_.clear();
  geometry_msgs::TransformStamped clean = message;
  clean.header.frame_id = frameName(message.header.frame_id);
  clean.child_frame_id = frameName(message.child_frame_id);
  const std::string& child = clean.child_frame_id;
  const std::string& parent = clean.header.frame_id;
  const std::string name = "transform " + parent + " <- " + child;
  const StampNs stamp = stampNs(message.header.stamp);
  Transform T_parent_child;
  try {
    T_parent_child = transform(message.transform);
    checkPlace(T_parent_child.translation(), config_.largest_coordinate_m);
    const std::string off = normNote(message.transform.rotation);
    if (!off.empty()) note("norm " + child, name + " " + off);
    const Eigen::Quaterniond rotation(T_parent_child.linear());
    clean.transform.rotation.w = rotation.w();
    clean.transform.rotation.x = rotation.x();
    clean.transform.rotation.y = rotation.y();
    clean.transform.rotation.z = rotation.z();
  } catch (const DataError& e) {
    return refuse(child, name, e.what());
  }
  for (const std::string& frame : {parent, child}) {
    if (frame.size() <= kLongestFrame) continue;
    return refuse("long name", "transform",
                  "a frame's name of " + std::to_string(frame.size()) + " bytes; at most " +
                      std::to_string(kLongestFrame) + " are taken");
  }
  if (parent.empty()) return refuse(child, name, "header.frame_id is empty");
  if (child.empty()) return refuse(child, name, "child_frame_id is empty");
  if (child == parent) return refuse(child, name, "a frame cannot hang below itself");
  if (!is_static && stamp == 0) return refuse(child, name, "its stamp is 0");
  if (!noteStaticValues(clean, is_static, T_parent_child)) {
    ++counters_.repeated;
    return false;
  }
  const auto known = edges_.find(child);
  if (known != edges_.end()) is_static = known->second.is_static;  // tf2: the first one decides
  if (!is_static && stamp == 0) {
    return refuse(child, name, "its stamp is 0, and it came on /tf before");
  }
  if (known != edges_.end() && !is_static && stamp == known->second.newest) {
    ++counters_.repeated;
    return false;
  }
  if (known == edges_.end() && !hasRoom(is_static)) {
    return refuse("frames", name,
                  "there are " + std::to_string(kMostStatic) +
                      " static frames already; which node invents names?");
  }
  const bool late =
      known != edges_.end() && !is_static && stamp + kOrderlyNs < known->second.newest;
  if (late && config_.history_ns > 0 && stamp + config_.history_ns < known->second.newest) {
    return refuse(child, name, "it is older than what is kept; do two clocks stamp it?");
  }
  try {
    if (!late && !buffer_->setTransform(clean, "", is_static)) {
      return refuse(child, name, "tf2 takes it for too old or malformed");
    }
  } catch (const std::exception& e) {  // a stamp beyond what ros::Time can add up
    return refuse(child, name, e.what());
  }

  Edge& edge = edges_[child];
  if (known == edges_.end() || edge.parent != parent) {
    edge.parent = parent;
    edge.is_static = is_static;
    edge.first = T_parent_child;
    edge.poses.clear();
    chain_is_known_ = false;
  }
  edge.latest = T_parent_child;
  edge.changed = edge.changed || differ(edge.first, edge.latest);
  if (is_static) return true;
  edge.newest = std::max(edge.newest, stamp);
  const bool off_chain =
      chain_is_known_ && std::find(moving_.begin(), moving_.end(), child) == moving_.end();
  if (config_.source == OdometrySource::kTf && !off_chain) {
    edge.poses[stamp] = T_parent_child;
    while (config_.history_ns > 0 && edge.poses.begin()->first < edge.newest - config_.history_ns) {
      edge.poses.erase(edge.poses.begin());
    }
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
  problem_.clear();
  const std::string name = "odometry of " + frameName(message.child_frame_id);
  if (message.header.stamp.isZero()) return refuse("odometry", name, "its stamp is 0");
  Transform T_fixed_body;
  try {
    T_fixed_body = transform(message.pose.pose);
    checkPlace(T_fixed_body.translation(), config_.largest_coordinate_m);
    const std::string off = normNote(message.pose.pose.orientation);
    if (!off.empty()) note("norm", name + " " + off);
  } catch (const DataError& e) {
    return refuse("odometry", name, e.what());
  }
  noteTwist(message, T_fixed_body);
  pending_.push_back(message);
  if (pending_.size() > kMaxPendingOdometry) pending_.pop_front();
  counters_.odometry_pending = pending_.size();
  return true;
}

bool TfPoseSource::isOdometry(const geometry_msgs::TransformStamped& message) {
  return findMovingEdges() && std::find(moving_.begin(), moving_.end(),
                                        frameName(message.child_frame_id)) != moving_.end();
}

/// Each kind of contradiction between pose and twist is told once.
void TfPoseSource::noteTwist(const nav_msgs::Odometry& message, const Transform& T_fixed_body) {
  const auto& linear = message.twist.twist.linear;
  const auto& angular = message.twist.twist.angular;
  const Twist twist{{linear.x, linear.y, linear.z}, {angular.x, angular.y, angular.z}};
  const std::optional<std::string> doubt =
      twist_watch_.add(stampNs(message.header.stamp), T_fixed_body, twist);
  if (doubt) note("twist", *doubt);
}

/// Makes room for a frame that is new; false if there is none.
bool TfPoseSource::hasRoom(bool is_static) {
  const auto count = std::count_if(edges_.begin(), edges_.end(), [&](const auto& edge) {
    return edge.second.is_static == is_static;
  });
  if (is_static) return static_cast<std::size_t>(count) < kMostStatic;
  if (static_cast<std::size_t>(count) >= kMostMoving) forgetMoving();
  return true;
}

/// Keeps of the frames that move those between frames that are asked for. tf2 forgets no name: it
/// is set up anew.
void TfPoseSource::forgetMoving() {
  std::set<std::string> kept;
  for (const std::string& frame : asked_) {
    for (const std::string& above : ancestors(frame)) kept.insert(above);
  }
  std::size_t forgotten = 0;
  for (auto edge = edges_.begin(); edge != edges_.end();) {
    const bool keep = edge->second.is_static || kept.count(edge->first) > 0;
    forgotten += keep ? 0 : 1;
    edge = keep ? std::next(edge) : edges_.erase(edge);
  }
  note("frames", std::to_string(forgotten) +
                     " frames that move and that nobody asks for are forgotten: which node invents "
                     "names?");
  buffer_ = std::make_unique<tf2::BufferCore>(cacheLength(config_.history_ns));
  for (const auto& [child, edge] : edges_) {
    if (edge.is_static || edge.poses.empty()) {
      buffer_->setTransform(stampedTransform(edge.parent, child, edge.newest, edge.latest), "",
                            edge.is_static);
    }
    for (const auto& [stamp, pose] : edge.poses) {
      if (stamp + kOrderlyNs < edge.newest) continue;
      buffer_->setTransform(stampedTransform(edge.parent, child, stamp, pose), "", false);
    }
  }
}

void TfPoseSource::clear() {
  buffer_->clear();  // static transforms survive
  for (auto& edge : edges_) {
    edge.second.newest = 0;
    edge.second.unread.clear();
    edge.second.poses.clear();
  }
  wanted_.clear();
  late_.clear();
  twist_watch_.clear();
  pending_.clear();
  counters_.odometry_pending = 0;
  odometry_ = PoseBuffer(config_.history_ns, config_.fastest_mps);
  chain_is_known_ = false;
}

TransformAnswer TfPoseSource::extrinsics(const std::string& target,
                                         const std::string& source) const {
  if (asked_.size() >= kMostAsked) asked_ = {config_.fixed_frame, config_.vehicle_frame};
  asked_.insert({frameName(target), frameName(source)});
  noteChangingExtrinsics(frameName(target), frameName(source));
  return lookup(frameName(target), frameName(source), ros::Time(0));
}

/// Extrinsics are taken as fixed; a moving edge between the two frames that changed says otherwise.
void TfPoseSource::noteChangingExtrinsics(const std::string& target,
                                          const std::string& source) const {
  const std::vector<std::string> a = ancestors(target), b = ancestors(source);
  const auto shared = [](const std::string& frame, const std::vector<std::string>& others) {
    return std::find(others.begin(), others.end(), frame) != others.end();
  };
  for (const std::vector<std::string>& side : {a, b}) {
    for (const std::string& frame : side) {
      if (shared(frame, a) && shared(frame, b)) break;
      const auto edge = edges_.find(frame);
      const bool in_chain = std::find(moving_.begin(), moving_.end(), frame) != moving_.end();
      if (edge == edges_.end() || edge->second.is_static || in_chain) continue;
      if (!edge->second.changed) continue;
      note("changing " + frame, edge->second.parent + " <- " + frame + " changes, from " +
                                    valueText(edge->second.first) + " to " +
                                    valueText(edge->second.latest) +
                                    ": between sensors and vehicle the latest value counts for all "
                                    "times");
    }
  }
}

void TfPoseSource::read() {
  if (config_.source == OdometrySource::kTf) {
    readTf();
  } else {
    readPendingOdometry();
  }
}

const PoseBuffer& TfPoseSource::odometry() {
  read();
  if (!late_.empty()) odometry_.add(late_);
  late_.clear();
  if (!odometry_.jumps().empty() && noted_.count("jump") == 0) {
    note("jump", jumpText(odometry_.jumps().front()));
  }
  return odometry_;
}

void TfPoseSource::addReading(const StampedPose& reading) {
  if (odometry_.empty() || reading.stamp > odometry_.readings().back().stamp) {
    odometry_.add(reading);
  } else {
    late_.push_back(reading);
  }
}

/// Of the jump to the reading at `stamp`.
std::string TfPoseSource::jumpText(StampNs stamp) const {
  const auto& readings = odometry_.readings();
  const auto to =
      std::lower_bound(readings.begin(), readings.end(), stamp,
                       [](const StampedPose& reading, StampNs t) { return reading.stamp < t; });
  const StampedPose& a = *std::prev(to);
  char text[300];
  std::snprintf(
      text, sizeof(text),
      "the pose of %s in %s jumps by %.2f m and %.1f deg within %.3f s at %s: nothing is "
      "interpolated there, and points beyond it get status 4 (odometry.fastest_mps). Do two nodes "
      "publish it, or has a localisation found its place again?",
      config_.vehicle_frame.substr(0, 60).c_str(), config_.fixed_frame.substr(0, 60).c_str(),
      (to->T_fixed_vehicle.translation() - a.T_fixed_vehicle.translation()).norm(),
      Eigen::Quaterniond(a.T_fixed_vehicle.linear())
              .angularDistance(Eigen::Quaterniond(to->T_fixed_vehicle.linear())) *
          180.0 / kPi,
      toSeconds(to->stamp - a.stamp), seconds(a.stamp).c_str());
  return text;
}

std::string TfPoseSource::gap(StampNs from_ns, StampNs to_ns) {
  const PoseBuffer& poses = odometry();
  const std::vector<StampNs>& jumps = poses.jumps();
  const auto jump = std::upper_bound(jumps.begin(), jumps.end(), std::min(from_ns, to_ns));
  if (jump != jumps.end()) {
    const auto& readings = poses.readings();
    const auto behind =
        std::lower_bound(readings.begin(), readings.end(), *jump,
                         [](const StampedPose& reading, StampNs t) { return reading.stamp < t; });
    if (std::prev(behind)->stamp < std::max(from_ns, to_ns)) return jumpText(*jump);
  }
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
    const std::string missing = whatIsMissing(target, source);
    answer.message = "no transform from '" + source + "' to '" + target +
                     "': " + (missing.empty() ? e.what() : missing);
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
    answer.message = "no transform from '" + source + "' to '" + target + "': " + e.what();
    answer.problem = TransformProblem::kInvalidRequest;
  }
  return answer;
}

/// Why two frames are not joined: a frame that no transform has, or two trees; empty
/// if they are joined.
std::string TfPoseSource::whatIsMissing(const std::string& target,
                                        const std::string& source) const {
  constexpr std::size_t kMostCompared = 1000, kMostListed = 12;
  std::set<std::string> known;
  for (const auto& [child, edge] : edges_) {
    known.insert({child, edge.parent});
    if (known.size() > kMostCompared) return {};
  }
  const std::vector<std::string> names(known.begin(), known.end());
  for (const std::string& frame : {target, source}) {
    if (known.count(frame) > 0) continue;
    if (frame.empty()) return "the header.frame_id of its messages is empty";
    if (names.empty()) return "no transform came at all";
    const std::string text = "no transform has a frame '" + frame + "'";
    const std::string nearest = nearestName(frame, names);
    if (!nearest.empty()) return text + "; did you mean '" + nearest + "'?";
    const bool all = names.size() <= kMostListed;
    return text + ", of " +
           joined({names.begin(), all ? names.end() : names.begin() + kMostListed}) +
           (all ? "" : ", ...");
  }
  const std::string top_target = ancestors(target).back(), top_source = ancestors(source).back();
  if (top_target == top_source) return {};
  return "one hangs below '" + top_source + "', the other below '" + top_target +
         "', and nothing joins these";
}

/// A frame and those above it.
std::vector<std::string> TfPoseSource::ancestors(const std::string& frame) const {
  std::vector<std::string> chain{frame};
  for (auto edge = edges_.find(frame); edge != edges_.end() && chain.size() <= kMaxDepth;
       edge = edges_.find(chain.back())) {
    chain.push_back(edge->second.parent);
  }
  return chain;
}

/// T_fixed_vehicle at a time that all moving edges of the chain cover, without tf2.
std::optional<Transform> TfPoseSource::poseFromEdges(StampNs stamp) const {
  const std::vector<std::string> of_fixed = ancestors(config_.fixed_frame);
  const std::vector<std::string> of_vehicle = ancestors(config_.vehicle_frame);
  const auto joint =
      std::find_first_of(of_vehicle.begin(), of_vehicle.end(), of_fixed.begin(), of_fixed.end());
  if (joint == of_vehicle.end()) return std::nullopt;
  // T_joint_frame, up from `frame`.
  const auto below = [&](const std::vector<std::string>& frames) -> std::optional<Transform> {
    Transform T_here_frame = Transform::Identity();
    for (const std::string& frame : frames) {
      if (frame == *joint) break;
      const Edge& edge = edges_.at(frame);
      const std::optional<Transform> T_parent_here =
          edge.is_static ? edge.latest : poseOf(edge.poses, stamp);
      if (!T_parent_here) return std::nullopt;
      T_here_frame = *T_parent_here * T_here_frame;
    }
    return T_here_frame;
  };
  const std::optional<Transform> T_joint_fixed = below(of_fixed);
  const std::optional<Transform> T_joint_vehicle = below(of_vehicle);
  if (!T_joint_fixed || !T_joint_vehicle) return std::nullopt;
  return T_joint_fixed->inverse(Eigen::Isometry) * *T_joint_vehicle;
}

/// Finds the moving edges between the fixed frame and the vehicle; false if they are not joined.
bool TfPoseSource::findMovingEdges() {
  if (chain_is_known_) return true;
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
      edge.second.poses.clear();
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
    odometry_ = PoseBuffer(config_.history_ns, config_.fastest_mps);
    stands_still_ = false;
  }
  StampNs reached = std::numeric_limits<StampNs>::max();
  StampNs newest = 0;
  for (const std::string& child : moving_) {
    Edge& edge = edges_.at(child);
    wanted_.insert(edge.unread.begin(), edge.unread.end());
    edge.unread.clear();
    reached = std::min(reached, edge.newest);
    newest = std::max(newest, edge.newest);
  }
  while (!wanted_.empty() && *wanted_.begin() <= reached) {
    const StampNs stamp = *wanted_.begin();
    wanted_.erase(wanted_.begin());
    // A stamp before the first transform of another edge has no pose, now or later.
    const std::optional<Transform> pose =
        stamp + kOrderlyNs < newest
            ? poseFromEdges(stamp)
            : lookup(config_.fixed_frame, config_.vehicle_frame, rosTime(stamp)).transform;
    if (pose) addReading({stamp + config_.time_offset_ns, *pose});
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
    addReading({stampNs(message.header.stamp) + config_.time_offset_ns,
                transform(message.pose.pose) * T_child_vehicle});
    pending_.pop_front();
  }
  counters_.odometry_pending = pending_.size();
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Poses from tf or from nav_msgs/Odometry; the only place that looks transforms up.
///
/// Every transform is added as it comes. For each stamp of a moving edge between the fixed frame
/// and the vehicle, the pose is looked up once, as soon as all edges of that chain cover it; so the
/// core's PoseBuffer holds the very readings of the odometry, "closest reading" keeps its meaning,
/// and interpolation between readings equals tf2's own. Nothing here waits: ask for what is there.
/// Not thread-safe.
#pragma once

#include <geometry_msgs/TransformStamped.h>
#include <nav_msgs/Odometry.h>
#include <tf2/buffer_core.h>

#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/check/twist_watch.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/motion/pose_buffer.h"

namespace semantic_lidar_fusion {

enum class TransformProblem : std::uint8_t {
  kNone,
  kUnknownFrame,   ///< a frame was never seen
  kNotConnected,   ///< both frames are known, in different trees
  kNotCovered,     ///< the time is before or after what is known
  kInvalidRequest  ///< an empty frame name, a broken tree
};

/// What to do about transforms that are missing.
constexpr char kTransformCure[] =
    "publish it (what does not move on /tf_static), or give the bag that holds it, too";

/// A transform, or nothing and why.
struct TransformAnswer {
  std::optional<Transform> transform;
  TransformProblem problem = TransformProblem::kNone;
  std::string message;  ///< names the frames

  /// The message, and what to do about a transform that is missing.
  std::string advice() const;

  explicit operator bool() const { return transform.has_value(); }
};

struct TfPoseSourceConfig {
  std::string fixed_frame = "odom";
  std::string vehicle_frame = "base_link";
  OdometrySource source = OdometrySource::kTf;
  StampNs time_offset_ns = 0;         ///< of the odometry: true time = stamp + this
  StampNs history_ns = 0;             ///< how long readings and transforms are kept; 0 = for good
  double largest_coordinate_m = 1e8;  ///< larger translations are refused
  double fastest_mps = 100.0;         ///< faster steps are jumps; see PoseBuffer
};

TfPoseSourceConfig tfPoseSourceConfig(const Rig& rig, StampNs history_ns);

struct TfPoseSourceCounters {
  std::uint64_t transforms = 0;
  std::uint64_t rejected = 0;  ///< not finite, not a rotation, too far, stamp 0, empty frame,
                               ///< a moving transform of what /tf_static tells
  std::uint64_t repeated = 0;  ///< a second transform of one edge and stamp
  std::uint64_t odometry = 0;  ///< nav_msgs/Odometry
  std::uint64_t odometry_pending = 0;  ///< waiting for the transform from its child frame
};

class TfPoseSource {
 public:
  explicit TfPoseSource(TfPoseSourceConfig config);

  /// False if the transform is unusable (counted, see problem()) or known already.
  bool add(const geometry_msgs::TransformStamped& message, bool is_static);
  /// The pose of `child_frame_id` (empty: the vehicle) in `header.frame_id`, for source `topic`.
  /// False if unusable.
  bool add(const nav_msgs::Odometry& message);
  /// Whether a transform is one of the moving edges between the fixed frame and the vehicle.
  bool isOdometry(const geometry_msgs::TransformStamped& message);
  /// Counts a reading that was not added.
  void countRejected() { ++counters_.rejected; }
  /// Why the last `add` was refused; empty if it was not.
  const std::string& problem() const { return problem_; }
  /// What a user should know of the transforms (refused ones, two values of one that is static,
  /// jumps of the pose), as far as it was not told before: each once.
  std::vector<std::string> takeNotes();
  /// Forgets what moves, keeps static transforms and counters (a clock jump).
  void clear();

  /// T_target_source of frames that do not move against each other; frames joined by moving edges
  /// give their latest transform.
  TransformAnswer extrinsics(const std::string& target, const std::string& source) const;

  /// T_fixed_vehicle over time, with all that was added.
  const PoseBuffer& odometry();
  /// What odometry() does, but for sorting in what came late.
  void read();

  /// Why odometry does not cover `from_ns`..`to_ns` (true time), in words; empty if it does.
  std::string gap(StampNs from_ns, StampNs to_ns);

  const TfPoseSourceCounters& counters() const { return counters_; }

 private:
  struct Edge {
    std::string parent;
    bool is_static = false;
    StampNs newest = 0;
    std::deque<StampNs> unread;                ///< stamps whose pose is not in `odometry_` yet
    Transform first = Transform::Identity();   ///< of a static edge, or the first of a moving one
    Transform latest = Transform::Identity();  ///< in order of arrival
    bool changed = false;                      ///< `latest` ever differed from `first`
    std::map<StampNs, Transform> poses;        ///< of a moving edge of the chain
  };

  TransformAnswer lookup(const std::string& target, const std::string& source,
                         const ros::Time& time) const;
  bool refuse(const std::string& child, const std::string& what, const std::string& reason);
  void note(const std::string& key, const std::string& text) const;
  bool noteStaticValues(const geometry_msgs::TransformStamped& message, bool is_static,
                        const Transform& T_parent_child);
  void noteChangingExtrinsics(const std::string& target, const std::string& source) const;
  std::vector<std::string> ancestors(const std::string& frame) const;
  std::string whatIsMissing(const std::string& target, const std::string& source) const;
  std::optional<Transform> poseFromEdges(StampNs stamp) const;
  std::string jumpText(StampNs stamp) const;
  void addReading(const StampedPose& reading);
  void noteTwist(const nav_msgs::Odometry& message, const Transform& T_fixed_body);
  bool hasRoom(bool is_static);
  void forgetMoving();
  bool findMovingEdges();
  void readTf();
  void readPendingOdometry();

  TfPoseSourceConfig config_;
  TfPoseSourceCounters counters_;
  std::unique_ptr<tf2::BufferCore> buffer_;
  std::map<std::string, Edge> edges_;  ///< by child frame
  std::vector<std::string> moving_;    ///< children of the chain's moving edges
  bool chain_is_known_ = false;        ///< between the fixed frame and the vehicle
  bool stands_still_ = false;  ///< the chain has no moving edge: `odometry_` covers all times
  std::set<StampNs> wanted_;   ///< raw stamps to look up
  std::deque<nav_msgs::Odometry> pending_;  ///< without T_child_vehicle so far
  PoseBuffer odometry_;
  std::vector<StampedPose> late_;  ///< readings before the newest, to be sorted in
  std::string problem_;
  mutable std::set<std::string> asked_;     ///< frames that a transform was asked for
  mutable std::set<std::string> noted_;     ///< keys of what was told
  mutable std::vector<std::string> notes_;  ///< that were not taken
  TwistWatch twist_watch_;
};

}  // namespace semantic_lidar_fusion

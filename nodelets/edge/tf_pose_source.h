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

/// A transform, or nothing and why.
struct TransformAnswer {
  std::optional<Transform> transform;
  TransformProblem problem = TransformProblem::kNone;
  std::string message;  ///< names the frames

  explicit operator bool() const { return transform.has_value(); }
};

struct TfPoseSourceConfig {
  std::string fixed_frame = "odom";
  std::string vehicle_frame = "base_link";
  OdometrySource source = OdometrySource::kTf;
  StampNs time_offset_ns = 0;  ///< of the odometry: true time = stamp + this
  StampNs history_ns = 0;      ///< how long readings and transforms are kept; 0 = for good
};

TfPoseSourceConfig tfPoseSourceConfig(const Rig& rig, StampNs history_ns);

struct TfPoseSourceCounters {
  std::uint64_t transforms = 0;
  std::uint64_t rejected = 0;          ///< not finite, not a rotation, stamp 0, empty frame
  std::uint64_t repeated = 0;          ///< a second transform of one edge and stamp
  std::uint64_t odometry = 0;          ///< nav_msgs/Odometry
  std::uint64_t odometry_pending = 0;  ///< waiting for the transform from its child frame
};

class TfPoseSource {
 public:
  explicit TfPoseSource(TfPoseSourceConfig config);

  /// False if the transform is unusable (counted) or known already.
  bool add(const geometry_msgs::TransformStamped& message, bool is_static);
  /// The pose of `child_frame_id` (empty: the vehicle) in `header.frame_id`, for source `topic`.
  /// False if unusable.
  bool add(const nav_msgs::Odometry& message);
  /// Whether a transform is one of the moving edges between the fixed frame and the vehicle.
  bool isOdometry(const geometry_msgs::TransformStamped& message);
  /// Counts a reading that was not added.
  void countRejected() { ++counters_.rejected; }
  /// Forgets what moves, keeps static transforms and counters (a clock jump).
  void clear();

  /// T_target_source of frames that do not move against each other; frames joined by moving edges
  /// give their latest transform.
  TransformAnswer extrinsics(const std::string& target, const std::string& source) const;

  /// T_fixed_vehicle over time, with all that was added.
  const PoseBuffer& odometry();

  /// Why odometry does not cover `from_ns`..`to_ns` (true time), in words; empty if it does.
  std::string gap(StampNs from_ns, StampNs to_ns);

  const TfPoseSourceCounters& counters() const { return counters_; }

 private:
  struct Edge {
    std::string parent;
    bool is_static = false;
    StampNs newest = 0;
    std::deque<StampNs> unread;  ///< stamps whose pose is not in `odometry_` yet
  };

  TransformAnswer lookup(const std::string& target, const std::string& source,
                         const ros::Time& time) const;
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
};

}  // namespace semantic_lidar_fusion

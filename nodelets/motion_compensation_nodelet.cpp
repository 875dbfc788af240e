// SPDX-License-Identifier: MIT
/// Lidar scans -> one rigid cloud for each, as seen from the lidar's pose at t_ref.
///
/// A scan waits until t_ref is known and odometry covers the scan and t_ref, or until the timeout;
/// then what odometry does not cover is treated as `odometry.on_missing` says. Scans leave in
/// order. All callbacks run one at a time.
#include <algorithm>
#include <deque>
#include <memory>
#include <optional>
#include <pluginlib/class_list_macros.hpp>
#include <string>
#include <utility>

#include "base/fusion_nodelet.h"
#include "edge/conversions.h"
#include "edge/lidar_decoder.h"
#include "edge/tf_subscription.h"
#include "edge/topics.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "semantic_lidar_fusion/sync/epoch_monitor.h"
#include "semantic_lidar_fusion/sync/stamped_store.h"
#include "semantic_lidar_fusion/sync/waiting_room.h"

namespace semantic_lidar_fusion {
namespace {

constexpr std::size_t kKnownReferences = 128;
constexpr StampNs kReferenceGraceNs = 500000000;
/// Points of all scans that wait: a bound of memory where large scans come too fast.
constexpr std::size_t kPendingPoints = 8000000;

}  // namespace

class MotionCompensationNodelet : public FusionNodelet {
 public:
  ~MotionCompensationNodelet() override { stop(); }

 private:
  struct Scan {
    TimedCloud cloud;
    ScanInterval interval;
    StampNs arrived_ns = 0;
  };
  struct Reference {
    StampNs reference_ns = 0;
    StampNs arrived_ns = 0;
  };

  void initialize() override {
    pipeline_ = std::make_unique<ScanPipeline>(rig(), PipelineSteps{PipelineStep::kCompensate});
    lidar_ = std::make_unique<LidarDecoder>(
        rig().lidar,
        [this](const std::string& reason, std::uint64_t count) { onDropped(reason, count); },
        [this](const std::string& reason, std::uint64_t count) {
          health().count("left out: " + reason, count);
        });
    // The selection nodelet settles t_ref within its own timeout; the rest is grace for its thread.
    longest_reference_wait_ns_ = toNs(rig().reference.timeout_s) + kReferenceGraceNs;
    room_ = WaitingRoom(longest_reference_wait_ns_ + toNs(rig().odometry.timeout_s));
    epochs_ = watchedEpochs({rig().lidar.topic}, [this] { forget(); });
    tf_ = std::make_unique<TfSubscription>(getNodeHandle(), rig());
    output_ = advertise<sensor_msgs::PointCloud2>(getNodeHandle(), "points_compensated", 4);
    startTicking();
  }

  void updateSubscriptions() override {
    const bool wanted = isWanted(output_);
    if (wanted && !references_subscriber_) {
      references_subscriber_ = subscribe<sensor_msgs::TimeReference>(
          getNodeHandle(), "scan_reference", 16, &MotionCompensationNodelet::onReference);
      lidar_subscriber_ =
          rig().lidar.input == LidarInput::kPackets
              ? subscribe<VelodyneScan>(getNodeHandle(), rig().lidar.topic, 8,
                                        &MotionCompensationNodelet::onScan<VelodyneScan>)
              : subscribe<sensor_msgs::PointCloud2>(
                    getNodeHandle(), rig().lidar.topic, 8,
                    &MotionCompensationNodelet::onScan<sensor_msgs::PointCloud2>);
    } else if (!wanted && references_subscriber_) {
      unsubscribe(&references_subscriber_);
      unsubscribe(&lidar_subscriber_);
    }
  }

  template <class M>
  void onScan(const boost::shared_ptr<const M>& message) {
    const auto scan = std::make_shared<Scan>();
    {
      const StageTimer timer(health(), "decode");
      scan->cloud = lidar_->decode(*message);
    }
    reportNotes();
    rigWatch().lookAtScan(scan->cloud);
    scan->interval = scanInterval(scan->cloud);
    if (scan->interval.first_ns <= 0) {  // the selection nodelet says it; it is no jump of time
      health().count("dropped: scan of stamp 0");
      return;
    }
    admit(
        epochs_.get(), rig().lidar.topic, scan->interval.first_ns,
        [this, scan] { onAdmitted(std::move(*scan)); }, timeTolerance(scan->cloud));
  }

  void onAdmitted(Scan scan) {
    StampNs& last_ns = scan.cloud.empty() ? last_empty_ns_ : last_first_ns_;
    if (scan.interval.first_ns == last_ns) {
      health().count("dropped: scan of a known stamp");
      return;
    }
    last_ns = scan.interval.first_ns;
    if (!scan.cloud.empty()) {
      room_.observe(last_ns);
      references_.grow(2 * room_.capacity());
    }
    enqueue(std::move(scan));
  }

  void enqueue(Scan scan) {
    scan.arrived_ns = now();
    pending_.push_back(std::move(scan));
    std::size_t points = 0;
    for (const Scan& waiting : pending_) points += waiting.cloud.size();
    while (pending_.size() > room_.capacity() || (pending_.size() > 1 && points > kPendingPoints)) {
      points -= pending_.front().cloud.size();
      pending_.pop_front();
      health().count("dropped: scan, too many wait for odometry or scan_reference");
      warn("pending", "a scan is dropped: " + std::to_string(pending_.size()) +
                          " others wait for odometry or scan_reference");
    }
    release();
  }

  void onDropped(const std::string& reason, std::uint64_t count) {
    if (count == 0) return;
    health().count("dropped: " + reason, count);
    const std::string topic = getNodeHandle().resolveName(rig().lidar.topic);
    warn("lidar " + reason, topic + ": " + std::to_string(count) + " " + reason +
                                " in a scan; the rest of the scan is used");
  }

  /// Tells once how the lidar's messages are understood.
  void reportNotes() {
    for (const LidarDecoder::Note& note : lidar_->takeNotes()) {
      if (note.warning) {
        NODELET_WARN_STREAM(rig().lidar.topic << ": " << note.text);
      } else {
        NODELET_INFO_STREAM(rig().lidar.topic << ": " << note.text);
      }
    }
    health().set("point times", lidar_->timeDecision());
  }

  void onReference(const sensor_msgs::TimeReferenceConstPtr& message) {
    const StampNs scan_ns = stampNs(message->header.stamp);
    admit(epochs_.get(), "scan_reference", scan_ns, [this, scan_ns, message] {
      references_.put(scan_ns, {stampNs(message->time_ref), now()});
      release();
    });
  }

  void tick(StampNs /*now_ns*/) override { release(); }

  void forget() {
    health().count("dropped: scan pending at a clock jump", pending_.size());
    pending_.clear();
    references_.clear();
    last_first_ns_ = last_empty_ns_ = 0;
  }

  /// Publishes the scans at the front of the queue that need not wait any longer.
  void release() {
    while (!pending_.empty()) {
      const Scan& scan = pending_.front();
      if (scan.cloud.empty()) {  // has no time that a t_ref or odometry could belong to
        health().count("empty scans");
        TimedCloud empty = std::move(pending_.front().cloud);
        pending_.pop_front();
        publishCompensated(std::move(empty), 0, std::nullopt);
        continue;
      }
      const Reference* reference = references_.find(scan.interval.first_ns);
      if (reference == nullptr) {
        if (now() - scan.arrived_ns < longest_reference_wait_ns_) return;
        health().count("dropped: scan without scan_reference");
        warn("reference",
             "a scan is dropped: no scan_reference for its first point in " +
                 std::to_string(toSeconds(longest_reference_wait_ns_)) +
                 " s; is the selection nodelet fed with the same lidar topic and rig?");
        pending_.pop_front();
        continue;
      }
      const StampNs t_ref = reference->reference_ns;
      const StampNs from_ns = std::min(scan.interval.first_ns, t_ref);
      const StampNs to_ns = std::max(scan.interval.last_ns, t_ref);
      const std::string gap = rig().motion_enabled ? tf_->source().gap(from_ns, to_ns) : "";
      const TransformAnswer T_vehicle_lidar =
          tf_->source().extrinsics(rig().vehicle_frame, scan.cloud.frame_id);
      const bool complete = gap.empty() && (T_vehicle_lidar || !rig().motion_enabled);
      const StampNs waited_since = std::max(scan.arrived_ns, reference->arrived_ns);
      if (!complete && now() - waited_since < toNs(rig().odometry.timeout_s)) return;
      if (!complete) tellIncomplete(gap, T_vehicle_lidar);
      Scan leaving = std::move(pending_.front());
      pending_.pop_front();  // first: an error must not meet it again
      publishCompensated(std::move(leaving.cloud), t_ref, T_vehicle_lidar.transform);
    }
  }

  /// Why a scan leaves without all poses, after the wait for them.
  void tellIncomplete(const std::string& gap, const TransformAnswer& T_vehicle_lidar) {
    const std::string after = " after " + std::to_string(rig().odometry.timeout_s) + " s: ";
    if (T_vehicle_lidar) {
      health().problem("odometry timeouts");
      warn("odometry", "scan without full odometry" + after + gap);
    } else {
      health().problem("no extrinsics of the lidar");
      warn("extrinsics", "scan without extrinsics of the lidar" + after + T_vehicle_lidar.advice());
    }
  }

  void publishCompensated(TimedCloud scan, StampNs t_ref,
                          const std::optional<Transform>& T_vehicle_lidar) {
    if (T_vehicle_lidar && rig().motion_enabled) {
      rigWatch().lookAtMotion(scan, tf_->source().odometry(), *T_vehicle_lidar);
    }
    CompensationResult compensated;
    {
      const StageTimer timer(health(), "compensation");
      compensated =
          pipeline_->compensate(std::move(scan), t_ref, tf_->source().odometry(), T_vehicle_lidar);
    }
    const CompensationCounters& counters = compensated.counters;
    health().count("points", compensated.cloud.size());
    health().count("points without odometry: marked", counters.marked_points);
    health().count("points without odometry: dropped", counters.dropped_points);
    health().count("points without odometry: pose held", counters.held_points);
    health().count("points without odometry: pose extrapolated", counters.extrapolated_points);
    publish(output_, compensatedCloudMessage(compensated.cloud));
  }

  std::unique_ptr<ScanPipeline> pipeline_;
  std::unique_ptr<LidarDecoder> lidar_;
  std::unique_ptr<TfSubscription> tf_;
  std::unique_ptr<EpochMonitor> epochs_;
  StampNs last_first_ns_ = 0;  ///< of the last scan with points
  StampNs last_empty_ns_ = 0;  ///< of the last scan without
  StampedStore<Reference> references_{kKnownReferences};
  std::deque<Scan> pending_;
  WaitingRoom room_{0};
  StampNs longest_reference_wait_ns_ = 0;
  ros::Publisher output_;
  ros::Subscriber references_subscriber_, lidar_subscriber_;
};

}  // namespace semantic_lidar_fusion

PLUGINLIB_EXPORT_CLASS(semantic_lidar_fusion::MotionCompensationNodelet, nodelet::Nodelet)

// SPDX-License-Identifier: MIT
/// Stamps of scans and images -> t_ref of each scan and one image per camera, published as the
/// messages that came in. All callbacks run one at a time.
#include <memory>
#include <optional>
#include <pluginlib/class_list_macros.hpp>
#include <string>
#include <vector>

#include "base/fusion_nodelet.h"
#include "edge/camera_geometry.h"
#include "edge/conversions.h"
#include "edge/lidar_decoder.h"
#include "edge/tf_subscription.h"
#include "edge/topics.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "semantic_lidar_fusion/sync/epoch_monitor.h"
#include "semantic_lidar_fusion/sync/scan_selector.h"
#include "semantic_lidar_fusion/sync/stamped_store.h"

namespace semantic_lidar_fusion {
namespace {

/// Images kept per camera until no scan can choose them any more, at most: 2 s at 30 Hz, or 1.2 s
/// of raw 1920x1208.
constexpr std::size_t kMaxImages = 64;
constexpr std::size_t kMaxImageBytes = 256u << 20;
constexpr std::size_t kKnownStamps = 64;

}  // namespace

class ImageSelectionNodelet : public FusionNodelet {
 public:
  ~ImageSelectionNodelet() override { stop(); }

 private:
  struct Image {
    sensor_msgs::ImageConstPtr raw;
    sensor_msgs::CompressedImageConstPtr compressed;
    std::size_t bytes() const { return raw ? raw->data.size() : compressed->data.size(); }
  };
  struct Camera {
    explicit Camera(const CameraConfig& config) : config(config), geometry(config) {}

    const CameraConfig& config;
    CameraGeometry geometry;
    StampedStore<Image> images{kMaxImages};
    StampedStore<bool> semantics{kKnownStamps};  ///< free-running network: stamps with scores
    StampedStore<bool> sent{kKnownStamps};       ///< images that are published
    ros::Publisher selection, image_selected;
    ros::Subscriber images_subscriber, semantics_subscriber, info_subscriber;
  };

  void initialize() override {
    selector_ = std::make_unique<ScanSelector>(rig().selectorConfig());
    // The motion nodelet decodes the same messages, and counts.
    epochs_ = watchedEpochs({rig().lidar.topic}, [this] { forget(); });
    lidar_ = std::make_unique<LidarDecoder>(rig().lidar, [](const std::string&, std::uint64_t) {});
    sweep_ = rig().image_choice == ImageChoice::kClosestToSweep;
    if (sweep_) tf_ = std::make_unique<TfSubscription>(getNodeHandle(), rig());
    reference_ = advertise<sensor_msgs::TimeReference>(getNodeHandle(), "scan_reference", 16);
    for (const CameraConfig& config : rig().cameras) {
      cameras_.push_back(std::make_unique<Camera>(config));
      Camera& camera = *cameras_.back();
      camera.selection = advertise<sensor_msgs::TimeReference>(
          getNodeHandle(), cameraTopic(config, "selection"), 16);
      camera.image_selected =
          advertise<sensor_msgs::Image>(getNodeHandle(), cameraTopic(config, "image_selected"), 4);
      subscribeInfo(&camera);
    }
    followTuning();
    startTicking();
  }

  void rigChanged() override {
    for (std::size_t i = 0; i < rig().cameras.size(); ++i) {
      selector_->setTimeOffset(static_cast<int>(i), toNs(rig().cameras[i].time_offset_s));
    }
  }

  void updateSubscriptions() override {
    bool wanted = isWanted(reference_);
    for (const auto& camera : cameras_) {
      wanted = wanted || isWanted(camera->selection) || isWanted(camera->image_selected);
    }
    if (wanted == static_cast<bool>(lidar_subscriber_)) return;
    if (!wanted) {
      unsubscribe(&lidar_subscriber_);
      for (const auto& camera : cameras_) {
        unsubscribe(&camera->images_subscriber);
        unsubscribe(&camera->semantics_subscriber);
      }
      return;
    }
    for (std::size_t i = 0; i < cameras_.size(); ++i) subscribeCamera(static_cast<int>(i));
    lidar_subscriber_ = rig().lidar.input == LidarInput::kPackets
                            ? subscribe<VelodyneScan>(getNodeHandle(), rig().lidar.topic, 8,
                                                      &ImageSelectionNodelet::onScan<VelodyneScan>)
                            : subscribe<sensor_msgs::PointCloud2>(
                                  getNodeHandle(), rig().lidar.topic, 8,
                                  &ImageSelectionNodelet::onScan<sensor_msgs::PointCloud2>);
  }

  void subscribeCamera(int index) {
    Camera& camera = *cameras_[static_cast<std::size_t>(index)];
    const CameraConfig& config = camera.config;
    if (config.transport == ImageTransport::kCompressed) {
      camera.images_subscriber = subscribe<sensor_msgs::CompressedImage>(
          getNodeHandle(), imageTopic(config), 32,
          [this, index](const sensor_msgs::CompressedImageConstPtr& image) {
            onImage(index, {nullptr, image}, stampNs(image->header.stamp));
          });
    } else {
      camera.images_subscriber = subscribe<sensor_msgs::Image>(
          getNodeHandle(), imageTopic(config), 32,
          [this, index](const sensor_msgs::ImageConstPtr& image) {
            onImage(index, {image, nullptr}, stampNs(image->header.stamp));
          });
    }
    if (semanticsComeAlone()) {
      camera.semantics_subscriber = subscribe<sensor_msgs::Image>(
          getNodeHandle(), semanticsTopic(rig(), config), 32,
          [this, index](const sensor_msgs::ImageConstPtr& scores) { onSemantics(index, *scores); });
    }
  }

  /// Read from the start: it may be latched, or come only once. The projection tells what is wrong
  /// with it, or that it is missing.
  void subscribeInfo(Camera* camera) {
    camera->info_subscriber = subscribe<sensor_msgs::CameraInfo>(
        getNodeHandle(), inputTopic(camera->config, camera->config.camera_info), 8,
        [camera](const sensor_msgs::CameraInfoConstPtr& info) {
          try {
            camera->geometry.update(*info);
          } catch (const DataError&) {
          }
        },
        Health::Expect::kOnce);
    health().retireInput(camera->info_subscriber.getTopic());
  }

  /// A free-running network of another node: its scores come whether or not an image is chosen.
  bool semanticsComeAlone() const {
    return rig().segmentation.mode == SegmentationMode::kFreeRunning &&
           rig().segmentation.model.empty();
  }

  void onImage(int index, const Image& image, StampNs stamp) {
    Camera& camera = *cameras_[static_cast<std::size_t>(index)];
    if (!isStamped(imageTopic(camera.config), stamp)) return;
    lookAtArrival(imageTopic(camera.config), stamp);
    admit(epochs_.get(), imageTopic(camera.config), trueImageTime(camera, stamp),
          [this, index, image, stamp, &camera] {
            camera.images.put(stamp, image);
            camera.images.trim(kMaxImageBytes, [](const Image& held) { return held.bytes(); });
            offer(index, stamp);
          });
  }

  void onSemantics(int index, const sensor_msgs::Image& scores) {
    Camera& camera = *cameras_[static_cast<std::size_t>(index)];
    const StampNs stamp = stampNs(scores.header.stamp);
    const std::string topic = semanticsTopic(rig(), camera.config);
    if (scores.data.empty() || !isStamped(topic, stamp)) return;
    admit(epochs_.get(), topic, trueImageTime(camera, stamp), [this, index, stamp, &camera] {
      camera.semantics.put(stamp, true);
      offer(index, stamp);
    });
  }

  /// Lets an image be chosen once the parts of it that must be there have come.
  void offer(int index, StampNs stamp) {
    const Camera& camera = *cameras_[static_cast<std::size_t>(index)];
    const ImageParts parts{camera.images.find(stamp) != nullptr,
                           camera.semantics.find(stamp) != nullptr};
    if (!isCandidate(camera.config.input, parts, !semanticsComeAlone())) return;
    selector_->addImage(index, stamp);
    decide();
  }

  template <class M>
  void onScan(const boost::shared_ptr<const M>& message) {
    SelectorScan scan;
    bool empty = false;
    StampNs tolerance_ns = 0;
    {
      const StageTimer timer(health(), "decode");
      const TimedCloud cloud = lidar_->decode(*message);
      scan.interval = scanInterval(cloud);
      if (!isStamped(rig().lidar.topic, scan.interval.first_ns)) return;
      empty = cloud.empty();
      tolerance_ns = timeTolerance(cloud);
      if (!empty) lookAtArrival(rig().lidar.topic, cloud.header_stamp);
      if (sweep_ && !empty) scan.sweep_ns = sweepTimes(cloud);
    }
    const auto use = [this, scan, empty] {
      if (empty) {  // nothing to choose images for; it tells where the lidar's time is
        health().count("empty scans");
        return;
      }
      selector_->addScan(scan, now());
      decide();
    };
    admit(epochs_.get(), rig().lidar.topic, scan.interval.first_ns, use, tolerance_ns);
  }

  std::vector<std::optional<StampNs>> sweepTimes(const TimedCloud& cloud) {
    std::vector<std::optional<StampNs>> times;
    for (const auto& camera : cameras_) {
      times.emplace_back();
      if (!camera->geometry.model()) continue;
      const TransformAnswer T_camera_lidar =
          tf_->source().extrinsics(camera->geometry.frame(), cloud.frame_id);
      if (!T_camera_lidar) {
        warn("extrinsics " + camera->config.name, T_camera_lidar.message);
        continue;
      }
      times.back() = sweepTime(cloud, {camera->geometry.model(),
                                       camera->config.nudge.applied(*T_camera_lidar.transform)});
    }
    return times;
  }

  /// False for a stamp that cannot be used.
  bool isStamped(const std::string& topic, StampNs stamp) {
    if (stamp > 0) return true;
    health().count("dropped: stamp 0 on " + topic);
    error("stamp " + topic, topic + ": header.stamp is 0; it must be the time of measurement");
    return false;
  }

  void forget() {
    selector_->reset();
    for (const auto& camera : cameras_) {
      camera->images.clear();
      camera->semantics.clear();
      camera->sent.clear();
    }
  }

  StampNs trueImageTime(const Camera& camera, StampNs stamp) const {
    return stamp + toNs(camera.config.time_offset_s);
  }

  void tick(StampNs /*now_ns*/) override { decide(); }

  void decide() {
    const SelectorDecisions decisions = selector_->advance(now());
    for (const ReferenceDecision& decision : decisions.references) {
      if (decision.timed_out) {
        health().problem("t_ref is the middle of the scan: no reference image in time");
      }
      guard("scan_reference", [&] {
        publish(reference_, boost::make_shared<sensor_msgs::TimeReference>(
                                scanReferenceMessage(decision.scan_ns, decision.reference_ns)));
      });
    }
    for (const SelectionDecision& decision : decisions.selections) {
      guard("selection", [&] { publishSelection(decision); });
    }
    for (const DroppedScan& scan : decisions.dropped) {
      switch (scan.reason) {
        case DropReason::kQueueFull:
          health().count("dropped: scan, too many wait for images");
          warn("overflow", "a scan is dropped: too many wait for images");
          break;
        case DropReason::kNewEpoch:
          health().count("dropped: scan pending at a clock jump");
          break;
        case DropReason::kTooOld:
          health().count("dropped: scan older than all that are remembered");
          break;
      }
    }
    const std::uint64_t duplicates = selector_->counters().scans_duplicate;
    health().count("dropped: scan of a known stamp", duplicates - reported_duplicates_);
    reported_duplicates_ = duplicates;
    health().set("pending scans", std::to_string(selector_->pendingScans()));
  }

  void publishSelection(const SelectionDecision& decision) {
    Camera& camera = *cameras_[static_cast<std::size_t>(decision.camera)];
    const std::string& name = camera.config.name;
    if (!decision.image_stamp) {
      health().problem(name +
                       (decision.timed_out ? ": no image, timed out" : ": no image in time"));
    }
    publish(camera.selection, boost::make_shared<sensor_msgs::TimeReference>(
                                  selectionMessage(decision.scan_ns, decision.image_stamp, name)));
    if (!decision.image_stamp) return;
    // Scans come in order: the next one chooses this image again, or one after it.
    camera.images.eraseBefore(*decision.image_stamp);
    if (camera.sent.find(*decision.image_stamp) != nullptr ||
        camera.image_selected.getNumSubscribers() == 0) {
      return;
    }
    const Image* image = camera.images.find(*decision.image_stamp);
    if (image == nullptr && camera.config.input == CameraInput::kProbabilities) return;
    if (image == nullptr) {
      health().count("dropped: " + name + " image left the buffer before it was chosen");
      return;
    }
    camera.sent.put(*decision.image_stamp, true);
    guard(imageTopic(camera.config), [&] { publishImage(camera, *image); });
  }

  void publishImage(const Camera& camera, const Image& image) {
    std::optional<ImageSize> wanted;
    if (camera.geometry.model()) wanted = camera.geometry.model()->imageSize();
    if (image.raw) {
      checkImageSize(imageSize(*image.raw), wanted);
      camera.image_selected.publish(image.raw);
      health().published(camera.image_selected.getTopic());
    } else {
      const StageTimer timer(health(), "decompression");
      publish(camera.image_selected,
              imageMessage(decodedImage(*image.compressed, wanted), image.compressed->header));
    }
  }

  std::unique_ptr<ScanSelector> selector_;
  std::unique_ptr<LidarDecoder> lidar_;
  std::unique_ptr<TfSubscription> tf_;
  bool sweep_ = false;
  std::unique_ptr<EpochMonitor> epochs_;
  std::vector<std::unique_ptr<Camera>> cameras_;
  std::uint64_t reported_duplicates_ = 0;
  ros::Publisher reference_;
  ros::Subscriber lidar_subscriber_;
};

}  // namespace semantic_lidar_fusion

PLUGINLIB_EXPORT_CLASS(semantic_lidar_fusion::ImageSelectionNodelet, nodelet::Nodelet)

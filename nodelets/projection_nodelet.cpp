// SPDX-License-Identifier: MIT
/// Compensated clouds and the semantics of the selected images -> the semantic cloud.
///
/// Scans wait in a FusionQueue until each camera is ready, has no image, or is late. All callbacks
/// run one at a time.
#include <algorithm>
#include <cstdio>
#include <memory>
#include <optional>
#include <pluginlib/class_list_macros.hpp>
#include <string>
#include <utility>
#include <vector>

#include "base/fusion_nodelet.h"
#include "base/tuning_server.h"
#include "edge/camera_geometry.h"
#include "edge/conversions.h"
#include "edge/tf_subscription.h"
#include "edge/topics.h"
#include "semantic_lidar_fusion/fusion/calibration_notes.h"
#include "semantic_lidar_fusion/fusion/lidar_rows.h"
#include "semantic_lidar_fusion/fusion/report_pixels.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "semantic_lidar_fusion/overlay/overlay.h"
#include "semantic_lidar_fusion/sync/epoch_monitor.h"
#include "semantic_lidar_fusion/sync/fusion_queue.h"
#include "semantic_lidar_fusion/sync/stamped_store.h"

namespace semantic_lidar_fusion {
namespace {

/// Images whose semantics are kept per camera until no scan can choose them any more, at most. One
/// image can serve two scans; a free-running network sends scores of images long before a scan
/// chooses one: 0.8 s at 30 Hz.
constexpr std::size_t kKeptImages = 24;
/// The same by size: nine times 960x604x12 floats.
constexpr std::size_t kMaxSemanticsBytes = 256u << 20;

std::string fixed(double value) {
  char text[32];
  std::snprintf(text, sizeof(text), "%.3f", value);
  return text;
}

}  // namespace

class ProjectionNodelet : public FusionNodelet {
 public:
  ~ProjectionNodelet() override { stop(); }

 private:
  /// The parts of one image's semantics, as they come.
  struct Semantics {
    sensor_msgs::ImageConstPtr scores, share, probabilities;
    bool announced = false;  ///< told to the queue

    std::size_t bytes() const {
      std::size_t sum = 0;
      for (const auto& part : {scores, share, probabilities}) sum += part ? part->data.size() : 0;
      return sum;
    }
  };
  struct Camera {
    Camera(const CameraConfig& config, int index)
        : config(config), index(index), geometry(config) {}

    const CameraConfig& config;
    int index;  ///< in the rig file
    CameraGeometry geometry;
    StampedStore<Semantics> semantics{kKeptImages};
    StampedStore<sensor_msgs::ImageConstPtr> images{kKeptImages};  ///< for the overlay
    ros::Publisher overlay, pixels;
    ros::Subscriber info, selection, scores, share, probabilities, image;
  };

  void initialize() override {
    pipeline_ = std::make_unique<ScanPipeline>(
        rig(), PipelineSteps{PipelineStep::kView, PipelineStep::kFuse});
    lidar_rows_ = std::make_unique<LidarRows>(rig());

    FusionQueueConfig queue;
    for (const CameraConfig& camera : rig().cameras) {
      queue.timeout_ns.push_back(toNs(camera.timeout_s));
    }
    // A selection is settled within the longer of both waits, from the scan on.
    queue.selection_grace_ns += toNs(rig().reference.timeout_s);
    queue_ = std::make_unique<FusionQueue>(queue);
    // The selection nodelet has told jumps of the lidar's time from errors.
    epochs_ = watchedEpochs({"scan_reference", 1}, [this] { forget(); });
    tf_ = std::make_unique<TfSubscription>(getNodeHandle(), rig());

    class_info_ = getNodeHandle().advertise<std_msgs::String>("class_info", 1, true);
    class_info_.publish(classInfoMessage(rig().classes));
    output_ = advertise<sensor_msgs::PointCloud2>(getNodeHandle(), "points_semantic", 4);
    for (std::size_t i = 0; i < rig().cameras.size(); ++i) {
      cameras_.push_back(std::make_unique<Camera>(rig().cameras[i], static_cast<int>(i)));
      Camera& camera = *cameras_.back();
      camera.overlay = advertise<sensor_msgs::Image>(
          getNodeHandle(), cameraTopic(camera.config, "projection_overlay"), 2);
      camera.pixels = advertise<sensor_msgs::PointCloud2>(
          getNodeHandle(), cameraTopic(camera.config, "points_pixel"), 2);
      // Camera_info is read from the start: it may be latched, or come only once.
      camera.info = subscribe<sensor_msgs::CameraInfo>(
          getNodeHandle(), inputTopic(camera.config, camera.config.camera_info), 8,
          [this, &camera](const sensor_msgs::CameraInfoConstPtr& info) {
            camera.geometry.update(*info);
            if (!camera.geometry.info() || !camera.geometry.model()) return;
            rigWatch().lookAtInfo(static_cast<std::size_t>(camera.index), *camera.geometry.info(),
                                  *camera.geometry.model());
          },
          Health::Expect::kOnce);
      if (camera.config.withoutCameraInfo()) health().retireInput(camera.info.getTopic());
    }
    startTicking();
    tuning_ = std::make_unique<TuningServer>(
        getPrivateNodeHandle(), rig(), [this](const Rig& tuned) { tune(tuned); },
        [this](const std::string& problem) { error("tuning", "set_parameters: " + problem); });
  }

  void rigChanged() override { pipeline_->retune(rig()); }

  void updateSubscriptions() override {
    bool wanted = isWanted(output_);
    for (const auto& camera : cameras_) {
      wanted = wanted || isWanted(camera->overlay) || isWanted(camera->pixels);
    }
    for (const auto& camera : cameras_) updateCamera(wanted, camera.get());
    if (wanted && !cloud_subscriber_) {
      reference_subscriber_ = subscribe<sensor_msgs::TimeReference>(
          getNodeHandle(), "scan_reference", 16, &ProjectionNodelet::onReference);
      cloud_subscriber_ = subscribe<sensor_msgs::PointCloud2>(getNodeHandle(), "points_compensated",
                                                              8, &ProjectionNodelet::onCloud);
    } else if (!wanted && cloud_subscriber_) {
      unsubscribe(&reference_subscriber_);
      unsubscribe(&cloud_subscriber_);
    }
  }

  void updateCamera(bool wanted, Camera* camera) {
    const CameraConfig& config = camera->config;
    const auto images =
        [&](bool needed, const std::string& topic, ros::Subscriber* subscriber,
            void (ProjectionNodelet::*callback)(Camera*, const sensor_msgs::ImageConstPtr&)) {
          if (needed && !*subscriber) {
            *subscriber = subscribe<sensor_msgs::Image>(
                getNodeHandle(), topic, 32,
                [this, camera, callback](const sensor_msgs::ImageConstPtr& message) {
                  (this->*callback)(camera, message);
                });
          } else if (!needed && *subscriber) {
            unsubscribe(subscriber);
          }
        };
    if (wanted && !camera->selection) {
      camera->selection = subscribe<sensor_msgs::TimeReference>(
          getNodeHandle(), cameraTopic(config, "selection"), 16,
          [this, camera](const sensor_msgs::TimeReferenceConstPtr& message) {
            onSelection(camera, *message);
          });
    } else if (!wanted && camera->selection) {
      unsubscribe(&camera->selection);
    }
    const bool scores = !transfersProbabilities(rig(), config);
    images(wanted && scores, semanticsTopic(rig(), config), &camera->scores,
           &ProjectionNodelet::onScores);
    images(wanted && scores, cameraTopic(config, "share"), &camera->share,
           &ProjectionNodelet::onShare);
    // Made by the superpixel nodelet, unless another node gives them.
    images(wanted && !scores,
           config.input == CameraInput::kProbabilities ? semanticsTopic(rig(), config)
                                                       : cameraTopic(config, "probabilities"),
           &camera->probabilities, &ProjectionNodelet::onProbabilities);
    images(wanted && (isWanted(camera->overlay) || rig().check.live),
           cameraTopic(config, "image_selected"), &camera->image, &ProjectionNodelet::onImage);
  }

  // --- Inputs

  void onReference(const sensor_msgs::TimeReferenceConstPtr& message) {
    const StampNs scan_ns = stampNs(message->header.stamp);
    admit(epochs_.get(), "scan_reference", scan_ns, [this, scan_ns, message] {
      queue_->addReference(scan_ns, stampNs(message->time_ref));
      fuseComplete();
    });
  }

  void onSelection(Camera* camera, const sensor_msgs::TimeReference& message) {
    const StampNs scan_ns = stampNs(message.header.stamp);
    const StampNs image_stamp = stampNs(message.time_ref);
    admit(epochs_.get(), camera->config.name + " selection", scan_ns,
          [this, camera, scan_ns, image_stamp] {
            queue_->addSelection(scan_ns, camera->index,
                                 image_stamp == 0 ? std::nullopt : std::make_optional(image_stamp),
                                 now());
            fuseComplete();
          });
  }

  void onCloud(const sensor_msgs::PointCloud2ConstPtr& message) {
    const auto cloud = std::make_shared<const Cloud>(compensatedCloud(*message));
    if (cloud->empty()) {  // has no scan_reference that would tell its epoch, and needs none
      addCloud(cloud);
      return;
    }
    admit(epochs_.get(), "points_compensated", cloud->stamp, [this, cloud] { addCloud(cloud); });
  }

  void addCloud(const std::shared_ptr<const Cloud>& cloud) {
    const FusionQueueCounters before = queue_->counters();
    queue_->addCloud(cloud, now());
    const FusionQueueCounters& after = queue_->counters();
    health().count("dropped: scan behind the last one, or known",
                   after.out_of_order - before.out_of_order);
    if (after.overflow > before.overflow) {
      health().count("dropped: scan, too many wait for cameras", after.overflow - before.overflow);
      warn("pending", "a scan is dropped: too many others wait for cameras");
    }
    fuseComplete();
  }

  void onScores(Camera* camera, const sensor_msgs::ImageConstPtr& message) {
    addSemantics(camera, "scores", message, &Semantics::scores);
  }
  void onShare(Camera* camera, const sensor_msgs::ImageConstPtr& message) {
    addSemantics(camera, "share", message, &Semantics::share);
  }
  void onProbabilities(Camera* camera, const sensor_msgs::ImageConstPtr& message) {
    addSemantics(camera, "probabilities", message, &Semantics::probabilities);
  }

  void addSemantics(Camera* camera, const std::string& source,
                    const sensor_msgs::ImageConstPtr& message,
                    sensor_msgs::ImageConstPtr Semantics::*part) {
    const StampNs stamp = stampNs(message->header.stamp);
    admit(epochs_.get(), camera->config.name + " " + source,
          stamp + toNs(camera->config.time_offset_s), [this, camera, stamp, message, part] {
            if (message->width == 0 || message->height == 0) {
              health().problem(camera->config.name +
                               ": the network gave no scores for a selected image");
              queue_->setSemantics(camera->index, stamp, false);
            } else {
              if (camera->semantics.find(stamp) == nullptr) camera->semantics.put(stamp, {});
              if (Semantics* known = camera->semantics.find(stamp)) known->*part = message;
              health().count(
                  "dropped: " + camera->config.name + " semantics, more wait than memory is for",
                  camera->semantics.trim(kMaxSemanticsBytes,
                                         [](const Semantics& held) { return held.bytes(); }));
            }
            fuseComplete();
          });
  }

  void onImage(Camera* camera, const sensor_msgs::ImageConstPtr& message) {
    // Images are large: for the check they are kept only while one is due.
    if (camera->overlay.getNumSubscribers() == 0 && !rigWatch().edgesAreDue()) {
      camera->images.clear();
      return;
    }
    camera->images.put(stampNs(message->header.stamp), message);
  }

  void tick(StampNs /*now_ns*/) override { fuseComplete(); }

  void forget() {
    health().count("dropped: scan pending at a clock jump", queue_->pending());
    queue_->reset();
    for (const auto& camera : cameras_) {
      camera->semantics.clear();
      camera->images.clear();
    }
  }

  // --- Fusion

  /// Tells the queue of every image whose semantics are whole and whose time odometry covers.
  void announceReady() {
    for (const auto& camera : cameras_) {
      for (const auto& [stamp, known] : camera->semantics.values()) {
        if (known.announced) continue;
        const bool whole = known.probabilities || (known.scores && known.share);
        if (!whole) continue;
        if (!pipeline_->coversImage(static_cast<std::size_t>(camera->index), stamp,
                                    tf_->source().odometry())) {
          continue;
        }
        camera->semantics.find(stamp)->announced = true;
        queue_->setSemantics(camera->index, stamp, true);
      }
    }
  }

  void fuseComplete() {
    announceReady();
    for (const CompletedScan& scan : queue_->advance(now())) {
      guard("fusion", [&] { fuse(scan); });
    }
    health().set("pending scans", std::to_string(queue_->pending()));
  }

  void fuse(const CompletedScan& scan) {
    const StageTimer timer(health(), "fusion");
    const Cloud& cloud = *scan.cloud;
    const TransformAnswer T_vehicle_lidar =
        tf_->source().extrinsics(rig().vehicle_frame, cloud.frame_id);
    std::vector<CameraView> views;
    for (const auto& camera : cameras_) {
      const auto index = static_cast<std::size_t>(camera->index);
      const CameraPlace place = placeOf(*camera, cloud.frame_id);
      std::optional<SegmentedImage> image =
          cloud.empty() ? std::nullopt : imageOf(*camera, scan.views[index]);
      if (image) image->lidar_rows = lidar_rows_->of(index, place);
      views.push_back(pipeline_->view(index, place, image ? &*image : nullptr, cloud.stamp,
                                      tf_->source().odometry(), T_vehicle_lidar.transform));
    }
    for (const std::string& note : calibration_notes_.news(rig(), views)) NODELET_WARN_STREAM(note);
    const bool with_pixels = std::any_of(cameras_.begin(), cameras_.end(), [](const auto& camera) {
      return camera->overlay.getNumSubscribers() > 0 || camera->pixels.getNumSubscribers() > 0;
    });
    const FusionResult result = pipeline_->fuse(cloud, views, with_pixels);
    if (!result.note.empty() && result.note != told_note_) {
      told_note_ = result.note;
      health().set("lidar", result.note);
      NODELET_WARN_STREAM(result.note);
    }
    countPoints(result.cloud);
    for (const CameraFusionReport& report : result.cameras) {
      health().count(report.name + ": points beyond lidar_rows", report.beyond_rows);
    }
    watchScan(scan, views, T_vehicle_lidar.transform, result.cloud);
    publish(output_, semanticCloudMessage(result.cloud, rig().classes));
    if (with_pixels) publishPixels(scan, result);
    dropPassed(scan);
  }

  /// Scans come in order: the next one chooses the images of this one again, or later ones.
  void dropPassed(const CompletedScan& scan) {
    for (const auto& camera : cameras_) {
      const StampNs chosen = scan.views[static_cast<std::size_t>(camera->index)].image_stamp;
      camera->semantics.eraseBefore(chosen);  // 0: none was
      camera->images.eraseBefore(chosen);
    }
  }

  /// Model and extrinsics; no model if either is unknown.
  CameraPlace placeOf(const Camera& camera, const std::string& lidar_frame) {
    const std::string& name = camera.config.name;
    CameraPlace place;
    if (!camera.geometry.model()) {
      health().problem(name + ": no usable camera_info");
      return place;
    }
    const TransformAnswer T_camera_lidar =
        tf_->source().extrinsics(camera.geometry.frame(), lidar_frame);
    health().set(name + ": extrinsics", T_camera_lidar ? "known" : T_camera_lidar.message);
    if (!T_camera_lidar) {
      health().problem(name + ": no extrinsics");
      warn("extrinsics " + name, name + ": " + T_camera_lidar.advice());
      return place;
    }
    place.model = camera.geometry.model();
    place.T_camera_lidar = camera.config.nudge.applied(*T_camera_lidar.transform);
    return place;
  }

  /// The semantics that a camera brings to a scan; empty, and counted, if none.
  std::optional<SegmentedImage> imageOf(const Camera& camera, const CompletedScan::View& state) {
    const std::string& name = camera.config.name;
    if (state.state != ViewState::kReady) {
      health().problem(name + (state.state == ViewState::kNone ? ": no image in time"
                               : state.timed_out               ? ": timed out"
                                                               : ": no scores"));
      return std::nullopt;
    }
    const Semantics* known = camera.semantics.find(state.image_stamp);
    if (known == nullptr) {
      health().problem(name + ": semantics left the buffer");
      return std::nullopt;
    }
    health().count(name + ": images used");
    SegmentedImage image;
    image.stamp = state.image_stamp;
    if (known->probabilities) {
      image.semantics.probabilities = pixelView(*known->probabilities);
    } else {
      image.semantics.scores =
          ScoreMap(pixelView(*known->scores), rig().classes.size(), camera.config.score_format);
      image.semantics.share = pixelView(*known->share);
    }
    return image;
  }

  void countPoints(const SemanticCloud& cloud) {
    const auto counts = countByStatus(cloud.points);
    for (std::size_t status = 0; status < counts.size(); ++status) {
      health().count(std::string("points ") + kPointStatusNames[status], counts[status]);
    }
    health().count("scans");
  }

  /// Shows the watch what a scan came to, and each camera's figures to those who look.
  void watchScan(const CompletedScan& scan, const std::vector<CameraView>& views,
                 const std::optional<Transform>& T_vehicle_lidar, const SemanticCloud& cloud) {
    rigWatch().lookAtFusion(cloud, views, T_vehicle_lidar);
    if (rig().check.live && rigWatch().edgesAreDue()) {
      const StageTimer timer(health(), "check");
      std::vector<cv::Mat> pixels;
      for (const auto& camera : cameras_) {
        const auto index = static_cast<std::size_t>(camera->index);
        const auto* image = camera->images.find(scan.views[index].image_stamp);
        pixels.push_back(image ? colorImage(*image) : cv::Mat());
      }
      rigWatch().lookAtEdges(lidarEdges(*scan.cloud), views, pixels);
    }
    for (const auto& camera : cameras_) {
      const auto figures = rigWatch().figures(static_cast<std::size_t>(camera->index));
      health().set(camera->config.name + ": points", std::to_string(figures.points));
      health().set(camera->config.name + ": share of fused points",
                   fixed(figures.fused_points > 0 ? static_cast<double>(figures.points) /
                                                        static_cast<double>(figures.fused_points)
                                                  : 0.0));
      if (figures.edges.edges > 0) {
        health().set(camera->config.name + ": edges meet with", fixed(figures.edges.lift()));
      }
    }
  }

  /// What each camera's listeners want to know of its pixels.
  void publishPixels(const CompletedScan& scan, const FusionResult& result) {
    for (const CameraFusionReport& report : result.cameras) {
      const auto found = std::find_if(cameras_.begin(), cameras_.end(), [&](const auto& camera) {
        return camera->config.name == report.name;
      });
      Camera& camera = **found;
      if (camera.pixels.getNumSubscribers() > 0) {
        publish(camera.pixels, pixelCloudMessage(*scan.cloud, pixelsOf(report)));
      }
      if (camera.overlay.getNumSubscribers() == 0) continue;
      const auto index = static_cast<std::size_t>(camera.index);
      const StampNs stamp = scan.views[index].image_stamp;
      const auto* image = camera.images.find(stamp);
      if (image == nullptr) continue;
      const StageTimer timer(health(), "overlay");
      publish(camera.overlay,
              imageMessage(
                  drawProjection(colorImage(*image), report, result.cloud, rig().classes,
                                 toSeconds(pipeline_->imageTime(index, stamp) - scan.cloud->stamp)),
                  (*image)->header));
    }
  }

  std::unique_ptr<ScanPipeline> pipeline_;
  std::unique_ptr<LidarRows> lidar_rows_;
  std::unique_ptr<FusionQueue> queue_;
  std::unique_ptr<TuningServer> tuning_;
  std::unique_ptr<TfSubscription> tf_;
  std::unique_ptr<EpochMonitor> epochs_;
  std::vector<std::unique_ptr<Camera>> cameras_;
  CalibrationNotes calibration_notes_;
  ros::Publisher output_, class_info_;
  std::string told_note_;  ///< of the lidar's beams
  ros::Subscriber cloud_subscriber_, reference_subscriber_;
};

}  // namespace semantic_lidar_fusion

PLUGINLIB_EXPORT_CLASS(semantic_lidar_fusion::ProjectionNodelet, nodelet::Nodelet)

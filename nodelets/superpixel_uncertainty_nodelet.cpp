// SPDX-License-Identifier: MIT
/// Selected images and their scores -> share of the prevalent label per superpixel, for one camera
/// (`~camera`) or for all cameras of the rig.
///
/// Images are clustered as soon as they come, in parallel with the network; the share follows when
/// the scores of the same stamp are there. Cameras run in parallel on the manager's threads; what
/// belongs to one camera is guarded by the camera's mutex.
#include <algorithm>
#include <memory>
#include <mutex>
#include <pluginlib/class_list_macros.hpp>
#include <string>
#include <utility>
#include <vector>

#include "base/fusion_nodelet.h"
#include "edge/camera_geometry.h"
#include "edge/conversions.h"
#include "edge/tf_subscription.h"
#include "edge/topics.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/fusion/lidar_rows.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "semantic_lidar_fusion/overlay/overlay.h"
#include "semantic_lidar_fusion/sync/epoch_monitor.h"
#include "semantic_lidar_fusion/sync/stamped_store.h"

namespace semantic_lidar_fusion {
namespace {

/// Selected images that wait for their scores, per camera.
constexpr std::size_t kWaiting = 4;
/// Scores that wait for a scan to choose their image, which many never see: a free-running network
/// sends those of every image, and a scan comes as much as its own length later. 0.8 s at 30 Hz.
constexpr std::size_t kWaitingScores = 24;
/// The same by size: nine times 960x604x12 floats.
constexpr std::size_t kMaxScoresBytes = 256u << 20;

}  // namespace

class SuperpixelUncertaintyNodelet : public FusionNodelet {
 public:
  ~SuperpixelUncertaintyNodelet() override { stop(); }

 private:
  using Outputs = std::vector<std::pair<const ros::Publisher*, sensor_msgs::ImagePtr>>;

  struct Image {
    sensor_msgs::ImageConstPtr message;
    SegmentedImage segmented;
  };
  struct Camera {
    Camera(const CameraConfig& config, std::size_t index)
        : config(config), index(index), geometry(config) {}

    const CameraConfig& config;
    const std::size_t index;  ///< in the rig file
    /// For `lidar_rows: auto`; of the callbacks that run one at a time.
    CameraGeometry geometry;
    bool has_rows = !config.finds_lidar_rows;
    ros::Subscriber info_subscriber;
    std::mutex mutex;  ///< guards what follows, up to the publishers, and the pipeline's camera
    std::string told_clamping;
    RowBand lidar_rows;
    std::unique_ptr<EpochMonitor> epochs;
    Outputs outputs;  ///< complete, to be published
    StampedStore<Image> images{kWaiting};
    StampedStore<sensor_msgs::ImageConstPtr> scores{kWaitingScores};

    ros::Publisher share, share_view, superpixels, probabilities, confidence_view, overlay;
    ros::Subscriber image_subscriber, scores_subscriber;
  };

  void initialize() override {
    std::string only;
    getPrivateNodeHandle().getParam("camera", only);
    pipeline_ = std::make_unique<ScanPipeline>(rig(), PipelineSteps{PipelineStep::kSegment});
    for (std::size_t i = 0; i < rig().cameras.size(); ++i) {
      const CameraConfig& config = rig().cameras[i];
      if (!only.empty() && config.name != only) continue;
      cameras_.push_back(std::make_unique<Camera>(config, i));
      Camera& camera = *cameras_.back();
      // The selection nodelet has told jumps of the lidar's time from errors.
      camera.epochs = watchedEpochs({config.name + " image_selected", 1}, [&camera] {
        camera.images.clear();
        camera.scores.clear();
      });
      const auto output = [&](const std::string& name) {
        return advertise<sensor_msgs::Image>(getNodeHandle(), cameraTopic(config, name), 4);
      };
      if (config.input == CameraInput::kScores) {
        camera.share = output("share");
        camera.share_view = output("share_view");
      }
      camera.superpixels = output("superpixels");
      if (config.input != CameraInput::kProbabilities) {
        camera.probabilities = output("probabilities");
        camera.confidence_view = output("confidence_view");
      }
      if (config.input == CameraInput::kScores) camera.overlay = output("uncertainty_overlay");
    }
    if (cameras_.empty() && !only.empty()) {
      throw ConfigError({"camera: is '" + only + "', which the rig file does not list"});
    }
    if (std::any_of(cameras_.begin(), cameras_.end(),
                    [](const auto& camera) { return camera->config.finds_lidar_rows; })) {
      findLidarRows();
    }
    followTuning();
  }

  /// Follows what the rows of `lidar_rows: auto` come from.
  void findLidarRows() {
    lidar_rows_ = std::make_unique<LidarRows>(rig());
    tf_ = std::make_unique<TfSubscription>(getNodeHandle(), rig());
    for (const auto& owned : cameras_) {
      Camera* camera = owned.get();
      // Read from the start: it may be latched, or come only once.
      camera->info_subscriber = subscribe<sensor_msgs::CameraInfo>(
          getNodeHandle(), inputTopic(camera->config, camera->config.camera_info), 8,
          [this, camera](const sensor_msgs::CameraInfoConstPtr& info) {
            camera->geometry.update(*info);
            updateLidarRows(camera);
          },
          Health::Expect::kOnce);
      if (camera->config.withoutCameraInfo()) {
        health().retireInput(camera->info_subscriber.getTopic());
      }
    }
    startTicking();
  }

  /// Transforms may come after the last camera_info.
  void tick(StampNs /*now_ns*/) override {
    for (const auto& camera : cameras_) {
      if (!camera->has_rows) updateLidarRows(camera.get());
    }
  }

  void updateLidarRows(Camera* camera) {
    if (!camera->geometry.model()) return;
    const TransformAnswer T_camera_lidar =
        tf_->source().extrinsics(camera->geometry.frame(), rig().lidar.frame);
    if (!T_camera_lidar) return;  // the projection tells it
    const RowBand rows = lidar_rows_->of(
        camera->index,
        {camera->geometry.model(), camera->config.nudge.applied(*T_camera_lidar.transform)});
    camera->has_rows = true;
    const std::lock_guard<std::mutex> lock(camera->mutex);
    camera->lidar_rows = rows;
  }

  void rigChanged() override {
    std::vector<std::unique_lock<std::mutex>> locks;
    for (const auto& camera : cameras_) locks.emplace_back(camera->mutex);
    pipeline_->retune(rig());
    for (const auto& camera : cameras_) camera->has_rows = !camera->config.finds_lidar_rows;
  }

  /// Different cameras run in parallel; one camera's images come one at a time.
  void updateSubscriptions() override {
    for (const auto& owned : cameras_) {
      Camera* camera = owned.get();
      const bool wants_semantics = isWanted(camera->share) || isWanted(camera->share_view) ||
                                   isWanted(camera->probabilities) ||
                                   isWanted(camera->confidence_view) || isWanted(camera->overlay);
      const bool wants_image = wants_semantics || isWanted(camera->superpixels);
      update(wants_image, cameraTopic(camera->config, "image_selected"), camera,
             &SuperpixelUncertaintyNodelet::onImage, &camera->image_subscriber);
      update(wants_image && camera->config.input != CameraInput::kProbabilities,
             semanticsTopic(rig(), camera->config), camera, &SuperpixelUncertaintyNodelet::onScores,
             &camera->scores_subscriber);
    }
  }

  static bool listened(const ros::Publisher& publisher) {
    return publisher && publisher.getNumSubscribers() > 0;
  }

  void update(bool wanted, const std::string& topic, Camera* camera,
              void (SuperpixelUncertaintyNodelet::*callback)(Camera*,
                                                             const sensor_msgs::ImageConstPtr&),
              ros::Subscriber* subscriber) {
    if (wanted && !*subscriber) {
      *subscriber = subscribe<sensor_msgs::Image>(
          getMTNodeHandle(), topic, 16,
          [this, camera, callback](const sensor_msgs::ImageConstPtr& image) {
            (this->*callback)(camera, image);
          });
    } else if (!wanted && *subscriber) {
      unsubscribe(subscriber);
    }
  }

  void onImage(Camera* camera, const sensor_msgs::ImageConstPtr& image) {
    take(camera, "image_selected", image, [this, camera, image](StampNs stamp) {
      Image waiting{image, {}};
      waiting.segmented.stamp = stamp;
      waiting.segmented.lidar_rows = camera->lidar_rows;
      waiting.segmented.image = colorImage(image);
      health().count("dropped: " + camera->config.name + " image without scores",
                     camera->images.put(stamp, std::move(waiting)));
      if (Image* const stored = camera->images.find(stamp)) cluster(camera, &stored->segmented);
    });
  }

  void onScores(Camera* camera, const sensor_msgs::ImageConstPtr& scores) {
    if (scores->width == 0 || scores->height == 0) return;  // the network gave none for this image
    take(camera, "scores", scores, [this, camera, scores](StampNs stamp) {
      health().count(camera->config.name + " scores of images that no scan chose",
                     camera->scores.put(stamp, scores));
      const auto bytes = [](const sensor_msgs::ImageConstPtr& held) { return held->data.size(); };
      health().count("dropped: " + camera->config.name + " scores, more wait than memory is for",
                     camera->scores.trim(kMaxScoresBytes, bytes));
    });
  }

  /// Keeps a message by `keep`, unless its time is in doubt, and publishes what it makes complete.
  void take(Camera* camera, const std::string& source, const sensor_msgs::ImageConstPtr& message,
            const std::function<void(StampNs)>& keep) {
    Outputs outputs;
    {
      std::lock_guard<std::mutex> lock(camera->mutex);
      const StampNs stamp = stampNs(message->header.stamp);
      admit(camera->epochs.get(), camera->config.name + " " + source, stamp,
            [this, camera, stamp, keep] {
              keep(stamp);
              const Outputs complete = combine(camera, stamp);
              camera->outputs.insert(camera->outputs.end(), complete.begin(), complete.end());
            });
      outputs.swap(camera->outputs);
    }
    publishAll(outputs);
  }

  /// Superpixels as soon as their number of pixels is known, in parallel with the network.
  void cluster(Camera* camera, SegmentedImage* image) {
    {
      const StageTimer timer(health(), "superpixels");
      pipeline_->cluster(camera->index, image);
    }
    tellClamping(camera, image->note);
  }

  /// Tells once, and in the diagnostics, that a map is too small for the wanted superpixels.
  void tellClamping(Camera* camera, const std::string& note) {
    if (note.empty() || note == camera->told_clamping) return;
    camera->told_clamping = note;
    health().set(camera->config.name + " superpixels", note);
    NODELET_INFO_STREAM(camera->config.name << ": " << note);
  }

  /// What can be published for the images of one stamp, with the camera's mutex held.
  Outputs combine(Camera* camera, StampNs stamp) {
    Outputs outputs;
    Image* const image = camera->images.find(stamp);
    if (image == nullptr) return outputs;
    const std_msgs::Header& header = image->message->header;
    SegmentedImage& segmented = image->segmented;
    const auto add = [&](const ros::Publisher& publisher, const cv::Mat& pixels) {
      outputs.emplace_back(&publisher, imageMessage(pixels, header));
    };
    const auto* scores = camera->scores.find(stamp);
    if (camera->config.input == CameraInput::kProbabilities) {
      // They go straight to the projection: all that is made here are superpixels to look at.
      if (!segmented.superpixels.ids.empty()) {
        add(camera->superpixels, segmented.superpixels.ids);
        camera->images.erase(stamp);
      }
      return outputs;
    }
    if (scores == nullptr) return outputs;

    segment(camera, **scores, &segmented);
    if (listened(camera->superpixels)) add(camera->superpixels, segmented.superpixels.ids);
    if (camera->config.input == CameraInput::kScores) add(camera->share, segmented.share);
    const bool published =
        transfersProbabilities(rig(), camera->config) || listened(camera->probabilities);
    if (published || listened(camera->confidence_view)) {
      const cv::Mat probabilities = pipeline_->probabilities(segmented);
      if (published) add(camera->probabilities, probabilities);
      if (listened(camera->confidence_view)) {
        add(camera->confidence_view, drawConfidence(probabilities));
      }
    }
    if (listened(camera->share_view)) add(camera->share_view, drawShare(segmented.share));
    if (listened(camera->overlay)) {
      add(camera->overlay,
          drawUncertainty(segmented.image, segmented.superpixels.ids, segmented.share));
    }
    camera->images.erase(stamp);
    camera->scores.erase(stamp);
    dropUnchosen(camera, stamp);
    return outputs;
  }

  /// Images are chosen in the order of their stamps: scores before the image of `stamp` that no
  /// image waits for are of images that no scan has chosen.
  void dropUnchosen(Camera* camera, StampNs stamp) {
    const auto& waiting = camera->images.values();
    if (!waiting.empty()) stamp = std::min(stamp, waiting.begin()->first);
    health().count(camera->config.name + " scores of images that no scan chose",
                   camera->scores.eraseBefore(stamp));
  }

  /// An error names the topic of the scores or labels, whichever message's arrival it is that shows
  /// it.
  void segment(Camera* camera, const sensor_msgs::Image& scores, SegmentedImage* image) {
    try {
      image->input = pixelView(scores);
      rigWatch().lookAtSemantics(camera->index, image->input,
                                 {image->image.cols, image->image.rows});
      const StageTimer timer(health(),
                             camera->config.input == CameraInput::kLabels ? "histogram" : "share");
      pipeline_->segment(camera->index, image);
    } catch (const DataError& problem) {
      throw DataError(getNodeHandle().resolveName(semanticsTopic(rig(), camera->config)) + ": " +
                      problem.what());
    }
    tellClamping(camera, image->note);
    health().count("non-finite score cells", image->nonfinite_cells);
  }

  void publishAll(const Outputs& outputs) {
    for (const auto& [publisher, message] : outputs) publish(*publisher, message);
  }

  std::unique_ptr<ScanPipeline> pipeline_;
  /// Only with `lidar_rows: auto`.
  std::unique_ptr<LidarRows> lidar_rows_;
  std::unique_ptr<TfSubscription> tf_;
  std::vector<std::unique_ptr<Camera>> cameras_;
};

}  // namespace semantic_lidar_fusion

PLUGINLIB_EXPORT_CLASS(semantic_lidar_fusion::SuperpixelUncertaintyNodelet, nodelet::Nodelet)

// SPDX-License-Identifier: MIT
/// Selected images and their scores -> share of the prevalent label per superpixel, for one camera
/// (`~camera`) or for all cameras of the rig.
///
/// Images are clustered as soon as they come, in parallel with the network; the share follows when
/// the scores of the same stamp are there. Cameras run in parallel on the manager's threads; what
/// belongs to one camera is guarded by the camera's mutex.
#include <memory>
#include <mutex>
#include <pluginlib/class_list_macros.hpp>
#include <string>
#include <utility>
#include <vector>

#include "base/fusion_nodelet.h"
#include "edge/conversions.h"
#include "edge/topics.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/fusion/camera_semantics.h"
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

}  // namespace

class SuperpixelUncertaintyNodelet : public FusionNodelet {
 public:
  ~SuperpixelUncertaintyNodelet() override { stop(); }

 private:
  struct Camera {
    explicit Camera(const Rig& rig, const CameraConfig& config)
        : config(config), semantics(rig.superpixels, rig.classes.size(), config.score_format) {}

    const CameraConfig& config;
    std::mutex mutex;  ///< guards what follows, up to the publishers
    CameraSemantics semantics;
    std::string told_clamping;
    EpochMonitor epoch;
    StampedStore<sensor_msgs::ImageConstPtr> images{kWaiting};
    StampedStore<sensor_msgs::ImageConstPtr> scores{kWaitingScores};
    StampedStore<std::shared_ptr<const SuperpixelMap>> maps{kWaiting};

    ros::Publisher share, superpixels, probabilities, overlay;
    ros::Subscriber image_subscriber, scores_subscriber;
  };

  void initialize() override {
    std::string only;
    getPrivateNodeHandle().getParam("camera", only);
    for (const CameraConfig& config : rig().cameras) {
      if (!only.empty() && config.name != only) continue;
      cameras_.push_back(std::make_unique<Camera>(rig(), config));
      Camera& camera = *cameras_.back();
      const auto output = [&](const std::string& name) {
        return advertise<sensor_msgs::Image>(getNodeHandle(), cameraTopic(config, name), 4);
      };
      if (config.input == CameraInput::kScores) camera.share = output("share");
      camera.superpixels = output("superpixels");
      if (config.input != CameraInput::kProbabilities)
        camera.probabilities = output("probabilities");
      if (config.input == CameraInput::kScores) camera.overlay = output("uncertainty_overlay");
    }
    if (cameras_.empty() && !only.empty()) {
      throw ConfigError({"camera: is '" + only + "', which the rig file does not list"});
    }
  }

  /// Different cameras run in parallel; one camera's images come one at a time.
  void updateSubscriptions() override {
    for (const auto& owned : cameras_) {
      Camera* camera = owned.get();
      const bool wants_semantics =
          listened(camera->share) || listened(camera->probabilities) || listened(camera->overlay);
      const bool wants_image = wants_semantics || listened(camera->superpixels);
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
    Outputs outputs;
    {
      std::lock_guard<std::mutex> lock(camera->mutex);
      if (!current(camera, "image", image)) return;
      const StampNs stamp = stampNs(image->header.stamp);
      health().count("dropped: " + camera->config.name + " image without scores",
                     camera->images.put(stamp, image));
      if (const auto size = camera->semantics.mapSize(
              {static_cast<int>(image->width), static_cast<int>(image->height)})) {
        cluster(camera, stamp, image, *size);
      }
      outputs = combine(camera, stamp);
    }
    publishAll(outputs);
  }

  void onScores(Camera* camera, const sensor_msgs::ImageConstPtr& scores) {
    if (scores->width == 0 || scores->height == 0) return;  // the network gave none for this image
    Outputs outputs;
    {
      std::lock_guard<std::mutex> lock(camera->mutex);
      if (!current(camera, "scores", scores)) return;
      camera->semantics.noteScores(pixelView(*scores));
      const StampNs stamp = stampNs(scores->header.stamp);
      health().count(camera->config.name + " scores of images that no scan chose",
                     camera->scores.put(stamp, scores));
      outputs = combine(camera, stamp);
    }
    publishAll(outputs);
  }

  /// False for what is from before a clock jump.
  bool current(Camera* camera, const std::string& source, const sensor_msgs::ImageConstPtr& image) {
    switch (camera->epoch.observe(source, stampNs(image->header.stamp))) {
      case StampVerdict::kCurrent:
        return true;
      case StampVerdict::kStale:
        health().count("dropped: " + camera->config.name + " " + source +
                       " from before a clock jump");
        return false;
      case StampVerdict::kNewEpoch:
        health().count("clock jumps");
        camera->images.clear();
        camera->scores.clear();
        camera->maps.clear();
        return true;
    }
    return true;
  }

  void cluster(Camera* camera, StampNs stamp, const sensor_msgs::ImageConstPtr& image,
               const ImageSize& map_size) {
    tellClamping(camera, map_size);
    const StageTimer timer(health(), "superpixels");
    camera->maps.put(stamp, std::make_shared<const SuperpixelMap>(
                                camera->semantics.cluster(colorImage(image), map_size, stamp)));
  }

  /// Tells once, and in the diagnostics, that a map is too small for the wanted superpixels.
  void tellClamping(Camera* camera, const ImageSize& map_size) {
    const std::string note = camera->semantics.clampNote(map_size);
    if (note.empty() || note == camera->told_clamping) return;
    camera->told_clamping = note;
    health().set(camera->config.name + " superpixels", note);
    NODELET_INFO_STREAM(camera->config.name << ": " << note);
  }

  using Outputs = std::vector<std::pair<const ros::Publisher*, sensor_msgs::ImagePtr>>;

  /// What can be published for the images of one stamp, with the camera's mutex held.
  Outputs combine(Camera* camera, StampNs stamp) {
    Outputs outputs;
    const auto* image = camera->images.find(stamp);
    if (image == nullptr) return outputs;
    const std_msgs::Header& header = (*image)->header;
    const auto* scores = camera->scores.find(stamp);
    if (camera->config.input == CameraInput::kProbabilities) {
      if (const auto* map = camera->maps.find(stamp)) {
        outputs.emplace_back(&camera->superpixels, imageMessage((*map)->ids, header));
        camera->images.erase(stamp);
      }
      return outputs;
    }
    if (scores == nullptr) return outputs;

    const cv::Mat values = fromSemantics(*camera, [&] { return pixelView(**scores); });
    const ImageSize image_size{static_cast<int>((*image)->width),
                               static_cast<int>((*image)->height)};
    const ImageSize map_size = *camera->semantics.mapSize(image_size);
    const auto* map = camera->maps.find(stamp);
    if (map == nullptr || ImageSize{(*map)->ids.cols, (*map)->ids.rows} != map_size) {
      cluster(camera, stamp, *image, map_size);
      map = camera->maps.find(stamp);
    }
    if (listened(camera->superpixels)) {
      outputs.emplace_back(&camera->superpixels, imageMessage((*map)->ids, header));
    }
    if (camera->config.input == CameraInput::kLabels) {
      const StageTimer timer(health(), "histogram");
      outputs.emplace_back(&camera->probabilities,
                           imageMessage(fromSemantics(*camera,
                                                      [&] {
                                                        return histogramProbabilities(
                                                            **map, values, rig().classes.size());
                                                      }),
                                        header));
    } else {
      addShare(*camera, **map, values, *image, &outputs);
    }
    camera->images.erase(stamp);
    camera->scores.erase(stamp);
    camera->maps.erase(stamp);
    return outputs;
  }

  /// What `work` makes of the scores or labels; an error names their topic, whichever message's
  /// arrival it is that shows it.
  template <class Work>
  auto fromSemantics(const Camera& camera, const Work& work) -> decltype(work()) {
    try {
      return work();
    } catch (const DataError& problem) {
      throw DataError(getNodeHandle().resolveName(semanticsTopic(rig(), camera.config)) + ": " +
                      problem.what());
    }
  }

  void addShare(const Camera& camera, const SuperpixelMap& map, const cv::Mat& scores,
                const sensor_msgs::ImageConstPtr& image, Outputs* outputs) {
    ShareMap share;
    {
      const StageTimer timer(health(), "share");
      share = fromSemantics(camera, [&] { return camera.semantics.share(map, scores); });
    }
    health().count("non-finite score cells", share.nonfinite_cells);
    outputs->emplace_back(&camera.share, imageMessage(share.share, image->header));
    if (listened(camera.probabilities)) {
      const ScoreMap score_map(scores, rig().classes.size(), camera.config.score_format);
      outputs->emplace_back(
          &camera.probabilities,
          imageMessage(denseProbabilities(score_map, share.share, rig().uncertainty),
                       image->header));
    }
    if (listened(camera.overlay)) {
      outputs->emplace_back(
          &camera.overlay,
          imageMessage(drawUncertainty(colorImage(image), map.ids, share.share), image->header));
    }
  }

  void publishAll(const Outputs& outputs) {
    for (const auto& [publisher, message] : outputs) publish(*publisher, message);
  }

  std::vector<std::unique_ptr<Camera>> cameras_;
};

}  // namespace semantic_lidar_fusion

PLUGINLIB_EXPORT_CLASS(semantic_lidar_fusion::SuperpixelUncertaintyNodelet, nodelet::Nodelet)

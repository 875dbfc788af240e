// SPDX-License-Identifier: MIT
/// Selected images -> class scores, by one network for all cameras in a thread of its own.
///
/// The oldest waiting image goes first; a camera's newer image replaces its waiting one. An image
/// that gets no scores is reported at once by an empty score image of its stamp.
#include <condition_variable>
#include <optional>
#include <pluginlib/class_list_macros.hpp>
#include <thread>
#include <vector>

#include "base/fusion_nodelet.h"
#include "edge/conversions.h"
#include "edge/topics.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/segmentation/model.h"

namespace semantic_lidar_fusion {

class SegmentationNodelet : public FusionNodelet {
 public:
  ~SegmentationNodelet() override {
    stop();
    {
      std::lock_guard<std::mutex> lock(mutex_);
      stopping_ = true;
    }
    wake_.notify_all();
    if (worker_.joinable()) worker_.join();
  }

 private:
  struct Camera {
    ros::Publisher scores;
    ros::Subscriber subscriber;
    sensor_msgs::ImageConstPtr waiting;  ///< guarded by mutex_
  };

  void initialize() override {
    if (rig().segmentation.model.empty()) {
      throw ConfigError(
          {"segmentation.model: is empty; name a model file, or do not load this nodelet"});
    }
    model_.emplace(rig().segmentation.model, rig().classes);
    cameras_.resize(rig().cameras.size());
    for (std::size_t i = 0; i < cameras_.size(); ++i) {
      cameras_[i].scores = advertise<sensor_msgs::Image>(
          getNodeHandle(), cameraTopic(rig().cameras[i], "scores"), 4);
    }
    worker_ = std::thread([this] { run(); });
  }

  void updateSubscriptions() override {
    for (std::size_t i = 0; i < cameras_.size(); ++i) {
      Camera& camera = cameras_[i];
      const bool wanted = isWanted(camera.scores);
      if (wanted && !camera.subscriber) {
        camera.subscriber = subscribe<sensor_msgs::Image>(
            getNodeHandle(), cameraTopic(rig().cameras[i], "image_selected"), 16,
            [this, i](const sensor_msgs::ImageConstPtr& image) { onImage(i, image); });
      } else if (!wanted && camera.subscriber) {
        unsubscribe(&camera.subscriber);
      }
    }
  }

  void onImage(std::size_t index, const sensor_msgs::ImageConstPtr& image) {
    sensor_msgs::ImageConstPtr superseded;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      superseded = std::move(cameras_[index].waiting);
      cameras_[index].waiting = image;
    }
    wake_.notify_one();
    if (superseded) {
      health().count("dropped: image superseded by a newer one of its camera");
      reportNoScores(index, superseded->header);
    }
  }

  void reportNoScores(std::size_t index, const std_msgs::Header& header) {
    const auto empty = boost::make_shared<sensor_msgs::Image>();
    empty->header = header;
    empty->encoding = "32FC" + std::to_string(rig().classes.size());
    publish(cameras_[index].scores, empty);
  }

  /// Waits for the oldest waiting image; empty when the nodelet stops.
  std::optional<std::pair<std::size_t, sensor_msgs::ImageConstPtr>> next() {
    std::unique_lock<std::mutex> lock(mutex_);
    std::optional<std::size_t> oldest;
    wake_.wait(lock, [&] {
      for (std::size_t i = 0; i < cameras_.size(); ++i) {
        if (cameras_[i].waiting && (!oldest || cameras_[i].waiting->header.stamp <
                                                   cameras_[*oldest].waiting->header.stamp)) {
          oldest = i;
        }
      }
      return stopping_ || oldest;
    });
    if (stopping_) return std::nullopt;
    return std::make_pair(*oldest, std::move(cameras_[*oldest].waiting));
  }

  void run() {
    while (const auto job = next()) {
      const auto& [index, image] = *job;
      bool published = false;
      guard(cameraTopic(rig().cameras[index], "image_selected"),
            [&, &image = image, index = index] {
              const StageTimer timer(health(), "segmentation");
              publish(cameras_[index].scores,
                      imageMessage(model_->scores(colorImage(image)), image->header));
              published = true;
            });
      if (!published) reportNoScores(index, image->header);
    }
  }

  std::optional<SegmentationModel> model_;  ///< used by the worker alone
  std::vector<Camera> cameras_;
  std::mutex mutex_;
  std::condition_variable wake_;
  bool stopping_ = false;  ///< guarded by mutex_
  std::thread worker_;
};

}  // namespace semantic_lidar_fusion

PLUGINLIB_EXPORT_CLASS(semantic_lidar_fusion::SegmentationNodelet, nodelet::Nodelet)

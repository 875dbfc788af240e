// SPDX-License-Identifier: MIT
#include "rig_player.h"

#include <rosbag/view.h>
#include <tf2_eigen/tf2_eigen.h>
#include <time.h>

#include <algorithm>
#include <cmath>
#include <thread>
#include <utility>

#include "edge/conversions.h"
#include "edge/topics.h"
#include "semantic_lidar_fusion/common/error.h"
#include "tools/common/bag_input.h"

namespace semantic_lidar_fusion {
namespace {

constexpr StampNs kScanPeriod = 100000000;
constexpr StampNs kImagePeriod = 33333333;
constexpr StampNs kPacketLength = 1327104;

double threadCpuSeconds() {
  timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

void sleepUntil(std::int64_t steady_ns) {
  const timespec until{steady_ns / 1000000000, steady_ns % 1000000000};
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, nullptr) != 0 && ros::ok()) {
  }
}

boost::shared_ptr<sensor_msgs::Image> decodedMessage(const sensor_msgs::CompressedImage& image) {
  return imageMessage(decodedImage(image), image.header);
}

Transform pose(const geometry_msgs::TransformStamped& message) {
  return transform(message.transform);
}

}  // namespace

std::int64_t steadyNs() {
  timespec now{};
  clock_gettime(CLOCK_MONOTONIC, &now);
  return now.tv_sec * std::int64_t{1000000000} + now.tv_nsec;
}

RigPlayer::RigPlayer(const Rig& rig, const PlayerOptions& options) : rig_(rig), options_(options) {
  load(options);
  schedule(options.score_latency_s);
  scan_publisher_ = node_.advertise<VelodyneScan>(rig.lidar.topic, 8);
  tf_publisher_ = node_.advertise<tf2_msgs::TFMessage>("/tf", 100);
  static_tf_publisher_ = node_.advertise<tf2_msgs::TFMessage>("/tf_static", 1, true);
  static_tf_publisher_.publish(static_transforms_);
  for (Camera& camera : cameras_) {
    const std::string topic = imageTopic(*camera.config);
    camera.image_publisher = camera.compressed
                                 ? node_.advertise<sensor_msgs::CompressedImage>(topic, 8)
                                 : node_.advertise<sensor_msgs::Image>(topic, 8);
    camera.info_publisher = node_.advertise<sensor_msgs::CameraInfo>(
        inputTopic(*camera.config, camera.config->camera_info), 8, true);
    camera.info_publisher.publish(camera.info);
    camera.scores_publisher =
        node_.advertise<sensor_msgs::Image>(inputTopic(*camera.config, camera.config->scores), 8);
  }
}

void RigPlayer::load(const PlayerOptions& options) {
  const BagInput input({options.bag});
  const auto look = [&](const std::string& name, rosbag::View* view) {
    const BagInput::Topic* found = input.find(name);
    if (found == nullptr) throw Error(options.bag + " has no topic " + name);
    input.addTo({found->name}, view);
  };

  rosbag::View scans;
  look(rig_.lidar.topic, &scans);
  for (const rosbag::MessageInstance& message : scans) {
    const auto scan = message.instantiate<VelodyneScan>();
    if (!scan || scan->packets.empty()) throw Error(options.bag + ": a scan has no packets");
    if (scans_.empty()) bag_start_ = stampNs(scan->packets.front().stamp);
    scans_.push_back({stampNs(scan->packets.front().stamp) - bag_start_,
                      boost::make_shared<VelodyneScan>(*scan)});
  }
  if (scans_.empty()) throw Error(options.bag + " has no scan");
  round_ = static_cast<StampNs>(scans_.size()) * kScanPeriod;

  const auto in_round = [&](StampNs offset) { return offset >= 0 && offset < round_; };
  Transform first = Transform::Identity(), end = Transform::Identity();
  StampNs end_error = kScanPeriod;
  rosbag::View transforms;
  look("/tf", &transforms);
  for (const rosbag::MessageInstance& message : transforms) {
    const auto readings = message.instantiate<tf2_msgs::TFMessage>();
    for (const auto& reading : readings->transforms) {
      const StampNs offset = stampNs(reading.header.stamp) - bag_start_;
      if (in_round(offset)) {
        if (odometry_.empty()) first = pose(reading);
        odometry_.push_back({offset, boost::make_shared<geometry_msgs::TransformStamped>(reading)});
      }
      if (std::abs(offset - round_) < end_error) {
        end_error = std::abs(offset - round_);
        end = pose(reading);
      }
    }
  }
  if (odometry_.empty()) throw Error(options.bag + " has no odometry on /tf");
  round_motion_ = end * first.inverse();
  rosbag::View statics;
  look("/tf_static", &statics);
  for (const rosbag::MessageInstance& message : statics) {
    const auto readings = message.instantiate<tf2_msgs::TFMessage>();
    for (const auto& one : readings->transforms) {
      static_transforms_.transforms.push_back(one);
    }
  }

  for (const CameraConfig& config : rig_.cameras) {
    Camera camera{};
    camera.config = &config;
    camera.compressed = config.transport == ImageTransport::kCompressed;
    CameraConfig source = config;
    source.transport = ImageTransport::kCompressed;
    rosbag::View infos;
    look(inputTopic(config, config.camera_info), &infos);
    camera.info = *infos.begin()->instantiate<sensor_msgs::CameraInfo>();
    rosbag::View scores;
    look(inputTopic(config, config.scores), &scores);
    for (const rosbag::MessageInstance& message : scores) {
      const auto image = message.instantiate<sensor_msgs::Image>();
      const StampNs offset = stampNs(image->header.stamp) - bag_start_;
      if (in_round(offset))
        camera.scores.push_back({offset, boost::make_shared<sensor_msgs::Image>(*image)});
    }
    const auto is_used = [&](StampNs offset) {
      return std::any_of(camera.scores.begin(), camera.scores.end(),
                         [&](const auto& score) { return score.offset == offset; });
    };
    rosbag::View images;
    look(imageTopic(source), &images);
    for (const rosbag::MessageInstance& message : images) {
      const auto image = message.instantiate<sensor_msgs::CompressedImage>();
      const StampNs offset = stampNs(image->header.stamp) - bag_start_;
      if (!in_round(offset) || !is_used(offset)) continue;
      if (camera.compressed) {
        camera.compressed_images.push_back(
            {offset, boost::make_shared<sensor_msgs::CompressedImage>(*image)});
      } else {
        camera.images.push_back({offset, decodedMessage(*image)});
      }
    }
    if (camera.scores.empty() ||
        camera.scores.size() != camera.images.size() + camera.compressed_images.size()) {
      throw Error(options.bag + ": camera " + config.name + " has not one image for each of its " +
                  std::to_string(camera.scores.size()) + " scores");
    }
    cameras_.push_back(std::move(camera));
  }
}

void RigPlayer::schedule(double score_latency_s) {
  const auto latency = static_cast<StampNs>(std::llround(1e9 * score_latency_s));
  for (int i = 0; i < static_cast<int>(odometry_.size()); ++i) {
    events_.push_back({odometry_[i].offset, odometry_[i].offset, Kind::kOdometry, 0, i});
  }
  for (int i = 0; i < static_cast<int>(scans_.size()); ++i) {
    const StampNs end = stampNs(scans_[i].message->packets.back().stamp) - bag_start_;
    events_.push_back({end + kPacketLength, scans_[i].offset, Kind::kScan, 0, i});
  }
  for (int c = 0; c < static_cast<int>(cameras_.size()); ++c) {
    const Camera& camera = cameras_[c];
    for (int i = 0; i < static_cast<int>(camera.scores.size()); ++i) {
      const StampNs offset = camera.scores[i].offset;
      events_.push_back({offset, offset, Kind::kImage, c, i});
      events_.push_back({offset + latency, offset, Kind::kScores, c, i});
      // Two more images before the next one that is used.
      for (const StampNs later : {offset + kImagePeriod, offset + 2 * kImagePeriod}) {
        events_.push_back({later, later, Kind::kFiller, c, 0});
      }
    }
  }
  // What is due after the end of a round comes in the next one.
  for (Event& event : events_) {
    const StampNs rounds = event.at / round_;
    event.at -= rounds * round_;
    event.offset -= rounds * round_;
  }
  std::stable_sort(events_.begin(), events_.end(),
                   [](const Event& a, const Event& b) { return a.at < b.at; });
}

void RigPlayer::awaitListeners() const {
  const auto heard = [this] {
    bool all = scan_publisher_.getNumSubscribers() > 0 && tf_publisher_.getNumSubscribers() > 0;
    for (const Camera& camera : cameras_) {
      all = all && camera.image_publisher.getNumSubscribers() > 0 &&
            camera.scores_publisher.getNumSubscribers() > 0 &&
            camera.info_publisher.getNumSubscribers() > 0;
    }
    return all;
  };
  for (int i = 0; i < 600; ++i) {
    if (heard()) return;
    std::this_thread::sleep_for(std::chrono::milliseconds(50));
  }
  throw Error("nobody subscribes to everything that is played within 30 s");
}

void RigPlayer::play() {
  if (options_.wait_for_listeners) awaitListeners();
  constexpr StampNs kLead = 300000000;
  start_steady_ns_ = steadyNs() + kLead;
  const StampNs start = stampNs(ros::Time::now()) + kLead;
  const auto length = static_cast<StampNs>(1e9 * options_.seconds);
  for (StampNs round_start = 0; round_start < length; round_start += round_) {
    for (const Event& event : events_) {
      const StampNs due = round_start + event.at;
      if (due >= length || !ros::ok()) break;
      if (round_start + event.offset < 0) continue;  // of a round before the first
      sleepUntil(start_steady_ns_ + due);
      largest_lag_ns_ = std::max(largest_lag_ns_, steadyNs() - start_steady_ns_ - due);
      publish(event, start + round_start);
    }
    motion_so_far_ = round_motion_ * motion_so_far_;
  }
}

/// The message itself if nobody else holds it, else a copy that takes its place.
template <class M>
boost::shared_ptr<M> RigPlayer::owned(boost::shared_ptr<M>* message) {
  if (message->use_count() > 1) {
    const double cpu_start = threadCpuSeconds();
    *message = boost::make_shared<M>(**message);
    copies_.push_back({steadyNs(), threadCpuSeconds() - cpu_start});
  }
  return *message;
}

void RigPlayer::publish(const Event& event, StampNs round_start) {
  const StampNs stamp = round_start + event.offset;
  switch (event.kind) {
    case Kind::kOdometry: {
      const auto message = boost::make_shared<tf2_msgs::TFMessage>();
      message->transforms.push_back(*odometry_[event.index].message);
      geometry_msgs::TransformStamped& reading = message->transforms.front();
      const Transform moved = motion_so_far_ * pose(reading);
      reading.transform = tf2::eigenToTransform(moved).transform;
      reading.header.stamp = rosTime(stamp);
      tf_publisher_.publish(message);
      deliveries_.push_back({"odometry", stamp, stamp, steadyNs()});
      break;
    }
    case Kind::kScan: {
      const auto scan = owned(&scans_[event.index].message);
      const StampNs shift = stamp - stampNs(scan->packets.front().stamp);
      for (VelodynePacket& packet : scan->packets) {
        packet.stamp = rosTime(stampNs(packet.stamp) + shift);
      }
      scan->header.stamp = scan->packets.back().stamp;
      const StampNs end = stampNs(scan->packets.back().stamp) + kPacketLength;
      scan_publisher_.publish(scan);
      deliveries_.push_back({"scan", stamp, end, steadyNs()});
      ++scan_count_;
      break;
    }
    case Kind::kScores: {
      Camera& camera = cameras_[event.camera];
      const auto scores = owned(&camera.scores[event.index].message);
      scores->header.stamp = rosTime(stamp);
      camera.scores_publisher.publish(scores);
      deliveries_.push_back({camera.config->name, stamp, stamp, steadyNs()});
      break;
    }
    case Kind::kImage:
    case Kind::kFiller:
      publishImage(&cameras_[event.camera], event, stamp);
      break;
  }
}

void RigPlayer::publishImage(Camera* camera, const Event& event, StampNs stamp) {
  const auto send = [&](auto* images, auto* fillers) {
    auto* message = event.kind == Kind::kImage ? &(*images)[event.index].message : nullptr;
    for (auto& filler : *fillers) {
      if (message == nullptr && filler.use_count() == 1) message = &filler;
    }
    if (message == nullptr) {  // all are waiting for a scan to choose them
      using Message = typename std::decay_t<decltype(*fillers)>::value_type::element_type;
      const double cpu_start = threadCpuSeconds();
      fillers->push_back(boost::make_shared<Message>(*images->front().message));
      message = &fillers->back();
      copies_.push_back({steadyNs(), threadCpuSeconds() - cpu_start});
    }
    const auto image = owned(message);
    image->header.stamp = rosTime(stamp);
    camera->image_publisher.publish(image);
  };
  if (camera->compressed) {
    send(&camera->compressed_images, &camera->compressed_fillers);
  } else {
    send(&camera->images, &camera->fillers);
  }
  const auto info = boost::make_shared<sensor_msgs::CameraInfo>(camera->info);
  info->header.stamp = rosTime(stamp);
  camera->info_publisher.publish(info);
}

}  // namespace semantic_lidar_fusion

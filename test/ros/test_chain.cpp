// SPDX-License-Identifier: MIT
// All nodelets in this process, so that messages can be compared by address: nothing is copied on
// the way, nothing is changed, and nothing runs that nobody listens to.
#include <diagnostic_msgs/DiagnosticArray.h>
#include <geometry_msgs/TransformStamped.h>
#include <gtest/gtest.h>
#include <nodelet/loader.h>
#include <ros/ros.h>
#include <sensor_msgs/CameraInfo.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/PointCloud2.h>
#include <sensor_msgs/TimeReference.h>
#include <sensor_msgs/point_cloud2_iterator.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <cstring>
#include <fstream>
#include <functional>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "../unit/segmentation/onnx_writer.h"
#include "temporary_folder.h"

namespace semantic_lidar_fusion {
namespace {

constexpr int kWidth = 64, kHeight = 48, kClasses = 3;
const char* const kTypes[] = {"ImageSelection", "SuperpixelUncertainty", "MotionCompensation",
                              "Projection"};

bool waitFor(const std::function<bool()>& condition, double timeout_s = 20.0) {
  const ros::WallTime deadline = ros::WallTime::now() + ros::WallDuration(timeout_s);
  while (ros::WallTime::now() < deadline) {
    ros::spinOnce();
    if (condition()) return true;
    ros::WallDuration(0.005).sleep();
  }
  return condition();
}

/// Writes a rig of two cameras; `extra` is appended.
std::string rigFile(const std::string& folder, const std::string& extra = "") {
  const std::string path = folder + "/rig.yaml";
  std::ofstream(path) << "classes: {classes: [{name: road, color: [1, 2, 3]}, "
                         "{name: wall, color: [4, 5, 6]}, {name: sky, color: [7, 8, 9]}]}\n"
                         "cameras: [{name: front, timeout: 10}, {name: left, timeout: 10}]\n"
                         "lidar: {input: points}\n"
                         "reference: {timeout: 10}\n"
                         "superpixels: {count: 20}\nocclusion: {mode: 'off'}\n"
                      << extra;
  return path;
}

/// The nodelets of the package in a namespace of their own.
class Chain {
 public:
  Chain(const std::string& ns, const std::vector<std::string>& types, const std::string& rig)
      : node_("/" + ns), loader_(false) {
    for (const std::string& type : types) {
      const std::string name = "/" + ns + "/" + type;
      ros::param::set(name + "/rig_file", rig);
      EXPECT_TRUE(loader_.load(name, "semantic_lidar_fusion/" + type + "Nodelet", {}, {})) << type;
    }
  }
  ros::NodeHandle& node() { return node_; }

 private:
  ros::NodeHandle node_;
  nodelet::Loader loader_;
};

template <class M>
ros::Subscriber listen(ros::NodeHandle& node, const std::string& topic,
                       std::vector<boost::shared_ptr<const M>>* received) {
  return node.subscribe<M>(
      topic, 100,
      boost::function<void(const boost::shared_ptr<const M>&)>(
          [received](const boost::shared_ptr<const M>& message) { received->push_back(message); }));
}

ros::Time at(double seconds) { return ros::Time(1000.0 + seconds); }

sensor_msgs::ImagePtr image(const std::string& encoding, int width, int height, int pixel_bytes,
                            const ros::Time& stamp) {
  auto message = boost::make_shared<sensor_msgs::Image>();
  message->header.stamp = stamp;
  message->header.frame_id = "front";
  message->width = static_cast<std::uint32_t>(width);
  message->height = static_cast<std::uint32_t>(height);
  message->encoding = encoding;
  message->step = static_cast<std::uint32_t>(width * pixel_bytes);
  message->data.resize(static_cast<std::size_t>(width * height * pixel_bytes));
  return message;
}

sensor_msgs::ImagePtr colorPixels(const ros::Time& stamp) {
  const auto message = image("bgr8", kWidth, kHeight, 3, stamp);
  for (std::size_t i = 0; i < message->data.size(); ++i) {
    message->data[i] = static_cast<std::uint8_t>(i * 7 % 251);
  }
  return message;
}

sensor_msgs::ImagePtr scorePixels(const ros::Time& stamp) {
  const auto message = image("32FC3", kWidth / 4, kHeight / 4, 4 * kClasses, stamp);
  std::vector<float> values(message->data.size() / 4);
  for (std::size_t i = 0; i < values.size(); ++i) values[i] = static_cast<float>(i % 5);
  std::memcpy(message->data.data(), values.data(), message->data.size());
  return message;
}

sensor_msgs::PointCloud2Ptr points(const ros::Time& stamp) {
  auto message = boost::make_shared<sensor_msgs::PointCloud2>();
  message->header.stamp = stamp;
  message->header.frame_id = "velodyne";
  sensor_msgs::PointCloud2Modifier modifier(*message);
  modifier.setPointCloud2Fields(
      4, "x", 1, sensor_msgs::PointField::FLOAT32, "y", 1, sensor_msgs::PointField::FLOAT32, "z", 1,
      sensor_msgs::PointField::FLOAT32, "time", 1, sensor_msgs::PointField::FLOAT32);
  constexpr int kPoints = 200;
  modifier.resize(kPoints);
  sensor_msgs::PointCloud2Iterator<float> value(*message, "x");
  for (int i = 0; i < kPoints; ++i, ++value) {
    value[0] = 10.0f;
    value[1] = static_cast<float>(i % 20 - 10);
    value[2] = static_cast<float>(i / 20 - 5);
    value[3] = 0.0005f * static_cast<float>(i);
  }
  return message;
}

sensor_msgs::CameraInfo cameraInfo(const std::string& frame) {
  sensor_msgs::CameraInfo info;
  info.header.frame_id = frame;
  info.width = kWidth;
  info.height = kHeight;
  info.distortion_model = "plumb_bob";
  info.D.assign(5, 0.0);
  info.K = {30, 0, 31.5, 0, 30, 23.5, 0, 0, 1};
  info.R = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  info.P = {30, 0, 31.5, 0, 0, 30, 23.5, 0, 0, 0, 1, 0};
  return info;
}

geometry_msgs::TransformStamped transform(const std::string& parent, const std::string& child,
                                          const ros::Time& stamp, bool optical) {
  geometry_msgs::TransformStamped message;
  message.header.frame_id = parent;
  message.header.stamp = stamp;
  message.child_frame_id = child;
  message.transform.rotation.w = 1.0;
  if (optical) {
    auto& q = message.transform.rotation;
    q.x = -0.5, q.y = 0.5, q.z = -0.5, q.w = 0.5;
  }
  return message;
}

std::size_t hashOf(const std::vector<std::uint8_t>& data) {
  return std::hash<std::string>()(std::string(data.begin(), data.end()));
}

/// Remembers messages and what they held.
class Witness {
 public:
  template <class M>
  void see(const std::string& name, const boost::shared_ptr<const M>& message) {
    seen_.push_back({name, ros::WallTime::now(), [message] { return hashOf(message->data); },
                     hashOf(message->data)});
  }
  /// A second after the last was seen.
  bool isLater() const { return ros::WallTime::now() > seen_.back().time + ros::WallDuration(1.0); }
  void check() const {
    ASSERT_FALSE(seen_.empty());
    for (const auto& one : seen_) EXPECT_EQ(one.hash(), one.was) << one.name << " was changed";
  }

 private:
  struct Seen {
    std::string name;
    ros::WallTime time;
    std::function<std::size_t()> hash;
    std::size_t was;
  };
  std::vector<Seen> seen_;
};

TEST(ZeroCopy, MessagesPassByPointerAndAreNotChanged) {
  const TemporaryFolder folder;
  Chain chain("zero_copy", {std::begin(kTypes), std::end(kTypes)}, rigFile(folder.path()));
  ros::NodeHandle& node = chain.node();
  ros::Publisher tf = node.advertise<tf2_msgs::TFMessage>("/tf", 10);
  ros::Publisher tf_static = node.advertise<tf2_msgs::TFMessage>("/tf_static", 10, true);
  ros::Publisher cloud = node.advertise<sensor_msgs::PointCloud2>("points", 10);
  std::map<std::string, ros::Publisher> images, scores, infos;
  std::map<std::string, std::vector<sensor_msgs::ImageConstPtr>> selected, share, share_again,
      scores_seen;
  std::vector<ros::Subscriber> subscribers;
  for (const std::string camera : {"front", "left"}) {
    images[camera] = node.advertise<sensor_msgs::Image>(camera + "/image", 10);
    scores[camera] = node.advertise<sensor_msgs::Image>(camera + "/scores", 10);
    infos[camera] = node.advertise<sensor_msgs::CameraInfo>(camera + "/camera_info", 10, true);
    subscribers.push_back(listen(node, camera + "/image_selected", &selected[camera]));
    subscribers.push_back(listen(node, camera + "/scores", &scores_seen[camera]));
    subscribers.push_back(listen(node, camera + "/share", &share[camera]));
    subscribers.push_back(listen(node, camera + "/share", &share_again[camera]));
  }
  std::vector<sensor_msgs::PointCloud2ConstPtr> compensated, compensated_again, semantic;
  subscribers.push_back(listen(node, "points_compensated", &compensated));
  subscribers.push_back(listen(node, "points_compensated", &compensated_again));
  subscribers.push_back(listen(node, "points_semantic", &semantic));

  tf2_msgs::TFMessage fixed;
  fixed.transforms = {transform("base_link", "velodyne", at(0), false),
                      transform("base_link", "front", at(0), true),
                      transform("base_link", "left", at(0), true)};
  tf_static.publish(fixed);
  for (auto& info : infos) info.second.publish(cameraInfo(info.first));
  // Listeners of one process count as one; what each nodelet subscribes is in its diagnostics.
  std::map<std::string, std::set<std::string>> keys;
  ros::Subscriber reports = node.subscribe<diagnostic_msgs::DiagnosticArray>(
      "/diagnostics", 100,
      boost::function<void(const diagnostic_msgs::DiagnosticArrayConstPtr&)>(
          [&keys](const diagnostic_msgs::DiagnosticArrayConstPtr& array) {
            for (const auto& status : array->status) {
              for (const auto& value : status.values) {
                keys[status.name].insert(value.key);
                keys[status.name].insert(value.key + " = " + value.value);
              }
            }
          }));
  const auto reads = [&keys](const std::string& nodelet, const std::string& topic) {
    for (const auto& [name, known] : keys) {
      if (name.find(nodelet) != std::string::npos && known.count("input /zero_copy/" + topic) > 0) {
        return true;
      }
    }
    return false;
  };
  ASSERT_TRUE(waitFor([&] {
    return reads("ImageSelection", "points messages") &&
           reads("MotionCompensation", "points messages") &&
           reads("SuperpixelUncertainty", "left/image_selected messages") &&
           reads("Projection", "points_compensated messages") &&
           reads("Projection", "left/share messages") &&
           reads("Projection", "front/camera_info messages = 1") &&
           reads("Projection", "left/camera_info messages = 1");
  }));

  Witness witness;
  std::map<std::string, sensor_msgs::ImageConstPtr> sent;
  for (int i = 0; i <= 30; ++i) {
    tf2_msgs::TFMessage moving;
    moving.transforms = {transform("odom", "base_link", at(0.01 * i), false)};
    tf.publish(moving);
  }
  const sensor_msgs::PointCloud2ConstPtr scan = points(at(0.1));
  witness.see("points", scan);
  cloud.publish(scan);
  for (const std::string camera : {"front", "left"}) {
    for (const double t : {0.1, 0.15, 0.2}) {
      const sensor_msgs::ImageConstPtr picture = colorPixels(at(t));
      witness.see(camera + " image", picture);
      images[camera].publish(picture);
      if (t == 0.15) sent[camera] = picture;
    }
  }
  std::map<std::string, sensor_msgs::ImageConstPtr> sent_scores;
  for (const std::string camera : {"front", "left"}) {
    ASSERT_TRUE(waitFor([&] { return selected[camera].size() == 1; })) << camera;
    EXPECT_EQ(selected[camera][0].get(), sent[camera].get()) << "image_selected is a copy";
    sent_scores[camera] = scorePixels(at(0.15));
    witness.see(camera + " scores", sent_scores[camera]);
    scores[camera].publish(sent_scores[camera]);
  }
  ASSERT_TRUE(waitFor([&] { return semantic.size() == 1; }));
  for (const std::string camera : {"front", "left"}) {
    ASSERT_TRUE(waitFor([&] {
      return share[camera].size() == 1 && share_again[camera].size() == 1 &&
             scores_seen[camera].size() == 1;
    }));
    EXPECT_EQ(share[camera][0].get(), share_again[camera][0].get());
    EXPECT_EQ(scores_seen[camera][0].get(), sent_scores[camera].get());
    EXPECT_EQ(share[camera][0]->header.stamp, at(0.15));
    witness.see(camera + " share", share[camera][0]);
  }
  ASSERT_TRUE(waitFor([&] { return compensated.size() == 1 && compensated_again.size() == 1; }));
  EXPECT_EQ(compensated[0].get(), compensated_again[0].get());
  witness.see("points_compensated", compensated[0]);
  EXPECT_EQ(semantic[0]->header.stamp, at(0.15));
  EXPECT_EQ(semantic[0]->width, scan->width);
  sensor_msgs::PointCloud2ConstIterator<std::uint8_t> status(*semantic[0], "status");
  int fused = 0;
  for (; status != status.end(); ++status) fused += *status == 0;
  EXPECT_GT(fused, 20);
  ASSERT_TRUE(waitFor([&] { return witness.isLater(); }));
  witness.check();
}

/// What one nodelet subscribes while its output is listened to.
struct Lazy {
  const char* type;
  const char* output;
  bool output_is_image, output_is_cloud;
  std::vector<std::string> images, clouds, times;
};

/// Nodelet and output as a name.
std::string nameOf(const Lazy& lazy) {
  std::string name = std::string(lazy.type) + "_" + lazy.output;
  std::replace(name.begin(), name.end(), '/', '_');
  return name;
}

class Laziness : public testing::TestWithParam<Lazy> {};

TEST_P(Laziness, SubscribesOnlyWhileListenedTo) {
  const Lazy& lazy = GetParam();
  const TemporaryFolder folder;
  std::string extra;
  if (std::string(lazy.type) == "Segmentation") {
    writeConvolution(folder.path() + "/net.onnx", kWidth, kHeight, 1, std::vector<float>(9, 0.01f),
                     {0, 0, 0});
    std::ofstream(folder.path() + "/model.yaml")
        << "file: net.onnx\ninput: {width: 64, height: 48}\n"
           "classes: {road: [0], wall: [1], sky: [2]}\n";
    extra = "segmentation: {model: model.yaml}\n";
  }
  Chain chain("lazy_" + nameOf(lazy), {lazy.type}, rigFile(folder.path(), extra));
  ros::NodeHandle& node = chain.node();
  std::vector<ros::Publisher> inputs;
  for (const auto& topic : lazy.images)
    inputs.push_back(node.advertise<sensor_msgs::Image>(topic, 1));
  for (const auto& topic : lazy.clouds) {
    inputs.push_back(node.advertise<sensor_msgs::PointCloud2>(topic, 1));
  }
  for (const auto& topic : lazy.times) {
    inputs.push_back(node.advertise<sensor_msgs::TimeReference>(topic, 1));
  }
  const auto all = [&](std::uint32_t wanted) {
    for (const auto& input : inputs) {
      if (input.getNumSubscribers() != wanted) return false;
    }
    return true;
  };
  for (int round = 0; round < 2; ++round) {
    EXPECT_TRUE(all(0)) << "subscribed without a listener";
    std::vector<sensor_msgs::ImageConstPtr> images;
    std::vector<sensor_msgs::PointCloud2ConstPtr> clouds;
    std::vector<sensor_msgs::TimeReferenceConstPtr> times;
    ros::Subscriber listener = lazy.output_is_image   ? listen(node, lazy.output, &images)
                               : lazy.output_is_cloud ? listen(node, lazy.output, &clouds)
                                                      : listen(node, lazy.output, &times);
    EXPECT_TRUE(waitFor([&] { return all(1); })) << "the first listener changed nothing";
    listener.shutdown();
    EXPECT_TRUE(waitFor([&] { return all(0); })) << "still subscribed after the last listener left";
  }
}

INSTANTIATE_TEST_SUITE_P(
    Nodelets, Laziness,
    testing::Values(
        Lazy{"ImageSelection",
             "scan_reference",
             false,
             false,
             {"front/image", "left/image"},
             {"points"},
             {}},
        Lazy{"Segmentation", "front/scores", true, false, {"front/image_selected"}, {}, {}},
        Lazy{"SuperpixelUncertainty",
             "front/share",
             true,
             false,
             {"front/image_selected", "front/scores"},
             {},
             {}},
        Lazy{"SuperpixelUncertainty",
             "front/superpixels",
             true,
             false,
             {"front/image_selected", "front/scores"},
             {},
             {}},
        Lazy{"SuperpixelUncertainty",
             "left/probabilities",
             true,
             false,
             {"left/image_selected", "left/scores"},
             {},
             {}},
        Lazy{"SuperpixelUncertainty",
             "left/uncertainty_overlay",
             true,
             false,
             {"left/image_selected", "left/scores"},
             {},
             {}},
        Lazy{"SuperpixelUncertainty",
             "left/share_view",
             true,
             false,
             {"left/image_selected", "left/scores"},
             {},
             {}},
        Lazy{"SuperpixelUncertainty",
             "left/confidence_view",
             true,
             false,
             {"left/image_selected", "left/scores"},
             {},
             {}},
        Lazy{"ImageSelection",
             "left/image_selected",
             true,
             false,
             {"front/image", "left/image"},
             {"points"},
             {}},
        Lazy{"Projection",
             "left/projection_overlay",
             true,
             false,
             {"front/scores", "front/share", "left/scores", "left/share", "left/image_selected"},
             {"points_compensated"},
             {"front/selection", "left/selection", "scan_reference"}},
        Lazy{"Projection",
             "left/points_pixel",
             false,
             true,
             {"front/scores", "front/share", "left/scores", "left/share"},
             {"points_compensated"},
             {"front/selection", "left/selection", "scan_reference"}},
        Lazy{"MotionCompensation",
             "points_compensated",
             false,
             true,
             {},
             {"points"},
             {"scan_reference"}},
        Lazy{"Projection",
             "points_semantic",
             false,
             true,
             {"front/scores", "front/share", "left/scores", "left/share"},
             {"points_compensated"},
             {"front/selection", "left/selection", "scan_reference"}}),
    [](const testing::TestParamInfo<Lazy>& info) { return nameOf(info.param); });

TEST(Laziness, ALastListenerStopsTheWholeChain) {
  const TemporaryFolder folder;
  Chain chain("lazy_chain", {std::begin(kTypes), std::end(kTypes)}, rigFile(folder.path()));
  ros::NodeHandle& node = chain.node();
  ros::Publisher cloud = node.advertise<sensor_msgs::PointCloud2>("points", 1);
  ros::Publisher picture = node.advertise<sensor_msgs::Image>("left/image", 1);
  ros::Publisher scores = node.advertise<sensor_msgs::Image>("left/scores", 1);
  for (int round = 0; round < 2; ++round) {
    std::vector<sensor_msgs::PointCloud2ConstPtr> semantic;
    ros::Subscriber listener = listen(node, "points_semantic", &semantic);
    EXPECT_TRUE(waitFor([&] {
      return cloud.getNumSubscribers() == 1 && picture.getNumSubscribers() == 1 &&
             scores.getNumSubscribers() == 1;
    }));
    listener.shutdown();
    EXPECT_TRUE(waitFor([&] {
      return cloud.getNumSubscribers() == 0 && picture.getNumSubscribers() == 0 &&
             scores.getNumSubscribers() == 0;
    }));
  }
}

TEST(Segmentation, EveryImageIsAnsweredAndTheNewestByTheNetwork) {
  const TemporaryFolder folder;
  // Score of class c = weight * mean of the channels + bias of c.
  writeConvolution(folder.path() + "/net.onnx", kWidth, kHeight, 1,
                   {0.5f, 0, 0, 0, 0.5f, 0, 0, 0, 0.5f}, {1, 2, 3});
  std::ofstream(folder.path() + "/model.yaml")
      << "file: net.onnx\ninput: {width: 64, height: 48, channels: bgr, scale: 1}\n"
         "classes: {road: [0], wall: [1], sky: [2]}\n";
  Chain chain("network", {"Segmentation"},
              rigFile(folder.path(), "segmentation: {model: model.yaml}\n"));
  ros::NodeHandle& node = chain.node();
  ros::Publisher images = node.advertise<sensor_msgs::Image>("front/image_selected", 20);
  std::vector<sensor_msgs::ImageConstPtr> scores;
  ros::Subscriber listener = listen(node, "front/scores", &scores);
  ASSERT_TRUE(waitFor([&] { return images.getNumSubscribers() == 1; }));
  constexpr int kImages = 12;
  for (int i = 0; i < kImages; ++i) {
    const auto picture = image("bgr8", kWidth, kHeight, 3, at(i));
    for (std::size_t k = 0; k < picture->data.size(); ++k) {
      picture->data[k] = static_cast<std::uint8_t>(10 * i + static_cast<int>(k % 3));
    }
    images.publish(sensor_msgs::ImageConstPtr(picture));
  }
  ASSERT_TRUE(waitFor([&] { return scores.size() == kImages; })) << scores.size();
  std::map<ros::Time, sensor_msgs::ImageConstPtr> by_stamp;
  for (const auto& answer : scores) by_stamp[answer->header.stamp] = answer;
  ASSERT_EQ(by_stamp.size(), static_cast<std::size_t>(kImages)) << "an image is answered twice";
  int superseded = 0;
  for (int i = 0; i < kImages; ++i) {
    ASSERT_EQ(by_stamp.count(at(i)), 1u);
    const sensor_msgs::Image& answer = *by_stamp[at(i)];
    if (answer.data.empty()) {
      ++superseded;
      continue;
    }
    ASSERT_EQ(answer.encoding, "32FC3");
    float first[kClasses];
    std::memcpy(first, answer.data.data(), sizeof(first));
    for (int c = 0; c < kClasses; ++c) {
      EXPECT_NEAR(first[c], 0.5 * (10 * i + c) + 1 + c, 1e-4);
    }
  }
  EXPECT_GT(superseded, 0) << "a burst of images, and the network took them all";
  EXPECT_FALSE(by_stamp[at(kImages - 1)]->data.empty()) << "the newest image got no scores";
}

}  // namespace
}  // namespace semantic_lidar_fusion

int main(int argc, char** argv) {
  testing::InitGoogleTest(&argc, argv);
  ros::init(argc, argv, "test_chain");
  ros::NodeHandle keep_alive;
  return RUN_ALL_TESTS();
}

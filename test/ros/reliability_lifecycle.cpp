// SPDX-License-Identifier: MIT
// Nodelets come and go while messages arrive at 50 Hz on several threads: nothing crashes, hangs or
// races, and the last set still works. SLF_CYCLES: how often (default 12; 100 by hand and under the
// sanitizers).
#include <gtest/gtest.h>
#include <nodelet/loader.h>
#include <ros/ros.h>
#include <sensor_msgs/CameraInfo.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/PointCloud2.h>
#include <sensor_msgs/point_cloud2_iterator.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <atomic>
#include <boost/make_shared.hpp>
#include <cstdlib>
#include <fstream>
#include <memory>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include "temporary_folder.h"

namespace semantic_lidar_fusion {
namespace {

constexpr int kWidth = 64, kHeight = 48, kClasses = 3;

int cycles() {
  const char* const wanted = std::getenv("SLF_CYCLES");
  return wanted == nullptr ? 12 : std::atoi(wanted);
}

sensor_msgs::ImagePtr image(const std::string& encoding, int pixel_bytes, const ros::Time& stamp) {
  auto message = boost::make_shared<sensor_msgs::Image>();
  message->header.stamp = stamp;
  message->header.frame_id = "front";
  message->width = kWidth;
  message->height = kHeight;
  message->encoding = encoding;
  message->step = static_cast<std::uint32_t>(kWidth * pixel_bytes);
  message->data.assign(static_cast<std::size_t>(message->step) * kHeight, 1);
  return message;
}

sensor_msgs::PointCloud2Ptr cloud(const ros::Time& stamp) {
  auto message = boost::make_shared<sensor_msgs::PointCloud2>();
  message->header.stamp = stamp;
  message->header.frame_id = "velodyne";
  sensor_msgs::PointCloud2Modifier modifier(*message);
  modifier.setPointCloud2Fields(
      4, "x", 1, sensor_msgs::PointField::FLOAT32, "y", 1, sensor_msgs::PointField::FLOAT32, "z", 1,
      sensor_msgs::PointField::FLOAT32, "time", 1, sensor_msgs::PointField::FLOAT32);
  modifier.resize(400);
  sensor_msgs::PointCloud2Iterator<float> value(*message, "x");
  for (int i = 0; i < 400; ++i, ++value) {
    value[0] = 10.0f;
    value[1] = static_cast<float>(i % 20 - 10);
    value[2] = static_cast<float>(i / 20 - 10);
    value[3] = 0.00004f * static_cast<float>(i);
  }
  return message;
}

tf2_msgs::TFMessage transform(const std::string& parent, const std::string& child,
                              const ros::Time& stamp, bool optical = false) {
  tf2_msgs::TFMessage message;
  message.transforms.resize(1);
  auto& one = message.transforms[0];
  one.header.frame_id = parent;
  one.header.stamp = stamp;
  one.child_frame_id = child;
  one.transform.rotation.w = 1.0;
  if (optical) {
    one.transform.rotation.x = one.transform.rotation.z = -0.5;
    one.transform.rotation.y = one.transform.rotation.w = 0.5;
  }
  return message;
}

/// Publishes everything a rig of one camera needs, 50 times a second, until it is destroyed.
class Traffic {
 public:
  explicit Traffic(ros::NodeHandle node)
      : tf_(node.advertise<tf2_msgs::TFMessage>("/tf", 10)),
        lidar_extrinsics_(node.advertise<tf2_msgs::TFMessage>("/tf_static", 10, true)),
        points_(node.advertise<sensor_msgs::PointCloud2>("points", 10)),
        image_(node.advertise<sensor_msgs::Image>("front/image", 10)),
        scores_(node.advertise<sensor_msgs::Image>("front/scores", 10)),
        info_(node.advertise<sensor_msgs::CameraInfo>("front/camera_info", 10)),
        thread_([this] { run(); }) {}
  ~Traffic() {
    stop_ = true;
    thread_.join();
  }

 private:
  void run() {
    tf2_msgs::TFMessage extrinsics = transform("base_link", "velodyne", ros::Time(1));
    extrinsics.transforms.push_back(
        transform("base_link", "front", ros::Time(1), true).transforms[0]);
    lidar_extrinsics_.publish(extrinsics);
    sensor_msgs::CameraInfo info;
    info.header.frame_id = "front";
    info.width = kWidth;
    info.height = kHeight;
    info.K = {30, 0, 31.5, 0, 30, 23.5, 0, 0, 1};
    info.P = {30, 0, 31.5, 0, 0, 30, 23.5, 0, 0, 0, 1, 0};
    for (int i = 0; !stop_; ++i) {
      const ros::Time now = ros::Time(1000.0 + 0.02 * i);
      tf_.publish(transform("odom", "base_link", now));
      info_.publish(info);
      image_.publish(image("bgr8", 3, now));
      scores_.publish(image("32FC" + std::to_string(kClasses), 4 * kClasses, now));
      points_.publish(cloud(now - ros::Duration(0.02)));
      ros::WallDuration(0.02).sleep();
    }
  }

  std::atomic<bool> stop_{false};
  ros::Publisher tf_, lidar_extrinsics_, points_, image_, scores_, info_;
  std::thread thread_;
};

TEST(Lifecycle, LoadsAndUnloadsUnderLoad) {
  const TemporaryFolder folder;
  const std::string rig = folder.path() + "/rig.yaml";
  std::ofstream(rig) << "classes: {classes: [{name: road, color: [1, 2, 3]}, "
                        "{name: wall, color: [4, 5, 6]}, {name: sky, color: [7, 8, 9]}]}\n"
                        "cameras: [{name: front}]\nlidar: {input: points}\n"
                        "superpixels: {count: 20}\nocclusion: {mode: 'off'}\n";
  ros::NodeHandle node;
  std::atomic<int> received{0};
  // The listener comes and goes as well: the chain wakes up and falls asleep while it is loaded.
  const boost::function<void(const sensor_msgs::PointCloud2ConstPtr&)> listen =
      [&](const sensor_msgs::PointCloud2ConstPtr&) { ++received; };
  ros::AsyncSpinner spinner(1);
  spinner.start();
  const Traffic traffic(node);
  nodelet::Loader loader(false);
  std::vector<std::string> types = {"ImageSelection", "SuperpixelUncertainty", "MotionCompensation",
                                    "Projection"};
  for (const std::string& type : types) ros::param::set("/" + type + "/rig_file", rig);
  std::mt19937 random(3);
  int worked = 0;
  for (int cycle = 0; cycle < cycles(); ++cycle) {
    std::shuffle(types.begin(), types.end(), random);
    for (const std::string& type : types) {
      ASSERT_TRUE(loader.load("/" + type, "semantic_lidar_fusion/" + type + "Nodelet", {}, {}));
    }
    received = 0;
    ros::Subscriber listener =
        node.subscribe<sensor_msgs::PointCloud2>("points_semantic", 10, listen);
    // Mostly until the chain works, sometimes into its first moments.
    const bool patient = cycle % 4 != 3;
    const ros::WallTime deadline =
        ros::WallTime::now() + ros::WallDuration(patient ? 60.0 : 0.001 * (random() % 40));
    while (ros::WallTime::now() < deadline && received < 2) ros::WallDuration(0.005).sleep();
    if (patient) {
      EXPECT_GE(received, 2) << "cycle " << cycle;
    }
    worked += received >= 2;
    if (cycle % 2 == 0) listener.shutdown();
    std::shuffle(types.begin(), types.end(), random);
    for (const std::string& type : types) ASSERT_TRUE(loader.unload("/" + type));
  }
  EXPECT_GE(worked, cycles() / 2);
}

}  // namespace
}  // namespace semantic_lidar_fusion

int main(int argc, char** argv) {
  testing::InitGoogleTest(&argc, argv);
  ros::init(argc, argv, "reliability_lifecycle");
  ros::NodeHandle keep_alive;
  return RUN_ALL_TESTS();
}

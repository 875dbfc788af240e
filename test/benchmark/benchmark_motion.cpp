// SPDX-License-Identifier: MIT
/// Motion compensation of one VLP-16 scan, a pose for each firing, beside what a user would build
/// of tf2 and `pcl_ros::transformPointCloud`: a lookup for each packet, as velodyne_pointcloud's
/// Transform nodelet does it, or for each firing, one thread. Both give one cloud for the scan.
/// Compare rows of one run: absolute times depend on the machine and on its other work.
#include <benchmark/benchmark.h>

#include <cmath>
#include <cstring>
#include <utility>
#include <vector>

#include "benchmark_main.h"
#include "semantic_lidar_fusion/motion/compensation.h"
#ifdef SLF_BENCHMARK_PCL
#include <pcl_ros/transforms.h>
#include <sensor_msgs/PointCloud2.h>
#include <sensor_msgs/point_cloud2_iterator.h>
#include <tf2/buffer_core.h>
#include <tf2_eigen/tf2_eigen.h>
#endif

namespace semantic_lidar_fusion {
namespace {

constexpr int kPackets = 76;
constexpr int kFiringsPerPacket = 24;
constexpr int kRings = 16;
constexpr StampNs kStart = 1600000000 * kNsPerSecond;
constexpr StampNs kFiring_ns = 55296;
constexpr StampNs kReference = kStart + 50000000;
constexpr StampNs kOdometry_ns = 10000000;  // 100 Hz

/// 15 m/s along a curve of 30 deg/s, in map coordinates.
Transform vehicleAt(StampNs time) {
  const double t = toSeconds(time - kStart), rate = 0.52, radius = 15.0 / rate;
  Transform T_fixed_vehicle = Transform::Identity();
  T_fixed_vehicle.linear() =
      Eigen::AngleAxisd(rate * t, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T_fixed_vehicle.translation() = Eigen::Vector3d(334000.0 + radius * std::sin(rate * t),
                                                  6250000.0 - radius * std::cos(rate * t), 20.0);
  return T_fixed_vehicle;
}

Transform vehicleLidar() {
  Transform T_vehicle_lidar = Transform::Identity();
  T_vehicle_lidar.translation() = Eigen::Vector3d(1.2, 0.0, 1.8);
  return T_vehicle_lidar;
}

TimedCloud scan() {
  TimedCloud cloud;
  for (int packet = 0; packet < kPackets; ++packet) {
    for (int f = 0; f < kFiringsPerPacket; ++f) {
      const int number = packet * kFiringsPerPacket + f;
      const StampNs time = kStart + number * kFiring_ns;
      cloud.firings.push_back({time, time + 15 * 2304, static_cast<std::uint32_t>(packet)});
      const double azimuth = -number * 0.2 * M_PI / 180.0;
      for (int ring = 0; ring < kRings; ++ring) {
        const double elevation = (2.0 * ring - 15.0) * M_PI / 180.0, range = 5.0 + number % 40;
        cloud.x.push_back(static_cast<float>(range * std::cos(elevation) * std::cos(azimuth)));
        cloud.y.push_back(static_cast<float>(range * std::cos(elevation) * std::sin(azimuth)));
        cloud.z.push_back(static_cast<float>(range * std::sin(elevation)));
        cloud.intensity.push_back(1.0f);
        cloud.ring.push_back(static_cast<std::uint16_t>(ring));
        cloud.time_ns.push_back(time + ring * 2304);
        cloud.firing.push_back(static_cast<std::uint32_t>(number));
      }
    }
  }
  return cloud;
}

void motionOurs(benchmark::State& state) {
  const TimedCloud cloud = scan();
  PoseBuffer odometry;
  for (int i = -5; i < 20; ++i) {
    const StampNs stamp = kStart + i * kOdometry_ns;
    odometry.add({stamp, vehicleAt(stamp)});
  }
  for (auto _ : state) {
    // The nodelet's scan is its own, fresh from the decoder: the copy is not part of the work.
    state.PauseTiming();
    TimedCloud own = cloud;
    state.ResumeTiming();
    const CompensationResult result =
        compensate(std::move(own), kReference, odometry, vehicleLidar(), {});
    benchmark::DoNotOptimize(result.cloud.x.data());
  }
  state.counters["points"] = static_cast<double>(cloud.size());
}
BENCHMARK(motionOurs)->Name("motion/ours")->Unit(benchmark::kMicrosecond);

#ifdef SLF_BENCHMARK_PCL
geometry_msgs::TransformStamped stamped(const Transform& transform, const std::string& parent,
                                        const std::string& child, StampNs stamp) {
  geometry_msgs::TransformStamped message = tf2::eigenToTransform(transform);
  message.header.frame_id = parent;
  message.child_frame_id = child;
  message.header.stamp.fromNSec(static_cast<std::uint64_t>(stamp));
  return message;
}

sensor_msgs::PointCloud2 partOf(const TimedCloud& scan, std::size_t begin, std::size_t end) {
  sensor_msgs::PointCloud2 cloud;
  cloud.header.frame_id = "lidar";
  sensor_msgs::PointCloud2Modifier modifier(cloud);
  modifier.setPointCloud2Fields(
      5, "x", 1, sensor_msgs::PointField::FLOAT32, "y", 1, sensor_msgs::PointField::FLOAT32, "z", 1,
      sensor_msgs::PointField::FLOAT32, "intensity", 1, sensor_msgs::PointField::FLOAT32, "ring", 1,
      sensor_msgs::PointField::UINT16);
  modifier.resize(end - begin);
  for (std::size_t i = begin; i < end; ++i) {
    std::uint8_t* point = cloud.data.data() + (i - begin) * cloud.point_step;
    const float values[4] = {scan.x[i], scan.y[i], scan.z[i], scan.intensity[i]};
    std::memcpy(point, values, sizeof(values));
    std::memcpy(point + sizeof(values), &scan.ring[i], sizeof(scan.ring[i]));
  }
  return cloud;
}

/// A lookup for `firings` firings at a time.
void motionPeer(benchmark::State& state, int firings) {
  const TimedCloud cloud = scan();
  tf2::BufferCore buffer(ros::Duration(20.0));
  buffer.setTransform(stamped(vehicleLidar(), "base_link", "lidar", kStart), "benchmark", true);
  for (int i = -5; i < 20; ++i) {
    const StampNs stamp = kStart + i * kOdometry_ns;
    buffer.setTransform(stamped(vehicleAt(stamp), "odom", "base_link", stamp), "benchmark");
  }
  std::vector<sensor_msgs::PointCloud2> parts;
  const auto points = static_cast<std::size_t>(firings * kRings);
  for (std::size_t begin = 0; begin < cloud.size(); begin += points) {
    parts.push_back(partOf(cloud, begin, begin + points));
  }
  ros::Time reference;
  reference.fromNSec(static_cast<std::uint64_t>(kReference));
  sensor_msgs::PointCloud2 moved, whole;
  for (auto _ : state) {
    whole.data.clear();
    for (std::size_t k = 0; k < parts.size(); ++k) {
      ros::Time time;
      time.fromNSec(static_cast<std::uint64_t>(cloud.time_ns[k * points]));
      const geometry_msgs::TransformStamped transform =
          buffer.lookupTransform("lidar", reference, "lidar", time, "odom");
      const Eigen::Matrix4f matrix =
          tf2::transformToEigen(transform.transform).matrix().cast<float>();
      pcl_ros::transformPointCloud(matrix, parts[k], moved);
      whole.data.insert(whole.data.end(), moved.data.begin(), moved.data.end());
    }
    benchmark::DoNotOptimize(whole.data.data());
  }
}
BENCHMARK_CAPTURE(motionPeer, packet, kFiringsPerPacket)
    ->Name("motion/tf2+pcl_ros::transformPointCloud")
    ->Unit(benchmark::kMicrosecond);
BENCHMARK_CAPTURE(motionPeer, firing, 1)
    ->Name("motion_by_firing/tf2+pcl_ros::transformPointCloud")
    ->Unit(benchmark::kMicrosecond);
#endif

}  // namespace
}  // namespace semantic_lidar_fusion

int main(int argc, char** argv) {
  return semantic_lidar_fusion::runBenchmarksWithWarmHeap(argc, argv);
}

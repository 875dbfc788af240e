// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <cmath>
#include <memory>
#include <random>
#include <string>
#include <tuple>

#include "semantic_lidar_fusion/common/yaml_reader.h"
#include "semantic_lidar_fusion/fusion/lidar_rows.h"

namespace semantic_lidar_fusion {
namespace {

constexpr double kRadPerDeg = 3.14159265358979323846 / 180.0;

/// Axes of a camera (z forward, y down) that looks along a body's x.
Eigen::Matrix3d bodyFromOptical() {
  Eigen::Matrix3d R;
  R << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  return R;
}

/// Of a camera at `place` in the lidar's frame, yawed and then pitched (nose down).
Transform cameraFromLidar(const Eigen::Vector3d& place, double yaw, double pitch) {
  Transform T_lidar_camera = Transform::Identity();
  T_lidar_camera.linear() = (Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) *
                             Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()))
                                .toRotationMatrix() *
                            bodyFromOptical();
  T_lidar_camera.translation() = place;
  return T_lidar_camera.inverse();
}

std::shared_ptr<const CameraModel> pinhole(double focal_px = 300.0) {
  CameraInfo info;
  info.size = {640, 480};
  info.k = {focal_px, 0, 320, 0, focal_px, 240, 0, 0, 1};
  return std::make_shared<const CameraModel>(info, CameraModelOptions{});
}

std::shared_ptr<const CameraModel> fisheye() {
  CameraInfo info;
  info.size = {1920, 1208};
  info.distortion_model = "equidistant";
  info.d = {-0.0557, 0.0173, -0.0019, 0.00007};
  info.k = {980.0, 0.0, 970.5, 0.0, 975.0, 610.25, 0.0, 0.0, 1.0};
  return std::make_shared<const CameraModel>(info, CameraModelOptions{});
}

/// A point of a ring of the lidar, and the lidar turned meanwhile by as much as the margin is.
Eigen::Vector3d randomPoint(const LidarSpec& lidar, std::mt19937* random) {
  std::uniform_real_distribution<double> part(0.0, 1.0);
  std::uniform_int_distribution<std::size_t> laser(0, lidar.lasers.size() - 1);
  const double elevation = lidar.lasers[laser(*random)].elevation_rad;
  const double azimuth = 2.0 * 180.0 * kRadPerDeg * part(*random);
  const double range = kReachNearest_m * std::exp(5.0 * part(*random));
  const Eigen::Vector3d axis(part(*random) - 0.5, part(*random) - 0.5, part(*random) - 0.5);
  return Eigen::AngleAxisd(kReachMarginRad, axis.normalized()) *
         Eigen::Vector3d(range * std::cos(elevation) * std::cos(azimuth),
                         range * std::cos(elevation) * std::sin(azimuth),
                         range * std::sin(elevation));
}

TEST(LidarRowsTest, HoldEveryPointOfTheReach) {
  std::mt19937 random(1);
  int seen = 0;
  for (const char* name : {"VLP16", "HDL32E"}) {
    const LidarSpec& lidar = *findLidarSpec(name);
    for (const auto& camera : {pinhole(), fisheye()}) {
      for (const auto& [place, yaw, pitch] :
           {std::tuple(Eigen::Vector3d(0.0, 0.0, 0.0), 0.0, 0.0),
            std::tuple(Eigen::Vector3d(0.4, 0.5, -0.3), 1.1, 0.15),
            std::tuple(Eigen::Vector3d(-0.8, -0.2, 0.2), -2.5, -0.1)}) {
        const Transform T_camera_lidar = cameraFromLidar(place, yaw, pitch);
        const RowBand rows = reachedRows(*camera, T_camera_lidar, reachOf(lidar, 0.0));
        const double height = camera->imageSize().height;
        for (int i = 0; i < 4000; ++i) {
          const auto pixel = camera->project(T_camera_lidar * randomPoint(lidar, &random));
          if (!pixel || !inImage(pixel->x(), pixel->y(), camera->imageSize())) continue;
          ++seen;
          ASSERT_GE(pixel->y(), rows.first * height) << name << " " << yaw;
          ASSERT_LT(pixel->y(), rows.last * height) << name << " " << yaw;
        }
      }
    }
  }
  EXPECT_GT(seen, 5000);
}

TEST(LidarRowsTest, AreThoseOfTheOutermostRingsSeenFromTheLidarsPlace) {
  // v - cy = f tan(elevation) hypot(1, (u - cx) / f), most at the image's left and right border.
  const double focal = 300.0, steepest = 15.0 * kRadPerDeg + kReachMarginRad;
  const double v = focal * std::tan(steepest) * std::hypot(1.0, 320.0 / focal);
  const RowBand rows = reachedRows(*pinhole(focal), cameraFromLidar({0, 0, 0}, 0.7, 0.0),
                                   reachOf(*findLidarSpec("VLP16"), 0.0));
  // 0.01 of the height as a margin, and less than 1 px for the steps of the azimuth.
  EXPECT_NEAR(rows.first, (240.0 - v) / 480.0 - 0.01, 1.0 / 480.0);
  EXPECT_NEAR(rows.last, (240.0 + v + 1.0) / 480.0 + 0.01, 1.0 / 480.0);
}

TEST(LidarRowsTest, NearPointsReachFurtherUpWhereTheCameraIsLower) {
  const Transform T_camera_lidar = cameraFromLidar({0.0, 0.0, -0.5}, 0.0, 0.0);
  const LidarSpec& lidar = *findLidarSpec("VLP16");
  const RowBand near = reachedRows(*pinhole(), T_camera_lidar, reachOf(lidar, 0.0));
  const RowBand far = reachedRows(*pinhole(), T_camera_lidar, reachOf(lidar, 20.0));
  EXPECT_EQ(reachOf(lidar, 20.0).nearest_m, 20.0);
  EXPECT_EQ(reachOf(lidar, 0.0).nearest_m, kReachNearest_m);
  // In the image's middle, where it is least.
  EXPECT_LT(near.first, far.first - 300.0 * (0.5 / kReachNearest_m - 0.5 / 20.0) / 480.0);
  EXPECT_NEAR(near.last, far.last, 8.0 / 480.0);  // far points of the lowest ring, of both
}

TEST(LidarRowsTest, ALidarThatTheCameraDoesNotSeeLeavesTheWholeImage) {
  // The camera looks straight up.
  const RowBand rows = reachedRows(*pinhole(), cameraFromLidar({0, 0, 0}, 0.0, -90.0 * kRadPerDeg),
                                   reachOf(*findLidarSpec("VLP16"), 0.0));
  EXPECT_EQ(rows.first, 0.0);
  EXPECT_EQ(rows.last, 1.0);
}

Rig rigWithRows(const std::string& rows) {
  return rigFromYaml(
      parseYaml("classes: classes_usyd12.yaml\nlidar: {model: VLP16, frame: velodyne}\n"
                "cameras:\n  - {name: a, lidar_rows: " +
                    rows + "}\n",
                "rig.yaml"),
      std::string(SLF_SOURCE_DIR) + "/config", "rig");
}

TEST(LidarRowsTest, AreFoundAgainWhenTheCameraMoves) {
  const Rig rig = rigWithRows("auto");
  LidarRows lidar_rows(rig);
  EXPECT_EQ(lidar_rows.of(0, {}).first, 0.0);
  EXPECT_EQ(lidar_rows.of(0, {}).last, 1.0);
  const auto camera = pinhole(150.0);
  for (const double pitch : {0.0, 0.2, 0.0}) {
    const CameraPlace place{camera, cameraFromLidar({0.3, 0.1, -0.2}, 0.0, pitch)};
    const RowBand expected = reachedRows(*place.model, place.T_camera_lidar,
                                         reachOf(*rig.lidar.model, rig.lidar.min_range_m));
    EXPECT_GT(expected.first, 0.02);
    for (int i = 0; i < 2; ++i) {
      EXPECT_EQ(lidar_rows.of(0, place).first, expected.first);
      EXPECT_EQ(lidar_rows.of(0, place).last, expected.last);
    }
  }
  const auto longer = pinhole(200.0);
  EXPECT_LT(lidar_rows.of(0, {longer, cameraFromLidar({0.3, 0.1, -0.2}, 0.0, 0.0)}).first,
            lidar_rows.of(0, {camera, cameraFromLidar({0.3, 0.1, -0.2}, 0.0, 0.0)}).first);
}

TEST(LidarRowsTest, ThatTheRigNamesStand) {
  const Rig rig = rigWithRows("{first: 0.2, last: 0.7}");
  LidarRows lidar_rows(rig);
  for (const CameraPlace& place : {CameraPlace{}, CameraPlace{pinhole(), Transform::Identity()}}) {
    EXPECT_EQ(lidar_rows.of(0, place).first, 0.2);
    EXPECT_EQ(lidar_rows.of(0, place).last, 0.7);
  }
}

}  // namespace
}  // namespace semantic_lidar_fusion

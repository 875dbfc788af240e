// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

#include "ray_scene.h"
#include "semantic_lidar_fusion/projection/cloud_projector.h"

namespace semantic_lidar_fusion {
namespace {

CameraInfo fisheyeInfo() {
  CameraInfo info;
  info.size = {1928, 1208};
  info.distortion_model = "equidistant";
  info.d = {-0.0557, 0.0173, -0.0019, 0.00007};
  info.k = {1166.0, 4.0, 970.5, 0.0, 1150.0, 610.25, 0.0, 0.0, 1.0};
  info.p = {900.0, 0.0, 950.0, 0.0, 0.0, 910.0, 600.0, 0.0, 0.0, 0.0, 1.0, 0.0};
  return info;
}

Cloud randomCloud(std::size_t count, std::uint32_t seed) {
  std::mt19937 random(seed);
  std::normal_distribution<float> coordinate(0.0f, 12.0f);
  Cloud cloud;
  for (std::size_t i = 0; i < count; ++i) {
    cloud.x.push_back(coordinate(random));
    cloud.y.push_back(coordinate(random));
    cloud.z.push_back(0.2f * coordinate(random));
    cloud.status.push_back(i % 7 == 3 ? static_cast<std::uint8_t>(PointStatus::kNoOdometry) : 0);
  }
  cloud.ring.assign(count, 0);
  return cloud;
}

Transform cameraFromLidar() {
  Transform T_lidar_camera = Transform::Identity();
  T_lidar_camera.linear() = Eigen::AngleAxisd(0.3, Eigen::Vector3d::UnitZ()) * bodyFromOptical();
  T_lidar_camera.translation() = Eigen::Vector3d(0.3, -0.5, -0.4);
  return T_lidar_camera.inverse();
}

TEST(ProjectCloud, KeepsExactlyThePointsWithAPixelWithinTheMargin) {
  const Cloud cloud = randomCloud(20000, 1);
  const Transform T_camera_lidar = cameraFromLidar();
  const CameraModel camera(fisheyeInfo(), {});
  for (const double margin : {0.0, 41.5}) {
    const ProjectedPoints points = projectCloud(cloud, T_camera_lidar, camera, margin);
    ASSERT_EQ(points.u.size(), points.size());
    ASSERT_EQ(points.v.size(), points.size());
    ASSERT_EQ(points.distance.size(), points.size());
    ASSERT_EQ(points.theta.size(), points.size());
    std::size_t next = 0;
    for (std::size_t i = 0; i < cloud.size(); ++i) {
      if (cloud.status[i] != 0) continue;
      const Eigen::Vector3d p =
          T_camera_lidar * Eigen::Vector3d(cloud.x[i], cloud.y[i], cloud.z[i]);
      const auto pixel = camera.project(p);
      if (!pixel || pixel->x() < -0.5 - margin || pixel->x() >= 1927.5 + margin ||
          pixel->y() < -0.5 - margin || pixel->y() >= 1207.5 + margin) {
        continue;
      }
      ASSERT_LT(next, points.size());
      EXPECT_EQ(points.index[next], i);
      // Half a unit in the last place of a float below 2048, of 50 m and of pi
      EXPECT_NEAR(points.u[next], pixel->x(), 1.3e-4);
      EXPECT_NEAR(points.v[next], pixel->y(), 1.3e-4);
      EXPECT_NEAR(points.distance[next], p.norm(), 4e-6);
      EXPECT_NEAR(points.theta[next], std::atan2(std::hypot(p.x(), p.y()), p.z()), 3e-7);
      ++next;
    }
    EXPECT_EQ(next, points.size());
    EXPECT_GT(next, 2000u);
  }
}

TEST(ProjectCloud, UAndVOfAnOffAxisPoint) {
  // 45 deg right of and 20 deg below the axis on a lens without distortion: equal angles, equal px.
  CameraInfo info = fisheyeInfo();
  info.d.assign(4, 0.0);
  info.k[1] = 0.0;
  Cloud cloud;
  const Eigen::Vector3d direction(std::tan(0.5), 0.0, 1.0), lower(0.0, std::tan(0.25), 1.0);
  for (const Eigen::Vector3d& p : {direction, lower}) {
    cloud.x.push_back(static_cast<float>(p.x()));
    cloud.y.push_back(static_cast<float>(p.y()));
    cloud.z.push_back(static_cast<float>(p.z()));
    cloud.status.push_back(0);
  }
  const auto points = projectCloud(cloud, Transform::Identity(), CameraModel(info, {}), 0.0);
  ASSERT_EQ(points.size(), 2u);
  EXPECT_NEAR(points.u[0], 970.5 + 0.5 * 1166.0, 1e-3);
  EXPECT_NEAR(points.v[0], 610.25, 1e-3);
  EXPECT_NEAR(points.u[1], 970.5, 1e-3);
  EXPECT_NEAR(points.v[1], 610.25 + 0.25 * 1150.0, 1e-3);
}

TEST(ProjectCloud, PointsAtTheBorderStayInsideAfterTheCast) {
  // u just below width - 0.5 rounds up as a float; it must then not count as inside.
  CameraInfo info = fisheyeInfo();
  info.distortion_model = "";
  info.d.clear();
  const CameraModel camera(info, {});
  Cloud cloud;
  for (int i = -200; i < 200; ++i) {
    const double u = 1927.5 + i * 2e-6;
    cloud.x.push_back(static_cast<float>((u - 970.5) / 1166.0));
    cloud.y.push_back(0.0f);
    cloud.z.push_back(1.0f);
    cloud.status.push_back(0);
  }
  const auto points = projectCloud(cloud, Transform::Identity(), camera, 0.0);
  EXPECT_GT(points.size(), 0u);
  EXPECT_LT(points.size(), 400u);
  for (std::size_t i = 0; i < points.size(); ++i) {
    EXPECT_TRUE(inImage(points.u[i], points.v[i], camera.imageSize()));
    EXPECT_LT(pixelIndex(points.u[i]), 1928);
  }
}

TEST(ProjectCloud, DistanceIsFromTheOpticalCentreOfARectifiedImage) {
  CameraInfo info = fisheyeInfo();
  info.p[3] = -900.0 * 0.54;  // second camera of a stereo pair
  CameraModelOptions options;
  options.rectified = true;
  Cloud cloud;
  cloud.x = {1.0f};
  cloud.y = {0.2f};
  cloud.z = {4.0f};
  cloud.status = {0};
  const auto points = projectCloud(cloud, Transform::Identity(), CameraModel(info, options), 0.0);
  ASSERT_EQ(points.size(), 1u);
  EXPECT_NEAR(points.distance[0], std::sqrt(0.46 * 0.46 + 0.2 * 0.2 + 16.0), 1e-6);
  EXPECT_NEAR(points.theta[0], std::atan2(std::hypot(0.46, 0.2), 4.0), 1e-6);
}

TEST(ProjectCloud, NonFiniteAndEmpty) {
  Cloud cloud;
  const CameraModel camera(fisheyeInfo(), {});
  EXPECT_EQ(projectCloud(cloud, Transform::Identity(), camera, 10.0).size(), 0u);
  cloud.x = {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity(), 0.0f};
  cloud.y = {0.0f, 0.0f, 0.0f};
  cloud.z = {5.0f, 5.0f, 0.0f};
  cloud.status = {0, 0, 0};
  EXPECT_EQ(projectCloud(cloud, Transform::Identity(), camera, 10.0).size(), 0u);
}

}  // namespace
}  // namespace semantic_lidar_fusion

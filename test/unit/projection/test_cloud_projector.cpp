// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <opencv2/calib3d.hpp>
#include <optional>
#include <random>
#include <vector>

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
      // Half a unit in the last place of a float below 2048, and the lens in single precision
      EXPECT_NEAR(points.u[next], pixel->x(), 1e-3);
      EXPECT_NEAR(points.v[next], pixel->y(), 1e-3);
      EXPECT_NEAR(points.distance[next], p.norm(), 4e-6);
      EXPECT_NEAR(points.theta[next], std::atan2(std::hypot(p.x(), p.y()), p.z()), 5e-7);
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

/// Points that project to about where the model ends, a hair's breadth to either side, and on the
/// axis.
Cloud pointsAtTheLimit(const CameraModel& camera) {
  std::mt19937 random(5);
  Cloud cloud;
  for (const double beside :
       {0.0, 1e-9, -1e-9, 1e-7, -1e-7, 3e-7, -3e-7, 1e-6, -1e-6, 3e-6, -3e-6, 1e-4, -1e-4}) {
    for (int i = 0; i < 60; ++i) {
      const double theta = camera.maxThetaRad() + beside, turn = 0.11 * i;
      const double range = std::pow(10.0, static_cast<int>(random() % 6) - 2);
      cloud.x.push_back(static_cast<float>(range * std::sin(theta) * std::cos(turn)));
      cloud.y.push_back(static_cast<float>(range * std::sin(theta) * std::sin(turn)));
      cloud.z.push_back(static_cast<float>(range * std::cos(theta)));
    }
  }
  for (const float along : {-3.0f, -1e-6f, 0.0f, 1e-20f, 1e-7f, 2.0f, 1e10f, 1e20f, 3e38f}) {
    for (const float aside : {0.0f, 1e-30f, -1e-20f, 1e-12f, 1e-7f, 1e15f, -3e38f}) {
      cloud.x.push_back(aside);
      cloud.y.push_back(0.0f);
      cloud.z.push_back(along);
    }
  }
  cloud.status.assign(cloud.x.size(), 0);
  return cloud;
}

TEST(ProjectCloud, LimitsAreThoseOfTheModelToTheLastBit) {
  struct Lens {
    std::vector<double> k;
    double max_theta_deg;
  };
  // No limit at all; a fold-over at 90 deg and more, and before it; a limit that is given.
  for (const Lens& lens :
       {Lens{{0.0, 0.0, 0.0, 0.0}, 0.0}, Lens{{-0.1, 0.0, 0.0, 0.0}, 0.0},
        Lens{{-0.3, 0.0, 0.0, 0.0}, 0.0}, Lens{{-0.0557, 0.0173, -0.0019, 0.00007}, 50.0},
        Lens{{-0.0557, 0.0173, -0.0019, 0.00007}, 110.0}}) {
    CameraInfo info = fisheyeInfo();
    info.d = lens.k;
    CameraModelOptions options;
    options.max_theta_deg = lens.max_theta_deg;
    const CameraModel camera(info, options);
    const Cloud cloud = pointsAtTheLimit(camera);
    // So wide that the bounds of the image decide nothing.
    const double margin = 5000.0;
    const ProjectedPoints points = projectCloud(cloud, Transform::Identity(), camera, margin);
    std::size_t next = 0, without = 0;
    for (std::size_t i = 0; i < cloud.size(); ++i) {
      const Eigen::Vector3d p(cloud.x[i], cloud.y[i], cloud.z[i]);
      const auto pixel = camera.project(p);
      const bool kept = next < points.size() && points.index[next] == i;
      ASSERT_EQ(kept, pixel.has_value())
          << "(" << p.transpose() << "), limit " << camera.maxThetaRad();
      if (!kept) {
        ++without;
        continue;
      }
      EXPECT_NEAR(points.u[next], pixel->x(), 2e-3) << p.transpose();
      EXPECT_NEAR(points.v[next], pixel->y(), 2e-3) << p.transpose();
      ++next;
    }
    EXPECT_EQ(next, points.size());
    EXPECT_GT(next, 100u);
    EXPECT_GT(without, 2u);  // straight behind there is none, whatever the lens
  }
}

TEST(ProjectCloud, EveryModelGivesItsPixels) {
  std::mt19937 random(11);
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  int points_in_all = 0;
  for (int trial = 0; trial < 60; ++trial) {
    CameraInfo info = fisheyeInfo();
    info.k[1] = 30.0 * uniform(random);  // skew
    for (double& k : info.d) k *= 1.0 + uniform(random);
    const double focal = std::pow(10.0, 2.5 + uniform(random));
    info.k[0] = focal;
    info.k[4] = focal * (1.0 + 0.2 * uniform(random));
    info.size = {1 + static_cast<int>(random() % 3000), 1 + static_cast<int>(random() % 2000)};
    if (trial % 4 == 1) {
      info.distortion_model = "";
      info.d.clear();
    } else if (trial % 4 == 2) {
      info.distortion_model = "plumb_bob";
      info.d = {-0.3, 0.1, 0.001, -0.002, 0.01};
    }
    const CameraModel camera(info, {});
    const Cloud cloud = randomCloud(2000, static_cast<std::uint32_t>(trial));
    const Transform T_camera_lidar = cameraFromLidar();
    const double margin = trial % 3 * 10.0;
    const ProjectedPoints points = projectCloud(cloud, T_camera_lidar, camera, margin);
    const double near = 2e-3;
    std::size_t next = 0;
    for (std::size_t i = 0; i < cloud.size(); ++i) {
      const Eigen::Vector3d p =
          T_camera_lidar * Eigen::Vector3d(cloud.x[i], cloud.y[i], cloud.z[i]);
      const auto pixel = cloud.status[i] == 0 ? camera.project(p) : std::nullopt;
      const auto within = [&](double slack) {
        return pixel && pixel->x() >= -0.5 - margin - slack &&
               pixel->x() < info.size.width - 0.5 + margin + slack &&
               pixel->y() >= -0.5 - margin - slack &&
               pixel->y() < info.size.height - 0.5 + margin + slack;
      };
      const bool kept = next < points.size() && points.index[next] == i;
      if (kept ? !within(near) : within(-near)) {
        FAIL() << "trial " << trial << ", point " << i << (kept ? " kept" : " lost");
      }
      if (!kept) continue;
      ASSERT_NEAR(points.u[next], pixel->x(), near) << "trial " << trial;
      ASSERT_NEAR(points.v[next], pixel->y(), near) << "trial " << trial;
      ASSERT_NEAR(points.distance[next], p.norm(), 1e-7 * p.norm());
      ++next;
    }
    EXPECT_EQ(next, points.size()) << "trial " << trial;
    points_in_all += static_cast<int>(next);
  }
  EXPECT_GT(points_in_all, 5000);
}

TEST(ProjectCloud, AgreesWithOpencv) {
  const CameraInfo info = fisheyeInfo();
  const CameraModel camera(info, {});
  const Cloud cloud = randomCloud(5000, 21);
  const Transform T_camera_lidar = cameraFromLidar();
  const ProjectedPoints points = projectCloud(cloud, T_camera_lidar, camera, 0.0);
  std::vector<cv::Point3d> in_front;
  std::vector<std::size_t> which;
  for (std::size_t k = 0; k < points.size(); ++k) {
    const std::uint32_t i = points.index[k];
    const Eigen::Vector3d p = T_camera_lidar * Eigen::Vector3d(cloud.x[i], cloud.y[i], cloud.z[i]);
    if (p.z() < 0.1) continue;
    in_front.emplace_back(p.x(), p.y(), p.z());
    which.push_back(k);
  }
  ASSERT_GT(which.size(), 500u);
  std::vector<cv::Point2d> pixels;
  const cv::Matx33d k(info.k[0], 0, info.k[2], 0, info.k[4], info.k[5], 0, 0, 1);
  cv::fisheye::projectPoints(in_front, pixels, cv::Vec3d(), cv::Vec3d(), k, info.d,
                             info.k[1] / info.k[0]);
  for (std::size_t j = 0; j < which.size(); ++j) {
    EXPECT_NEAR(points.u[which[j]], pixels[j].x, 1e-3);
    EXPECT_NEAR(points.v[which[j]], pixels[j].y, 1e-3);
  }
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

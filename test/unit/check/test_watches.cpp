// SPDX-License-Identifier: MIT
/// Motion, twist and classes against geometry.
#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <cmath>
#include <random>

#include "semantic_lidar_fusion/check/class_geometry.h"
#include "semantic_lidar_fusion/check/own_motion.h"
#include "semantic_lidar_fusion/check/twist_watch.h"

namespace semantic_lidar_fusion {
namespace {

// --- TwistWatch

/// What is said of 3 s at 50 Hz with the given pose per second and twist.
std::string said(double pose_mps, double pose_rad_s, double twist_mps, double twist_rad_s) {
  TwistWatch watch;
  Transform T = Transform::Identity();
  const Transform step = Eigen::Translation3d(0.02 * pose_mps, 0, 0) *
                         Eigen::AngleAxisd(0.02 * pose_rad_s, Eigen::Vector3d::UnitZ());
  std::string result;
  for (int k = 0; k < 150; ++k) {
    const auto doubt =
        watch.add(kNsPerSecond + k * 20000000LL, T, {{twist_mps, 0, 0}, {0, 0, twist_rad_s}});
    if (doubt && result.empty()) result = *doubt;
    T = T * step;
  }
  return result;
}

TEST(TwistWatch, PoseAndTwistThatAgreeAreFine) {
  EXPECT_EQ(said(8.0, 0.3, 8.0, 0.3), "");
  EXPECT_EQ(said(-2.0, 0.0, -2.0, 0.0), "") << "backwards";
  EXPECT_EQ(said(0.0, 0.0, 0.0, 0.0), "");
  EXPECT_EQ(said(8.0, 0.3, 0.0, 0.0), "") << "a driver without a twist";
}

TEST(TwistWatch, NamesWhatDiffers) {
  EXPECT_NE(said(0.0, 0.0, 8.0, 0.0).find("frozen"), std::string::npos);
  EXPECT_NE(said(8000.0, 0.0, 8.0, 0.0).find("another unit"), std::string::npos);
  EXPECT_NE(said(-8.0, 0.0, 8.0, 0.0).find("inverted"), std::string::npos);
  EXPECT_NE(said(8.0, -0.3, 8.0, 0.3).find("sign of yaw"), std::string::npos);
}

// --- OwnMotion

/// A scan of 8 rings between upright posts of random places, and the ground 1.8 m below, from
/// `x` m along the street.
TimedCloud scanAt(double x, StampNs stamp) {
  std::mt19937 random(4);
  std::uniform_real_distribution<double> along(-60, 60), across(3, 15);
  TimedCloud cloud;
  std::vector<Eigen::Vector2d> posts;
  for (int k = 0; k < 90; ++k) {
    posts.emplace_back(along(random), across(random) * (k % 2 ? 1 : -1));
  }
  for (std::uint16_t ring = 0; ring < 8; ++ring) {
    for (int k = 0; k < 360; ++k) {
      const double azimuth = (k + 0.5) * kPi / 180.0 - kPi;
      const Eigen::Vector2d beam(std::cos(azimuth), std::sin(azimuth));
      double range = 0.0;
      for (const Eigen::Vector2d& post : posts) {  // of a radius of 0.6 m
        const Eigen::Vector2d to = post - Eigen::Vector2d(x, 0);
        const double ahead = to.dot(beam);
        const double off = to.squaredNorm() - ahead * ahead;
        if (ahead < 2.5 || off > 0.36) continue;
        const double hit = ahead - std::sqrt(0.36 - off);
        if (range == 0.0 || hit < range) range = hit;
      }
      if (ring < 3) range = 1.8 / std::tan((8 - 2 * ring) * kPi / 180.0);
      if (range == 0.0) continue;
      cloud.x.push_back(static_cast<float>(range * beam.x()));
      cloud.y.push_back(static_cast<float>(range * beam.y()));
      cloud.z.push_back(0.0f);
      cloud.ring.push_back(ring);
      cloud.time_ns.push_back(stamp);
      cloud.firings.push_back({stamp, stamp, 0});
    }
  }
  return cloud;
}

/// 30 scans at 10 Hz at `lidar_mps`, with odometry that says `odometry_mps`.
std::string ownMotionSays(double lidar_mps, double odometry_mps) {
  PoseBuffer odometry;
  for (int k = -1; k < 32; ++k) {
    StampedPose pose;
    pose.stamp = kNsPerSecond + k * 100000000LL;
    pose.T_fixed_vehicle.translation().x() = 0.1 * k * odometry_mps;
    odometry.add(pose);
  }
  OwnMotion motion;
  for (int k = 0; k < 30; ++k) {
    motion.add(scanAt(0.1 * k * lidar_mps, kNsPerSecond + k * 100000000LL), odometry,
               Transform::Identity());
  }
  return motion.doubt();
}

TEST(OwnMotion, TellsFrozenAndInvertedOdometryOnly) {
  EXPECT_EQ(ownMotionSays(8.0, 8.0), "");
  EXPECT_EQ(ownMotionSays(-3.0, -3.0), "") << "backwards";
  EXPECT_EQ(ownMotionSays(0.0, 0.0), "") << "at rest";
  EXPECT_NE(ownMotionSays(8.0, 0.0).find("frozen"), std::string::npos);
  EXPECT_NE(ownMotionSays(8.0, -8.0).find("inverted"), std::string::npos);
}

TEST(OwnMotion, RangesThatChangeAtRandomAreNoMotion) {
  std::mt19937 random(5);
  std::normal_distribution<float> noise(0.0f, 0.5f);
  TimedCloud first = scanAt(0.0, kNsPerSecond), second = first;
  for (std::size_t i = 0; i < second.size(); ++i) {  // leaves in the wind
    const float scale = 1.0f + noise(random) / std::hypot(second.x[i], second.y[i]);
    second.x[i] *= scale;
    second.y[i] *= scale;
  }
  const RangeGrid::Change change = RangeGrid(first).to(RangeGrid(second));
  EXPECT_GT(change.changed, 500u);
  EXPECT_FALSE(change.isClear());
}

TEST(OwnMotion, ABusThatPassesIsNoMotion) {
  TimedCloud first, second;
  for (TimedCloud* cloud : {&first, &second}) {
    for (std::uint16_t ring = 0; ring < 8; ++ring) {
      for (int k = 0; k < 360; ++k) {
        const double azimuth = (k + 0.5) * kPi / 180.0 - kPi;
        const bool bus = k > 250 && k < 300;  // to the left, comes nearer
        const double range = bus ? (cloud == &first ? 8.0 : 7.2) : 20.0;
        cloud->x.push_back(static_cast<float>(range * std::cos(azimuth)));
        cloud->y.push_back(static_cast<float>(range * std::sin(azimuth)));
        cloud->z.push_back(0.0f);
        cloud->ring.push_back(ring);
      }
    }
  }
  const RangeGrid::Change change = RangeGrid(first).to(RangeGrid(second));
  EXPECT_EQ(change.changed, 8u * 49u);
  EXPECT_GT(change.motion.norm(), 0.5);
  EXPECT_FALSE(change.isClear());
}

// --- ClassGeometry

LabelSet classes() {
  return LabelSet::fromYaml(
      YAML::Load("[{name: sky, color: [0, 0, 1]}, {name: building, color: [0, 0, 2]},"
                 " {name: road, color: [0, 0, 3]}, {name: tree, color: [0, 0, 4]},"
                 " {name: car, color: [0, 0, 5]}]"),
      "test");
}

constexpr int kBuilding = 1, kRoad = 2, kTree = 3, kCar = 4;

/// A lidar 1.8 m above a road, with walls up to 8 m, and some trees and cars; labels by
/// `label(true class)`.
template <typename Label>
SemanticCloud street(const Label& label) {
  SemanticCloud cloud;
  const auto add = [&](float x, float y, float z, int of) {
    cloud.points.x.push_back(x);
    cloud.points.y.push_back(y);
    cloud.points.z.push_back(z);
    cloud.points.status.push_back(0);
    cloud.cameras.push_back(1);
    cloud.label.push_back(static_cast<std::uint8_t>(label(of)));
  };
  for (int i = 0; i < 40; ++i) {
    for (int k = 0; k < 40; ++k) add(0.5f * i - 10.0f, 0.25f * k - 5.0f, -1.8f, kRoad);
    for (int k = 1; k < 20; ++k) add(0.5f * i - 10.0f, 6.0f, 0.5f * k - 1.8f, kBuilding);
    add(0.5f * i - 10.0f, 4.0f, -0.8f, kCar);
    add(0.5f * i - 10.0f, -4.0f, -0.8f, kTree);
  }
  return cloud;
}

template <typename Label>
ClassGeometry::Answer judged(const Label& label) {
  const SemanticCloud cloud = street(label);
  const auto ground = groundPlane(cloud.points, Transform::Identity());
  EXPECT_TRUE(ground);
  EXPECT_NEAR(ground->height_m, -1.8, 0.1);  // a bin
  EXPECT_FALSE(ground->has_other_side);
  ClassGeometry geometry;
  geometry.add(cloud, 0, Transform::Identity(), *ground);
  return geometry.judge(classes());
}

TEST(ClassGeometry, NamesIdsThatDoNotFitTheGround) {
  using Verdict = ClassGeometry::Verdict;
  EXPECT_EQ(judged([](int of) { return of; }).verdict, Verdict::kFine);
  EXPECT_EQ(judged([](int of) { return of + 1; }).verdict, Verdict::kIdsTooHigh);
  EXPECT_EQ(judged([](int of) { return of - 1; }).verdict, Verdict::kIdsTooLow);
  EXPECT_EQ(judged([](int of) { return (of + 2) % 5; }).verdict, Verdict::kGroundIsOther);
  EXPECT_EQ(judged([](int of) { return of == kBuilding ? kRoad : of; }).verdict,
            Verdict::kGroundIsHigh);
  int n = 0;
  const auto some_sky =
      judged([&](int of) { return of == kBuilding ? (++n % 2 ? 0 : kBuilding) : of; });
  EXPECT_EQ(some_sky.verdict, Verdict::kSky);
  EXPECT_NE(some_sky.text.find("sky"), std::string::npos);
}

TEST(ClassGeometry, LabelsOfOneThingAndItsSurroundingsSayNothing) {
  EXPECT_EQ(judged([](int of) { return of == kCar ? kCar : kBuilding; }).verdict,
            ClassGeometry::Verdict::kTooFew);
}

TEST(ClassGeometry, SaysNothingWithoutGroundClassesOrPoints) {
  const SemanticCloud cloud = street([](int of) { return of; });
  ClassGeometry geometry;
  EXPECT_EQ(geometry.judge(classes()).verdict, ClassGeometry::Verdict::kTooFew);
  geometry.add(cloud, 1, Transform::Identity(), *groundPlane(cloud.points, Transform::Identity()));
  EXPECT_EQ(geometry.judge(classes()).verdict, ClassGeometry::Verdict::kTooFew)
      << "another camera's points";
  geometry.add(cloud, 0, Transform::Identity(), *groundPlane(cloud.points, Transform::Identity()));
  const LabelSet parts = LabelSet::fromYaml(YAML::Load("[{name: a, color: [0, 0, 1]}]"), "test");
  EXPECT_EQ(geometry.judge(parts).verdict, ClassGeometry::Verdict::kTooFew);
}

TEST(ClassGeometry, FindsTheGroundAboveALidarOnItsHead) {
  const SemanticCloud cloud = street([](int) { return kRoad; });
  const Transform on_its_head(Eigen::AngleAxisd(kPi, Eigen::Vector3d::UnitX()));
  const auto ground = groundPlane(cloud.points, on_its_head);
  ASSERT_TRUE(ground);
  EXPECT_NEAR(ground->above_lidar_m, 1.8, 0.1);
  EXPECT_FALSE(ground->has_other_side);
  Cloud few = cloud.points;
  few.x.resize(100);
  few.y.resize(100);
  few.z.resize(100);
  EXPECT_FALSE(groundPlane(few, Transform::Identity()));
}

}  // namespace
}  // namespace semantic_lidar_fusion

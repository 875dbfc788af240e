// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>
#include <string>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/motion/pose_buffer.h"

namespace semantic_lidar_fusion {
namespace {

Transform pose(double x, double yaw_rad) {
  Transform T = Transform::Identity();
  T.linear() = Eigen::AngleAxisd(yaw_rad, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T.translation() = Eigen::Vector3d(x, 2.0 * x, -x);
  return T;
}

double yaw(const Transform& T) { return std::atan2(T.linear()(1, 0), T.linear()(0, 0)); }

TEST(Interpolate, IsLinearInTranslationAndAngle) {
  const Transform a = pose(1.0, 0.1);
  const Transform b = pose(3.0, 0.9);
  for (const double fraction : {0.0, 0.25, 0.5, 1.0}) {
    const Transform T = interpolate(a, b, fraction);
    EXPECT_NEAR(T.translation().x(), 1.0 + 2.0 * fraction, 1e-12);
    EXPECT_NEAR(T.translation().z(), -1.0 - 2.0 * fraction, 1e-12);
    EXPECT_NEAR(yaw(T), 0.1 + 0.8 * fraction, 1e-12);
  }
}

TEST(Interpolate, TakesTheShorterWayAcrossTheHalfTurn) {
  // The quaternions of +179 and -179 deg have a negative dot product.
  const double degree = kPi / 180.0;
  const Transform T = interpolate(pose(0.0, 179.0 * degree), pose(0.0, -179.0 * degree), 0.25);
  EXPECT_NEAR(yaw(T), 179.5 * degree, 1e-12);
}

TEST(Interpolate, KeepsRotationsOrthonormal) {
  std::mt19937 random(7);
  std::normal_distribution<double> normal;
  for (int i = 0; i < 1000; ++i) {
    const auto draw = [&] {
      Transform T = Transform::Identity();
      T.linear() =
          Eigen::Quaterniond(normal(random), normal(random), normal(random), normal(random))
              .normalized()
              .toRotationMatrix();
      return T;
    };
    const Eigen::Matrix3d R = interpolate(draw(), draw(), 0.3).linear();
    EXPECT_LT((R.transpose() * R - Eigen::Matrix3d::Identity()).norm(), 1e-12);
    EXPECT_NEAR(R.determinant(), 1.0, 1e-12);
  }
}

TEST(PoseBuffer, AnswersBetweenItsReadingsOnly) {
  PoseBuffer buffer;
  EXPECT_TRUE(buffer.empty());
  EXPECT_FALSE(buffer.covers(0));
  EXPECT_FALSE(buffer.lookup(0));
  EXPECT_FALSE(buffer.closest(0));

  buffer.add({100, pose(1.0, 0.0)});
  EXPECT_TRUE(buffer.covers(100));
  EXPECT_FALSE(buffer.covers(101));
  EXPECT_EQ(buffer.lookup(100)->translation().x(), 1.0);
  EXPECT_EQ(buffer.closest(100)->translation().x(), 1.0);

  buffer.add({200, pose(2.0, 0.0)});
  EXPECT_FALSE(buffer.lookup(99));
  EXPECT_FALSE(buffer.lookup(201));
  EXPECT_FALSE(buffer.closest(201));
  EXPECT_NEAR(buffer.lookup(130)->translation().x(), 1.3, 1e-12);
  EXPECT_EQ(buffer.closest(149)->translation().x(), 1.0);
  EXPECT_EQ(buffer.closest(150)->translation().x(), 1.0) << "half-way: the earlier reading";
  EXPECT_EQ(buffer.closest(151)->translation().x(), 2.0);
  EXPECT_EQ(buffer.lookup(200)->translation().x(), 2.0);
}

TEST(PoseBuffer, SortsLateReadingsAndReplacesDuplicates) {
  PoseBuffer buffer;
  for (const StampNs stamp : {300, 100, 400, 200}) {
    buffer.add({stamp, pose(static_cast<double>(stamp), 0.0)});
  }
  ASSERT_EQ(buffer.size(), 4u);
  for (std::size_t i = 0; i < 4; ++i) {
    EXPECT_EQ(buffer.readings()[i].stamp, static_cast<StampNs>(100 * (i + 1)));
  }
  buffer.add({200, pose(-7.0, 0.0)});
  ASSERT_EQ(buffer.size(), 4u);
  EXPECT_EQ(buffer.lookup(200)->translation().x(), -7.0);
}

TEST(PoseBuffer, InterpolatesAcrossAGap) {
  PoseBuffer buffer;
  buffer.add({0, pose(0.0, 0.0)});
  buffer.add({10, pose(1.0, 0.0)});
  buffer.add({10010, pose(2.0, 0.0)});
  EXPECT_NEAR(buffer.lookup(5010)->translation().x(), 1.5, 1e-12);
}

TEST(PoseBuffer, TwistIsThatOfAConstantDrive) {
  // 15 m/s along the vehicle's own x, 30 deg/s: the exponential of a constant twist, on a circle of
  // radius v / w.
  const double v = 15.0, w = 30.0 * kPi / 180.0, radius = v / w;
  const auto at = [&](StampNs t) {
    const double a = w * toSeconds(t);
    Transform T = Transform::Identity();
    T.linear() = Eigen::AngleAxisd(a, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    T.translation() = Eigen::Vector3d(radius * std::sin(a), radius * (1.0 - std::cos(a)), 0.0);
    return T;
  };
  for (const StampNs period : {StampNs{1000000}, StampNs{10000000}, StampNs{50000000}}) {
    PoseBuffer buffer;
    for (StampNs t = 0; t <= 20 * period; t += period) buffer.add({t, at(t)});
    for (const StampNs t : {StampNs{0}, 5 * period + 1, 7 * period, 20 * period}) {
      const auto twist = buffer.twist(t);
      ASSERT_TRUE(twist);
      // A chord is shorter than its arc by (w dt)^2 / 24.
      EXPECT_NEAR(twist->velocity.x(), v, 1e-3);
      EXPECT_NEAR(twist->velocity.y(), 0.0, 1e-6);
      EXPECT_NEAR(twist->turn.z(), w, 1e-9);
    }
    EXPECT_FALSE(buffer.twist(-1));
    EXPECT_FALSE(buffer.twist(20 * period + 1));
  }
}

TEST(PoseBuffer, TwistOfFastReadingsSpansTenMillisecondsAndLaterOnesDoNotChangeIt) {
  // Noise of 1 mm at 1 kHz would be 1 m/s between neighbours.
  PoseBuffer buffer;
  for (StampNs t = 0; t <= 40; ++t) {
    buffer.add({t * 1000000, pose(0.01 * static_cast<double>(t) + (t % 2 == 0 ? 1e-3 : 0.0), 0.0)});
  }
  const auto twist = buffer.twist(20500000);
  ASSERT_TRUE(twist);
  // From 11 to 21 ms: both odd.
  EXPECT_NEAR(twist->velocity.x(), 10.0, 1e-9);
  buffer.add({41000000, pose(99.0, 0.0)});
  EXPECT_EQ(buffer.twist(20500000)->velocity, twist->velocity);
  PoseBuffer single;
  single.add({5, pose(1.0, 0.0)});
  EXPECT_FALSE(single.twist(5));
}

TEST(PoseBuffer, ForgetsWhatIsOlderThanItsHistory) {
  PoseBuffer buffer(100);
  for (StampNs stamp = 0; stamp <= 1000; stamp += 10) buffer.add({stamp, pose(0.0, 0.0)});
  EXPECT_EQ(buffer.readings().front().stamp, 900);
  EXPECT_EQ(buffer.size(), 11u);
  buffer.add({500, pose(0.0, 0.0)});
  EXPECT_EQ(buffer.readings().front().stamp, 900) << "a reading beyond the history is not kept";
  buffer.clear();
  EXPECT_TRUE(buffer.empty());
}

TEST(PoseBuffer, RefusesBrokenPosesAndStaysAsItWas) {
  PoseBuffer buffer;
  buffer.add({1, pose(0.0, 0.0)});
  const auto message = [&](const Transform& T) -> std::string {
    try {
      buffer.add({77, T});
    } catch (const DataError& error) {
      return error.what();
    }
    return "";
  };
  Transform bad = pose(0.0, 0.0);
  bad.translation().y() = std::numeric_limits<double>::quiet_NaN();
  EXPECT_NE(message(bad).find("77 ns"), std::string::npos);
  bad.translation().y() = std::numeric_limits<double>::infinity();
  EXPECT_NE(message(bad).find("finite"), std::string::npos);
  bad = pose(0.0, 0.0);
  bad.linear() *= 1.01;
  EXPECT_NE(message(bad).find("orthonormal"), std::string::npos);
  bad = pose(0.0, 0.0);
  bad.linear().col(0) *= -1.0;
  EXPECT_NE(message(bad).find("orthonormal"), std::string::npos) << "a mirror is no rotation";
  bad = pose(0.0, 0.0);
  bad.linear().setZero();
  EXPECT_NE(message(bad).find("orthonormal"), std::string::npos);
  EXPECT_EQ(buffer.size(), 1u);
}

StampedPose placed(StampNs stamp, double x, double yaw = 0.0) {
  StampedPose pose{stamp, Transform::Identity()};
  pose.T_fixed_vehicle.translation().x() = x;
  pose.T_fixed_vehicle.linear() =
      Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  return pose;
}

TEST(PoseBuffer, AJumpPartsItsReadings) {
  constexpr StampNs ms = 1000000;
  PoseBuffer buffer(0, 100.0);
  for (int i = 0; i < 20; ++i) buffer.add(placed(i * 10 * ms, 0.2 * i + (i < 12 ? 0.0 : 3.0)));
  EXPECT_EQ(buffer.jumps(), std::vector<StampNs>{120 * ms});
  EXPECT_TRUE(buffer.covers(110 * ms) && buffer.covers(120 * ms));
  EXPECT_FALSE(buffer.covers(115 * ms));
  EXPECT_FALSE(buffer.lookup(115 * ms));
  EXPECT_EQ(buffer.stretchAround(50 * ms), (PoseBuffer::Stretch{0, 12}));
  EXPECT_EQ(buffer.stretchAround(115 * ms), (PoseBuffer::Stretch{0, 12}));
  EXPECT_EQ(buffer.stretchAround(116 * ms), (PoseBuffer::Stretch{12, 20}));
  EXPECT_EQ(buffer.stretchAround(-ms), (PoseBuffer::Stretch{0, 12}));
  EXPECT_EQ(buffer.stretchAround(900 * ms), (PoseBuffer::Stretch{12, 20}));
  PoseBuffer unlimited;
  for (const StampedPose& reading : buffer.readings()) unlimited.add(reading);
  EXPECT_TRUE(unlimited.jumps().empty());

  PoseBuffer turned(0, 100.0);
  for (int i = 0; i < 4; ++i) turned.add(placed(i * 10 * ms, 0.0, i < 2 ? 0.0 : 1.0));
  EXPECT_EQ(turned.jumps(), std::vector<StampNs>{20 * ms});
}

TEST(PoseBuffer, TwoSourcesOfOnePoseJumpToAndFro) {
  constexpr StampNs ms = 1000000;
  PoseBuffer buffer(0, 100.0);
  for (int i = 0; i < 20; ++i) buffer.add(placed(i * 5 * ms, 0.1 * i + (i % 2) * 0.6));
  // All but the first step, which could be a fast one.
  EXPECT_EQ(buffer.jumps().size(), 18u);
  PoseBuffer noisy(0, 100.0);
  for (int i = 0; i < 20; ++i) noisy.add(placed(i * 5 * ms, 0.1 * i + (i % 2) * 0.02));
  EXPECT_TRUE(noisy.jumps().empty());
}

TEST(PoseBuffer, ManyReadingsInAnyOrderAreAsOneByOne) {
  constexpr StampNs ms = 1000000;
  std::vector<StampedPose> readings;
  for (int i = 0; i < 50; ++i) {
    readings.push_back(placed((i * 37 % 50) * 10 * ms, i * 37 % 50 < 30 ? 0.0 : 40.0));
  }
  readings.push_back(placed(70 * ms, 0.5));  // a second one
  PoseBuffer together(400 * ms, 100.0), single(400 * ms, 100.0);
  together.add(readings);
  for (const StampedPose& reading : readings) single.add(reading);
  ASSERT_EQ(together.size(), 41u);
  ASSERT_EQ(single.jumps(), together.jumps());
  ASSERT_EQ(together.jumps(), std::vector<StampNs>{300 * ms});
  for (std::size_t i = 0; i < together.size(); ++i) {
    EXPECT_EQ(together.readings()[i].stamp, (i + 9) * 10 * ms);
  }
}

}  // namespace
}  // namespace semantic_lidar_fusion

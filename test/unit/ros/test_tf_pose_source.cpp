// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <tf2/buffer_core.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <random>

#include "edge/conversions.h"
#include "edge/tf_pose_source.h"

namespace semantic_lidar_fusion {
namespace {

constexpr StampNs kStart = 1546300800000000000;
constexpr StampNs kMs = 1000000;

geometry_msgs::TransformStamped stamped(const std::string& parent, const std::string& child,
                                        StampNs stamp, const Transform& T_parent_child) {
  geometry_msgs::TransformStamped message;
  message.header.frame_id = parent;
  message.child_frame_id = child;
  message.header.stamp = rosTime(stamp);
  message.transform.translation.x = T_parent_child.translation().x();
  message.transform.translation.y = T_parent_child.translation().y();
  message.transform.translation.z = T_parent_child.translation().z();
  const Eigen::Quaterniond q(T_parent_child.linear());
  message.transform.rotation.w = q.w();
  message.transform.rotation.x = q.x();
  message.transform.rotation.y = q.y();
  message.transform.rotation.z = q.z();
  return message;
}

Transform pose(double x, double y, double yaw) {
  Transform T = Transform::Identity();
  T.linear() = Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T.translation() = Eigen::Vector3d(x, y, 0.3);
  return T;
}

/// 15 m/s, 30 deg/s from an origin in UTM coordinates.
Transform driven(double t_s) { return pose(331275.0 + 15.0 * t_s, 6250099.0 - t_s, 0.5236 * t_s); }

void expectEqual(const Transform& a, const Transform& b, double tolerance) {
  EXPECT_NEAR((a.translation() - b.translation()).norm(), 0.0, tolerance);
  EXPECT_NEAR((a.linear() - b.linear()).norm(), 0.0, tolerance);
}

TfPoseSourceConfig defaults() { return {}; }

TEST(TfPoseSource, InterpolatesAsTf2Does) {
  TfPoseSource source(defaults());
  tf2::BufferCore oracle(ros::Duration(100));
  for (int i = 0; i <= 50; ++i) {
    const auto message = stamped("odom", "base_link", kStart + i * 10 * kMs, driven(0.01 * i));
    EXPECT_TRUE(source.add(message, false));
    oracle.setTransform(message, "");
  }
  const PoseBuffer& odometry = source.odometry();
  EXPECT_EQ(odometry.size(), 51u);
  std::mt19937 random(1);
  std::uniform_int_distribution<StampNs> time(0, 500 * kMs);
  for (int i = 0; i < 200; ++i) {
    const StampNs t = kStart + time(random);
    const auto ours = odometry.lookup(t);
    ASSERT_TRUE(ours);
    const Transform theirs =
        transform(oracle.lookupTransform("odom", "base_link", rosTime(t)).transform);
    // Two roundings of coordinates of 6e6 m: 2 * 2^-53 * 6.25e6 = 1.4e-9.
    expectEqual(*ours, theirs, 5e-9);
  }
  EXPECT_FALSE(odometry.covers(kStart - 1));
  EXPECT_FALSE(odometry.covers(kStart + 500 * kMs + 1));
}

TEST(TfPoseSource, JoinsStaticAndTwoMovingEdges) {
  TfPoseSourceConfig config;
  config.fixed_frame = "map";
  config.vehicle_frame = "base_link";
  TfPoseSource source(config);
  tf2::BufferCore oracle(ros::Duration(100));
  const auto add = [&](const geometry_msgs::TransformStamped& message, bool is_static) {
    EXPECT_TRUE(source.add(message, is_static));
    oracle.setTransform(message, "", is_static);
  };
  add(stamped("footprint", "base_link", kStart, pose(0, 0, 0.1)), true);
  for (int i = 0; i <= 20; ++i) {
    if (i % 5 == 0) {
      add(stamped("map", "odom", kStart + i * 10 * kMs + 3 * kMs, pose(1.0 * i, 0, 0.01 * i)),
          false);
    }
    add(stamped("odom", "footprint", kStart + i * 10 * kMs, driven(0.01 * i)), false);
    source.odometry();  // reading now and then or once gives the same
  }
  const PoseBuffer& odometry = source.odometry();
  ASSERT_FALSE(odometry.empty());
  // Covered from map -> odom's first (3 ms) to odom -> footprint's last (200 ms).
  EXPECT_EQ(odometry.readings().front().stamp, kStart + 3 * kMs);
  EXPECT_EQ(odometry.readings().back().stamp, kStart + 200 * kMs);
  for (const StampedPose& reading : odometry.readings()) {
    expectEqual(
        reading.T_fixed_vehicle,
        transform(oracle.lookupTransform("map", "base_link", rosTime(reading.stamp)).transform),
        5e-9);
  }
}

TEST(TfPoseSource, StaticTreeThatComesLateIsMadeUpFor) {
  TfPoseSource source(defaults());
  for (int i = 0; i < 10; ++i) {
    source.add(stamped("odom", "footprint", kStart + i * 10 * kMs, driven(0.01 * i)), false);
  }
  EXPECT_TRUE(source.odometry().empty());
  source.add(stamped("footprint", "base_link", kStart, pose(1, 0, 0)), true);
  EXPECT_EQ(source.odometry().size(), 10u);
}

TEST(TfPoseSource, FixedFrameMayHangBelowTheVehicle) {
  TfPoseSource source(defaults());
  for (int i = 0; i < 3; ++i) {
    source.add(stamped("base_link", "odom", kStart + i * 10 * kMs, driven(0.01 * i).inverse()),
               false);
  }
  ASSERT_EQ(source.odometry().size(), 3u);
  expectEqual(source.odometry().readings()[1].T_fixed_vehicle, driven(0.01), 5e-9);
}

TEST(TfPoseSource, MovingFramesBesideTheChainAreNotRead) {
  TfPoseSource source(defaults());
  source.add(stamped("odom", "base_link", kStart, driven(0)), false);
  source.add(stamped("base_link", "wheel", kStart + kMs, pose(0, 1, 2)), false);
  source.add(stamped("odom", "base_link", kStart + 10 * kMs, driven(0.01)), false);
  EXPECT_EQ(source.odometry().size(), 2u);
}

TEST(TfPoseSource, LeadingSlashesDoNotMatter) {
  TfPoseSourceConfig config;
  config.fixed_frame = "/odom";
  TfPoseSource source(config);
  source.add(stamped("/odom", "/base_link", kStart, driven(0)), false);
  source.add(stamped("/base_link", "velodyne", kStart, pose(1, 0, 0)), true);
  EXPECT_EQ(source.odometry().size(), 1u);
  ASSERT_TRUE(source.extrinsics("base_link", "/velodyne"));
  EXPECT_EQ(source.extrinsics("base_link", "/velodyne").transform->translation().x(), 1.0);
}

TEST(TfPoseSource, VehicleThatStandsStillIsCoveredAtAllTimes) {
  TfPoseSource source(defaults());
  source.add(stamped("odom", "base_link", kStart, pose(4, 5, 0)), true);
  EXPECT_TRUE(source.odometry().covers(kStart));
  EXPECT_TRUE(source.odometry().covers(kStart + 3600 * kNsPerSecond));
  EXPECT_EQ(source.odometry().lookup(kStart)->translation().x(), 4.0);
}

TEST(TfPoseSource, TimeOffsetShiftsReadings) {
  TfPoseSourceConfig config;
  config.time_offset_ns = -7 * kMs;
  TfPoseSource source(config);
  source.add(stamped("odom", "base_link", kStart, driven(0)), false);
  EXPECT_EQ(source.odometry().readings().front().stamp, kStart - 7 * kMs);
}

TEST(TfPoseSource, UnusableTransformsAreCountedAndHarmNothing) {
  TfPoseSource source(defaults());
  auto bad = stamped("odom", "base_link", kStart, driven(0));
  bad.transform.translation.x = std::numeric_limits<double>::quiet_NaN();
  EXPECT_FALSE(source.add(bad, false));
  bad = stamped("odom", "base_link", kStart, driven(0));
  bad.transform.rotation.w = bad.transform.rotation.z = 0;
  EXPECT_FALSE(source.add(bad, false));
  EXPECT_FALSE(source.add(stamped("odom", "base_link", 0, driven(0)), false));
  EXPECT_FALSE(source.add(stamped("", "base_link", kStart, driven(0)), false));
  EXPECT_FALSE(source.add(stamped("odom", "", kStart, driven(0)), false));
  EXPECT_FALSE(source.add(stamped("odom", "odom", kStart, driven(0)), false));
  EXPECT_FALSE(
      source.add(stamped("odom", "base_link", 4294967295LL * kNsPerSecond, driven(0)), false) &&
      source.add(stamped("odom", "base_link", 4294967295LL * kNsPerSecond - 1, driven(0)), false));
  EXPECT_GE(source.counters().rejected, 6u);
  TfPoseSource fresh(defaults());
  EXPECT_TRUE(fresh.add(stamped("odom", "base_link", kStart, driven(0)), false));
  EXPECT_FALSE(fresh.add(stamped("odom", "base_link", kStart, driven(0)), false));
  EXPECT_EQ(fresh.counters().repeated, 1u);
  EXPECT_EQ(fresh.odometry().size(), 1u);
}

TEST(TfPoseSource, LoopInTheTreeEnds) {
  TfPoseSource source(defaults());
  source.add(stamped("base_link", "odom", kStart, driven(0)), false);
  source.add(stamped("odom", "base_link", kStart, driven(0)), false);
  source.odometry();
  EXPECT_FALSE(source.extrinsics("odom", "velodyne"));
}

TEST(TfPoseSource, SaysWhyThereIsNoTransform) {
  TfPoseSource source(defaults());
  source.add(stamped("odom", "base_link", kStart, driven(0)), false);
  source.add(stamped("island", "camera", kStart, pose(0, 0, 0)), true);
  const TransformAnswer unknown = source.extrinsics("base_link", "velodyne");
  EXPECT_FALSE(unknown);
  EXPECT_EQ(unknown.problem, TransformProblem::kUnknownFrame);
  EXPECT_NE(unknown.message.find("velodyne"), std::string::npos);
  const TransformAnswer apart = source.extrinsics("base_link", "camera");
  EXPECT_EQ(apart.problem, TransformProblem::kNotConnected);
  EXPECT_NE(apart.message.find("camera"), std::string::npos);
  EXPECT_EQ(source.extrinsics("", "camera").problem, TransformProblem::kInvalidRequest);
}

TEST(TfPoseSource, GapNamesFramesAndTimes) {
  TfPoseSource source(defaults());
  EXPECT_NE(source.gap(kStart, kStart).find("base_link"), std::string::npos);
  source.add(stamped("odom", "base_link", kStart, driven(0)), false);
  source.add(stamped("odom", "base_link", kStart + 10 * kMs, driven(0.01)), false);
  EXPECT_EQ(source.gap(kStart, kStart + 10 * kMs), "");
  const std::string gap = source.gap(kStart, kStart + 11 * kMs);
  EXPECT_NE(gap.find("odom"), std::string::npos) << gap;
  EXPECT_NE(gap.find("1546300800.010000000"), std::string::npos) << gap;
  EXPECT_NE(gap.find("1546300800.011000000"), std::string::npos) << gap;
}

TEST(TfPoseSource, ClearForgetsMotionAndKeepsExtrinsics) {
  TfPoseSource source(defaults());
  source.add(stamped("base_link", "velodyne", kStart, pose(1, 0, 0)), true);
  source.add(stamped("odom", "base_link", kStart + 10 * kMs, driven(0)), false);
  EXPECT_EQ(source.odometry().size(), 1u);
  source.clear();
  EXPECT_TRUE(source.odometry().empty());
  EXPECT_TRUE(source.extrinsics("base_link", "velodyne"));
  EXPECT_TRUE(source.add(stamped("odom", "base_link", kStart, driven(0)), false));
  EXPECT_EQ(source.odometry().size(), 1u);
}

TEST(TfPoseSource, BoundedHistoryForgets) {
  TfPoseSourceConfig config;
  config.history_ns = 100 * kMs;
  TfPoseSource source(config);
  for (int i = 0; i <= 100; ++i) {
    source.add(stamped("odom", "base_link", kStart + i * 10 * kMs, driven(0.01 * i)), false);
    source.odometry();
  }
  EXPECT_EQ(source.odometry().size(), 11u);
}

TEST(TfPoseSource, GapSaysThatTheHistoryIsTooShort) {
  TfPoseSourceConfig config;
  config.history_ns = 10 * kNsPerSecond;
  TfPoseSource source(config);
  for (int i = 0; i <= 300; ++i) {
    source.add(stamped("odom", "base_link", kStart + i * 100 * kMs, driven(0.1 * i)), false);
  }
  const StampNs newest = kStart + 30 * kNsPerSecond;
  const std::string old = source.gap(newest - 20 * kNsPerSecond, newest - 19 * kNsPerSecond);
  EXPECT_NE(old.find("older than the 10.000000000 s that are kept"), std::string::npos) << old;
  const std::string future = source.gap(newest, newest + kNsPerSecond);
  EXPECT_NE(future.find("is known from"), std::string::npos) << future;
  EXPECT_EQ(future.find("older than"), std::string::npos) << future;
}

std::string notesOf(TfPoseSource& source) {
  std::string text;
  for (const std::string& note : source.takeNotes()) text += note + "\n";
  return text;
}

TEST(TfPoseSource, RefusesWithTheReasonOnceForEachFrame) {
  const auto reasonOf = [](const std::function<void(geometry_msgs::TransformStamped&)>& spoil) {
    TfPoseSource source(defaults());
    auto message = stamped("odom", "base_link", kStart, driven(0));
    spoil(message);
    for (int i = 0; i < 3; ++i) EXPECT_FALSE(source.add(message, false));
    const std::string text = notesOf(source);
    EXPECT_EQ(std::count(text.begin(), text.end(), '\n'), 1) << text;
    EXPECT_EQ(source.problem() + "\n", text);
    return text;
  };
  using Message = geometry_msgs::TransformStamped;
  const auto expect = [&](const std::string& word, const std::function<void(Message&)>& spoil) {
    const std::string text = reasonOf(spoil);
    EXPECT_NE(text.find(word), std::string::npos) << text;
  };
  expect("1.2", [](Message& m) {
    m.transform.rotation.w *= 1.2;
    m.transform.rotation.z *= 1.2;
  });
  expect("norm 0", [](Message& m) { m.transform.rotation.w = m.transform.rotation.z = 0.0; });
  expect("stamp is 0", [](Message& m) { m.header.stamp = ros::Time(); });
  expect("header.frame_id is empty", [](Message& m) { m.header.frame_id.clear(); });
  expect("child_frame_id is empty", [](Message& m) { m.child_frame_id.clear(); });
  expect("below itself", [](Message& m) { m.child_frame_id = "odom"; });
  expect("finite", [](Message& m) { m.transform.translation.y = std::nan(""); });
  expect("odometry.largest_coordinate_m", [](Message& m) { m.transform.translation.x = 1e39; });
}

TEST(TfPoseSource, ARotationThatIsNotQuiteNormalisedIsTakenAndSaidOnce) {
  TfPoseSource source(defaults()), exact(defaults());
  for (int i = 0; i < 3; ++i) {
    auto message = stamped("odom", "base_link", kStart + i * kMs, driven(i));
    exact.add(message, false);
    message.transform.rotation.w *= 1.02;
    message.transform.rotation.z *= 1.02;
    EXPECT_TRUE(source.add(message, false)) << source.problem();
  }
  EXPECT_EQ(notesOf(exact), "");
  const std::string text = notesOf(source);
  EXPECT_NE(text.find("norm 1.02"), std::string::npos) << text;
  EXPECT_EQ(std::count(text.begin(), text.end(), '\n'), 1) << text;
  EXPECT_EQ(source.counters().rejected, 0u);
  expectEqual(*source.odometry().lookup(kStart + kMs), *exact.odometry().lookup(kStart + kMs),
              1e-12);
}

TEST(TfPoseSource, InventedFramesTakeNoMoreThanTheirRoom) {
  TfPoseSourceConfig config = defaults();
  config.history_ns = 10 * kNsPerSecond;
  TfPoseSource source(config), quiet(config);
  for (TfPoseSource* each : {&source, &quiet}) {
    each->add(stamped("base_link", "velodyne", kStart, pose(1, 0, 0)), true);
  }
  std::mt19937_64 random(3);
  for (int i = 0; i < 300; ++i) {
    const StampNs stamp = kStart + i * 10 * kMs;
    for (TfPoseSource* each : {&source, &quiet}) {
      each->add(stamped("odom", "base_link", stamp, driven(0.01 * i)), false);
    }
    for (int k = 0; k < 10; ++k) {
      const std::string name = std::to_string(random());
      source.add(stamped(k % 2 ? "odom" : name + "x", name, stamp, pose(1, 2, 3)), false);
    }
  }
  const std::string notes = notesOf(source);
  EXPECT_NE(notes.find("which node invents names?"), std::string::npos) << notes;
  EXPECT_EQ(std::count(notes.begin(), notes.end(), '\n'), 1) << notes;
  ASSERT_EQ(source.odometry().readings().size(), quiet.odometry().readings().size());
  for (std::size_t i = 0; i < quiet.odometry().readings().size(); ++i) {
    expectEqual(source.odometry().readings()[i].T_fixed_vehicle,
                quiet.odometry().readings()[i].T_fixed_vehicle, 1e-9);
  }
  EXPECT_TRUE(source.extrinsics("base_link", "velodyne")) << "static frames come once, and stay";
  for (int i = 0; i < 11000; ++i) {
    source.add(stamped("base_link", "s" + std::to_string(i), kStart, pose(0, 0, 0)), true);
  }
  EXPECT_NE(notesOf(source).find("static frames already"), std::string::npos);
  EXPECT_TRUE(source.extrinsics("base_link", "s9000"));
  EXPECT_FALSE(source.extrinsics("base_link", "s10500"));
  auto long_name = stamped("odom", std::string(1000000, 'x'), kStart, pose(0, 0, 0));
  EXPECT_FALSE(source.add(long_name, false));
  EXPECT_LT(source.problem().size(), 200u);
}

TEST(TfPoseSource, TwoValuesOfAStaticTransformAreSaidOnce) {
  TfPoseSource source(defaults());
  source.add(stamped("base_link", "velodyne", kStart, pose(1, 0, 0)), true);
  source.add(stamped("base_link", "velodyne", kStart, pose(1, 0, 0)), true);
  source.add(stamped("base_link", "velodyne", kStart, pose(1, 0, 0)), false);
  EXPECT_EQ(notesOf(source), "") << "one value twice harms nothing";
  for (int i = 0; i < 5; ++i) {
    source.add(stamped("base_link", "velodyne", kStart + i * kMs, pose(1.5, 0, 0)), false);
  }
  const std::string both = notesOf(source);
  EXPECT_NE(both.find("(1.000, 0.000, 0.300)"), std::string::npos) << both;
  EXPECT_NE(both.find("(1.500, 0.000, 0.300)"), std::string::npos) << both;
  EXPECT_EQ(std::count(both.begin(), both.end(), '\n'), 1) << both;
  EXPECT_EQ(source.extrinsics("base_link", "velodyne").transform->translation().x(), 1.0)
      << "/tf_static counts";

  source.add(stamped("base_link", "velodyne", kStart, pose(2, 0, 0)), true);
  const std::string changed = notesOf(source);
  EXPECT_NE(changed.find("(2.000, 0.000, 0.300)"), std::string::npos) << changed;
  EXPECT_EQ(source.extrinsics("base_link", "velodyne").transform->translation().x(), 2.0);
}

TEST(TfPoseSource, ExtrinsicsThatChangeAreSaid) {
  TfPoseSource source(defaults());
  source.add(stamped("odom", "base_link", kStart, driven(0)), false);
  source.odometry();
  for (int i = 0; i < 3; ++i) {
    source.add(stamped("base_link", "mast", kStart + i * 10 * kMs, pose(1, 0, 0)), false);
    source.add(stamped("base_link", "wheel", kStart + i * 10 * kMs, pose(0, 0, i)), false);
    source.extrinsics("base_link", "mast");
  }
  EXPECT_EQ(notesOf(source), "") << "the wheel concerns no sensor";
  source.add(stamped("base_link", "mast", kStart + 40 * kMs, pose(1, 0, 0.1)), false);
  source.extrinsics("base_link", "mast");
  const std::string text = notesOf(source);
  EXPECT_NE(text.find("base_link <- mast changes"), std::string::npos) << text;
  source.extrinsics("base_link", "mast");
  EXPECT_EQ(notesOf(source), "");
}

TEST(TfPoseSource, AJumpIsSaidOnceAndIsTheReasonOfAGap) {
  TfPoseSource source(defaults());
  for (int i = 0; i < 20; ++i) {
    Transform T = driven(0.01 * i);
    T.translation().x() += i < 10 ? 0.0 : 10.0;
    source.add(stamped("odom", "base_link", kStart + i * 10 * kMs, T), false);
  }
  source.odometry();
  const std::string text = notesOf(source);
  EXPECT_NE(text.find("jumps by 10.1"), std::string::npos) << text;
  source.odometry();
  EXPECT_EQ(notesOf(source), "");
  EXPECT_NE(source.gap(kStart, kStart + 150 * kMs).find("jumps by"), std::string::npos);
  EXPECT_EQ(source.gap(kStart, kStart + 90 * kMs), "");
  EXPECT_EQ(source.gap(kStart + 100 * kMs, kStart + 190 * kMs), "");
}

TEST(TfPoseSource, TwoClocksAnHourApartAndStampsThatDecreaseGiveEveryReading) {
  // Through two moving edges, so that a pose takes more than a copy.
  const auto fill = [](TfPoseSource& source, StampNs t, double t_s) {
    source.add(stamped("odom", "footprint", t, driven(t_s)), false);
    source.add(stamped("footprint", "base_link", t, pose(0, 0, 0)), false);
    source.read();
  };
  const StampNs hour = 3600 * kNsPerSecond;
  constexpr int kCount = 4000;
  TfPoseSource two(defaults());
  for (int i = 0; i < kCount; ++i) {
    fill(two, kStart + i * 10 * kMs, 0.01 * i);
    fill(two, kStart + hour + i * 10 * kMs, 0.01 * i);
  }
  const PoseBuffer& odometry = two.odometry();
  // The first of the earlier clock is read when its last edge comes.
  EXPECT_GE(odometry.size(), 2u * kCount - 2);
  for (const StampNs t : {kStart + 20 * kNsPerSecond, kStart + hour + 20 * kNsPerSecond}) {
    ASSERT_TRUE(odometry.covers(t));
    Transform expected = driven(20.0) * pose(0, 0, 0);
    expectEqual(*odometry.lookup(t), expected, 1e-6);
  }
  TfPoseSource backward(defaults());
  for (int i = kCount - 1; i >= 0; --i) fill(backward, kStart + i * 10 * kMs, 0.01 * i);
  EXPECT_GE(backward.odometry().size(), kCount - 2u);
  ASSERT_TRUE(backward.odometry().covers(kStart + 20 * kNsPerSecond));
  expectEqual(*backward.odometry().lookup(kStart + 20 * kNsPerSecond), driven(20.0) * pose(0, 0, 0),
              1e-6);
}

nav_msgs::Odometry odometry(const std::string& child, StampNs stamp, const Transform& T) {
  const auto as_tf = stamped("odom", child, stamp, T);
  nav_msgs::Odometry message;
  message.header = as_tf.header;
  message.child_frame_id = child;
  message.pose.pose.position.x = as_tf.transform.translation.x;
  message.pose.pose.position.y = as_tf.transform.translation.y;
  message.pose.pose.position.z = as_tf.transform.translation.z;
  message.pose.pose.orientation = as_tf.transform.rotation;
  return message;
}

TEST(OdometryTopic, IsThePoseOfItsChildFrame) {
  TfPoseSourceConfig config;
  config.source = OdometrySource::kTopic;
  TfPoseSource source(config);
  EXPECT_TRUE(source.add(odometry("base_link", kStart, driven(0))));
  EXPECT_TRUE(source.add(odometry("", kStart + 10 * kMs, driven(0.01))));
  ASSERT_EQ(source.odometry().size(), 2u);
  expectEqual(source.odometry().readings()[1].T_fixed_vehicle, driven(0.01), 5e-9);
}

TEST(OdometryTopic, OtherChildFrameWaitsForItsTransform) {
  TfPoseSourceConfig config;
  config.source = OdometrySource::kTopic;
  TfPoseSource source(config);
  source.add(odometry("/imu", kStart, driven(0.5)));
  EXPECT_TRUE(source.odometry().empty());
  EXPECT_EQ(source.counters().odometry_pending, 1u);
  EXPECT_NE(source.gap(kStart, kStart).find("imu"), std::string::npos);
  const Transform T_vehicle_imu = pose(1.5, -0.2, 0.7);
  source.add(stamped("base_link", "imu", kStart, T_vehicle_imu), true);
  ASSERT_EQ(source.odometry().size(), 1u);
  expectEqual(source.odometry().readings()[0].T_fixed_vehicle,
              driven(0.5) * T_vehicle_imu.inverse(), 5e-9);
}

TEST(OdometryTopic, UnusableMessagesAreRefused) {
  TfPoseSourceConfig config;
  config.source = OdometrySource::kTopic;
  TfPoseSource source(config);
  auto bad = odometry("base_link", kStart, driven(0));
  bad.pose.pose.orientation.w = 0;
  bad.pose.pose.orientation.z = 0;
  EXPECT_FALSE(source.add(bad));
  EXPECT_FALSE(source.add(odometry("base_link", 0, driven(0))));
  EXPECT_EQ(source.counters().rejected, 2u);
  EXPECT_TRUE(source.odometry().empty());
}

TEST(OdometryTopic, APoseThatDoesNotFollowItsTwistIsSaid) {
  const auto notes = [](double pose_mps, double twist_mps) {
    TfPoseSourceConfig config;
    config.source = OdometrySource::kTopic;
    TfPoseSource source(config);
    for (int i = 0; i < 150; ++i) {
      auto message = odometry("base_link", kStart + i * 10 * kMs, pose(0.01 * i * pose_mps, 0, 0));
      message.twist.twist.linear.x = twist_mps;
      source.add(message);
    }
    return notesOf(source);
  };
  EXPECT_NE(notes(0.0, 5.0).find("frozen"), std::string::npos);
  EXPECT_NE(notes(5.0, 18.0).find("another unit"), std::string::npos);
  EXPECT_EQ(notes(5.0, 5.2), "");
  EXPECT_EQ(notes(0.0, 0.0), "");
  EXPECT_EQ(notes(5.0, 0.0), "") << "no twist";
}

}  // namespace
}  // namespace semantic_lidar_fusion

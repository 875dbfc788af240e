// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <iostream>
#include <random>
#include <vector>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/motion/compensation.h"
#include "stamps.h"

namespace semantic_lidar_fusion {
namespace {

constexpr StampNs kFiringNs = 55296;
constexpr StampNs kLaserNs = 2304;
constexpr int kFiringsPerPacket = 24;
constexpr int kLasers = 16;
constexpr int kPackets = 76;
constexpr StampNs kReadingNs = 10000000;

using Motion = std::function<Transform(StampNs)>;

/// Constant twist, closed form: 15 m/s along the vehicle's x, 30 deg/s about z; a circle.
Motion constantTwist(const Eigen::Vector3d& origin = Eigen::Vector3d::Zero()) {
  return [origin](StampNs t) {
    const double v = 15.0;
    const double w = 30.0 * kPi / 180.0;
    const double angle = w * toSeconds(t - kUnroundStart);
    Transform T = Transform::Identity();
    T.linear() = Eigen::AngleAxisd(angle, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    T.translation() =
        origin + Eigen::Vector3d(v / w * std::sin(angle), v / w * (1.0 - std::cos(angle)), 0.0);
    return T;
  };
}

Transform lidarOnVehicle() {
  Transform T = Transform::Identity();
  T.linear() = (Eigen::AngleAxisd(0.05, Eigen::Vector3d::UnitY()) *
                Eigen::AngleAxisd(0.2, Eigen::Vector3d::UnitZ()))
                   .toRotationMatrix();
  T.translation() = Eigen::Vector3d(1.4, 0.1, 1.9);
  return T;
}

PoseBuffer odometryOf(const Motion& motion, StampNs begin, StampNs end) {
  PoseBuffer odometry;
  for (StampNs t = begin; t <= end; t += kReadingNs) odometry.add({t, motion(t)});
  return odometry;
}

/// Static points seen from the moving lidar, each at its own laser's time, and the same points as
/// seen from the lidar at t_ref.
struct Drive {
  TimedCloud scan;
  std::vector<Eigen::Vector3d> truth;
  StampNs reference = kUnroundStart + 50000123;
};

Drive makeDrive(const Motion& motion, const Transform& T_vehicle_lidar, double max_range_m = 50.0) {
  std::mt19937 random(3);
  std::uniform_real_distribution<double> range(1.0, max_range_m);
  Drive drive;
  drive.scan.frame_id = "velodyne";
  drive.scan.header_stamp = kUnroundStart + 123;
  const Transform T_ref_fixed = (motion(drive.reference) * T_vehicle_lidar).inverse();
  for (int packet = 0; packet < kPackets; ++packet) {
    for (int k = 0; k < kFiringsPerPacket; ++k) {
      const StampNs begin = kUnroundStart + (packet * kFiringsPerPacket + k) * kFiringNs;
      drive.scan.firings.push_back(
          {begin, begin + (kLasers - 1) * kLaserNs, static_cast<std::uint32_t>(packet)});
      for (int laser = 0; laser < kLasers; ++laser) {
        const StampNs time = begin + laser * kLaserNs;
        const double azimuth = 2.0 * kPi * 10.0 * toSeconds(time - kUnroundStart);
        const double elevation = (-15.0 + 2.0 * laser) * kPi / 180.0;
        const double d = range(random);
        const Eigen::Vector3f measured(
            static_cast<float>(d * std::cos(elevation) * std::cos(azimuth)),
            static_cast<float>(-d * std::cos(elevation) * std::sin(azimuth)),
            static_cast<float>(d * std::sin(elevation)));
        drive.scan.x.push_back(measured.x());
        drive.scan.y.push_back(measured.y());
        drive.scan.z.push_back(measured.z());
        drive.scan.intensity.push_back(static_cast<float>(laser));
        drive.scan.ring.push_back(static_cast<std::uint16_t>(laser));
        drive.scan.time_ns.push_back(time);
        drive.scan.firing.push_back(static_cast<std::uint32_t>(drive.scan.firings.size() - 1));
        drive.truth.push_back(T_ref_fixed * motion(time) * T_vehicle_lidar *
                              measured.cast<double>());
      }
    }
  }
  return drive;
}

Eigen::Vector3d at(const Cloud& cloud, std::size_t i) {
  return Eigen::Vector3d(cloud.x[i], cloud.y[i], cloud.z[i]);
}

double largestError(const Cloud& cloud, const std::vector<Eigen::Vector3d>& truth) {
  double largest = 0.0;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    largest = std::max(largest, (at(cloud, i) - truth[i]).norm());
  }
  return largest;
}

const StampNs kBefore = kUnroundStart - 23000000;
const StampNs kAfter = kUnroundStart + 147000000;

TEST(Compensation, ConstantTwistIsCorrectedToHalfAMillimetre) {
  // Between 100 Hz readings the circle's chord departs from the arc by
  // 15 m/s * 0.01 s * 0.3 deg / 8 = 0.098 mm, at the point's time and at t_ref.
  const Motion motion = constantTwist();
  const Drive drive = makeDrive(motion, lidarOnVehicle());
  const PoseBuffer odometry = odometryOf(motion, kBefore, kAfter);
  CompensationConfig config;
  const CompensationResult firing =
      compensate(drive.scan, drive.reference, odometry, lidarOnVehicle(), config);
  config.granularity = MotionGranularity::kPacket;
  const CompensationResult packet =
      compensate(drive.scan, drive.reference, odometry, lidarOnVehicle(), config);
  config.granularity = MotionGranularity::kFiring;
  config.lookup = OdometryLookup::kClosest;
  const CompensationResult closest =
      compensate(drive.scan, drive.reference, odometry, lidarOnVehicle(), config);
  config.enabled = false;
  const CompensationResult none =
      compensate(drive.scan, drive.reference, odometry, lidarOnVehicle(), config);

  const double firing_m = largestError(firing.cloud, drive.truth);
  const double packet_m = largestError(packet.cloud, drive.truth);
  const double closest_m = largestError(closest.cloud, drive.truth);
  const double none_m = largestError(none.cloud, drive.truth);
  std::cout << "largest error: firing " << firing_m * 1e3 << " mm, packet " << packet_m * 1e3
            << " mm, closest " << closest_m * 1e3 << " mm, none " << none_m * 1e3 << " mm\n";
  EXPECT_LT(firing_m, 0.5e-3);
  // A packet lasts 24 firings: (15 m/s + 50 m * 30 deg/s) * 1.327 ms = 55 mm at most.
  EXPECT_LT(packet_m, 0.056);
  EXPECT_GT(packet_m, 0.020);
  // Half the interval between readings: (15 + 26.2) m/s * 5 ms = 206 mm at most.
  EXPECT_LT(closest_m, 0.207);
  EXPECT_GT(closest_m, 0.075);
  EXPECT_GT(none_m, 0.75);
  EXPECT_EQ(firing.counters.uncovered_firings, 0u);
  EXPECT_TRUE(firing.counters.reference_covered);
}

TEST(Compensation, NothingChangesInMapCoordinates) {
  const Motion motion = constantTwist();
  const Motion far = constantTwist(Eigen::Vector3d(331275.0, 6250099.0, 41.0));
  const Drive drive = makeDrive(motion, lidarOnVehicle());
  const CompensationConfig config;
  const Cloud here = compensate(drive.scan, drive.reference, odometryOf(motion, kBefore, kAfter),
                                lidarOnVehicle(), config)
                         .cloud;
  const Cloud there = compensate(drive.scan, drive.reference, odometryOf(far, kBefore, kAfter),
                                 lidarOnVehicle(), config)
                          .cloud;
  double largest = 0.0;
  for (std::size_t i = 0; i < here.size(); ++i) {
    largest = std::max(largest, (at(here, i) - at(there, i)).norm());
  }
  std::cout << "largest change: " << largest * 1e3 << " mm\n";
  // 6.25e6 m have steps of 1e-9 m in double; the rest is one step of float at 50 m.
  EXPECT_LT(largest, 2e-5);
}

/// Equation 5 as it stands, one point at a time.
Eigen::Vector3d plain(const Transform& T_fixed_vehicle_ref, const Transform& T_fixed_vehicle,
                      const Transform& T_vehicle_lidar, const Eigen::Vector3d& p) {
  return T_vehicle_lidar.inverse() *
         (T_fixed_vehicle_ref.inverse() * (T_fixed_vehicle * (T_vehicle_lidar * p)));
}

/// Rough odometry with uneven intervals, so that every piece of the track shows.
PoseBuffer roughOdometry(StampNs begin, StampNs end) {
  std::mt19937 random(11);
  std::normal_distribution<double> normal;
  std::uniform_int_distribution<StampNs> interval(3000000, 25000000);
  PoseBuffer odometry;
  for (StampNs t = begin; t <= end; t += interval(random)) {
    Transform T = Transform::Identity();
    T.linear() = (Eigen::AngleAxisd(0.1 * normal(random), Eigen::Vector3d::UnitZ()) *
                  Eigen::AngleAxisd(0.1 * normal(random), Eigen::Vector3d::UnitX()))
                     .toRotationMatrix();
    T.translation() = Eigen::Vector3d(normal(random), normal(random), normal(random));
    odometry.add({t, T});
  }
  return odometry;
}

// Rounding of float coordinates and matrices at 50 m: some steps of 4e-6 m, and the segments'
// 51 m * (1e-3)^2 / 8 = 6e-6 m.
constexpr double kArithmetic = 4e-5;

TEST(Compensation, EqualsThePlainFormulaForEachChoice) {
  const Drive drive = makeDrive(constantTwist(), lidarOnVehicle());
  const PoseBuffer odometry = roughOdometry(kBefore - 30000000, kAfter + 30000000);
  for (const bool closest : {false, true}) {
    for (const bool packet : {false, true}) {
      CompensationConfig config;
      config.lookup = closest ? OdometryLookup::kClosest : OdometryLookup::kInterpolate;
      config.granularity = packet ? MotionGranularity::kPacket : MotionGranularity::kFiring;
      const Cloud cloud =
          compensate(drive.scan, drive.reference, odometry, lidarOnVehicle(), config).cloud;
      ASSERT_EQ(cloud.size(), drive.scan.size());
      double largest = 0.0;
      for (std::size_t i = 0; i < cloud.size(); ++i) {
        const Firing& firing = drive.scan.firings[drive.scan.firing[i]];
        const StampNs t = packet ? drive.scan.firings[firing.packet * kFiringsPerPacket].begin_ns
                                 : drive.scan.time_ns[i];
        const Eigen::Vector3d expected = plain(
            *odometry.lookup(drive.reference), closest ? *odometry.closest(t) : *odometry.lookup(t),
            lidarOnVehicle(), Eigen::Vector3d(drive.scan.x[i], drive.scan.y[i], drive.scan.z[i]));
        largest = std::max(largest, (at(cloud, i) - expected).norm());
      }
      EXPECT_LT(largest, kArithmetic) << "closest " << closest << " packet " << packet;
    }
  }
}

TEST(Compensation, AnyOrderOfPointsGivesTheSamePoints) {
  const Motion motion = constantTwist();
  const Drive drive = makeDrive(motion, lidarOnVehicle());
  const PoseBuffer odometry = odometryOf(motion, kBefore, kAfter);
  std::vector<std::size_t> order(drive.scan.size());
  for (std::size_t i = 0; i < order.size(); ++i) order[i] = i;
  std::shuffle(order.begin(), order.end(), std::mt19937(5));
  TimedCloud shuffled = drive.scan;
  for (std::size_t i = 0; i < order.size(); ++i) {
    shuffled.x[i] = drive.scan.x[order[i]];
    shuffled.y[i] = drive.scan.y[order[i]];
    shuffled.z[i] = drive.scan.z[order[i]];
    shuffled.intensity[i] = drive.scan.intensity[order[i]];
    shuffled.time_ns[i] = drive.scan.time_ns[order[i]];
    shuffled.firing[i] = drive.scan.firing[order[i]];
  }
  const CompensationConfig config;
  const Cloud a = compensate(drive.scan, drive.reference, odometry, lidarOnVehicle(), config).cloud;
  const Cloud b = compensate(shuffled, drive.reference, odometry, lidarOnVehicle(), config).cloud;
  for (std::size_t i = 0; i < order.size(); ++i) {
    // Vector and scalar loops round differently.
    ASSERT_LT((at(a, order[i]) - at(b, i)).norm(), kArithmetic);
    ASSERT_EQ(a.dt[order[i]], b.dt[i]);
    ASSERT_EQ(a.intensity[order[i]], b.intensity[i]);
  }
}

TEST(Compensation, KeepsEveryAttributeAndTellsWhenEachPointWasMeasured) {
  const Motion motion = constantTwist();
  const Drive drive = makeDrive(motion, lidarOnVehicle());
  const Cloud cloud = compensate(drive.scan, drive.reference, odometryOf(motion, kBefore, kAfter),
                                 lidarOnVehicle(), CompensationConfig())
                          .cloud;
  EXPECT_EQ(cloud.frame_id, "velodyne");
  EXPECT_EQ(cloud.stamp, drive.reference);
  EXPECT_EQ(cloud.first_point_ns, kUnroundStart);
  EXPECT_EQ(cloud.intensity, drive.scan.intensity);
  EXPECT_EQ(cloud.ring, drive.scan.ring);
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    ASSERT_EQ(cloud.status[i], 0);
    ASSERT_NEAR(cloud.dt[i], toSeconds(drive.scan.time_ns[i] - drive.reference), 4e-9);
  }
}

TEST(Compensation, DisabledLeavesPointsAsMeasuredWithoutAnyOdometry) {
  const Drive drive = makeDrive(constantTwist(), lidarOnVehicle());
  CompensationConfig config;
  config.enabled = false;
  const CompensationResult result =
      compensate(drive.scan, drive.reference, PoseBuffer(), lidarOnVehicle(), config);
  EXPECT_EQ(result.cloud.x, drive.scan.x);
  EXPECT_EQ(result.cloud.z, drive.scan.z);
  EXPECT_EQ(result.cloud.stamp, drive.reference);
  EXPECT_EQ(std::count(result.cloud.status.begin(), result.cloud.status.end(), 0),
            static_cast<std::ptrdiff_t>(drive.scan.size()));
  EXPECT_EQ(result.counters.marked_points, 0u);
}

TEST(Compensation, AnEmptyScanGivesAnEmptyCloudStampedWithItsHeader) {
  TimedCloud scan;
  scan.frame_id = "velodyne";
  scan.header_stamp = 99;
  const CompensationResult result =
      compensate(scan, 12345, PoseBuffer(), lidarOnVehicle(), CompensationConfig());
  EXPECT_TRUE(result.cloud.empty());
  EXPECT_EQ(result.cloud.stamp, 99);
  EXPECT_EQ(result.cloud.first_point_ns, 99);
  EXPECT_EQ(result.cloud.frame_id, "velodyne");
}

TEST(Compensation, WithoutThePoseAtTheReferenceEveryPointIsMarked) {
  const Motion motion = constantTwist();
  const Drive drive = makeDrive(motion, lidarOnVehicle());
  for (const auto mode :
       {OnMissingOdometry::kMark, OnMissingOdometry::kExtrapolate, OnMissingOdometry::kDrop}) {
    CompensationConfig config;
    config.on_missing = mode;
    const CompensationResult result =
        compensate(drive.scan, kAfter + 1000000000, odometryOf(motion, kBefore, kAfter),
                   lidarOnVehicle(), config);
    EXPECT_FALSE(result.counters.reference_covered);
    EXPECT_EQ(result.counters.marked_points, drive.scan.size());
    EXPECT_EQ(result.cloud.x, drive.scan.x);
    EXPECT_EQ(std::count(result.cloud.status.begin(), result.cloud.status.end(), 4),
              static_cast<std::ptrdiff_t>(drive.scan.size()));
  }
}

/// Odometry from 35 ms to 85 ms of the scan: its first and its last part are not covered.
struct PartlyCovered : ::testing::Test {
  Motion motion = constantTwist();
  Drive drive = makeDrive(motion, lidarOnVehicle());
  StampNs first_reading = kUnroundStart + 35000000;
  StampNs last_reading = kUnroundStart + 85000000;
  PoseBuffer odometry = odometryOf(motion, first_reading, last_reading);

  CompensationResult run(OnMissingOdometry mode, StampNs max_extrapolation_ns = 100000000) {
    CompensationConfig config;
    config.on_missing = mode;
    config.max_extrapolation_ns = max_extrapolation_ns;
    return compensate(drive.scan, drive.reference, odometry, lidarOnVehicle(), config);
  }
  bool covered(std::size_t i) const {
    const Firing& firing = drive.scan.firings[drive.scan.firing[i]];
    return firing.begin_ns >= first_reading && firing.end_ns <= last_reading;
  }
  std::size_t uncoveredPoints() const {
    std::size_t count = 0;
    for (std::size_t i = 0; i < drive.scan.size(); ++i) count += covered(i) ? 0 : 1;
    return count;
  }
};

TEST_F(PartlyCovered, MarkHarmsNoOtherPoint) {
  const CompensationResult result = run(OnMissingOdometry::kMark);
  ASSERT_EQ(result.cloud.size(), drive.scan.size());
  for (std::size_t i = 0; i < drive.scan.size(); ++i) {
    if (covered(i)) {
      ASSERT_EQ(result.cloud.status[i], 0);
      ASSERT_LT((at(result.cloud, i) - drive.truth[i]).norm(), 0.5e-3);
    } else {
      ASSERT_EQ(result.cloud.status[i], 4);
      ASSERT_EQ(result.cloud.x[i], drive.scan.x[i]);
      ASSERT_EQ(result.cloud.y[i], drive.scan.y[i]);
      ASSERT_EQ(result.cloud.z[i], drive.scan.z[i]);
    }
  }
  EXPECT_EQ(result.counters.marked_points, uncoveredPoints());
  EXPECT_EQ(result.counters.uncovered_firings * kLasers, uncoveredPoints());
}

TEST_F(PartlyCovered, DropTakesThemOutAndKeepsTheOrder) {
  const CompensationResult result = run(OnMissingOdometry::kDrop);
  EXPECT_EQ(result.counters.dropped_points, uncoveredPoints());
  ASSERT_EQ(result.cloud.size(), drive.scan.size() - uncoveredPoints());
  std::size_t k = 0;
  for (std::size_t i = 0; i < drive.scan.size(); ++i) {
    if (!covered(i)) continue;
    ASSERT_LT((at(result.cloud, k) - drive.truth[i]).norm(), 0.5e-3);
    ASSERT_EQ(result.cloud.intensity[k], drive.scan.intensity[i]);
    ASSERT_EQ(result.cloud.status[k], 0);
    ++k;
  }
  EXPECT_EQ(result.cloud.first_point_ns, kUnroundStart) << "the key of the scan stays";
}

TEST_F(PartlyCovered, WithoutThePoseAtTheReferenceNoneIsDropped) {
  drive.reference = last_reading + 1;
  const CompensationResult result = run(OnMissingOdometry::kDrop);
  EXPECT_EQ(result.counters.dropped_points, 0u);
  EXPECT_EQ(result.cloud.x, drive.scan.x);
  EXPECT_EQ(result.cloud.status, std::vector<std::uint8_t>(drive.scan.size(), 4));
}

TEST_F(PartlyCovered, HoldTakesTheNearestReading) {
  const CompensationResult result = run(OnMissingOdometry::kHold);
  EXPECT_EQ(result.counters.held_points, uncoveredPoints());
  EXPECT_EQ(result.counters.marked_points, 0u);
  double largest = 0.0;
  for (std::size_t i = 0; i < drive.scan.size(); ++i) {
    const StampNs t = std::min(std::max(drive.scan.time_ns[i], first_reading), last_reading);
    const Eigen::Vector3d expected =
        plain(*odometry.lookup(drive.reference), *odometry.lookup(t), lidarOnVehicle(),
              Eigen::Vector3d(drive.scan.x[i], drive.scan.y[i], drive.scan.z[i]));
    largest = std::max(largest, (at(result.cloud, i) - expected).norm());
    ASSERT_EQ(result.cloud.status[i], 0);
  }
  EXPECT_LT(largest, kArithmetic);
}

TEST_F(PartlyCovered, ExtrapolateFollowsTheTwist) {
  // The motion has a constant twist, so that extrapolation is as good as the readings; only the
  // chord at t_ref is left.
  const CompensationResult result = run(OnMissingOdometry::kExtrapolate);
  EXPECT_EQ(result.counters.extrapolated_points, uncoveredPoints());
  EXPECT_LT(largestError(result.cloud, drive.truth), 0.5e-3);
}

TEST_F(PartlyCovered, ExtrapolateMarksBeyondItsLimit) {
  const CompensationResult result = run(OnMissingOdometry::kExtrapolate, 10000000);
  std::size_t marked = 0;
  for (std::size_t i = 0; i < drive.scan.size(); ++i) {
    const Firing& firing = drive.scan.firings[drive.scan.firing[i]];
    const bool beyond =
        firing.begin_ns < first_reading - 10000000 || firing.end_ns > last_reading + 10000000;
    ASSERT_EQ(result.cloud.status[i], beyond ? 4 : 0);
    marked += beyond ? 1 : 0;
  }
  EXPECT_GT(marked, 0u);
  EXPECT_EQ(result.counters.marked_points, marked);
  EXPECT_EQ(result.counters.extrapolated_points, uncoveredPoints() - marked);
}

TEST(Compensation, ExtrapolationFollowsAScrewInSpace) {
  // Two readings a known screw motion apart; a point half a step later lies where half the screw
  // again puts it.
  const double angle = 0.3;
  const Eigen::Vector3d axis = Eigen::Vector3d(1.0, 2.0, -1.0).normalized();
  // About an axis through `centre`, with a pitch along it: closed form without logarithms.
  const Eigen::Vector3d centre(2.0, -1.0, 0.5);
  const auto screw = [&](double fraction) {
    Transform T = Transform::Identity();
    T.linear() = Eigen::AngleAxisd(fraction * angle, axis).toRotationMatrix();
    T.translation() = centre - T.linear() * centre + fraction * 0.7 * axis;
    return T;
  };
  const Transform start = lidarOnVehicle();
  PoseBuffer odometry;
  odometry.add({kUnroundStart, start});
  odometry.add({kUnroundStart + 1000, start * screw(1.0)});
  for (const StampNs t : {kUnroundStart + 1500, kUnroundStart - 500}) {
    TimedCloud scan;
    scan.x = {3.0f};
    scan.y = {-4.0f};
    scan.z = {1.0f};
    scan.intensity = {0.0f};
    scan.ring = {0};
    scan.time_ns = {t};
    scan.firing = {0};
    scan.firings = {{t, t, 0}};
    CompensationConfig config;
    config.on_missing = OnMissingOdometry::kExtrapolate;
    const Cloud cloud =
        compensate(scan, kUnroundStart, odometry, Transform::Identity(), config).cloud;
    const Eigen::Vector3d expected =
        screw(static_cast<double>(t - kUnroundStart) / 1000.0) * Eigen::Vector3d(3.0, -4.0, 1.0);
    EXPECT_LT((at(cloud, 0) - expected).norm(), 1e-5);
  }
}

TEST(Compensation, OneReadingServesItsOwnInstantOnly) {
  const Motion motion = constantTwist();
  Drive drive = makeDrive(motion, lidarOnVehicle());
  PoseBuffer odometry;
  odometry.add({kUnroundStart, motion(kUnroundStart)});
  CompensationConfig config;
  config.on_missing = OnMissingOdometry::kExtrapolate;
  const CompensationResult result =
      compensate(drive.scan, kUnroundStart, odometry, lidarOnVehicle(), config);
  EXPECT_TRUE(result.counters.reference_covered);
  EXPECT_EQ(result.counters.marked_points, drive.scan.size()) << "two readings make a twist";

  config.on_missing = OnMissingOdometry::kHold;
  const Cloud held =
      compensate(drive.scan, kUnroundStart, odometry, lidarOnVehicle(), config).cloud;
  for (std::size_t i = 0; i < held.size(); ++i) {
    ASSERT_LT(
        (at(held, i) - Eigen::Vector3d(drive.scan.x[i], drive.scan.y[i], drive.scan.z[i])).norm(),
        kArithmetic);
  }
}

TEST(Compensation, AnInstantIsAScanToo) {
  const Motion motion = constantTwist();
  Drive drive = makeDrive(motion, lidarOnVehicle());
  const StampNs t = kUnroundStart + 20000000;
  for (StampNs& time : drive.scan.time_ns) time = t;
  std::fill(drive.scan.firing.begin(), drive.scan.firing.end(), 0u);
  drive.scan.firings = {{t, t, 0}};
  const PoseBuffer odometry = odometryOf(motion, kBefore, kAfter);
  const Cloud cloud =
      compensate(drive.scan, drive.reference, odometry, lidarOnVehicle(), CompensationConfig())
          .cloud;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const Eigen::Vector3d expected =
        plain(motion(drive.reference), motion(t), lidarOnVehicle(),
              Eigen::Vector3d(drive.scan.x[i], drive.scan.y[i], drive.scan.z[i]));
    ASSERT_LT((at(cloud, i) - expected).norm(), 0.25e-3);
  }
}

TEST(VehicleMotion, IsTheTransformBetweenTwoTimesAlsoInMapCoordinates) {
  const Motion motion = constantTwist(Eigen::Vector3d(331275.0, 6250099.0, 41.0));
  const Motion near = constantTwist();
  const PoseBuffer odometry = odometryOf(motion, kUnroundStart, kAfter);
  const StampNs from = kUnroundStart + 2 * kReadingNs;
  const StampNs to = kUnroundStart + 7 * kReadingNs;
  const auto T_to_from = vehicleMotion(odometry, from, to);
  ASSERT_TRUE(T_to_from);
  const Transform expected = near(to).inverse() * near(from);
  EXPECT_LT((T_to_from->matrix() - expected.matrix()).cwiseAbs().maxCoeff(), 2e-9);
  EXPECT_FALSE(vehicleMotion(odometry, from, kAfter + kNsPerSecond));
  EXPECT_FALSE(vehicleMotion(odometry, kUnroundStart - 1, to));
}

TEST_F(PartlyCovered, HoldAndExtrapolateReachTheReferenceAndTheImageToo) {
  const StampNs behind = last_reading + 600000;
  drive.reference = behind;
  const Transform T_ref_fixed = (motion(behind) * lidarOnVehicle()).inverse();
  const CompensationResult extrapolated = run(OnMissingOdometry::kExtrapolate);
  EXPECT_TRUE(extrapolated.counters.reference_covered);
  EXPECT_EQ(extrapolated.counters.marked_points, 0u);
  for (std::size_t i = 0; i < drive.scan.size(); i += 7) {
    const Eigen::Vector3d point(drive.scan.x[i], drive.scan.y[i], drive.scan.z[i]);
    const Eigen::Vector3d truth =
        T_ref_fixed * motion(drive.scan.time_ns[i]) * lidarOnVehicle() * point;
    ASSERT_LT((at(extrapolated.cloud, i) - truth).norm(), 0.5e-3);
  }
  EXPECT_TRUE(run(OnMissingOdometry::kHold).counters.reference_covered);
  EXPECT_FALSE(run(OnMissingOdometry::kMark).counters.reference_covered);
  EXPECT_FALSE(run(OnMissingOdometry::kExtrapolate, 500000).counters.reference_covered);

  CompensationConfig config;
  const StampNs from = kUnroundStart + 50000000;
  EXPECT_FALSE(vehicleMotion(odometry, from, behind, config));
  config.on_missing = OnMissingOdometry::kExtrapolate;
  const auto moved = vehicleMotion(odometry, from, behind, config);
  ASSERT_TRUE(moved);
  EXPECT_LT(
      (moved->matrix() - (motion(behind).inverse() * motion(from)).matrix()).cwiseAbs().maxCoeff(),
      1e-4);
  config.on_missing = OnMissingOdometry::kHold;
  const auto held = vehicleMotion(odometry, from, behind, config);
  ASSERT_TRUE(held);
  EXPECT_LT((held->matrix() - (motion(last_reading).inverse() * motion(from)).matrix())
                .cwiseAbs()
                .maxCoeff(),
            1e-4);
}

TEST(Compensation, APacketHasThePoseOfItsFirstFiringWhateverReturned) {
  const Motion motion = constantTwist();
  Drive drive = makeDrive(motion, lidarOnVehicle());
  for (int p = 0; p < kPackets; ++p) {
    drive.scan.packet_begin_ns.push_back(kUnroundStart + p * kFiringsPerPacket * kFiringNs);
  }
  const PoseBuffer odometry = odometryOf(motion, kBefore, kAfter);
  CompensationConfig config;
  config.granularity = MotionGranularity::kPacket;
  const CompensationResult whole =
      compensate(drive.scan, drive.reference, odometry, lidarOnVehicle(), config);

  // The first half of every packet returns nothing.
  TimedCloud half;
  half.packet_begin_ns = drive.scan.packet_begin_ns;
  std::vector<std::size_t> kept;
  for (std::size_t i = 0; i < drive.scan.size(); ++i) {
    if (drive.scan.firing[i] % kFiringsPerPacket < kFiringsPerPacket / 2) continue;
    kept.push_back(i);
    half.x.push_back(drive.scan.x[i]);
    half.y.push_back(drive.scan.y[i]);
    half.z.push_back(drive.scan.z[i]);
    half.intensity.push_back(drive.scan.intensity[i]);
    half.ring.push_back(drive.scan.ring[i]);
    half.time_ns.push_back(drive.scan.time_ns[i]);
    half.firing.push_back(drive.scan.firing[i]);
  }
  half.firings = drive.scan.firings;
  const CompensationResult result =
      compensate(half, drive.reference, odometry, lidarOnVehicle(), config);
  for (std::size_t k = 0; k < kept.size(); ++k) {
    ASSERT_EQ(at(result.cloud, k), at(whole.cloud, kept[k]));
  }

  // Odometry that ends within the last packet still knows its first firing.
  const StampNs last_packet = drive.scan.packet_begin_ns.back();
  PoseBuffer ends = odometryOf(motion, kBefore, last_packet);
  ends.add({last_packet + 1000, motion(last_packet + 1000)});
  const CompensationResult ended =
      compensate(drive.scan, drive.reference, ends, lidarOnVehicle(), config);
  EXPECT_EQ(ended.counters.marked_points, 0u);
}

TEST(Compensation, NothingIsInterpolatedAcrossAJumpOfThePose) {
  const Motion motion = constantTwist();
  const Drive drive = makeDrive(motion, lidarOnVehicle());
  const StampNs jump = kBefore + 9 * kReadingNs;  // the first reading behind it
  for (const StampNs reference : {jump - 15000000, jump + 5000000}) {
    PoseBuffer odometry(0, 100.0);
    for (StampNs t = kBefore; t <= kAfter; t += kReadingNs) {
      Transform T = motion(t);
      if (t >= jump) T.translation().x() += 10.0;
      odometry.add({t, T});
    }
    ASSERT_EQ(odometry.jumps(), std::vector<StampNs>{jump});
    const CompensationResult result =
        compensate(drive.scan, reference, odometry, lidarOnVehicle(), CompensationConfig());
    const Transform T_ref_fixed = (motion(reference) * lidarOnVehicle()).inverse();
    std::size_t marked = 0;
    for (std::size_t i = 0; i < drive.scan.size(); ++i) {
      const Firing& firing = drive.scan.firings[drive.scan.firing[i]];
      const bool same_side =
          reference < jump ? firing.end_ns <= jump - kReadingNs : firing.begin_ns >= jump;
      ASSERT_EQ(result.cloud.status[i], same_side ? 0 : 4);
      marked += same_side ? 0 : 1;
      const Eigen::Vector3d point(drive.scan.x[i], drive.scan.y[i], drive.scan.z[i]);
      const Eigen::Vector3d truth =
          T_ref_fixed * motion(drive.scan.time_ns[i]) * lidarOnVehicle() * point;
      if (same_side) {
        ASSERT_LT((at(result.cloud, i) - truth).norm(), 0.5e-3);
      }
    }
    EXPECT_EQ(result.counters.marked_points, marked);
    EXPECT_GT(marked, 0u);
    EXPECT_FALSE(vehicleMotion(odometry, jump - 20000000, jump + 20000000));
    EXPECT_TRUE(vehicleMotion(odometry, jump, jump + 20000000));
  }
  PoseBuffer odometry(0, 100.0);
  for (StampNs t = kBefore; t <= kAfter; t += kReadingNs) odometry.add({t, motion(t)});
  EXPECT_TRUE(odometry.jumps().empty());
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <Eigen/Dense>
#include <cmath>
#include <fstream>
#include <random>
#include <string>

#include "optional_data.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/uncertainty/errors.h"
#include "temporary_folder.h"

namespace semantic_lidar_fusion {
namespace {

Transform poseOf(const Vector6d& run) {
  Transform T = Transform::Identity();
  T.linear() = (Eigen::AngleAxisd(run[2], Eigen::Vector3d::UnitZ()) *
                Eigen::AngleAxisd(run[1], Eigen::Vector3d::UnitY()) *
                Eigen::AngleAxisd(run[0], Eigen::Vector3d::UnitX()))
                   .toRotationMatrix();
  T.translation() = run.tail<3>();
  return T;
}

/// The run whose pose is `T_lidar_camera`.
Vector6d runOf(const Transform& T_lidar_camera) {
  const Eigen::Matrix3d& R = T_lidar_camera.linear();
  Vector6d run;
  run << std::atan2(R(2, 1), R(2, 2)), std::asin(-R(2, 0)), std::atan2(R(1, 0), R(0, 0)),
      T_lidar_camera.translation();
  return run;
}

TEST(CalibrationRuns, HaveTheCovarianceOfTheMotionsThatMadeThem) {
  std::mt19937 random(11);
  std::normal_distribution<double> normal;
  Transform T_camera_lidar = Transform::Identity();
  T_camera_lidar.linear() =
      (Eigen::AngleAxisd(1.2, Eigen::Vector3d(0.3, -0.5, 0.8).normalized())).toRotationMatrix();
  T_camera_lidar.translation() << 0.3, -0.8, 0.1;
  // Roll hangs together with z.
  Matrix6d factor = Matrix6d::Zero();
  factor.diagonal() << 0.01, 0.02, 0.005, 0.004, 0.006, 0.005;
  factor(2, 3) = 0.03;
  std::vector<Vector6d> runs;
  Matrix6d made = Matrix6d::Zero();
  constexpr int kRuns = 4000;
  for (int k = 0; k < kRuns; ++k) {
    Vector6d z;
    for (double& value : z) value = normal(random);
    const Vector6d motion = factor * z;
    made += motion * motion.transpose() / kRuns;
    // First order: [along; around] with the turn about the camera's origin.
    Transform T = Transform::Identity();
    T.linear() = Eigen::AngleAxisd(motion.tail<3>().norm(), motion.tail<3>().normalized())
                     .toRotationMatrix();
    T.translation() = motion.head<3>();
    runs.push_back(runOf((T * T_camera_lidar).inverse()));
  }
  const CalibrationRuns result = calibrationOf(runs);
  EXPECT_EQ(result.runs, static_cast<std::size_t>(kRuns));
  EXPECT_LT((result.covariance - made).norm(), 0.03 * made.norm());
  EXPECT_LT(motionOf(result.T_camera_lidar * T_camera_lidar.inverse()).norm(), 0.002);
}

TEST(MotionOf, IsTheInverseOfTheExponential) {
  std::mt19937 random(5);
  std::normal_distribution<double> normal;
  for (const double size : {1e-9, 1e-5, 1e-2, 1.0}) {
    Vector6d motion;
    for (double& value : motion) value = size * normal(random);
    // Exp by many small steps of the same motion.
    constexpr int kHalvings = 30;
    Eigen::Matrix4d step = Eigen::Matrix4d::Zero();
    const Eigen::Vector3d w = motion.tail<3>();
    step.topLeftCorner<3, 3>() << 0, -w.z(), w.y(), w.z(), 0, -w.x(), -w.y(), w.x(), 0;
    step.topRightCorner<3, 1>() = motion.head<3>();
    step /= std::pow(2.0, kHalvings);
    step += Eigen::Matrix4d(0.5 * step * step) + Eigen::Matrix4d::Identity();
    for (int k = 0; k < kHalvings; ++k) step = Eigen::Matrix4d(step * step);
    Transform T = Transform::Identity();
    T.matrix() = step;
    // 2^30 steps add up roundings of 1e-16.
    EXPECT_LT((motionOf(T) - motion).norm(), 1e-6) << size;
  }
}

TEST(CalibrationRuns, ReadsCommasBlanksAndHeaders) {
  const TemporaryFolder folder;
  const std::string path = folder.path() + "/runs.csv";
  std::ofstream file(path);
  file << "# of a camera\nroll,pitch,yaw,x,y,z\n\n";
  for (int k = 0; k < 8; ++k) {
    file << 0.1 + 0.001 * k << (k % 2 == 0 ? "," : " ") << "0.2, -0.3 ,1,2," << 3 + 0.01 * k
         << "\n";
  }
  file.close();
  const CalibrationRuns runs = readCalibrationRuns(path);
  EXPECT_EQ(runs.runs, 8u);
  Vector6d mean;
  mean << 0.1035, 0.2, -0.3, 1, 2, 3.035;
  EXPECT_LT(motionOf(poseOf(mean) * runs.T_camera_lidar).norm(), 1e-6);
  // All that turns is roll, by 2.449 mrad.
  EXPECT_NEAR(std::sqrt(runs.covariance.bottomRightCorner<3, 3>().trace()), 2.449e-3, 1e-6);
}

std::string problemOf(const std::string& text) {
  const TemporaryFolder folder;
  const std::string path = folder.path() + "/runs.csv";
  std::ofstream(path) << text;
  try {
    readCalibrationRuns(path);
  } catch (const ConfigError& error) {
    return error.problems().at(0).substr(path.size());
  }
  return "(no problem)";
}

TEST(CalibrationRuns, NamesWhatIsWrong) {
  EXPECT_EQ(problemOf(""), ": holds 0 calibration runs, must hold from 7 to 1000000");
  EXPECT_EQ(problemOf("r,p,y\n1,2,3,4,5\n"),
            " line 2: must hold six finite numbers: roll pitch yaw (rad) x y z (m)");
  EXPECT_EQ(problemOf("1,2,3,4,5,6,7\n").find(" line 1: must hold six finite numbers"), 0u);
  EXPECT_EQ(problemOf("1,2,3,4,5,nan\n").find(" line 1: must hold six finite numbers"), 0u);
  EXPECT_THROW(readCalibrationRuns("/nowhere/runs.csv"), ConfigError);
}

TEST(CalibrationRuns, OfTheRealRigHangTogether) {
  SLF_SKIP_WITHOUT("data/acfr_a0_vlp16/extrinsic_runs.csv");
  const CalibrationRuns runs =
      readCalibrationRuns(sharedPath("data/acfr_a0_vlp16/extrinsic_runs.csv"));
  EXPECT_EQ(runs.runs, 50u);
  const auto deviation = runs.covariance.diagonal().cwiseSqrt().eval();
  // Its readme: 0.67 0.62 0.40 deg, each of another axis.
  EXPECT_NEAR(deviation.tail<3>().norm() * 180.0 / M_PI, std::hypot(0.67, 0.62, 0.40), 0.03);
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <Eigen/Dense>
#include <algorithm>
#include <cctype>
#include <cmath>
#include <fstream>
#include <sstream>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/uncertainty/errors.h"

namespace semantic_lidar_fusion {
namespace {

/// Fewer cannot fill a covariance of six.
constexpr std::size_t kLeastRuns = 7;
/// More is another file.
constexpr std::size_t kMostRuns = 1000000;

Eigen::Matrix3d rotationOf(const Eigen::Vector3d& roll_pitch_yaw) {
  return (Eigen::AngleAxisd(roll_pitch_yaw.z(), Eigen::Vector3d::UnitZ()) *
          Eigen::AngleAxisd(roll_pitch_yaw.y(), Eigen::Vector3d::UnitY()) *
          Eigen::AngleAxisd(roll_pitch_yaw.x(), Eigen::Vector3d::UnitX()))
      .toRotationMatrix();
}

/// The rotation nearest to a sum of rotations.
Eigen::Matrix3d nearestRotation(const Eigen::Matrix3d& sum) {
  const Eigen::JacobiSVD<Eigen::Matrix3d> svd(sum, Eigen::ComputeFullU | Eigen::ComputeFullV);
  Eigen::Matrix3d signs = Eigen::Matrix3d::Identity();
  signs(2, 2) = (svd.matrixU() * svd.matrixV().transpose()).determinant() < 0.0 ? -1.0 : 1.0;
  return svd.matrixU() * signs * svd.matrixV().transpose();
}

bool isHeader(const std::string& line) {
  const auto first = std::find_if(line.begin(), line.end(), [](char c) {
    return std::isspace(static_cast<unsigned char>(c)) == 0;
  });
  return first == line.end() || *first == '#' || std::isalpha(static_cast<unsigned char>(*first));
}

Vector6d runOf(std::string line, const std::string& where) {
  std::replace(line.begin(), line.end(), ',', ' ');
  std::istringstream words(line);
  words.imbue(std::locale::classic());
  Vector6d run;
  std::string rest;
  for (double& value : run) words >> value;
  if (!words || words >> rest || !run.allFinite()) {
    throw ConfigError({where + ": must hold six finite numbers: roll pitch yaw (rad) x y z (m)"});
  }
  return run;
}

}  // namespace

Vector6d motionOf(const Transform& T) {
  const Eigen::AngleAxisd turn(T.linear());
  const Eigen::Vector3d phi = turn.angle() * turn.axis();
  // rho = V^-1 t, V^-1 = I - [phi]x / 2 + (1 / a^2 - (1 + cos a) / (2 a sin a)) [phi]x^2
  const double a = turn.angle();
  const double factor =
      a < 1e-4 ? 1.0 / 12.0 + a * a / 720.0 : 1.0 / (a * a) - 0.5 / (a * std::tan(0.5 * a));
  const Eigen::Vector3d t = T.translation();
  const Eigen::Vector3d turned = phi.cross(t);
  Vector6d motion;
  motion << t - 0.5 * turned + factor * phi.cross(turned), phi;
  return motion;
}

CalibrationRuns calibrationOf(const std::vector<Vector6d>& runs) {
  Eigen::Matrix3d rotations = Eigen::Matrix3d::Zero();
  Eigen::Vector3d position = Eigen::Vector3d::Zero();
  for (const Vector6d& run : runs) {
    rotations += rotationOf(run.head<3>());
    position += run.tail<3>();
  }
  CalibrationRuns result;
  result.runs = runs.size();
  Transform T_lidar_camera = Transform::Identity();
  T_lidar_camera.linear() = nearestRotation(rotations);
  T_lidar_camera.translation() = position / static_cast<double>(runs.size());
  result.T_camera_lidar = T_lidar_camera.inverse(Eigen::Isometry);

  std::vector<Vector6d> motions;
  Vector6d mean = Vector6d::Zero();
  for (const Vector6d& run : runs) {
    Transform T = Transform::Identity();  // lidar from the camera of this run
    T.linear() = rotationOf(run.head<3>());
    T.translation() = run.tail<3>();
    motions.push_back(motionOf(T.inverse(Eigen::Isometry) * T_lidar_camera));
    mean += motions.back();
  }
  mean /= static_cast<double>(runs.size());
  for (const Vector6d& motion : motions) {
    result.covariance += (motion - mean) * (motion - mean).transpose();
  }
  result.covariance /= static_cast<double>(runs.size() - 1);
  return result;
}

CalibrationRuns readCalibrationRuns(const std::string& path) {
  std::ifstream file(path);
  if (!file) throw ConfigError({path + ": must be a readable file"});
  std::vector<Vector6d> runs;
  std::string line;
  for (std::size_t number = 1; std::getline(file, line); ++number) {
    if (isHeader(line)) continue;
    runs.push_back(runOf(line, path + " line " + std::to_string(number)));
    if (runs.size() > kMostRuns) break;
  }
  if (runs.size() < kLeastRuns || runs.size() > kMostRuns) {
    throw ConfigError({path + ": holds " + std::to_string(runs.size()) +
                       " calibration runs, must hold from " + std::to_string(kLeastRuns) + " to " +
                       std::to_string(kMostRuns)});
  }
  return calibrationOf(runs);
}

}  // namespace semantic_lidar_fusion

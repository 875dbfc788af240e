// SPDX-License-Identifier: MIT
/// Masks with the paper's own camera and lidar: a calibration board of known shape in a workshop.
#include <gtest/gtest.h>

#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <sstream>

#include "npz.h"
#include "semantic_lidar_fusion/projection/occlusion_mask.h"

namespace semantic_lidar_fusion {
namespace {

/// Mean of the calibration runs: roll pitch yaw (rad, fixed axes) and position of the camera in the
/// lidar's frame.
Transform cameraFromLidar(const std::string& folder) {
  std::ifstream file(folder + "/extrinsic_runs.csv");
  std::string line;
  std::getline(file, line);  // names
  Eigen::Matrix<double, 6, 1> sum = Eigen::Matrix<double, 6, 1>::Zero();
  int runs = 0;
  while (std::getline(file, line)) {
    std::stringstream cells(line);
    std::string cell;
    for (int k = 0; k < 6 && std::getline(cells, cell, ','); ++k) sum[k] += std::stod(cell);
    ++runs;
  }
  const Eigen::Matrix<double, 6, 1> mean = sum / runs;
  Transform T_lidar_camera = Transform::Identity();
  T_lidar_camera.translation() = mean.tail<3>();
  T_lidar_camera.linear() = (Eigen::AngleAxisd(mean[2], Eigen::Vector3d::UnitZ()) *
                             Eigen::AngleAxisd(mean[1], Eigen::Vector3d::UnitY()) *
                             Eigen::AngleAxisd(mean[0], Eigen::Vector3d::UnitX()))
                                .toRotationMatrix();
  return T_lidar_camera.inverse();
}

CameraModel cameraA0() {
  CameraInfo info;
  info.size = {1920, 1208};
  info.distortion_model = "equidistant";
  info.d = {-0.0540096, -0.0784275, 0.0959641, -0.0515253};
  info.k = {1176.93, 0.0, 962.275, 0.0, 1177.72, 612.725, 0.0, 0.0, 1.0};
  return CameraModel(info, {});
}

/// Whether the line of sight to `p` crosses the board (corners in order) more than 0.3 m before it.
bool behindBoard(const Eigen::Vector3d& p, const std::array<Eigen::Vector3d, 4>& corners) {
  const Eigen::Vector3d normal = (corners[1] - corners[0]).cross(corners[3] - corners[0]);
  const double part = corners[0].dot(normal) / p.dot(normal);
  if (!(part > 0.0) || !((1.0 - part) * p.norm() > 0.3)) return false;
  for (std::size_t k = 0; k < 4; ++k) {
    const Eigen::Vector3d edge = corners[(k + 1) % 4] - corners[k];
    if (!(edge.cross(part * p - corners[k]).dot(normal) > 0.0)) return false;
  }
  return true;
}

struct Counts {
  int hidden = 0, caught = 0, board = 0, lost = 0;
};

Counts judge(const std::string& path, const Transform& T_camera_lidar) {
  const auto arrays = readNpz(path);
  Cloud cloud;
  cloud.x = arrays.at("x").as<float>();
  cloud.y = arrays.at("y").as<float>();
  cloud.z = arrays.at("z").as<float>();
  cloud.ring = arrays.at("ring").as<std::uint16_t>();
  cloud.status.assign(cloud.x.size(), 0);
  const auto on_board = arrays.at("on_board").as<std::uint8_t>();
  const auto values = arrays.at("board_corners_camera_m").as<double>();
  std::array<Eigen::Vector3d, 4> corners;
  for (std::size_t k = 0; k < 4; ++k) corners[k] = Eigen::Vector3d::Map(&values[3 * k]);

  const CameraModel camera = cameraA0();
  const OcclusionConfig config;
  const BeamGrid grid = beamGrid(cloud, config);
  const ProjectedPoints points =
      projectCloud(cloud, T_camera_lidar, camera, castMarginPx(camera, grid, config));
  const auto visible = visiblePoints(cloud, points, T_camera_lidar, camera, grid, config);
  Counts counts;
  for (std::size_t k = 0; k < points.size(); ++k) {
    if (!inImage(points.u[k], points.v[k], camera.imageSize())) continue;
    const std::uint32_t i = points.index[k];
    const bool gone = visible[k] == 0;
    if (on_board[i] != 0) {
      ++counts.board;
      counts.lost += gone;
    }
    if (behindBoard(T_camera_lidar * Eigen::Vector3d(cloud.x[i], cloud.y[i], cloud.z[i]),
                    corners)) {
      ++counts.hidden;
      counts.caught += gone;
    }
  }
  return counts;
}

TEST(RealBoard, HidesWhatIsBehindAndLosesNothingOfItself) {
  const std::string folder = std::string(SLF_SOURCE_DIR) + "/../shared/data/acfr_a0_vlp16";
  if (!std::filesystem::exists(folder)) {
    GTEST_SKIP() << "../shared/data/acfr_a0_vlp16 is not there";
  }
  const Transform T_camera_lidar = cameraFromLidar(folder);
  Counts all, without_pose01;
  for (const auto& file : std::filesystem::directory_iterator(folder)) {
    if (file.path().extension() != ".npz") continue;
    const Counts counts = judge(file.path().string(), T_camera_lidar);
    std::printf("%s: %d of %d hidden points caught, %d of %d board points lost\n",
                file.path().stem().c_str(), counts.caught, counts.hidden, counts.lost,
                counts.board);
    for (Counts* sum : {&all, &without_pose01}) {
      if (sum == &without_pose01 && file.path().stem() == "pose01") continue;
      sum->hidden += counts.hidden;
      sum->caught += counts.caught;
      sum->board += counts.board;
      sum->lost += counts.lost;
    }
  }
  EXPECT_GT(all.hidden, 1500);
  EXPECT_GT(all.board, 6000);
  std::printf("caught %.2f %%, lost %.3f %%; without pose01 caught %.2f %%\n",
              100.0 * all.caught / all.hidden, 100.0 * all.lost / all.board,
              100.0 * without_pose01.caught / without_pose01.hidden);
  EXPECT_GE(all.caught, 0.88 * all.hidden);
  EXPECT_LE(all.lost, 0.001 * all.board);
  // In pose01 the corners that the camera found lie 9 cm (rms) off the plane of the board's returns
  // (2 cm in the others): what is hidden is not known there.
  EXPECT_GE(without_pose01.caught, 0.96 * without_pose01.hidden);
}

}  // namespace
}  // namespace semantic_lidar_fusion

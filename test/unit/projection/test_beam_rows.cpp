// SPDX-License-Identifier: MIT
/// Scans that are not one turn of rings: several turns, rosettes, lidars without rings.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <numeric>
#include <random>
#include <set>

#include "ray_scene.h"
#include "semantic_lidar_fusion/projection/occlusion_mask.h"

namespace semantic_lidar_fusion {
namespace {

/// A room of 30 x 20 m without anything in it: nothing hides anything.
RayScene emptyRoom() {
  RayScene scene;
  scene.addGround(0.0);
  scene.addPanel(-15.0, -10.0, 15.0, -10.0, 0.0, 20.0);
  scene.addPanel(-15.0, 10.0, 15.0, 10.0, 0.0, 20.0);
  scene.addPanel(-15.0, -10.0, -15.0, 10.0, 0.0, 20.0);
  scene.addPanel(15.0, -10.0, 15.0, 10.0, 0.0, 20.0);
  return scene;
}

Transform lidarAt(double x) {
  Transform T_world_lidar = Transform::Identity();
  T_world_lidar.translation() = Eigen::Vector3d(x, 0.0, 1.8);
  return T_world_lidar;
}

/// Turns of a VLP-16 that moves 0.8 m a turn, in the lidar's frame of the first.
Cloud turnsOf(const RayScene& scene, int turns, double begin_deg, double end_deg,
              double last_turn = 1.0) {
  Cloud cloud;
  for (int turn = 0; turn < turns; ++turn) {
    LidarPattern pattern = LidarPattern::vlp16(0.2);
    pattern.azimuth_begin_deg =
        turn + 1 < turns ? begin_deg : end_deg - last_turn * (end_deg - begin_deg);
    pattern.azimuth_end_deg = end_deg;
    const double moved = 0.8 * turn;
    const LidarScan scan = scanScene(scene, lidarAt(moved), pattern, 3);
    for (std::size_t i = 0; i < scan.cloud.size(); ++i) {
      cloud.x.push_back(scan.cloud.x[i] + static_cast<float>(moved));
      cloud.y.push_back(scan.cloud.y[i]);
      cloud.z.push_back(scan.cloud.z[i]);
      cloud.ring.push_back(scan.cloud.ring[i]);
      cloud.status.push_back(0);
      cloud.dt.push_back(static_cast<float>(
          0.1 * turn + 0.1 * (radians(end_deg) - scan.azimuth[i]) / (2.0 * M_PI)));
    }
  }
  return cloud;
}

/// Fields of `cloud` in another order.
Cloud reordered(const Cloud& cloud, const std::vector<std::size_t>& order) {
  Cloud result;
  for (const std::size_t i : order) {
    result.x.push_back(cloud.x[i]);
    result.y.push_back(cloud.y[i]);
    result.z.push_back(cloud.z[i]);
    result.ring.push_back(cloud.ring[i]);
    result.status.push_back(cloud.status[i]);
    result.dt.push_back(cloud.dt[i]);
  }
  return result;
}

std::size_t rowsWithPoints(const BeamGrid& grid) {
  std::set<std::uint16_t> rows(grid.ring.begin(), grid.ring.end());
  rows.erase(kNoRing);
  return rows.size();
}

template <typename Visit>
void forLinks(const BeamGrid& grid, const Visit& visit) {
  for (std::size_t i = 0; i < grid.links.size(); ++i) {
    const BeamGrid::Links& links = grid.links[i];
    for (const std::int32_t link : {links.left, links.right, links.up, links.down}) {
      if (link != BeamGrid::kNoLink) visit(i, static_cast<std::size_t>(link));
    }
  }
}

double hiddenShare(const Cloud& cloud) {
  CameraInfo info;
  info.size = {1200, 800};
  info.distortion_model = "equidistant";
  info.d = {0.0, 0.0, 0.0, 0.0};
  info.k = {600.0, 0.0, 599.5, 0.0, 600.0, 399.5, 0.0, 0.0, 1.0};
  const CameraModel camera(info, {});
  Transform T_lidar_camera = Transform::Identity();
  T_lidar_camera.translation() = Eigen::Vector3d(0.3, 0.0, -0.2);
  T_lidar_camera.linear() = bodyFromOptical();
  const Transform T = T_lidar_camera.inverse();
  const OcclusionConfig config;
  const BeamGrid grid = beamGrid(cloud, config);
  const ProjectedPoints points = projectCloud(cloud, T, camera, castMarginPx(camera, grid, config));
  const auto visible = visiblePoints(cloud, points, T, camera, grid, config);
  double hidden = 0, all = 0;
  for (std::size_t k = 0; k < points.size(); ++k) {
    if (!inImage(points.u[k], points.v[k], camera.imageSize())) continue;
    all += 1;
    hidden += visible[k] == 0;
  }
  EXPECT_GT(all, 500);
  return hidden / all;
}

void expectTurns(const Cloud& cloud, std::size_t turns, const std::string& what) {
  const BeamGrid grid = beamGrid(cloud, {});
  EXPECT_EQ(rowsWithPoints(grid), 16 * turns) << what;
  EXPECT_TRUE(grid.note.empty()) << grid.note;
  forLinks(grid, [&](std::size_t i, std::size_t j) {
    // Within a turn, neighbours are at most 9 steps of 0.2 deg apart, or next to the seam.
    ASSERT_LT(std::abs(grid.ring[i] - grid.ring[j]), 16) << what;
  });
  EXPECT_LT(hiddenShare(cloud), 0.01) << what;
}

TEST(Turns, EachHasRowsOfItsOwn) {
  const RayScene room = emptyRoom();
  expectTurns(turnsOf(room, 1, -180.0, 180.0), 1, "one");
  expectTurns(turnsOf(room, 1, -180.0, 240.0), 1, "one and a little more");
  expectTurns(turnsOf(room, 1, -40.0, 30.0), 1, "a part of one");
  expectTurns(turnsOf(room, 2, -180.0, 180.0), 2, "two");
  expectTurns(turnsOf(room, 2, -180.0, 180.0, 0.5), 2, "one and a half");
  expectTurns(turnsOf(room, 3, -30.0, 30.0), 3, "three parts");
  expectTurns(turnsOf(room, 8, -20.0, 20.0), 8, "eight parts");
  expectTurns(turnsOf(room, 2, -150.0, 150.0), 2, "two with a gap at the back");
}

TEST(Turns, CountInOrderOfTime) {
  const Cloud cloud = turnsOf(emptyRoom(), 2, -180.0, 180.0);
  std::vector<std::size_t> order(cloud.size());
  std::iota(order.begin(), order.end(), 0u);
  std::stable_sort(order.begin(), order.end(),
                   [&](std::size_t a, std::size_t b) { return cloud.ring[a] < cloud.ring[b]; });
  expectTurns(reordered(cloud, order), 2, "ring by ring");
  std::reverse(order.begin(), order.end());
  expectTurns(reordered(cloud, order), 2, "backwards");

  // Without times or order nothing tells turns apart.
  std::shuffle(order.begin(), order.end(), std::mt19937(4));
  Cloud shuffled = reordered(turnsOf(emptyRoom(), 1, -180.0, 180.0), [&] {
    std::vector<std::size_t> first;
    const std::size_t half = turnsOf(emptyRoom(), 1, -180.0, 180.0).size();
    for (const std::size_t i : order) {
      if (i < half) first.push_back(i);
    }
    return first;
  }());
  shuffled.dt.assign(shuffled.size(), 0.0f);
  EXPECT_EQ(rowsWithPoints(beamGrid(shuffled, {})), 16u);
}

TEST(Turns, APacketAloneIsEnough) {
  // 24 firings, 4.8 deg.
  const Cloud cloud = turnsOf(emptyRoom(), 1, -2.4, 2.4);
  EXPECT_LE(cloud.size(), 24u * 16u + 16u);
  const BeamGrid grid = beamGrid(cloud, {});
  EXPECT_EQ(rowsWithPoints(grid), 16u);
  EXPECT_NEAR(grid.horizontal_step_rad, radians(0.2), 0.01 * radians(0.2));
}

/// The rosette of two turning prisms in six lines, which `ring` numbers, 0.3 deg apart.
LidarScan rosette(const RayScene& scene, int points) {
  LidarScan scan;
  std::mt19937 random(5);
  std::normal_distribution<double> noise(0.0, 0.02);
  const Transform T_world_lidar = lidarAt(0.0);
  const double a = 2.0 * M_PI * 121.57, b = -2.0 * M_PI * 77.73, r = radians(17.6);
  for (int k = 0; k < points; ++k) {
    const double t = 0.1 * k / points;
    const int line = k % 6;
    const double azimuth = r * (std::cos(a * t) + std::cos(b * t));
    const double elevation = r * (std::sin(a * t) + std::sin(b * t)) + radians(0.3 * line - 10.0);
    const Eigen::Vector3d ray(std::cos(elevation) * std::cos(azimuth),
                              std::cos(elevation) * std::sin(azimuth), std::sin(elevation));
    const RayScene::Hit hit = scene.cast(T_world_lidar.translation(), ray);
    if (hit.object < 0) continue;
    const Eigen::Vector3d p = (hit.distance + noise(random)) * ray;
    scan.cloud.x.push_back(static_cast<float>(p.x()));
    scan.cloud.y.push_back(static_cast<float>(p.y()));
    scan.cloud.z.push_back(static_cast<float>(p.z()));
    scan.cloud.ring.push_back(static_cast<std::uint16_t>(line));
    scan.cloud.status.push_back(0);
    scan.cloud.dt.push_back(static_cast<float>(t));
    scan.object.push_back(hit.object);
  }
  return scan;
}

TEST(Rosette, IsCutByAngleAndSaysSo) {
  for (const int points : {5000, 24000}) {
    const LidarScan scan = rosette(emptyRoom(), points);
    const BeamGrid grid = beamGrid(scan.cloud, {});
    EXPECT_NE(grid.note.find("no cones"), std::string::npos);
    std::size_t links = 0, across = 0;
    forLinks(grid, [&](std::size_t i, std::size_t j) {
      ++links;
      across += scan.object[i] != scan.object[j];
    });
    EXPECT_GT(links, scan.cloud.size()) << points;
    EXPECT_LT(across, links / 20) << points;  // walls and ground meet without an edge
    EXPECT_LT(hiddenShare(scan.cloud), 0.001) << points;
  }
}

TEST(Rosette, StillHidesWhatStandsBehind) {
  RayScene scene = emptyRoom();
  // As wide as half of the view: the camera, 0.2 m lower, does not see what the lidar sees over it.
  const int board = scene.addPanel(4.0, -1.0, 4.0, 1.0, 0.5, 1.75);
  const LidarScan scan = rosette(scene, 24000);
  ASSERT_GT(std::count(scan.object.begin(), scan.object.end(), board), 500);
  const double hidden = hiddenShare(scan.cloud),
               without = hiddenShare(rosette(emptyRoom(), 24000).cloud);
  EXPECT_GT(hidden, without + 0.005);
}

TEST(Rosette, RingsOfATiltedLidarStayRings) {
  Cloud cloud = turnsOf(emptyRoom(), 1, -180.0, 180.0);
  const Eigen::Matrix3f tilt = Eigen::AngleAxisf(0.4f, Eigen::Vector3f::UnitY()).toRotationMatrix();
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const Eigen::Vector3f p = tilt * Eigen::Vector3f(cloud.x[i], cloud.y[i], cloud.z[i]);
    cloud.x[i] = p.x();
    cloud.y[i] = p.y();
    cloud.z[i] = p.z();
  }
  const BeamGrid grid = beamGrid(cloud, {});
  EXPECT_TRUE(grid.note.empty());
  EXPECT_EQ(rowsWithPoints(grid), 16u);
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <numeric>
#include <optional>
#include <random>

#include "ray_scene.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/projection/occlusion_mask.h"

namespace semantic_lidar_fusion {
namespace {

CameraModel fisheye(double focal_px, int width, int height) {
  CameraInfo info;
  info.size = {width, height};
  info.distortion_model = "equidistant";
  info.d = {-0.0557, 0.0173, -0.0019, 0.00007};
  info.k = {focal_px, 0.0, 0.5 * (width - 1), 0.0, focal_px, 0.5 * (height - 1), 0.0, 0.0, 1.0};
  return CameraModel(info, {});
}

CameraModel referenceCamera() { return fisheye(1166.0, 1928, 1208); }

OcclusionConfig mode(const OcclusionMode* mode, double horizontal_step_deg = 0.0,
                     double vertical_step_deg = 0.0) {
  OcclusionConfig config;
  config.mode = mode;
  config.horizontal_step_deg = horizontal_step_deg;
  config.vertical_step_deg = vertical_step_deg;
  return config;
}

Transform lidarPose(double height, double pitch_deg = 0.0) {
  Transform T_world_lidar = Transform::Identity();
  T_world_lidar.translation() = Eigen::Vector3d(0.0, 0.0, height);
  T_world_lidar.linear() =
      Eigen::AngleAxisd(radians(pitch_deg), Eigen::Vector3d::UnitY()).toRotationMatrix();
  return T_world_lidar;
}

/// Camera 0.3 m ahead, `below` under and `aside` left of the lidar's place, level.
Transform cameraPose(double height, double below, double aside, double yaw_deg = 0.0) {
  Transform T_world_camera = Transform::Identity();
  T_world_camera.translation() = Eigen::Vector3d(0.3, aside, height - below);
  T_world_camera.linear() =
      Eigen::AngleAxisd(radians(yaw_deg), Eigen::Vector3d::UnitZ()) * bodyFromOptical();
  return T_world_camera;
}

/// Ground, a facade along the road, a wall across it and a solid panel before that wall.
struct PanelScene {
  RayScene scene;
  int ground, panel, facade, wall;
  PanelScene() {
    ground = scene.addGround(0.0);
    panel = scene.addPanel(8.0, -2.0, 8.0, 2.0, 0.0, 1.5);
    facade = scene.addPanel(-20.0, 6.0, 25.0, 6.0, 0.0, 8.0);
    wall = scene.addPanel(25.0, -30.0, 25.0, 30.0, 0.0, 8.0);
  }
};

/// A street with parked and crossing cars, poles, signs, pedestrians and low walls.
RayScene streetScene(std::uint32_t seed) {
  RayScene scene;
  std::mt19937 random(seed);
  const auto draw = [&](double low, double high) {
    return std::uniform_real_distribution<double>(low, high)(random);
  };
  const auto side = [](int i) { return i % 2 ? 1.0 : -1.0; };
  scene.addGround(0.0);
  scene.addPanel(-30.0, 9.0, 60.0, 9.5, 0.0, 9.0);
  scene.addPanel(-30.0, -11.0, 60.0, -10.5, 0.0, 9.0);
  scene.addPanel(60.0, -30.0, 60.0, 30.0, 0.0, 12.0);
  for (int i = 0; i < 4; ++i) {
    scene.addBox({draw(5.0, 35.0), side(i) * draw(3.2, 4.5), 0.75}, {4.3, 1.8, 1.5},
                 draw(-0.05, 0.05));
  }
  scene.addBox({draw(10.0, 30.0), draw(-2.0, 2.0), 0.75}, {4.3, 1.8, 1.5}, draw(-0.3, 0.3));
  for (int i = 0; i < 6; ++i) {
    scene.addPole(draw(5.0, 35.0), side(i) * draw(5.0, 7.0), draw(0.03, 0.12), 0.0, draw(3.0, 6.0));
  }
  for (int i = 0; i < 3; ++i) {
    scene.addPole(draw(5.0, 25.0), draw(-7.0, 7.0), draw(0.2, 0.3), 0.0, draw(1.5, 1.9));
  }
  for (int i = 0; i < 2; ++i) {
    const double x = draw(6.0, 30.0), y = side(i) * draw(5.0, 7.0), bottom = draw(1.8, 2.5);
    scene.addPanel(x, y - 0.4, x, y + 0.4, bottom, bottom + 0.7);
    scene.addPole(x + 0.05, y, 0.03, 0.0, bottom + 0.5);
  }
  const double x = draw(6.0, 30.0);
  scene.addPanel(x, -7.0, x + 5.0, -7.0, 0.0, draw(1.0, 2.0));
  return scene;
}

// ---------------------------------------------------------------- mode paper

TEST(PaperMask, SizeFollowsEquationFourteen) {
  const auto size = [](double gap_u, double gap_v) {
    const CameraModel camera = fisheye(1000.0, 1920, 1208);
    return paperMaskSize(camera, std::atan(gap_u / 1000.0), std::atan(gap_v / 1000.0));
  };
  const CameraModel reference = referenceCamera();
  EXPECT_EQ(paperMaskSize(reference, radians(0.1), radians(2.0)).width, 3);
  EXPECT_EQ(paperMaskSize(reference, radians(0.1), radians(2.0)).height, 41);
  EXPECT_EQ(paperMaskSize(reference, radians(0.2), radians(2.0)).width, 5);
  const std::vector<std::pair<double, int>> expected = {
      {0.0, 1},  {0.4, 1}, {1.2, 1},  {1.99, 1},  {2.01, 3},   {2.9, 3},
      {3.01, 5}, {4.9, 5}, {5.01, 7}, {40.7, 41}, {41.01, 43}, {100.5, 101}};
  for (const auto& [gap, odd] : expected) {
    EXPECT_EQ(size(gap, 20.0).width, odd) << gap;
    EXPECT_EQ(size(20.0, gap).height, odd) << gap;
    EXPECT_EQ(size(gap, gap).width % 2, 1);
  }
}

/// The rule as written, O(n^2).
std::vector<std::uint8_t> paperReference(const ProjectedPoints& points, const ImageSize& size,
                                         int width, int height) {
  std::vector<std::size_t> order(points.size());
  std::iota(order.begin(), order.end(), 0u);
  std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) {
    return points.distance[a] < points.distance[b];
  });
  std::vector<std::uint8_t> visible(points.size(), 0);
  std::vector<std::size_t> casters;
  for (const std::size_t i : order) {
    if (!inImage(points.u[i], points.v[i], size)) continue;
    const int u = pixelIndex(points.u[i]), v = pixelIndex(points.v[i]);
    visible[i] = std::none_of(casters.begin(), casters.end(), [&](std::size_t j) {
      return std::abs(u - pixelIndex(points.u[j])) <= (width - 1) / 2 &&
             std::abs(v - pixelIndex(points.v[j])) <= (height - 1) / 2;
    });
    if (visible[i]) casters.push_back(i);
  }
  return visible;
}

void expectPaperEqualsReference(const ProjectedPoints& points, const CameraModel& camera,
                                double horizontal_step_deg, double vertical_step_deg) {
  const OcclusionConfig config =
      mode(&OcclusionMode::kPaper, horizontal_step_deg, vertical_step_deg);
  BeamGrid grid;
  grid.horizontal_step_rad = radians(horizontal_step_deg);
  grid.vertical_step_rad = radians(vertical_step_deg);
  const auto visible = visiblePoints(Cloud(), points, Transform::Identity(), camera, grid, config);
  const MaskSize mask = paperMaskSize(camera, grid.horizontal_step_rad, grid.vertical_step_rad);
  const auto expected = paperReference(points, camera.imageSize(), mask.width, mask.height);
  ASSERT_EQ(visible.size(), expected.size());
  for (std::size_t i = 0; i < visible.size(); ++i) {
    if (!inImage(points.u[i], points.v[i], camera.imageSize())) continue;
    ASSERT_EQ(visible[i], expected[i])
        << "point " << i << " of mask " << mask.width << " x " << mask.height << " at "
        << points.u[i] << ", " << points.v[i];
  }
}

TEST(PaperMask, EqualsBruteForceOnRandomPoints) {
  std::mt19937 random(1);
  // Heights around the 64-bit words of the bit mask.
  for (const int height : {1, 63, 64, 65, 200}) {
    const CameraModel camera = fisheye(120.0, 151, height);
    ProjectedPoints points;
    std::uniform_real_distribution<float> u(-20.0f, 170.0f), v(-20.0f, height + 20.0f);
    std::uniform_int_distribution<int> distance(1, 500);  // many ties
    for (std::uint32_t i = 0; i < 1500; ++i) {
      points.index.push_back(3 * i);
      points.u.push_back(i % 10 ? u(random) : std::floor(u(random)) + 0.5f);
      points.v.push_back(i % 10 ? v(random) : std::floor(v(random)) + 0.5f);
      points.distance.push_back(0.1f * static_cast<float>(distance(random)));
      points.theta.push_back(0.0f);
    }
    for (const auto& [horizontal, vertical] : {std::pair<double, double>{1.5, 10.0},
                                               {0.1, 0.1},
                                               {3.0, 0.1},
                                               {0.1, 50.0},
                                               {20.0, 40.0}}) {
      expectPaperEqualsReference(points, camera, horizontal, vertical);
    }
  }
}

TEST(PaperMask, EqualsBruteForceOnScenes) {
  const CameraModel camera = referenceCamera();
  LidarPattern pattern = LidarPattern::vlp16(0.2);
  pattern.azimuth_begin_deg = -25.0;
  pattern.azimuth_end_deg = 25.0;
  for (const double below : {0.3, 1.0}) {
    const Transform T_world_lidar = lidarPose(1.7, 7.0);
    const LidarScan scan = scanScene(PanelScene().scene, T_world_lidar, pattern, 2);
    const Transform T_camera_lidar = cameraPose(1.7, below, 0.5).inverse() * T_world_lidar;
    const ProjectedPoints points = projectCloud(scan.cloud, T_camera_lidar, camera, 30.0);
    expectPaperEqualsReference(points, camera, 0.1, 2.0);
    expectPaperEqualsReference(points, camera, 0.2, 2.0);
  }
}

TEST(PaperMask, StepsComeFromTheDataUnlessGiven) {
  const LidarScan scan = scanScene(PanelScene().scene, lidarPose(1.7), LidarPattern::vlp16(0.2), 2);
  const BeamGrid measured = beamGrid(scan.cloud, mode(&OcclusionMode::kPaper));
  const MaskSize mask =
      paperMaskSize(referenceCamera(), measured.horizontal_step_rad, measured.vertical_step_rad);
  EXPECT_EQ(mask.width, 5);
  EXPECT_EQ(mask.height, 41);
  const BeamGrid given = beamGrid(scan.cloud, mode(&OcclusionMode::kPaper, 0.1, 1.0));
  EXPECT_DOUBLE_EQ(given.horizontal_step_rad, radians(0.1));
  EXPECT_DOUBLE_EQ(given.vertical_step_rad, radians(1.0));
  EXPECT_EQ(castMarginPx(referenceCamera(), given, mode(&OcclusionMode::kPaper)), 0.0);
}

TEST(Off, EveryPointIsVisible) {
  ProjectedPoints points;
  points.index = {0, 1};
  points.u = points.v = {5.0f, 5.0f};
  points.distance = {1.0f, 9.0f};
  points.theta = {0.0f, 0.0f};
  const auto visible = visiblePoints(Cloud(), points, Transform::Identity(), referenceCamera(), {},
                                     mode(&OcclusionMode::kOff));
  EXPECT_EQ(visible, (std::vector<std::uint8_t>{1, 1}));
}

// ---------------------------------------------------------------- steps from the data

/// 5 % of a step: more than range noise or a compensated turn of 30 deg/s (3 %) changes it.
constexpr double kStepTolerance = 0.05;

void expectSteps(const Cloud& cloud, double azimuth_deg, double elevation_deg,
                 const std::string& what) {
  const BeamGrid grid = beamGrid(cloud, mode(&OcclusionMode::kAdaptive));
  EXPECT_NEAR(grid.horizontal_step_rad, radians(azimuth_deg), kStepTolerance * radians(azimuth_deg))
      << what;
  EXPECT_NEAR(grid.vertical_step_rad, radians(elevation_deg),
              kStepTolerance * radians(elevation_deg))
      << what;
  for (const BeamGrid::Ring& ring : grid.rings) {
    if (ring.half_azimuth_rad == 0.0) continue;
    EXPECT_NEAR(2.0 * ring.half_azimuth_rad, radians(azimuth_deg),
                kStepTolerance * radians(azimuth_deg))
        << what;
    EXPECT_NEAR(2.0 * ring.half_up_rad, radians(elevation_deg),
                kStepTolerance * radians(elevation_deg))
        << what;
    EXPECT_NEAR(2.0 * ring.half_down_rad, radians(elevation_deg),
                kStepTolerance * radians(elevation_deg))
        << what;
  }
}

Cloud selected(const Cloud& cloud, const std::vector<std::size_t>& chosen) {
  Cloud result;
  for (const std::size_t i : chosen) {
    result.x.push_back(cloud.x[i]);
    result.y.push_back(cloud.y[i]);
    result.z.push_back(cloud.z[i]);
    result.ring.push_back(cloud.ring[i]);
    result.status.push_back(cloud.status[i]);
  }
  return result;
}

TEST(BeamGrid, StepsSurviveWhatRealDataDoes) {
  const RayScene scene = streetScene(1);
  for (const double step : {0.1, 0.2, 0.4}) {
    LidarPattern pattern = LidarPattern::vlp16(step);
    expectSteps(scanScene(scene, lidarPose(1.9), pattern, 3).cloud, step, 2.0,
                "plain " + std::to_string(step));
    pattern.dropout = 0.5;
    expectSteps(scanScene(scene, lidarPose(1.9), pattern, 3).cloud, step, 2.0,
                "half missing " + std::to_string(step));
  }
  const Cloud cloud = scanScene(scene, lidarPose(1.9), LidarPattern::vlp16(0.2), 3).cloud;
  std::vector<std::size_t> all(cloud.size());
  std::iota(all.begin(), all.end(), 0u);

  std::vector<std::size_t> shuffled = all;
  std::shuffle(shuffled.begin(), shuffled.end(), std::mt19937(4));
  expectSteps(selected(cloud, shuffled), 0.2, 2.0, "shuffled");

  std::vector<std::size_t> gaps;
  for (const std::size_t i : all) {
    if ((i / 700) % 3 != 1 && cloud.ring[i] != 6) gaps.push_back(i);
  }
  expectSteps(selected(cloud, gaps), 0.2, 2.0, "sectors and a ring missing");

  Cloud dual = cloud;  // second returns behind a third of the points
  for (std::size_t i = 0; i < cloud.size(); i += 3) {
    const float farther = 1.0f + 0.05f * static_cast<float>(i % 11);
    dual.x.push_back(farther * cloud.x[i]);
    dual.y.push_back(farther * cloud.y[i]);
    dual.z.push_back(farther * cloud.z[i]);
    dual.ring.push_back(cloud.ring[i]);
    dual.status.push_back(0);
  }
  expectSteps(dual, 0.2, 2.0, "dual return");

  // Compensated: the sensor moved 1.5 m and turned 3 deg during the scan.
  Cloud moved = cloud;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const double part = static_cast<double>(i) / static_cast<double>(cloud.size()) - 0.5;
    const Eigen::Vector3d p = Eigen::AngleAxisd(radians(3.0) * part, Eigen::Vector3d::UnitZ()) *
                                  Eigen::Vector3d(cloud.x[i], cloud.y[i], cloud.z[i]) +
                              Eigen::Vector3d(1.5 * part, 0.0, 0.0);
    moved.x[i] = static_cast<float>(p.x());
    moved.y[i] = static_cast<float>(p.y());
    moved.z[i] = static_cast<float>(p.z());
  }
  const BeamGrid grid = beamGrid(moved, mode(&OcclusionMode::kAdaptive));
  EXPECT_NEAR(grid.horizontal_step_rad, radians(0.2), 0.15 * radians(0.2));
  EXPECT_NEAR(grid.vertical_step_rad, radians(2.0), 0.05 * radians(2.0));
}

TEST(BeamGrid, UnevenRingsReachHalfWayToTheirNeighbours) {
  LidarPattern pattern = LidarPattern::vlp16(0.2);
  pattern.elevation_deg = {-25.0, -15.0, -10.0, -8.0, -7.0};
  const Cloud cloud = scanScene(streetScene(1), lidarPose(1.9), pattern, 3).cloud;
  const BeamGrid grid = beamGrid(cloud, mode(&OcclusionMode::kAdaptive));
  ASSERT_EQ(grid.rings.size(), 5u);
  EXPECT_NEAR(grid.rings[1].half_up_rad, radians(2.5), 1e-3);
  EXPECT_NEAR(grid.rings[1].half_down_rad, radians(5.0), 1e-3);
  EXPECT_NEAR(grid.rings[0].half_down_rad, radians(5.0), 1e-3);
  EXPECT_NEAR(grid.rings[4].half_up_rad, radians(0.5), 1e-3);
  EXPECT_NEAR(grid.rings[2].elevation_rad, radians(-10.0), 1e-3);
}

TEST(BeamGrid, GivenStepsOverrideTheData) {
  const Cloud cloud =
      scanScene(PanelScene().scene, lidarPose(1.7), LidarPattern::vlp16(0.2), 3).cloud;
  const BeamGrid grid = beamGrid(cloud, mode(&OcclusionMode::kAdaptive, 0.3, 1.0));
  EXPECT_DOUBLE_EQ(grid.horizontal_step_rad, radians(0.3));
  EXPECT_DOUBLE_EQ(grid.vertical_step_rad, radians(1.0));
  EXPECT_DOUBLE_EQ(grid.rings[3].half_azimuth_rad, radians(0.15));
  EXPECT_DOUBLE_EQ(grid.rings[3].half_up_rad, radians(0.5));
  EXPECT_DOUBLE_EQ(grid.rings[3].half_down_rad, radians(0.5));
}

TEST(BeamGrid, WithoutRingsTheVerticalStepMustBeGiven) {
  Cloud cloud = scanScene(PanelScene().scene, lidarPose(1.7), LidarPattern::vlp16(0.2), 3).cloud;
  std::fill(cloud.ring.begin(), cloud.ring.end(), kNoRing);
  try {
    beamGrid(cloud, mode(&OcclusionMode::kAdaptive));
    ADD_FAILURE() << "accepted";
  } catch (const DataError& error) {
    const std::string message = error.what();
    EXPECT_NE(message.find("ring"), std::string::npos) << message;
    EXPECT_NE(message.find("occlusion.vertical_step_deg = 0"), std::string::npos) << message;
  }
  const BeamGrid grid = beamGrid(cloud, mode(&OcclusionMode::kAdaptive, 0.0, 2.0));
  EXPECT_NEAR(grid.horizontal_step_rad, radians(0.2), kStepTolerance * radians(0.2));
  // The made-up rings are the real ones.
  const BeamGrid real =
      beamGrid(scanScene(PanelScene().scene, lidarPose(1.7), LidarPattern::vlp16(0.2), 3).cloud,
               mode(&OcclusionMode::kAdaptive, 0.0, 2.0));
  EXPECT_EQ(grid.ring, real.ring);
  EXPECT_NO_THROW(beamGrid(cloud, mode(&OcclusionMode::kOff)));
}

TEST(BeamGrid, EmptyAndUnusablePoints) {
  Cloud cloud;
  EXPECT_TRUE(beamGrid(cloud, mode(&OcclusionMode::kAdaptive)).links.empty());
  cloud.x = {1.0f, 0.0f, std::nanf(""), 2.0f};
  cloud.y = cloud.z = {0.0f, 0.0f, 0.0f, 0.0f};
  cloud.ring = {0, 0, 0, 0};
  cloud.status = {static_cast<std::uint8_t>(PointStatus::kNoOdometry), 0, 0, 0};
  const BeamGrid grid = beamGrid(cloud, mode(&OcclusionMode::kAdaptive));
  ASSERT_EQ(grid.ring.size(), 4u);
  EXPECT_EQ(grid.ring[0], kNoRing);
  EXPECT_EQ(grid.ring[1], kNoRing);
  EXPECT_EQ(grid.ring[2], kNoRing);
  EXPECT_EQ(grid.ring[3], 0);
  EXPECT_EQ(grid.links[3].left, BeamGrid::kNoLink);
}

TEST(BeamGrid, LinksStayOnOneSurface) {
  const PanelScene panel;
  for (const double step : {0.1, 0.2}) {
    const LidarScan scan =
        scanScene(panel.scene, lidarPose(1.7, 7.0), LidarPattern::vlp16(step), 3);
    const BeamGrid grid = beamGrid(scan.cloud, mode(&OcclusionMode::kAdaptive));
    int ground_up = 0, ground_beside = 0, ground = 0, panel_to_wall = 0;
    for (std::size_t i = 0; i < scan.cloud.size(); ++i) {
      const BeamGrid::Links& links = grid.links[i];
      const auto object = [&](std::int32_t j) { return scan.object[static_cast<std::size_t>(j)]; };
      if (scan.object[i] == panel.panel) {
        for (const std::int32_t j : {links.left, links.right, links.up, links.down}) {
          panel_to_wall += j != BeamGrid::kNoLink && object(j) == panel.wall;
        }
      }
      if (scan.object[i] != panel.ground || scan.cloud.ring[i] > 2) continue;
      ++ground;
      ground_up += links.up != BeamGrid::kNoLink;
      ground_beside += links.left != BeamGrid::kNoLink && links.right != BeamGrid::kNoLink;
      if (links.left != BeamGrid::kNoLink) {
        const auto j = static_cast<std::size_t>(links.left);
        EXPECT_EQ(scan.cloud.ring[j], scan.cloud.ring[i]);
        EXPECT_GT(std::remainder(scan.azimuth[j] - scan.azimuth[i], 2.0 * 3.14159265358979), 0.0);
      }
      if (links.up != BeamGrid::kNoLink) {
        EXPECT_EQ(scan.cloud.ring[static_cast<std::size_t>(links.up)], scan.cloud.ring[i] + 1);
      }
    }
    EXPECT_EQ(panel_to_wall, 0);
    EXPECT_GT(ground_up, 0.97 * ground);
    EXPECT_GT(ground_beside, 0.98 * ground);
  }
}

/// Returns 5 mm apart with the lidar's noise are in line with everything; they are no plane that
/// goes on to what is 10 m behind them.
TEST(BeamGrid, NoiseAtCloseRangeLinksNothingFarAway) {
  RayScene scene;
  scene.addPanel(-3.0, 1.5, 3.0, 1.5, -0.4, 0.4);
  scene.addPanel(-40.0, 11.0, 40.0, 11.0, -5.0, 9.0);
  LidarScan scan = scanScene(scene, Transform::Identity(), LidarPattern::vlp16(0.2), 3);
  std::mt19937 random(9);
  std::normal_distribution<float> noise(0.0f, 0.02f);
  Cloud& cloud = scan.cloud;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const float range =
        std::sqrt(cloud.x[i] * cloud.x[i] + cloud.y[i] * cloud.y[i] + cloud.z[i] * cloud.z[i]);
    const float scale = 1.0f + noise(random) / range;
    cloud.x[i] *= scale;
    cloud.y[i] *= scale;
    cloud.z[i] *= scale;
  }
  const BeamGrid grid = beamGrid(cloud, mode(&OcclusionMode::kAdaptive));
  int links = 0;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const BeamGrid::Links& own = grid.links[i];
    for (const std::int32_t j : {own.left, own.right, own.up, own.down}) {
      if (j == BeamGrid::kNoLink) continue;
      ++links;
      EXPECT_EQ(scan.object[i], scan.object[static_cast<std::size_t>(j)]) << i << " to " << j;
    }
  }
  EXPECT_GT(links, 10000);
}

// ---------------------------------------------------------------- mode adaptive

/// The rule of the header, in double precision, one pair of points at a time.
class AdaptiveReference {
 public:
  AdaptiveReference(const Cloud& cloud, const ProjectedPoints& points,
                    const Transform& T_camera_lidar, const CameraModel& camera,
                    const BeamGrid& grid, const OcclusionConfig& config)
      : cloud_(cloud), T_(T_camera_lidar), camera_(camera), config_(config) {
    for (const std::uint32_t i : points.index) {
      if (grid.ring[i] == kNoRing) continue;
      const BeamGrid::Links& links = grid.links[i];
      const BeamGrid::Ring& ring = grid.rings[grid.ring[i]];
      const bool lone = links.up < 0 && links.down < 0;
      const bool alone = lone && links.left < 0 && links.right < 0;
      const double tall = lone ? 1.0 : 1.5, wide = alone ? 1.0 : 1.5;
      const Image own = image(at(i));
      const Image left = end(i, links.left, links.right, wide * ring.half_azimuth_rad, 0.0);
      const Image right = end(i, links.right, links.left, -wide * ring.half_azimuth_rad, 0.0);
      const Image up = end(i, links.up, links.down, 0.0, tall * ring.half_up_rad);
      const Image down =
          foot(i, links, ring, grid)
              .value_or(end(i, links.down, links.up, 0.0, -tall * ring.half_down_rad));
      addPatch(own, left, right, up);
      addPatch(own, left, right, down);
    }
  }

  bool visible(double u, double v, double distance) const {
    double inverse = 0.0;
    for (const Patch& patch : patches_) {
      const Eigen::Vector2d st = patch.inverse * (Eigen::Vector2d(u, v) - patch.centre);
      if (std::abs(st.x()) > 1.0 + patch.slack.x() || st.y() < -patch.slack.y() ||
          st.y() > 1.0 + patch.slack.y()) {
        continue;
      }
      const double value = patch.own + st.x() * patch.across + st.y() * patch.along;
      inverse = std::max(inverse, std::min(patch.most, std::max(patch.least, value)));
    }
    if (inverse == 0.0) return true;
    const double near = 1.0 / inverse;
    return distance <= near + std::max(config_.depth_margin_m, config_.depth_margin_ratio * near);
  }

 private:
  struct Image {
    Eigen::Vector2d pixel;
    double inverse;
  };
  struct Patch {
    Eigen::Matrix2d inverse;
    Eigen::Vector2d centre, slack;
    double own, across, along, least, most;
  };

  Eigen::Vector3d at(std::size_t i) const { return {cloud_.x[i], cloud_.y[i], cloud_.z[i]}; }

  Image image(const Eigen::Vector3d& p_lidar) const {
    const Eigen::Vector3d p = T_ * p_lidar;
    return {*camera_.project(p), 1.0 / p.norm()};
  }

  Image end(std::size_t i, std::int32_t link, std::int32_t opposite, double azimuth,
            double elevation) const {
    const Image own = image(at(i));
    if (link >= 0) {
      const Image other = image(at(static_cast<std::size_t>(link)));
      return {0.5 * (own.pixel + other.pixel), 0.5 * (own.inverse + other.inverse)};
    }
    const Eigen::Vector3d p = at(i);
    const double range = p.norm();
    double inverse = 1.0 / range;
    const double beam_elevation = std::asin(p.z() / range);
    if (opposite >= 0) {
      const Eigen::Vector3d q = at(static_cast<std::size_t>(opposite));
      const double between = std::acos(std::min(1.0, p.dot(q) / (range * q.norm())));
      const double reach = std::abs(elevation) + std::abs(azimuth) * std::cos(beam_elevation);
      if (between > 1e-6) inverse += (1.0 / range - 1.0 / q.norm()) * reach / between;
      const double margin = std::max(config_.depth_margin_m, config_.depth_margin_ratio * range);
      inverse = std::max(inverse, 0.25 / range);
      inverse = std::min(inverse, 1.0 / std::max(0.5 * range, range - margin));
    }
    const double a = std::atan2(p.y(), p.x()) + azimuth, e = beam_elevation + elevation;
    return image(
        Eigen::Vector3d(std::cos(e) * std::cos(a), std::cos(e) * std::sin(a), std::sin(e)) /
        inverse);
  }

  /// Of what stands on the ground and is met by no lower ring.
  std::optional<Image> foot(std::size_t i, const BeamGrid::Links& links, const BeamGrid::Ring& ring,
                            const BeamGrid& grid) const {
    if (links.down >= 0 || !grid.ground) return std::nullopt;
    const BeamGrid::Ring* lowest = &ring;
    for (const BeamGrid::Ring& other : grid.rings) {
      if (other.half_azimuth_rad > 0 && other.elevation_rad < lowest->elevation_rad) {
        return std::nullopt;
      }
    }
    const Eigen::Vector3d normal = grid.ground->normal.cast<double>();
    const double height = normal.dot(at(i)) + grid.ground->offset_m;
    if (!(height > 0.3)) return std::nullopt;
    return image(at(i) - height * normal);
  }

  void addPatch(const Image& own, const Image& left, const Image& right, const Image& end) {
    Eigen::Matrix2d basis;
    basis.col(0) = 0.5 * (right.pixel - left.pixel);
    basis.col(1) = end.pixel - own.pixel;
    if (std::abs(basis.determinant()) < 1e-3 * (basis.col(0).norm() + basis.col(1).norm())) return;
    Patch patch;
    patch.inverse = basis.inverse();
    patch.centre = 0.5 * (right.pixel + left.pixel);
    patch.slack = 0.5 * patch.inverse.cwiseAbs().rowwise().sum();
    patch.own = own.inverse;
    patch.across = 0.5 * (right.inverse - left.inverse);
    patch.along = end.inverse - own.inverse;
    patch.least = std::min(own.inverse, end.inverse) - std::abs(patch.across);
    patch.most = std::max(own.inverse, end.inverse) + std::abs(patch.across);
    patches_.push_back(patch);
  }

  const Cloud& cloud_;
  const Transform& T_;
  const CameraModel& camera_;
  const OcclusionConfig& config_;
  std::vector<Patch> patches_;
};

TEST(AdaptiveMask, EqualsBruteForceWhereTheDecisionIsNotOnAnEdge) {
  const OcclusionConfig config = mode(&OcclusionMode::kAdaptive);
  LidarPattern pattern = LidarPattern::vlp16(0.2);
  pattern.azimuth_begin_deg = -14.0;
  pattern.azimuth_end_deg = 14.0;
  pattern.dropout = 0.05;
  for (const std::uint32_t seed : {1u, 2u}) {
    for (const int turns : {0, 1}) {  // upright and lying on its side
      const Transform T_world_lidar = lidarPose(1.9);
      const LidarScan scan = scanScene(streetScene(seed), T_world_lidar, pattern, seed);
      Transform T_world_camera = cameraPose(1.9, 0.8, 0.5);
      T_world_camera.rotate(Eigen::AngleAxisd(radians(90.0 * turns), Eigen::Vector3d::UnitZ()));
      const Transform T_camera_lidar = T_world_camera.inverse() * T_world_lidar;
      const CameraModel camera = referenceCamera();
      const BeamGrid grid = beamGrid(scan.cloud, config);
      const ProjectedPoints points =
          projectCloud(scan.cloud, T_camera_lidar, camera, castMarginPx(camera, grid, config));
      const auto visible = visiblePoints(scan.cloud, points, T_camera_lidar, camera, grid, config);
      const AdaptiveReference reference(scan.cloud, points, T_camera_lidar, camera, grid, config);
      // Rounding of pixels to float, and of an arm's angles by their series.
      const double du = 0.05, dv = 0.05;
      int compared = 0, hidden = 0;
      for (std::size_t i = 0; i < points.size(); ++i) {
        if (!inImage(points.u[i], points.v[i], camera.imageSize())) continue;
        const bool here = reference.visible(points.u[i], points.v[i], points.distance[i]);
        bool sure = true;
        for (const double a : {-1.0, 1.0}) {
          for (const double b : {-1.0, 1.0}) {
            for (const double grow : {0.999, 1.001}) {
              sure = sure && here == reference.visible(points.u[i] + a * du, points.v[i] + b * dv,
                                                       grow * points.distance[i]);
            }
          }
        }
        if (!sure) continue;
        ++compared;
        hidden += !here;
        ASSERT_EQ(visible[i] != 0, here) << "point " << i << " at " << points.u[i] << ", "
                                         << points.v[i] << ", " << points.distance[i] << " m";
      }
      EXPECT_GT(compared, 1000);
      EXPECT_GT(hidden, 30);
    }
  }
}

/// A beam on its own: everything clearly within its cell and behind the margin is hidden.
TEST(AdaptiveMask, ABeamOnItsOwnCastsItsCell) {
  Cloud cloud;
  const auto add = [&](double azimuth_deg, double elevation_deg, double range, int ring) {
    const double a = radians(azimuth_deg), e = radians(elevation_deg);
    cloud.x.push_back(static_cast<float>(range * std::cos(e) * std::cos(a)));
    cloud.y.push_back(static_cast<float>(range * std::cos(e) * std::sin(a)));
    cloud.z.push_back(static_cast<float>(range * std::sin(e)));
    cloud.ring.push_back(static_cast<std::uint16_t>(ring));
    cloud.status.push_back(0);
  };
  OcclusionConfig config = mode(&OcclusionMode::kAdaptive, 0.2, 2.0);
  Transform T_lidar_camera = Transform::Identity();
  T_lidar_camera.linear() = bodyFromOptical();
  const Transform T_camera_lidar = T_lidar_camera.inverse();
  add(0.0, 0.0, 5.0, 1);     // the near one
  add(0.0, 0.9, 5.49, 3);    // in the cell, within 10 %
  add(0.0, 0.9, 5.60, 4);    // beyond it
  add(0.09, -0.9, 50.0, 5);  // in the cell
  add(0.0, 2.2, 50.0, 6);    // above all cells
  add(0.25, 0.0, 50.0, 7);   // beside it
  const CameraModel camera = referenceCamera();
  const BeamGrid grid = beamGrid(cloud, config);
  const ProjectedPoints points = projectCloud(cloud, T_camera_lidar, camera, 0.0);
  ASSERT_EQ(points.size(), 6u);
  EXPECT_EQ(visiblePoints(cloud, points, T_camera_lidar, camera, grid, config),
            (std::vector<std::uint8_t>{1, 1, 0, 0, 1, 1}));
  // A point without odometry is not projected and casts nothing.
  cloud.status[0] = static_cast<std::uint8_t>(PointStatus::kNoOdometry);
  const BeamGrid without = beamGrid(cloud, config);
  const ProjectedPoints rest = projectCloud(cloud, T_camera_lidar, camera, 0.0);
  ASSERT_EQ(rest.size(), 5u);
  EXPECT_EQ(visiblePoints(cloud, rest, T_camera_lidar, camera, without, config)[1], 1);
  // Margins are parameters.
  cloud.status[0] = 0;
  config.depth_margin_ratio = 0.0;
  config.depth_margin_m = 0.7;
  EXPECT_EQ(visiblePoints(cloud, points, T_camera_lidar, camera, grid, config)[2], 1);
  config.depth_margin_m = 0.4;
  EXPECT_EQ(visiblePoints(cloud, points, T_camera_lidar, camera, grid, config)[1], 0);
}

/// A van whose side the lowest ring meets 0.6 m above the ground, and a camera below the lidar: the
/// wall's foot behind the van is hidden, though no beam meets what hides it.
TEST(AdaptiveMask, WhatTheLowestRingMeetsStandsOnTheGround) {
  const auto hiddenShare = [](bool with_ground) {
    RayScene scene;
    if (with_ground) scene.addGround(0.0);
    scene.addBox({4.5, 0.0, 1.0}, {1.6, 3.0, 2.0}, 0.0);
    const int wall = scene.addPanel(12.0, 8.0, 12.0, -8.0, 0.0, 3.0);
    LidarPattern pattern = LidarPattern::vlp16(0.2);
    const Transform T_world_lidar = lidarPose(1.6);
    LidarScan scan = scanScene(scene, T_world_lidar, pattern, 1);
    EXPECT_EQ(beamGrid(scan.cloud, mode(&OcclusionMode::kAdaptive)).ground.has_value(),
              with_ground);
    // What another sensor has seen of the wall below the van's side: beams of no ring.
    const std::size_t measured = scan.cloud.size();
    for (double y = -0.8; y <= 0.8; y += 0.1) {
      for (double z = 0.1; z <= 0.35; z += 0.05) {
        const Eigen::Vector3f p =
            (T_world_lidar.inverse() * Eigen::Vector3d(12.0, y, z)).cast<float>();
        scan.cloud.x.push_back(p.x());
        scan.cloud.y.push_back(p.y());
        scan.cloud.z.push_back(p.z());
        scan.cloud.ring.push_back(kNoRing);
        scan.cloud.status.push_back(0);
      }
    }
    EXPECT_GE(wall, 0);
    const Transform T_world_camera = cameraPose(0.6, 0.0, 0.0);
    const Transform T_camera_lidar = T_world_camera.inverse() * T_world_lidar;
    const CameraModel camera = referenceCamera();
    const OcclusionConfig config = mode(&OcclusionMode::kAdaptive);
    const BeamGrid grid = beamGrid(scan.cloud, config);
    const ProjectedPoints points = projectCloud(scan.cloud, T_camera_lidar, camera, 0.0);
    const auto visible = visiblePoints(scan.cloud, points, T_camera_lidar, camera, grid, config);
    int hidden = 0, all = 0;
    for (std::size_t i = 0; i < points.size(); ++i) {
      if (points.index[i] < measured) continue;
      ++all;
      hidden += !visible[i];
    }
    EXPECT_GT(all, 80);
    return static_cast<double>(hidden) / all;
  };
  EXPECT_GT(hiddenShare(true), 0.99);
  EXPECT_LT(hiddenShare(false), 0.5);
}

TEST(BeamGrid, FindsTheGroundUnderALidarThatIsTilted) {
  for (const double pitch_deg : {0.0, 6.0, -10.0}) {
    RayScene scene = streetScene(4);
    Transform T_world_lidar = lidarPose(1.9);
    T_world_lidar.rotate(Eigen::AngleAxisd(radians(pitch_deg), Eigen::Vector3d::UnitY()));
    const LidarScan scan = scanScene(scene, T_world_lidar, LidarPattern::vlp16(0.2), 4);
    const BeamGrid grid = beamGrid(scan.cloud, mode(&OcclusionMode::kAdaptive));
    ASSERT_TRUE(grid.ground);
    const Eigen::Vector3d up = T_world_lidar.linear().transpose() * Eigen::Vector3d::UnitZ();
    EXPECT_GT(grid.ground->normal.cast<double>().dot(up), std::cos(radians(1.5))) << pitch_deg;
    EXPECT_NEAR(grid.ground->offset_m, 1.9, 0.1) << pitch_deg;
  }
}

TEST(BeamGrid, FindsNoGroundWhereThereIsNone) {
  RayScene scene;  // a wall in front of a lidar in the air
  scene.addPanel(6.0, 8.0, 6.0, -8.0, -4.0, 4.0);
  const LidarScan scan = scanScene(scene, Transform::Identity(), LidarPattern::vlp16(0.2), 1);
  EXPECT_FALSE(beamGrid(scan.cloud, mode(&OcclusionMode::kAdaptive)).ground);
}

TEST(AdaptiveMask, PointsOutsideTheImageCastIntoIt) {
  // A narrow image whose border cuts through a panel: its points outside still hide the wall.
  RayScene scene;
  scene.addGround(0.0);
  scene.addPanel(6.0, -3.0, 6.0, 3.0, 0.0, 1.4);
  scene.addPanel(25.0, -30.0, 25.0, 30.0, 0.0, 8.0);
  const Transform T_world_lidar = lidarPose(1.9);
  const LidarScan scan = scanScene(scene, T_world_lidar, LidarPattern::vlp16(0.2), 5);
  const OcclusionConfig config = mode(&OcclusionMode::kAdaptive);
  const BeamGrid grid = beamGrid(scan.cloud, config);
  const CameraModel camera = fisheye(1166.0, 600, 61);  // +- 1.5 deg high
  const Transform T_world_camera = cameraPose(1.9, 0.8, 0.0);
  const Transform T_camera_lidar = T_world_camera.inverse() * T_world_lidar;
  const double margin = castMarginPx(camera, grid, config);
  EXPECT_GT(margin, 20.0);
  const auto hiddenCount = [&](double px) {
    const ProjectedPoints points = projectCloud(scan.cloud, T_camera_lidar, camera, px);
    const auto visible = visiblePoints(scan.cloud, points, T_camera_lidar, camera, grid, config);
    int hidden = 0;
    for (std::size_t i = 0; i < points.size(); ++i) {
      hidden += inImage(points.u[i], points.v[i], camera.imageSize()) && !visible[i];
    }
    return hidden;
  };
  EXPECT_GT(hiddenCount(margin), hiddenCount(0.0));
}

TEST(AdaptiveMask, RefusesTheGridOfAnotherCloud) {
  Cloud cloud;
  cloud.x = cloud.y = cloud.z = {1.0f};
  cloud.ring = {0};
  cloud.status = {0};
  EXPECT_THROW(visiblePoints(cloud, {}, Transform::Identity(), referenceCamera(), {},
                             mode(&OcclusionMode::kAdaptive)),
               DataError);
}

// ---------------------------------------------------------------- rates

struct Rates {
  int visible = 0, lost = 0;
  int lost_inside = 0;  ///< with no silhouette within one step of the line of sight
  int catchable = 0, caught = 0;
  int within_margin = 0;  ///< catchable, but closer to their occluder than the depth margin
  std::vector<int> visible_of, lost_of;  ///< by object

  double caughtShare() const { return static_cast<double>(caught) / std::max(1, catchable); }
  double lostShare() const { return static_cast<double>(lost) / std::max(1, visible); }
  double lostShareOf(int object) const {
    return static_cast<double>(lost_of[object]) / std::max(1, visible_of[object]);
  }
};

constexpr int kMostObjects = 64;

/// Truth by a ray from the camera to each point. A hidden point is catchable if a return of its
/// occluder lies within one ring and one azimuth step of where the line of sight meets it, and if
/// it is farther behind than the depth margin.
void measure(const RayScene& scene, const LidarScan& scan, const Transform& T_world_lidar,
             const Transform& T_world_camera, const OcclusionConfig& config, Rates* rates) {
  const CameraModel camera = referenceCamera();
  const Transform T_camera_lidar = T_world_camera.inverse() * T_world_lidar;
  const BeamGrid grid = beamGrid(scan.cloud, config);
  const ProjectedPoints points =
      projectCloud(scan.cloud, T_camera_lidar, camera, castMarginPx(camera, grid, config));
  const auto visible = visiblePoints(scan.cloud, points, T_camera_lidar, camera, grid, config);
  rates->visible_of.resize(kMostObjects, 0);
  rates->lost_of.resize(kMostObjects, 0);
  const Eigen::Vector3d eye = T_world_camera.translation();
  const double azimuth_step = radians(0.2), ring_step = radians(2.0);
  for (std::size_t k = 0; k < points.size(); ++k) {
    if (!inImage(points.u[k], points.v[k], camera.imageSize())) continue;
    const std::size_t i = points.index[k];
    const double distance = (scan.truth[i] - eye).norm();
    const Eigen::Vector3d sight = (scan.truth[i] - eye) / distance;
    const RayScene::Hit hit = scene.cast(eye, sight);
    if (hit.distance > distance - 1e-3) {
      ++rates->visible;
      ++rates->visible_of[scan.object[i]];
      if (visible[k]) continue;
      ++rates->lost;
      ++rates->lost_of[scan.object[i]];
      const double azimuth = std::atan2(sight.y(), sight.x()), elevation = std::asin(sight.z());
      bool silhouette = false;
      for (int a = -4; a <= 4; ++a) {
        for (int e = -8; e <= 8; ++e) {
          const double az = azimuth + 0.25 * a * azimuth_step;
          const double el = elevation + 0.125 * e * ring_step;
          const Eigen::Vector3d beside(std::cos(el) * std::cos(az), std::cos(el) * std::sin(az),
                                       std::sin(el));
          const RayScene::Hit other = scene.cast(eye, beside);
          silhouette =
              silhouette || (other.object != scan.object[i] && other.distance < distance - 0.3);
        }
      }
      rates->lost_inside += !silhouette;
      continue;
    }
    const Eigen::Vector3d place = T_world_lidar.inverse() * (eye + hit.distance * sight);
    const double azimuth = std::atan2(place.y(), place.x());
    const double elevation = std::atan2(place.z(), std::hypot(place.x(), place.y()));
    bool catchable = false;
    for (std::size_t j = 0; j < scan.object.size() && !catchable; ++j) {
      catchable =
          scan.object[j] == hit.object && std::abs(scan.elevation[j] - elevation) <= ring_step &&
          std::abs(std::remainder(scan.azimuth[j] - azimuth, radians(360.0))) <= azimuth_step;
    }
    if (!catchable) continue;
    if (distance <=
        hit.distance + std::max(config.depth_margin_m, config.depth_margin_ratio * hit.distance)) {
      ++rates->within_margin;
      continue;
    }
    ++rates->catchable;
    rates->caught += !visible[k];
  }
}

Rates panelRates(const OcclusionConfig& config, double below, double aside) {
  const PanelScene panel;
  const Transform T_world_lidar = lidarPose(1.7, 7.0);
  const LidarScan scan = scanScene(panel.scene, T_world_lidar, LidarPattern::vlp16(0.2), 5);
  Rates rates;
  measure(panel.scene, scan, T_world_lidar, cameraPose(1.7, below, aside), config, &rates);
  return rates;
}

const std::vector<std::pair<double, double>> kOffsets = {{0.3, 0.0}, {0.3, 0.5}, {0.3, 1.0},
                                                         {0.8, 0.0}, {0.8, 0.5}, {0.8, 1.0},
                                                         {1.0, 0.0}, {1.0, 0.5}, {1.0, 1.0}};

void report(const std::string& scene, double below, double aside, const std::string& name,
            const Rates& r) {
  std::printf(
      "%s, camera %.1f m below, %.1f m aside, %s: caught %5.1f %% of %d, lost %5.2f %% of "
      "%d (off silhouettes %.2f %%)\n",
      scene.c_str(), below, aside, name.c_str(), 100.0 * r.caughtShare(), r.catchable,
      100.0 * r.lostShare(), r.visible, 100.0 * r.lost_inside / std::max(1, r.visible));
}

constexpr double kLeastCaught = 0.97;
constexpr double kMostLost = 0.005;

TEST(AdaptiveRates, PanelBeforeAWall) {
  const PanelScene panel;
  for (const auto& [below, aside] : kOffsets) {
    const Rates rates = panelRates(mode(&OcclusionMode::kAdaptive), below, aside);
    report("panel", below, aside, "adaptive", rates);
    const Rates paper_01 = panelRates(mode(&OcclusionMode::kPaper, 0.1, 2.0), below, aside);
    report("panel", below, aside, "3 x 41  ", paper_01);
    const Rates paper_02 = panelRates(mode(&OcclusionMode::kPaper, 0.2, 2.0), below, aside);
    report("panel", below, aside, "5 x 41  ", paper_02);
    EXPECT_GE(rates.caughtShare(), kLeastCaught) << below << " " << aside;
    for (const int object : {panel.ground, panel.facade, panel.panel}) {
      EXPECT_LE(rates.lostShareOf(object), kMostLost) << object << ": " << below << " " << aside;
    }
    EXPECT_LE(rates.lost_inside, kMostLost * rates.visible) << below << " " << aside;
    EXPECT_GT(rates.caughtShare(), paper_01.caughtShare());
  }
}

TEST(AdaptiveRates, BareGroundHidesNothing) {
  RayScene scene;
  scene.addGround(0.0);
  scene.addPanel(40.0, -60.0, 40.0, 60.0, 0.0, 10.0);
  for (const double pitch : {0.0, 7.0}) {
    const Transform T_world_lidar = lidarPose(1.7, pitch);
    const LidarScan scan = scanScene(scene, T_world_lidar, LidarPattern::vlp16(0.2), 5);
    for (const auto& [below, aside] : kOffsets) {
      Rates adaptive, paper;
      const Transform T_world_camera = cameraPose(1.7, below, aside);
      measure(scene, scan, T_world_lidar, T_world_camera, mode(&OcclusionMode::kAdaptive),
              &adaptive);
      EXPECT_LE(adaptive.lostShare(), kMostLost) << below << " " << aside << " " << pitch;
      measure(scene, scan, T_world_lidar, T_world_camera, mode(&OcclusionMode::kPaper, 0.1, 2.0),
              &paper);
      if (below == 1.0 && pitch == 0.0) {
        EXPECT_GT(paper.lostShare(), 0.1);
      }
    }
  }
}

TEST(AdaptiveRates, Street) {
  // Silhouettes cost what no mask can know: an edge lies anywhere between the last beam that meets
  // the object and the first that does not. So all losses but a few are within one step of one.
  constexpr double kStreetCaught = 0.90, kStreetLost = 0.025;
  for (const auto& [below, aside] : kOffsets) {
    if (aside != (below == 0.8 ? 0.5 : 0.0)) continue;
    Rates adaptive, paper_01, paper_02;
    for (const std::uint32_t seed : {1u, 2u, 3u}) {
      const RayScene scene = streetScene(seed);
      const Transform T_world_lidar = lidarPose(1.9);
      const LidarScan scan = scanScene(scene, T_world_lidar, LidarPattern::vlp16(0.2), seed);
      const Transform T_world_camera = cameraPose(1.9, below, aside, 20.0 * (seed - 2.0));
      measure(scene, scan, T_world_lidar, T_world_camera, mode(&OcclusionMode::kAdaptive),
              &adaptive);
      measure(scene, scan, T_world_lidar, T_world_camera, mode(&OcclusionMode::kPaper, 0.1, 2.0),
              &paper_01);
      measure(scene, scan, T_world_lidar, T_world_camera, mode(&OcclusionMode::kPaper, 0.2, 2.0),
              &paper_02);
    }
    report("street", below, aside, "adaptive", adaptive);
    report("street", below, aside, "3 x 41  ", paper_01);
    report("street", below, aside, "5 x 41  ", paper_02);
    EXPECT_GE(adaptive.caughtShare(), kStreetCaught) << below << " " << aside;
    EXPECT_LE(adaptive.lostShare(), kStreetLost) << below << " " << aside;
    EXPECT_LE(adaptive.lost_inside, kMostLost * adaptive.visible) << below << " " << aside;
    EXPECT_GT(adaptive.caughtShare(), paper_02.caughtShare());
  }
}

}  // namespace
}  // namespace semantic_lidar_fusion

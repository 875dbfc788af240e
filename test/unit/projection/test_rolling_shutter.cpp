// SPDX-License-Identifier: MIT
// Pixels of a rolling shutter against a camera that is moved row by row.
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <random>

#include "semantic_lidar_fusion/projection/cloud_projector.h"
#include "semantic_lidar_fusion/projection/occlusion_mask.h"
#include "semantic_lidar_fusion/projection/rolling_shutter.h"

namespace semantic_lidar_fusion {
namespace {

CameraInfo sideCameraInfo() {
  CameraInfo info;
  info.frame_id = "camera";
  info.size = {1928, 1208};
  info.distortion_model = "equidistant";
  info.d = {-0.0557, 0.0173, -0.0019, 0.00007};
  info.k = {1166.0, 0.0, 963.5, 0.0, 1166.0, 603.5, 0.0, 0.0, 1.0};
  return info;
}

CameraModelOptions shutter(double readout_s, ShutterDirection direction = ShutterDirection::kDown,
                           StampRow stamp_row = StampRow::kFirst) {
  CameraModelOptions options;
  options.shutter = {readout_s, direction, stamp_row};
  return options;
}

/// The side camera of a vehicle at 15 m/s and 30 deg/s: it moves to its right and turns about its
/// vertical axis.
Twist drive() { return {{15.0, 0.3, -0.2}, {0.02, 30.0 * kPi / 180.0, -0.01}}; }

/// T_image_later: from the camera at a later time to the camera at the image's time, exactly, for
/// a constant twist (the exponential in many small steps).
Transform poseAfter(const Twist& twist, double t_s) {
  constexpr int kSteps = 500;
  Transform step = Transform::Identity();
  const Eigen::Vector3d turned = twist.turn * (t_s / kSteps);
  step.translation() = twist.velocity * (t_s / kSteps);
  if (turned.norm() > 0.0) {
    step.linear() = Eigen::AngleAxisd(turned.norm(), turned.normalized()).toRotationMatrix();
  }
  Transform pose = Transform::Identity();
  for (int i = 0; i < kSteps; ++i) pose = pose * step;
  return pose;
}

/// The pixel of a point, by bisection on the row's time: independent of the rounds.
std::optional<Eigen::Vector2d> sought(const CameraModel& camera, const Twist& twist,
                                      const Eigen::Vector3d& p, double first_s, double last_s) {
  const auto pixelAt = [&](double t) {
    return camera.project(poseAfter(twist, t).inverse(Eigen::Isometry) * p);
  };
  double lo = first_s, hi = last_s;
  for (int i = 0; i < 30; ++i) {
    const double middle = 0.5 * (lo + hi);
    const auto pixel = pixelAt(middle);
    if (!pixel) return std::nullopt;
    const double row_s = camera.rowTimes().at(pixel->x(), pixel->y());
    (row_s > middle ? lo : hi) = middle;
  }
  return pixelAt(0.5 * (lo + hi));
}

Cloud cloudOf(const std::vector<Eigen::Vector3d>& points) {
  Cloud cloud;
  for (const Eigen::Vector3d& p : points) {
    cloud.x.push_back(static_cast<float>(p.x()));
    cloud.y.push_back(static_cast<float>(p.y()));
    cloud.z.push_back(static_cast<float>(p.z()));
  }
  cloud.intensity.assign(points.size(), 0.0f);
  cloud.ring.assign(points.size(), 0);
  cloud.dt.assign(points.size(), 0.0f);
  cloud.status.assign(points.size(), 0);
  return cloud;
}

std::vector<Eigen::Vector3d> street(int count, double nearest_m, std::uint32_t seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> side(-1.0, 1.0), range(nearest_m, 60.0);
  std::vector<Eigen::Vector3d> points;
  while (static_cast<int>(points.size()) < count) {
    const Eigen::Vector3d p = Eigen::Vector3d(side(random), side(random), side(random));
    if (p.norm() > 1.0 || p.norm() < 0.1) continue;
    points.push_back(p.normalized() * range(random));
  }
  return points;
}

TEST(RollingShutter, RowTimesFollowDirectionStampAndReduction) {
  CameraInfo info = sideCameraInfo();
  const double line_s = 0.012 / 1208;
  const auto times = [&](ShutterDirection direction, StampRow row) {
    return CameraModel(info, shutter(0.012, direction, row)).rowTimes();
  };
  using D = ShutterDirection;
  EXPECT_NEAR(times(D::kDown, StampRow::kFirst).at(5, 0), 0.0, 1e-15);
  EXPECT_NEAR(times(D::kDown, StampRow::kFirst).at(5, 100), 100 * line_s, 1e-15);
  EXPECT_NEAR(times(D::kDown, StampRow::kMiddle).at(5, 603.5), 0.0, 1e-15);
  EXPECT_NEAR(times(D::kDown, StampRow::kLast).at(5, 1207), 0.0, 1e-15);
  EXPECT_NEAR(times(D::kUp, StampRow::kFirst).at(5, 1207), 0.0, 1e-15);
  EXPECT_NEAR(times(D::kUp, StampRow::kFirst).at(5, 1107), 100 * line_s, 1e-15);
  EXPECT_NEAR(times(D::kUp, StampRow::kLast).at(5, 0), 0.0, 1e-15);
  const double column_s = 0.012 / 1928;
  EXPECT_NEAR(times(D::kRight, StampRow::kFirst).at(100, 5), 100 * column_s, 1e-15);
  EXPECT_NEAR(times(D::kLeft, StampRow::kFirst).at(1827, 5), 100 * column_s, 1e-15);
  // The same row of the sensor, whatever binning and region make of it.
  info.binning_x = 2, info.binning_y = 4;
  info.roi_x = 100, info.roi_y = 200, info.roi_width = 800, info.roi_height = 400;
  EXPECT_NEAR(times(D::kDown, StampRow::kFirst).at(0, 25), (200 + 4 * 25) * line_s, 1e-15);
  EXPECT_NEAR(times(D::kUp, StampRow::kFirst).at(0, 25), (1207 - 300) * line_s, 1e-15);
  EXPECT_NEAR(times(D::kRight, StampRow::kMiddle).at(10, 0), (120 - 963.5) * column_s, 1e-15);
}

TEST(RollingShutter, PixelsAreThoseOfTheRowsOwnTime) {
  // The goal: 0.05 px. From 3 m on, at 30 ms of readout, everywhere in the image.
  constexpr double kGoal_px = 0.05;
  for (const ShutterDirection direction : {ShutterDirection::kDown, ShutterDirection::kUp,
                                           ShutterDirection::kRight, ShutterDirection::kLeft}) {
    for (const StampRow row : {StampRow::kFirst, StampRow::kMiddle, StampRow::kLast}) {
      const CameraModel camera(sideCameraInfo(), shutter(0.03, direction, row));
      const Twist twist = drive();
      int compared = 0;
      double worst = 0.0, ignored = 0.0;
      for (const Eigen::Vector3d& p : street(300, 3.0, 5)) {
        const auto seen = seePoint(camera, &twist, p);
        if (!seen || !inImage(seen->pixel.x(), seen->pixel.y(), camera.imageSize())) continue;
        const auto expected = sought(camera, twist, p, -0.04, 0.04);
        ASSERT_TRUE(expected);
        worst = std::max(worst, (seen->pixel - *expected).norm());
        ignored = std::max(ignored, (*camera.project(p) - *expected).norm());
        // Where it was when its row was exposed.
        ASSERT_LT((*camera.project(seen->p_camera) - seen->pixel).norm(), 1e-9);
        ++compared;
      }
      EXPECT_GT(compared, 20);
      EXPECT_LT(worst, kGoal_px);
      EXPECT_GT(ignored, 15.0);
    }
  }
}

TEST(RollingShutter, AWrongDirectionOrStampRowIsVisiblyWorse) {
  const Twist twist = drive();
  const CameraModel right(sideCameraInfo(), shutter(0.02));
  for (const CameraModelOptions& wrong :
       {shutter(0.02, ShutterDirection::kUp), shutter(0.02, ShutterDirection::kRight),
        shutter(0.02, ShutterDirection::kLeft),
        shutter(0.02, ShutterDirection::kDown, StampRow::kMiddle),
        shutter(0.02, ShutterDirection::kDown, StampRow::kLast)}) {
    const CameraModel camera(sideCameraInfo(), wrong);
    double worst = 0.0;
    for (const Eigen::Vector3d& p : street(300, 5.0, 6)) {
      const auto a = seePoint(right, &twist, p), b = seePoint(camera, &twist, p);
      if (!a || !b || !inImage(a->pixel.x(), a->pixel.y(), right.imageSize())) continue;
      worst = std::max(worst, (a->pixel - b->pixel).norm());
    }
    EXPECT_GT(worst, 5.0);
  }
}

TEST(RollingShutter, CloudsGetThePixelsOfSinglePoints) {
  Transform T_camera_lidar = Transform::Identity();
  T_camera_lidar.linear() =
      Eigen::AngleAxisd(0.4, Eigen::Vector3d(1, 2, -1).normalized()).toRotationMatrix();
  T_camera_lidar.translation() = Eigen::Vector3d(0.2, -0.5, 0.3);
  const Twist twist = drive();
  std::vector<Eigen::Vector3d> points = street(6000, 1.0, 7);
  points.push_back(T_camera_lidar.inverse(Eigen::Isometry) * Eigen::Vector3d(0, 0, 0));
  points.push_back(T_camera_lidar.inverse(Eigen::Isometry) * Eigen::Vector3d(0, 0, 5));
  points.push_back({std::nan(""), 0, 1});
  const Cloud cloud = cloudOf(points);
  CameraInfo pinhole = sideCameraInfo();
  pinhole.distortion_model = "";
  pinhole.d.clear();
  CameraInfo folding = sideCameraInfo();  // at 91 deg, in the image with this focal length
  folding.d = {-0.05, -0.02, 0.01, -0.003};
  folding.k[0] = folding.k[4] = 400.0;
  for (const CameraInfo& info : {sideCameraInfo(), pinhole, folding}) {
    const CameraModel camera(info, shutter(0.03, ShutterDirection::kUp, StampRow::kMiddle));
    const auto projected = projectCloud(cloud, T_camera_lidar, camera, 30.0, &twist);
    std::vector<int> slot(points.size(), -1);
    for (std::size_t k = 0; k < projected.size(); ++k) {
      slot[projected.index[k]] = static_cast<int>(k);
      if (k > 0) {
        ASSERT_LT(projected.index[k - 1], projected.index[k]);
      }
    }
    int compared = 0;
    for (std::size_t i = 0; i < points.size(); ++i) {
      const Eigen::Vector3d p(cloud.x[i], cloud.y[i], cloud.z[i]);
      const auto seen = seePoint(camera, &twist, T_camera_lidar * p);
      constexpr double kSingle_px = 0.02;  // of single precision, see kMostSinglePrecision_px
      const auto within = [&](double margin) {
        return seen && seen->pixel.x() >= -0.5 - margin &&
               seen->pixel.x() < camera.imageSize().width - 0.5 + margin &&
               seen->pixel.y() >= -0.5 - margin &&
               seen->pixel.y() < camera.imageSize().height - 0.5 + margin;
      };
      const bool near_limit =
          std::abs(camera.theta(T_camera_lidar * p) - camera.maxThetaRad()) < 0.1;
      if (slot[i] < 0) {
        if (!near_limit) {
          ASSERT_FALSE(within(30.0 - kSingle_px)) << i << ": " << p.transpose();
        }
        continue;
      }
      const auto k = static_cast<std::size_t>(slot[i]);
      ASSERT_TRUE(seen) << i;
      ASSERT_TRUE(within(30.0 + kSingle_px)) << i;
      ASSERT_NEAR(projected.u[k], seen->pixel.x(), kSingle_px) << p.transpose();
      ASSERT_NEAR(projected.v[k], seen->pixel.y(), kSingle_px) << p.transpose();
      ASSERT_NEAR(projected.distance[k], seen->p_camera.norm(), 1e-4 * seen->p_camera.norm());
      ++compared;
    }
    EXPECT_GT(compared, 500);
  }
}

TEST(RollingShutter, WithoutMotionOrReadoutNothingChanges) {
  const Cloud cloud = cloudOf(street(3000, 1.0, 8));
  const Twist twist = drive(), still;
  const auto plain =
      projectCloud(cloud, Transform::Identity(), CameraModel(sideCameraInfo(), {}), 5.0);
  const auto same = [&](const ProjectedPoints& other) {
    return other.index == plain.index && other.u == plain.u && other.v == plain.v &&
           other.distance == plain.distance && other.theta == plain.theta;
  };
  const CameraModel rolling(sideCameraInfo(), shutter(0.03));
  EXPECT_TRUE(same(
      projectCloud(cloud, Transform::Identity(), CameraModel(sideCameraInfo(), {}), 5.0, &twist)));
  EXPECT_TRUE(same(projectCloud(cloud, Transform::Identity(), rolling, 5.0)));
  EXPECT_TRUE(same(projectCloud(cloud, Transform::Identity(), rolling, 5.0, &still)));
  EXPECT_FALSE(same(projectCloud(cloud, Transform::Identity(), rolling, 5.0, &twist)));
}

TEST(RollingShutter, APointThatLeavesTheDomainInAnyRoundHasNoPixel) {
  // The valid angle ends at 60 deg. The camera turns fast: what is inside at the image's time is
  // outside at its row's, and the other way round.
  CameraModelOptions options = shutter(0.03, ShutterDirection::kRight);
  options.max_theta_deg = 60.0;
  const CameraModel camera(sideCameraInfo(), options);
  const Twist turning{{0, 0, 0}, {0, -1.0, 0}};
  int inside_first = 0, outside_first = 0;
  for (double deg = 55.0; deg < 65.0; deg += 0.01) {
    const double a = deg * kPi / 180.0;
    const Eigen::Vector3d p(9.0 * std::sin(a), 0.0, 9.0 * std::cos(a));
    const bool first = camera.project(p).has_value();
    const auto seen = seePoint(camera, &turning, p);
    if (!first) {
      EXPECT_FALSE(seen) << deg;
    }
    if (seen) {
      EXPECT_TRUE(camera.project(seen->p_camera)) << deg;
    }
    inside_first += first && !seen;
    outside_first += !first;
  }
  EXPECT_GT(inside_first, 10);
  EXPECT_GT(outside_first, 10);
}

TEST(RollingShutter, MasksAreCastWhereTheRowsSawTheSurface) {
  // A near pole before a wall, both seen by a camera that moves: the pole hides the wall where its
  // own rows saw it. With the shutter ignored by the mask the two would differ by 20 px.
  const CameraModel camera(sideCameraInfo(), shutter(0.03));
  const Twist twist{{15.0, 0.0, 0.0}, {0, 0, 0}};
  std::vector<Eigen::Vector3d> points;
  std::vector<std::uint16_t> rings;
  for (int ring = 0; ring < 16; ++ring) {
    for (int step = -150; step <= 150; ++step) {
      const double azimuth = step * 0.2 * kPi / 180.0;
      const double elevation = (2.0 * ring - 15.0) * kPi / 180.0;
      const double range = std::abs(step) < 12 ? 5.0 : 20.0;
      points.push_back(range * Eigen::Vector3d(std::sin(azimuth) * std::cos(elevation),
                                               -std::sin(elevation),
                                               std::cos(azimuth) * std::cos(elevation)));
      rings.push_back(static_cast<std::uint16_t>(ring));
    }
  }
  // In the axes of a lidar: x forward, y left, z up.
  Transform T_camera_lidar = Transform::Identity();
  T_camera_lidar.linear() << 0, -1, 0, 0, 0, -1, 1, 0, 0;
  for (Eigen::Vector3d& p : points) p = T_camera_lidar.linear().transpose() * p;
  Cloud cloud = cloudOf(points);
  cloud.ring = rings;
  OcclusionConfig config;
  config.mode = &OcclusionMode::kAdaptive;
  const BeamGrid grid = beamGrid(cloud, config);
  const auto projected = projectCloud(cloud, T_camera_lidar, camera, 100.0, &twist);
  const auto visible =
      visiblePoints(cloud, projected, T_camera_lidar, camera, grid, config, &twist);
  // What the pole's outline in the image says: the wall's points between its edges, row by row, as
  // the lidar in the camera's own place sees no hidden point but for the motion.
  int hidden = 0, pole_hidden = 0;
  for (std::size_t k = 0; k < projected.size(); ++k) {
    if (!inImage(projected.u[k], projected.v[k], camera.imageSize())) continue;
    const bool pole = projected.distance[k] < 10.0f;
    hidden += !pole && visible[k] == 0;
    pole_hidden += pole && visible[k] == 0;
  }
  EXPECT_EQ(pole_hidden, 0);
  EXPECT_GT(hidden, 0);
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <opencv2/imgproc.hpp>

#include "semantic_lidar_fusion/check/edge_alignment.h"

namespace semantic_lidar_fusion {
namespace {

constexpr double kStep = 0.5 * kPi / 180.0;

CameraModel pinhole(double cx = 319.5, double cy = 199.5) {
  CameraInfo info;
  info.size = {640, 400};
  info.distortion_model = "plumb_bob";
  info.k = {400, 0, cx, 0, 400, cy, 0, 0, 1};
  return CameraModel(info, {});
}

/// From a lidar with x forward to an optical frame at the same place.
Transform opticalFromBody() {
  Transform T = Transform::Identity();
  T.linear() << 0, -1, 0, 0, 0, -1, 1, 0, 0;
  return T;
}

void add(double range, double azimuth, double elevation, std::uint16_t ring, Cloud* cloud) {
  cloud->x.push_back(static_cast<float>(range * std::cos(elevation) * std::cos(azimuth)));
  cloud->y.push_back(static_cast<float>(range * std::cos(elevation) * std::sin(azimuth)));
  cloud->z.push_back(static_cast<float>(range * std::sin(elevation)));
  cloud->ring.push_back(ring);
  cloud->status.push_back(0);
}

/// Boards 8 m away before a wall 20 m away, seen by 16 rings.
Cloud boards() {
  Cloud cloud;
  for (std::uint16_t ring = 0; ring < 16; ++ring) {
    for (int k = -60; k <= 60; ++k) {
      const double azimuth = k * kStep;
      const bool board = std::fmod(std::abs(azimuth) * 180.0 / kPi, 12.0) < 5.1;
      add(board ? 8.0 : 20.0, azimuth, (ring - 7.5) * 2.0 * kPi / 180.0, ring, &cloud);
    }
  }
  return cloud;
}

TEST(EdgeAlignment, AnEdgeLiesBetweenTwoBeams) {
  Cloud cloud;
  for (int k = -40; k <= 40; ++k) {
    add(std::abs(k) <= 10 ? 8.0 : 20.0, k * kStep, 0.0, 3, &cloud);
  }
  const std::vector<LidarEdge> edges = lidarEdges(cloud);
  ASSERT_EQ(edges.size(), 2u);
  for (const LidarEdge& edge : edges) {
    const double azimuth = std::atan2(edge.p.y(), edge.p.x());
    EXPECT_NEAR(std::abs(azimuth), 10.5 * kStep, 1e-6);
    EXPECT_NEAR(edge.p.head<2>().norm(), 8.0, 1e-5);
    EXPECT_DOUBLE_EQ(edge.weight, std::sqrt(5.0));  // a step of 12 m counts as 5
  }
}

TEST(EdgeAlignment, SmallStepsFarPointsGapsAndPointsWithoutRingHaveNone) {
  const auto edgesOf = [](double near, double far, std::uint16_t ring, std::uint8_t status) {
    Cloud cloud;
    for (int k = -20; k <= 20; ++k) add(k < 0 ? near : far, k * kStep, 0.0, ring, &cloud);
    for (std::uint8_t& value : cloud.status) value = status;
    return lidarEdges(cloud).size();
  };
  EXPECT_EQ(edgesOf(8.0, 9.0, 0, 0), 1u);
  EXPECT_EQ(edgesOf(8.0, 8.4, 0, 0), 0u) << "less than 0.5 m";
  EXPECT_EQ(edgesOf(20.0, 21.5, 0, 0), 0u) << "less than a tenth";
  EXPECT_EQ(edgesOf(41.0, 60.0, 0, 0), 0u) << "beyond 40 m";
  EXPECT_EQ(edgesOf(8.0, 9.0, kNoRing, 0), 0u);
  EXPECT_EQ(edgesOf(8.0, 9.0, 0, 4), 0u) << "no odometry";
}

/// What a camera at the lidar's place sees of `boards()`.
cv::Mat picture() {
  cv::Mat image(400, 640, CV_8UC1, cv::Scalar(60));
  for (int column = 0; column < image.cols; ++column) {
    const double azimuth = std::abs(std::atan((column - 319.5) / 400.0)) * 180.0 / kPi;
    // Between the last beam of a board and the first of the wall.
    if (azimuth < 5.25 || (azimuth > 11.75 && azimuth < 17.25) || azimuth > 23.75) {
      image.col(column).setTo(200);
    }
  }
  return image;
}

TEST(EdgeAlignment, EdgesMeetWhereTheRigIsRightAndNotElsewhere) {
  const std::vector<LidarEdge> edges = lidarEdges(boards());
  const EdgeScore right = scoreEdges(edges, pinhole(), opticalFromBody(), picture());
  EXPECT_GT(right.edges, 60u);
  // Each edge within a pixel or so: exp(-1 / 3) = 0.72, and Canny's own half pixel.
  EXPECT_GT(right.lift(), 0.6);
  // 20 px sideways: far beyond the fall-off of 3 px.
  const EdgeScore wrong = scoreEdges(edges, pinhole(339.5), opticalFromBody(), picture());
  EXPECT_LT(wrong.lift(), 0.02);
  // Blank, and looking away.
  const EdgeScore blank =
      scoreEdges(edges, pinhole(), opticalFromBody(), cv::Mat(400, 640, CV_8UC1, cv::Scalar(9)));
  EXPECT_EQ(blank.lift(), 0.0);
  const Transform behind =
      Transform(Eigen::AngleAxisd(kPi, Eigen::Vector3d::UnitY())) * opticalFromBody();
  EXPECT_EQ(scoreEdges(edges, pinhole(), behind, picture()).edges, 0u);
}

TEST(EdgeAlignment, ScoresAddUp) {
  EdgeScore sum{10, 4.0, 3.0, 1.0};
  sum.add({5, 4.0, 1.0, 1.0});
  EXPECT_EQ(sum.edges, 15u);
  EXPECT_DOUBLE_EQ(sum.lift(), (4.0 - 2.0) / (8.0 - 2.0));
  EXPECT_DOUBLE_EQ(sum.meanChance(), 0.25);
  EXPECT_DOUBLE_EQ(EdgeScore().lift(), 0.0);
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <cmath>

#include "semantic_lidar_fusion/check/rig_watch.h"

namespace semantic_lidar_fusion {
namespace {

Rig rig() {
  return rigFromYaml(YAML::Load("{classes: {classes: [{name: road, color: [0, 0, 1]},"
                                " {name: sky, color: [0, 0, 2]}]},"
                                " cameras: [{name: front}, {name: left, input: labels}]}"),
                     ".", "test");
}

/// The texts on one subject.
std::string taken(RigWatch* watch, const std::string& subject) {
  std::string text;
  for (const RigDoubt& doubt : watch->takeDoubts()) {
    if (doubt.subject == subject) text += doubt.text + "\n";
  }
  return text;
}

bool contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

TimedCloud scan(StampNs span_ns, float range_m) {
  TimedCloud cloud;
  for (int k = 0; k < 100; ++k) {
    cloud.x.push_back(range_m);
    cloud.y.push_back(0.0f);
    cloud.z.push_back(0.0f);
    cloud.ring.push_back(0);
    const StampNs t = kNsPerSecond + span_ns * k / 99;
    cloud.time_ns.push_back(t);
    cloud.firings.push_back({t, t, static_cast<std::uint32_t>(k)});
    cloud.firing.push_back(static_cast<std::uint32_t>(k));
  }
  return cloud;
}

TEST(RigWatch, StampsAheadOfTheirArrivalAreToldOnce) {
  RigWatch watch(rig());
  for (int k = 0; k < 20; ++k) {
    watch.lookAtArrival("/late", k * kNsPerSecond, k * kNsPerSecond + 90000000);
    watch.lookAtArrival("/near", k * kNsPerSecond, k * kNsPerSecond - 19000000);
    watch.lookAtArrival("/ahead", k * kNsPerSecond, k * kNsPerSecond - 50000000);
    watch.lookAtArrival("/once", k * kNsPerSecond, k == 3 ? 0 : k * kNsPerSecond);
  }
  const std::vector<RigDoubt> doubts = watch.takeDoubts();
  ASSERT_EQ(doubts.size(), 1u);
  EXPECT_EQ(doubts[0].subject, "/ahead");
  EXPECT_TRUE(contains(doubts[0].text, "0.050 s ahead"));
  watch.lookAtArrival("/ahead", kNsPerSecond, 0);
  EXPECT_TRUE(watch.takeDoubts().empty());
}

TEST(RigWatch, ScansTooShortAndInMillimetresAreTold) {
  const auto said = [](StampNs span_ns, float range_m) {
    RigWatch watch(rig());
    for (int k = 0; k < 3; ++k) watch.lookAtScan(scan(span_ns, range_m));
    return taken(&watch, "lidar");
  };
  EXPECT_EQ(said(100000000, 12.0f), "");
  EXPECT_EQ(said(0, 12.0f), "") << "no times at all: the decoder tells";
  EXPECT_TRUE(contains(said(100000, 12.0f), "lidar.time_unit"));
  EXPECT_TRUE(contains(said(100000000, 12000.0f), "millimetres"));
  EXPECT_TRUE(contains(said(100000000, 0.012f), "not in metres"));
}

TEST(RigWatch, APrincipalPointFarOffTheCentreIsTold) {
  CameraInfo info;
  info.size = {1280, 720};
  info.distortion_model = "plumb_bob";
  const auto said = [&](double cx, double cy) {
    RigWatch watch(rig());
    info.k = {700, 0, cx, 0, 700, cy, 0, 0, 1};
    watch.lookAtInfo(0, info, CameraModel(info, {}));
    return taken(&watch, "camera front");
  };
  EXPECT_EQ(said(640, 360), "");
  EXPECT_EQ(said(640 - 250, 360 + 140), "") << "shifted lenses exist";
  EXPECT_TRUE(contains(said(320, 180), "another resolution"));
  info.roi_width = 640;
  info.roi_height = 720;
  EXPECT_EQ(said(640, 360), "") << "a part of the image";
}

TEST(RigWatch, ScoresOfAnotherAspectAndProbabilitiesAreTold) {
  const auto said = [](const cv::Mat& scores) {
    RigWatch watch(rig());
    watch.lookAtSemantics(0, scores, {1280, 720});
    return taken(&watch, "camera front");
  };
  EXPECT_EQ(said(cv::Mat(90, 160, CV_32FC2, cv::Scalar(3.0, -2.0))), "");
  EXPECT_EQ(said(cv::Mat(9, 17, CV_32FC2, cv::Scalar(3.0, -2.0))), "") << "rounded";
  EXPECT_TRUE(contains(said(cv::Mat(160, 160, CV_32FC2, cv::Scalar(3.0, -2.0))), "letterboxed"));
  EXPECT_TRUE(
      contains(said(cv::Mat(90, 160, CV_32FC2, cv::Scalar(0.75, 0.25))), "input: probabilities"));
  EXPECT_EQ(said(cv::Mat(90, 160, CV_32FC2, cv::Scalar(0.75, 0.5))), "");
}

TEST(RigWatch, LabelsOutOfRangeAreTold) {
  RigWatch watch(rig());
  cv::Mat labels(90, 160, CV_8UC1, cv::Scalar(1));
  labels.row(3).setTo(255);  // no class
  watch.lookAtSemantics(1, labels, {1280, 720});
  EXPECT_EQ(taken(&watch, "camera left"), "");
  labels.row(7).setTo(2);
  watch.lookAtSemantics(1, labels, {1280, 720});
  EXPECT_TRUE(contains(taken(&watch, "camera left"), "label 2 is at or above"));
}

/// A view of camera 0 that looks along x of the vehicle, in which the lidar stands.
CameraView view() {
  CameraInfo info;
  info.size = {640, 400};
  info.distortion_model = "plumb_bob";
  info.k = {400, 0, 319.5, 0, 400, 199.5, 0, 0, 1};
  CameraView result;
  result.name = "front";
  result.model = std::make_shared<const CameraModel>(info, CameraModelOptions());
  result.has_image = true;
  result.T_camera_lidar_static.linear() << 0, -1, 0, 0, 0, -1, 1, 0, 0;
  result.T_camera_lidar = result.T_camera_lidar_static;
  return result;
}

SemanticCloud cloudOf(std::uint16_t cameras) {
  SemanticCloud cloud;
  for (int k = 0; k < 10; ++k) {
    cloud.points.x.push_back(5.0f);
    cloud.points.y.push_back(0.0f);
    cloud.points.z.push_back(0.0f);
    cloud.points.status.push_back(k < 8 ? 0 : 2);
    cloud.cameras.push_back(k < 8 ? cameras : 0);
    cloud.label.push_back(k < 8 ? 0 : kNoLabel);
  }
  return cloud;
}

TEST(RigWatch, CountsPointsAndNamesCamerasWithout) {
  RigWatch watch(rig());
  for (int k = 0; k < 3; ++k) watch.lookAtFusion(cloudOf(1), {}, std::nullopt);
  EXPECT_EQ(watch.figures(0).points, 24u);
  EXPECT_EQ(watch.figures(0).fused_points, 24u);
  EXPECT_EQ(watch.figures(1).points, 0u);
  EXPECT_TRUE(watch.takeDoubts().empty()) << "too early";
  watch.finish();
  const std::vector<RigDoubt> doubts = watch.takeDoubts();
  ASSERT_EQ(doubts.size(), 1u);
  EXPECT_EQ(doubts[0].subject, "camera left");
  EXPECT_TRUE(contains(doubts[0].text, "no point of 3 scans"));
}

TEST(RigWatch, NamesCamerasThatLookUpOrStandFarAway) {
  const auto said = [](const Transform& T_camera_lidar) {
    RigWatch watch(rig());
    CameraView seen = view();
    seen.T_camera_lidar_static = T_camera_lidar;
    watch.lookAtFusion(cloudOf(3), {seen}, Transform::Identity());
    return taken(&watch, "camera front");
  };
  const Transform right = view().T_camera_lidar_static;
  EXPECT_EQ(said(right), "");
  EXPECT_TRUE(contains(said(Transform::Identity()), "looks straight up"));
  EXPECT_TRUE(contains(said(Transform(Eigen::AngleAxisd(kPi, Eigen::Vector3d::UnitZ())) * right),
                       "on its head"));
  EXPECT_TRUE(contains(said(Eigen::Translation3d(0, 0, 1500.0) * right), "millimetres"));
}

TEST(RigWatch, ComparesTheEdgesOfOneScanInAHundred) {
  RigWatch watch(rig());
  std::vector<LidarEdge> edges;  // on a grid that has nothing to do with the image
  for (int row = 0; row < 30; ++row) {
    for (int k = 0; k < 30; ++k) edges.push_back({{10.0, 0.4 * k - 6.0, 0.2 * row - 3.0}, 1.0});
  }
  cv::Mat image(400, 640, CV_8UC1, cv::Scalar(0));
  image.colRange(0, 20).setTo(255);
  EXPECT_TRUE(watch.edgesAreDue());
  watch.lookAtFusion(cloudOf(1), {view()}, std::nullopt);
  watch.lookAtEdges(edges, {view()}, {cv::Mat(), cv::Mat()});
  EXPECT_TRUE(watch.edgesAreDue()) << "no image, nothing compared";
  watch.lookAtEdges(edges, {view()}, {image, cv::Mat()});
  EXPECT_TRUE(contains(taken(&watch, "camera front"), "by chance"));
  EXPECT_GT(watch.figures(0).edges.edges, 300u);
  for (int k = 0; k < 100; ++k) {
    EXPECT_FALSE(watch.edgesAreDue()) << k;
    watch.lookAtFusion(cloudOf(1), {view()}, std::nullopt);
  }
  EXPECT_TRUE(watch.edgesAreDue());
}

}  // namespace
}  // namespace semantic_lidar_fusion

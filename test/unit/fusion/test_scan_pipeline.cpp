// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <cmath>
#include <fstream>
#include <memory>
#include <random>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "stamps.h"

namespace semantic_lidar_fusion {
namespace {

/// Two cameras, the second one 10 ms early; 12 classes.
Rig rig(const std::string& more = "") {
  const std::string text =
      "classes: classes_usyd12.yaml\n"
      "cameras:\n  - {name: left}\n  - {name: right, time_offset: -0.01}\n" +
      more;
  return rigFromYaml(parseYaml(text, "rig.yaml"), std::string(SLF_SOURCE_DIR) + "/config", "rig");
}

/// A vehicle that turns at 0.5 rad/s and drives 10 m/s.
Transform poseAt(StampNs t) {
  const double s = toSeconds(t - kStart);
  Transform pose = Transform::Identity();
  pose.linear() = Eigen::AngleAxisd(0.5 * s, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  pose.translation() = Eigen::Vector3d(300000.0 + 10.0 * s, 6000000.0, 2.0);
  return pose;
}

PoseBuffer drive() {
  PoseBuffer odometry;
  for (StampNs t = kStart - 200 * kMs; t <= kStart + 400 * kMs; t += 10 * kMs) {
    odometry.add({t, poseAt(t)});
  }
  return odometry;
}

Transform mounted(double x, double yaw) {
  Transform T = Transform::Identity();
  T.linear() = Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T.translation() = Eigen::Vector3d(x, 0.3, 1.5);
  return T;
}

TimedCloud scan() {
  TimedCloud cloud;
  cloud.frame_id = "lidar";
  cloud.header_stamp = kStart + 7;
  for (int i = 0; i < 20; ++i) {
    const StampNs time = kStart + i * 5 * kMs;
    cloud.x.push_back(5.0f + static_cast<float>(i));
    cloud.y.push_back(-2.0f);
    cloud.z.push_back(0.5f);
    cloud.intensity.push_back(1.0f);
    cloud.ring.push_back(0);
    cloud.time_ns.push_back(time);
    cloud.firing.push_back(static_cast<std::uint32_t>(i));
    cloud.firings.push_back({time, time, static_cast<std::uint32_t>(i)});
  }
  return cloud;
}

std::shared_ptr<const CameraModel> smallPinhole() {
  CameraInfo info;
  info.frame_id = "camera";
  info.size = {640, 400};
  info.k = {300, 0, 320, 0, 300, 200, 0, 0, 1};
  return std::make_shared<const CameraModel>(info, CameraModelOptions{});
}

SegmentedImage image(std::uint64_t seed, StampNs stamp) {
  cv::RNG random(seed);
  SegmentedImage image;
  image.stamp = stamp;
  image.image = cv::Mat(80, 120, CV_8UC3);
  random.fill(image.image, cv::RNG::UNIFORM, 0, 256);
  image.input = cv::Mat(40, 60, CV_32FC(12));
  random.fill(image.input, cv::RNG::NORMAL, 0, 3);
  return image;
}

bool same(const cv::Mat& a, const cv::Mat& b) {
  return a.size() == b.size() && a.type() == b.type() &&
         (a.empty() || cv::norm(a.reshape(1), b.reshape(1), cv::NORM_INF) == 0.0);
}

bool allHave(const Cloud& cloud, PointStatus status) {
  return !cloud.empty() && countByStatus(cloud)[static_cast<std::size_t>(status)] == cloud.size();
}

TEST(ScanPipelineTest, AnEmptyScanIsAnEmptyCloudStampedWithItsHeader) {
  const ScanPipeline pipeline(rig(), {PipelineStep::kCompensate, PipelineStep::kFuse});
  TimedCloud empty;
  empty.frame_id = "lidar";
  empty.header_stamp = kStart + 7;
  for (const auto& T_vehicle_lidar :
       {std::optional<Transform>(), std::optional<Transform>(mounted(1.0, 0.1))}) {
    const CompensationResult result =
        pipeline.compensate(empty, kStart + 99, drive(), T_vehicle_lidar);
    EXPECT_TRUE(result.cloud.empty());
    EXPECT_EQ(result.cloud.frame_id, "lidar");
    EXPECT_EQ(result.cloud.stamp, kStart + 7);
    EXPECT_EQ(result.cloud.first_point_ns, kStart + 7);
    EXPECT_TRUE(result.counters.reference_covered);
    EXPECT_EQ(pipeline.fuse(result.cloud, {}, false).cloud.size(), 0u);
  }
}

TEST(ScanPipelineTest, UnknownExtrinsicsOfTheLidarMeanNoOdometry) {
  const ScanPipeline pipeline(rig(), {PipelineStep::kCompensate});
  const CompensationResult unknown =
      pipeline.compensate(scan(), kStart + 50 * kMs, drive(), std::nullopt);
  EXPECT_TRUE(allHave(unknown.cloud, PointStatus::kNoOdometry));
  EXPECT_EQ(unknown.cloud.x, scan().x);
  const CompensationResult known =
      pipeline.compensate(scan(), kStart + 50 * kMs, drive(), mounted(1.0, 0.1));
  EXPECT_TRUE(allHave(known.cloud, PointStatus::kFused));
  EXPECT_NE(known.cloud.x, scan().x);

  const ScanPipeline still(rig("motion: {enabled: false}\n"), {PipelineStep::kCompensate});
  const CompensationResult measured =
      still.compensate(scan(), kStart + 50 * kMs, PoseBuffer(), std::nullopt);
  EXPECT_TRUE(allHave(measured.cloud, PointStatus::kFused));
  EXPECT_EQ(measured.cloud.x, scan().x);
}

TEST(ScanPipelineTest, ARollingShutterGetsTheMotionOfItsCamera) {
  const ScanPipeline pipeline(rig(), {PipelineStep::kView});
  const Transform T_vehicle_lidar = mounted(1.0, 0.1), T_camera_lidar = mounted(-0.4, 1.2);
  CameraInfo info;
  info.size = {640, 400};
  info.k = {300, 0, 320, 0, 300, 200, 0, 0, 1};
  CameraModelOptions rolling;
  rolling.shutter.readout_s = 0.02;
  const CameraPlace place{std::make_shared<const CameraModel>(info, rolling), T_camera_lidar};
  const StampNs t_image = kStart + 33 * kMs;
  const SegmentedImage seen = image(1, t_image);
  const auto cameraAt = [&](StampNs t) {
    return Transform(poseAt(t) * T_vehicle_lidar * T_camera_lidar.inverse(Eigen::Isometry));
  };
  // Also where the image is taken at the reference time.
  for (const StampNs reference : {t_image, kStart + 50 * kMs}) {
    const CameraView view = pipeline.view(0, place, &seen, reference, drive(), T_vehicle_lidar);
    ASSERT_TRUE(view.has_image && view.motion);
    const Eigen::Vector3d p(3.0, -2.0, 12.0);
    for (const int ms : {-20, 5, 20}) {
      const Eigen::Vector3d later =
          cameraAt(t_image + ms * kMs).inverse(Eigen::Isometry) * (cameraAt(t_image) * p);
      // poseAt() keeps its direction in the world, not in the vehicle: v w dt^2 / 2 apart, and the
      // twist is that of 2 ms later.
      const double dt = 1e-3 * ms;
      EXPECT_LT((seenLater(p, *view.motion, dt) - later).norm(),
                1.1 * (0.5 * 10.0 * 0.5 * dt * dt + 10.0 * 0.5 * 0.002 * std::abs(dt)))
          << ms;
    }
  }
  EXPECT_FALSE(
      pipeline.view(0, {smallPinhole(), T_camera_lidar}, &seen, t_image, drive(), T_vehicle_lidar)
          .motion);
  // Not known to move, not known where its rows were.
  EXPECT_FALSE(pipeline.view(0, place, &seen, t_image, PoseBuffer(), T_vehicle_lidar).has_image);
  const ScanPipeline still(rig("motion: {enabled: false}\n"), {PipelineStep::kView});
  const CameraView standing = still.view(0, place, &seen, t_image, PoseBuffer(), std::nullopt);
  EXPECT_TRUE(standing.has_image);
  EXPECT_FALSE(standing.motion);
}

TEST(ScanPipelineTest, AViewMovesWithTheVehicleToTheTimeOfItsImage) {
  const ScanPipeline pipeline(rig(), {PipelineStep::kView});
  const Transform T_vehicle_lidar = mounted(1.0, 0.1), T_camera_lidar = mounted(-0.4, 1.2);
  const CameraPlace place{smallPinhole(), T_camera_lidar};
  const PoseBuffer odometry = drive();
  SegmentedImage taken;
  taken.stamp = kStart + 40 * kMs;
  const StampNs reference = kStart + 53 * kMs;
  for (std::size_t camera = 0; camera < 2; ++camera) {
    const CameraView view =
        pipeline.view(camera, place, &taken, reference, odometry, T_vehicle_lidar);
    const StampNs true_time = taken.stamp - (camera == 1 ? 10 * kMs : 0);
    EXPECT_TRUE(view.has_image);
    EXPECT_EQ(view.image_ns, true_time);
    EXPECT_EQ(view.rig_index, static_cast<int>(camera));
    // A point that stands still: through the fixed frame from the lidar at t_ref to the camera.
    const Transform T_camera_vehicle = T_camera_lidar * T_vehicle_lidar.inverse();
    const Eigen::Vector3d p_lidar(12.0, 3.0, -1.0);
    const Eigen::Vector3d p_fixed = poseAt(reference) * (T_vehicle_lidar * p_lidar);
    const Eigen::Vector3d p_camera = T_camera_vehicle * (poseAt(true_time).inverse() * p_fixed);
    // Rounding of coordinates of 6e6 m: 1e-9 m each. Between readings of 10 ms the pose is linear
    // and slerped, which for a constant turn is exact in rotation and in this straight translation.
    EXPECT_LT((view.T_camera_lidar * p_lidar - p_camera).norm(), 1e-7);
    EXPECT_TRUE(view.T_camera_lidar_static.isApprox(T_camera_lidar));
  }
}

TEST(ScanPipelineTest, AViewHasNoImageWithoutOdometryModelOrExtrinsics) {
  const ScanPipeline pipeline(rig(), {PipelineStep::kView});
  const CameraPlace place{smallPinhole(), Transform::Identity()};
  const PoseBuffer odometry = drive();
  SegmentedImage taken;
  taken.stamp = kStart;
  const std::optional<Transform> lidar = mounted(1.0, 0.1);
  EXPECT_TRUE(pipeline.view(0, place, &taken, kStart + kMs, odometry, lidar).has_image);
  EXPECT_FALSE(pipeline.view(0, place, nullptr, kStart + kMs, odometry, lidar).has_image);
  EXPECT_FALSE(pipeline.view(0, {}, &taken, kStart + kMs, odometry, lidar).has_image);
  EXPECT_FALSE(pipeline.view(0, place, &taken, kStart + kMs, odometry, std::nullopt).has_image);
  EXPECT_FALSE(pipeline.view(0, place, &taken, kStart + kMs, PoseBuffer(), lidar).has_image);
  // At t_ref itself no odometry is needed.
  EXPECT_TRUE(pipeline.view(0, place, &taken, kStart, PoseBuffer(), std::nullopt).has_image);

  EXPECT_TRUE(pipeline.coversImage(0, kStart - 200 * kMs, odometry));
  EXPECT_FALSE(pipeline.coversImage(1, kStart - 200 * kMs, odometry));  // its true time is earlier
  const ScanPipeline still(rig("motion: {enabled: false}\n"), {PipelineStep::kView});
  EXPECT_TRUE(still.coversImage(1, 0, PoseBuffer()));
}

TEST(ScanPipelineTest, AnImageMayBeClusteredBeforeItsScoresCome) {
  for (const std::string scale : {"", "superpixels: {scale: 0.5, count: 30}\n"}) {
    ScanPipeline at_once(rig(scale), {PipelineStep::kSegment});
    ScanPipeline in_parts(rig(scale), {PipelineStep::kSegment});
    for (int i = 0; i < 3; ++i) {
      SegmentedImage whole = image(40 + i, kStart + i * 100 * kMs);
      at_once.segment(0, &whole);
      ASSERT_FALSE(whole.share.empty());

      SegmentedImage parts = image(40 + i, kStart + i * 100 * kMs);
      const cv::Mat scores = std::exchange(parts.input, cv::Mat());
      in_parts.cluster(0, &parts);
      // Without a scale the map has the size of the scores, unknown before the first of them.
      EXPECT_EQ(parts.superpixels.ids.empty(), scale.empty() && i == 0);
      EXPECT_TRUE(parts.share.empty());
      parts.input = scores;
      in_parts.segment(0, &parts);
      EXPECT_TRUE(same(parts.superpixels.ids, whole.superpixels.ids)) << i;
      EXPECT_TRUE(same(parts.share, whole.share)) << i;
      EXPECT_TRUE(same(in_parts.probabilities(parts), at_once.probabilities(whole))) << i;
    }
  }
}

TEST(ScanPipelineTest, RowsAreThoseOfTheRigUnlessItSaysAuto) {
  const std::string text = "lidar: {model: VLP16, frame: lidar}\nsuperpixels: {count: 30}\n";
  for (const bool finds : {true, false}) {
    Rig with_rows = rig(text);
    with_rows.cameras[0].finds_lidar_rows = finds;
    with_rows.cameras[0].lidar_rows = {0.5, 1.0};
    ScanPipeline pipeline(with_rows, {PipelineStep::kSegment, PipelineStep::kView});
    SegmentedImage found = image(3, kStart);
    found.lidar_rows = {0.0, 0.3};
    pipeline.segment(0, &found);
    // Blocks of 16 of 40 rows.
    EXPECT_EQ(found.superpixels.rows, finds ? cv::Range(0, 16) : cv::Range(16, 40));
    const CameraView view = pipeline.view(0, {smallPinhole(), mounted(-0.4, 1.2)}, &found, kStart,
                                          drive(), mounted(1.0, 0.1));
    EXPECT_EQ(view.lidar_rows.first, finds ? 0.0 : 0.5);
    EXPECT_EQ(view.lidar_rows.last, finds ? 0.3 : 1.0);
  }
}

TEST(ScanPipelineTest, ScoresOfAnotherSizeAreClusteredAnew) {
  ScanPipeline pipeline(rig(), {PipelineStep::kSegment});
  SegmentedImage first = image(1, kStart);
  pipeline.segment(0, &first);
  SegmentedImage second = image(2, kStart + 100 * kMs);
  const cv::Mat larger = cv::Mat(44, 66 * 12, CV_32FC1, cv::Scalar(1)).reshape(12);
  second.input = cv::Mat();
  pipeline.cluster(0, &second);
  EXPECT_EQ(second.superpixels.ids.size(), cv::Size(60, 40));
  second.input = larger;
  pipeline.segment(0, &second);
  EXPECT_EQ(second.superpixels.ids.size(), cv::Size(66, 44));
  EXPECT_EQ(second.share.size(), cv::Size(66, 44));
}

TEST(ScanPipelineTest, ImagesThatCannotBeSegmentedAreRefused) {
  ScanPipeline pipeline(rig(), {PipelineStep::kSegment});
  SegmentedImage without = image(1, kStart);
  without.input = cv::Mat();
  EXPECT_THROW(pipeline.segment(0, &without), DataError);
  SegmentedImage channels = image(1, kStart);
  channels.input = cv::Mat(40, 60 * 11, CV_32FC1, cv::Scalar(0)).reshape(11);
  EXPECT_THROW(pipeline.segment(0, &channels), DataError);
}

TEST(ScanPipelineTest, BuildsWhatItsStepsNeedAndNothingElse) {
  // A mask that cannot be read concerns the views, a network that does not exist the segmentation.
  const std::string broken = ::testing::TempDir() + "/slf_pipeline_mask.png";
  std::ofstream(broken) << "no image";
  Rig bad = rig();
  bad.cameras[0].mask = broken;
  bad.segmentation.model = broken;
  EXPECT_THROW(ScanPipeline(bad, {PipelineStep::kView}), ConfigError);
  EXPECT_THROW(ScanPipeline(bad, {PipelineStep::kSegment, PipelineStep::kNetwork}), ConfigError);
  EXPECT_THROW(ScanPipeline{bad}, ConfigError);
  ScanPipeline segment(bad, {PipelineStep::kSegment});
  const ScanPipeline rest(bad, {PipelineStep::kCompensate, PipelineStep::kFuse});
  std::remove(broken.c_str());

  SegmentedImage taken = image(1, kStart);
  EXPECT_NO_THROW(segment.segment(0, &taken));
  EXPECT_THROW(segment.compensate(scan(), kStart, drive(), std::nullopt), std::logic_error);
  EXPECT_THROW(segment.fuse(Cloud(), {}, false), std::logic_error);
  EXPECT_THROW(rest.view(0, {}, nullptr, kStart, drive(), std::nullopt), std::logic_error);
  ScanPipeline compensate(rig(), {PipelineStep::kCompensate});
  EXPECT_THROW(compensate.segment(0, &taken), std::logic_error);
  EXPECT_THROW(compensate.cluster(0, &taken), std::logic_error);
}

TEST(ScanPipelineTest, WithoutClassesNoPointHasOne) {
  const Rig bare = rigFromYaml(parseYaml("", "rig"), ".", "rig");
  const ScanPipeline pipeline(bare, {PipelineStep::kFuse});
  Cloud cloud;
  cloud.resize(3);
  cloud.status = {0, static_cast<std::uint8_t>(PointStatus::kNoOdometry), 0};
  const SemanticCloud points = pipeline.fuse(cloud, {}, false).cloud;
  EXPECT_EQ(points.points.status, (std::vector<std::uint8_t>{2, 4, 2}));
  EXPECT_EQ(points.label, std::vector<std::uint8_t>(3, kNoLabel));
}

TEST(ScanPipelineTest, AnImageIsACandidateOnceWhatItContributesIsThere) {
  for (const CameraInput input :
       {CameraInput::kScores, CameraInput::kLabels, CameraInput::kProbabilities}) {
    // Semantics are made on request: of any image.
    EXPECT_TRUE(isCandidate(input, {true, false}, true));
    EXPECT_TRUE(isCandidate(input, {true, true}, true));
    EXPECT_FALSE(isCandidate(input, {false, true}, true));
    // They come by themselves: of images that have them.
    EXPECT_TRUE(isCandidate(input, {true, true}, false));
    EXPECT_FALSE(isCandidate(input, {true, false}, false));
    EXPECT_FALSE(isCandidate(input, {false, false}, false));
    // Nothing is clustered for probabilities, so no pixels are needed.
    EXPECT_EQ(isCandidate(input, {false, true}, false), input == CameraInput::kProbabilities);
  }
}

TEST(CountByStatusTest, CountsEachStatusOnce) {
  Cloud cloud;
  cloud.status = {0, 0, 1, 2, 2, 2, 3, 4, 4};
  EXPECT_EQ(countByStatus(cloud), (std::array<std::uint64_t, 5>{2, 1, 3, 1, 2}));
}

}  // namespace
}  // namespace semantic_lidar_fusion

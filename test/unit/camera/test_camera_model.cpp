// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <functional>
#include <limits>
#include <opencv2/calib3d.hpp>
#include <random>

#include "direction.h"
#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

/// Of the issue: agreement with OpenCV where its functions are valid.
constexpr double kOpencvTolerancePx = 1e-3;
/// Of a double-precision round trip at focal lengths near 1000 px: 1e-16 * 1000 px, times the
/// conditioning of the inverse near the fold-over.
constexpr double kRoundTripPx = 1e-6;

double deg(double degrees) { return degrees * kPi / 180.0; }

CameraInfo baseInfo(const std::string& model, std::vector<double> d) {
  CameraInfo info;
  info.frame_id = "camera";
  info.size = {1928, 1208};
  info.distortion_model = model;
  info.d = std::move(d);
  info.k = {1166.0, 0.0, 970.5, 0.0, 1150.0, 610.25, 0.0, 0.0, 1.0};
  info.p = {900.0, 0.0, 950.0, 0.0, 0.0, 910.0, 600.0, 0.0, 0.0, 0.0, 1.0, 0.0};
  return info;
}

/// The reference rig's lens: monotone up to 180 deg.
CameraInfo fisheyeInfo() { return baseInfo("equidistant", {-0.0557, 0.0173, -0.0019, 0.00007}); }

/// Closed form of eq. 7-11 with the angle from the axis.
Eigen::Vector2d closedFormFisheye(const CameraInfo& info, double theta, double phi) {
  double theta_d = 1.0;
  for (int i = 0; i < 4; ++i) theta_d += info.d[i] * std::pow(theta, 2 * (i + 1));
  theta_d *= theta;
  const double x = theta_d * std::cos(phi), y = theta_d * std::sin(phi);
  return {info.k[0] * x + info.k[1] * y + info.k[2], info.k[4] * y + info.k[5]};
}

cv::Matx33d cvK(const CameraInfo& info) { return cv::Matx33d(info.k.data()); }

TEST(CameraModel, FisheyeMatchesTheClosedFormAtAllAngles) {
  CameraInfo info = fisheyeInfo();
  info.k[1] = 7.5;  // skew
  const CameraModel camera(info, {});
  for (const double theta : {0.0, 1e-9, 1.0, 45.0, 89.0, 90.0, 95.0, 110.0, 130.0}) {
    for (int i = 0; i < 24; ++i) {
      const double phi = deg(15.0 * i + 3.0);
      const auto pixel = camera.project(7.3 * direction(deg(theta), phi));
      ASSERT_TRUE(pixel) << theta;
      EXPECT_LT((*pixel - closedFormFisheye(info, deg(theta), phi)).norm(), 1e-9)
          << "theta " << theta << " phi " << phi;
    }
  }
}

TEST(CameraModel, PrincipalPointWithUnequalIntrinsics) {
  for (const char* model : {"equidistant", "plumb_bob", "rational_polynomial", ""}) {
    std::vector<double> d;
    if (std::string(model) == "equidistant") d = {0.1, 0.01, 0.0, 0.0};
    if (std::string(model) == "plumb_bob") d = {0.1, 0.01, 0.01, 0.02, 0.0};
    if (std::string(model) == "rational_polynomial") d = {0.1, 0.01, 0.01, 0.02, 0.0, 0.2, 0, 0};
    const CameraModel camera(baseInfo(model, d), {});
    const auto pixel = camera.project({0.0, 0.0, 3.0});
    ASSERT_TRUE(pixel);
    EXPECT_DOUBLE_EQ(pixel->x(), 970.5);
    EXPECT_DOUBLE_EQ(pixel->y(), 610.25);
    EXPECT_FALSE(camera.project({0.0, 0.0, 0.0}));
    EXPECT_FALSE(camera.project({0.0, 0.0, -3.0}));
    const auto ray = camera.ray({970.5, 610.25});
    ASSERT_TRUE(ray);
    EXPECT_LT((*ray - Eigen::Vector3d::UnitZ()).norm(), 1e-12);
  }
}

TEST(CameraModel, FisheyeMatchesOpencvInFront) {
  const CameraInfo info = fisheyeInfo();
  std::mt19937 random(1);
  std::uniform_real_distribution<double> theta(0.0, deg(89.9)), phi(-kPi, kPi), range(0.5, 80.0);
  for (const double skew_px : {0.0, 12.0}) {
    CameraInfo skewed = info;
    skewed.k[1] = skew_px;
    const CameraModel camera(skewed, {});
    std::vector<cv::Point3d> points;
    for (int i = 0; i < 5000; ++i) {
      const Eigen::Vector3d p = range(random) * direction(theta(random), phi(random));
      points.emplace_back(p.x(), p.y(), p.z());
    }
    std::vector<cv::Point2d> expected;
    cv::fisheye::projectPoints(points, expected, cv::Vec3d(0, 0, 0), cv::Vec3d(0, 0, 0), cvK(info),
                               info.d, skew_px / info.k[0]);
    for (std::size_t i = 0; i < points.size(); ++i) {
      const auto pixel = camera.project({points[i].x, points[i].y, points[i].z});
      ASSERT_TRUE(pixel);
      EXPECT_NEAR(pixel->x(), expected[i].x, kOpencvTolerancePx);
      EXPECT_NEAR(pixel->y(), expected[i].y, kOpencvTolerancePx);
    }
  }
}

TEST(CameraModel, BrownConradyMatchesOpencv) {
  const std::vector<CameraInfo> infos = {
      baseInfo("plumb_bob", {-0.36, 0.18, 0.0004, -0.0007, -0.05}),
      baseInfo("plumb_bob", {-0.10, 0.05, 0.001, 0.002}),
      baseInfo("plumb_bob", {}),
      baseInfo("", {}),
      baseInfo("", {0, 0, 0, 0, 0}),
      baseInfo("rational_polynomial", {8.2, 5.1, 0.0002, -0.0003, 0.27, 8.6, 7.9, 1.4}),
      baseInfo("rational_polynomial",
               {0.5, -2.7, 0.0008, -0.0003, 1.5, 0.4, -2.5, 1.4, 0, 0, 0, 0, 0, 0}),
  };
  std::mt19937 random(2);
  std::uniform_real_distribution<double> xy(-0.9, 0.9), depth(0.3, 60.0);
  for (const CameraInfo& info : infos) {
    const CameraModel camera(info, {});
    int compared = 0;
    for (int i = 0; i < 3000; ++i) {
      const double z = depth(random);
      const Eigen::Vector3d p(xy(random) * z, xy(random) * z, z);
      const auto pixel = camera.project(p);
      if (!pixel) {
        EXPECT_GT(p.head<2>().norm() / z, std::tan(camera.maxThetaRad()));
        continue;
      }
      std::vector<cv::Point2d> expected;
      cv::projectPoints(std::vector<cv::Point3d>{{p.x(), p.y(), p.z()}}, cv::Vec3d(0, 0, 0),
                        cv::Vec3d(0, 0, 0), cvK(info), info.d, expected);
      EXPECT_NEAR(pixel->x(), expected[0].x, kOpencvTolerancePx);
      EXPECT_NEAR(pixel->y(), expected[0].y, kOpencvTolerancePx);
      ++compared;
    }
    EXPECT_GT(compared, 1500);
  }
}

TEST(CameraModel, RayInvertsProjection) {
  CameraInfo skewed = fisheyeInfo();
  skewed.k[1] = -9.0;
  const std::vector<CameraInfo> infos = {
      skewed, baseInfo("plumb_bob", {-0.36, 0.18, 0.0004, -0.0007, -0.05}),
      baseInfo("rational_polynomial", {8.2, 5.1, 0.0002, -0.0003, 0.27, 8.6, 7.9, 1.4}),
      baseInfo("", {})};
  std::mt19937 random(3);
  std::uniform_real_distribution<double> unit(0.0, 1.0), phi(-kPi, kPi);
  for (CameraInfo info : infos) {
    const Eigen::Matrix3d r =
        Eigen::AngleAxisd(0.2, Eigen::Vector3d(1, -2, 0.5).normalized()).toRotationMatrix();
    Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(info.r.data()) = r;
    const CameraModel camera(info, {});
    const double most = std::min(0.98 * camera.maxThetaRad(), deg(125.0));
    for (int i = 0; i < 2000; ++i) {
      const double theta =
          std::min(most, camera.maxThetaRad() < kPi / 2 ? most : 0.99 * most) * unit(random);
      const Eigen::Vector3d in_raw_axes = direction(theta, phi(random));
      if (info.distortion_model != "equidistant" && theta > deg(80.0)) continue;
      const Eigen::Vector3d p = r * in_raw_axes;  // raw axes = R^T camera axes
      const auto pixel = camera.project(4.0 * p);
      ASSERT_TRUE(pixel) << info.distortion_model << " theta " << theta;
      const auto ray = camera.ray(*pixel);
      ASSERT_TRUE(ray) << info.distortion_model << " theta " << theta;
      EXPECT_LT((*ray - p).norm(), 1e-8) << info.distortion_model << " theta " << theta;
      const auto again = camera.project(*ray);
      ASSERT_TRUE(again);
      EXPECT_LT((*again - *pixel).norm(), kRoundTripPx);
      EXPECT_NEAR(camera.theta(p), theta, 1e-12);
    }
  }
}

TEST(CameraModel, RayOfEveryImagePixelComesBack) {
  for (const CameraInfo& info :
       {fisheyeInfo(), baseInfo("plumb_bob", {-0.30, 0.12, 0.0004, -0.0007, -0.02})}) {
    const CameraModel camera(info, {});
    for (int v = 0; v < 1208; v += 67) {
      for (int u = 0; u < 1928; u += 71) {
        const auto ray = camera.ray(Eigen::Vector2d(u, v));
        ASSERT_TRUE(ray) << u << " " << v;
        EXPECT_NEAR(ray->norm(), 1.0, 1e-12);
        const auto pixel = camera.project(*ray * 11.0);
        ASSERT_TRUE(pixel) << u << " " << v;
        EXPECT_LT((*pixel - Eigen::Vector2d(u, v)).norm(), kRoundTripPx);
      }
    }
  }
}

TEST(CameraModel, RayIsEmptyWhereNoPointProjects) {
  const CameraModel folding(baseInfo("equidistant", {-0.05, -0.02, 0.01, -0.003}), {});
  EXPECT_FALSE(folding.ray({970.5 + 1166.0 * 3.0, 610.25}));
  const CameraModel barrel(baseInfo("plumb_bob", {-0.3, 0.0, 0.0, 0.0, 0.0}), {});
  EXPECT_FALSE(barrel.ray({970.5 + 1166.0, 610.25}));  // r (1 - 0.3 r^2) is at most 0.703
  EXPECT_TRUE(barrel.ray({970.5 + 1166.0 * 0.70, 610.25}));
  EXPECT_FALSE(barrel.ray({std::numeric_limits<double>::quiet_NaN(), 0.0}));
  CameraModelOptions narrow;
  narrow.max_theta_deg = 30.0;
  const CameraModel limited(fisheyeInfo(), narrow);
  EXPECT_FALSE(limited.ray({0.0, 0.0}));
  EXPECT_TRUE(limited.ray({970.0, 400.0}));
}

TEST(CameraModel, FoldOverOfKnownLenses) {
  // d/dr r (1 + k1 r^2) = 1 + 3 k1 r^2
  const CameraModel barrel(baseInfo("plumb_bob", {-0.3, 0.0, 0.0, 0.0, 0.0}), {});
  EXPECT_NEAR(std::tan(barrel.maxThetaRad()), std::sqrt(1.0 / 0.9), 1e-12);
  EXPECT_NEAR(barrel.maxThetaRad(), std::atan(std::sqrt(1.0 / 0.9)), 1e-12);
  EXPECT_TRUE(barrel.project({1.05, 0.0, 1.0}));
  EXPECT_FALSE(barrel.project({1.06, 0.0, 1.0}));
  // The same with a numerator that carries the opposite sign: pole at r = 2 before any fold-over.
  const CameraModel pole(baseInfo("rational_polynomial", {0, 0, 0, 0, 0, -0.25, 0, 0}), {});
  EXPECT_NEAR(std::tan(pole.maxThetaRad()), 2.0, 1e-12);
  EXPECT_FALSE(pole.project({2.1, 0.0, 1.0}));
  // 1 + 3 k1 t^2 = 0
  const CameraModel fisheye(baseInfo("equidistant", {-0.1, 0, 0, 0}), {});
  EXPECT_NEAR(fisheye.maxThetaRad(), std::sqrt(1.0 / 0.3), 1e-12);
  // About 92 deg, from a real report.
  const CameraModel real(baseInfo("equidistant", {-0.05, -0.02, 0.01, -0.003}), {});
  EXPECT_NEAR(real.maxThetaRad(), deg(92.0), deg(1.0));
  // None: no further limit.
  EXPECT_DOUBLE_EQ(CameraModel(baseInfo("equidistant", {0, 0, 0, 0}), {}).maxThetaRad(), kPi);
  EXPECT_DOUBLE_EQ(CameraModel(baseInfo("plumb_bob", {0.1, 0, 0, 0, 0}), {}).maxThetaRad(),
                   kPi / 2);
  EXPECT_FALSE(CameraModel(baseInfo("", {}), {}).project({1.0, 0.0, 0.0}));
}

TEST(CameraModel, FindsAFoldOverOfHairsBreadth) {
  // Slope (1 - s)(1 - s / (1 + 1e-6)) (1 + s): negative only for s in (1, 1 + 1e-6).
  const double q = 1.0 / (1.0 + 1e-6);
  // (1 - (1 + q) s + q s^2)(1 + s) = 1 - q s + (q - 1 - q) s^2 + q s^3
  const CameraModel camera(baseInfo("equidistant", {-q / 3.0, -1.0 / 5.0, q / 7.0, 0.0}), {});
  EXPECT_NEAR(camera.maxThetaRad(), 1.0, 1e-6);
}

/// Independent check of the rising branch: slope by fine sampling.
double sampledFoldOver(const std::function<double(double)>& f, double end) {
  constexpr int kSamples = 20000;
  double last = 0.0;
  for (int i = 1; i <= kSamples; ++i) {
    const double x = end * i / kSamples;
    const double value = f(x);
    if (!(value > last)) return end * (i - 1) / kSamples;
    last = value;
  }
  return end;
}

TEST(CameraModel, FoldOverOfRandomLensesMatchesSampling) {
  std::mt19937 random(4);
  std::normal_distribution<double> k(0.0, 0.1);
  for (int i = 0; i < 100; ++i) {
    const std::vector<double> d = {k(random), 0.3 * k(random), 0.1 * k(random), 0.03 * k(random)};
    const CameraModel camera(baseInfo("equidistant", d), {});
    const double sampled = sampledFoldOver(
        [&](double t) {
          return t * (1 + d[0] * std::pow(t, 2) + d[1] * std::pow(t, 4) + d[2] * std::pow(t, 6) +
                      d[3] * std::pow(t, 8));
        },
        kPi);
    EXPECT_NEAR(camera.maxThetaRad(), sampled, 2.0 * kPi / 20000) << i;
  }
  for (int i = 0; i < 100; ++i) {
    std::vector<double> d(8);
    for (double& x : d) x = 3.0 * k(random);
    d[2] = d[3] = 0.0;
    const CameraModel camera(baseInfo("rational_polynomial", d), {});
    const double end = 5.0;
    const double sampled = sampledFoldOver(
        [&](double r) {
          const double s = r * r;
          const double q = 1 + d[5] * s + d[6] * s * s + d[7] * s * s * s;
          return q <= 0 ? -1.0 : r * (1 + d[0] * s + d[1] * s * s + d[4] * s * s * s) / q;
        },
        end);
    EXPECT_NEAR(std::min(end, std::tan(camera.maxThetaRad())), sampled, 2.0 * end / 20000) << i;
  }
}

TEST(CameraModel, NoPointEverFoldsIn) {
  // A point that gets a pixel is the point that the pixel's ray shows: 1e6 random points over
  // 100 random lenses. The inverse is taken for the few that fall into the image.
  std::mt19937 random(5);
  std::normal_distribution<double> k(0.0, 0.08), axis(0.0, 1.0);
  std::uniform_int_distribution<int> kind(0, 2);
  std::int64_t in_image = 0;
  for (int lens = 0; lens < 100; ++lens) {
    CameraInfo info;
    const int model = kind(random);
    if (model == 0) {
      info = baseInfo("equidistant", {k(random), k(random), 0.3 * k(random), 0.1 * k(random)});
    } else if (model == 1) {
      info = baseInfo("plumb_bob", {3 * k(random), k(random), 0, 0, k(random)});
    } else {
      info = baseInfo("rational_polynomial", {3 * k(random), k(random), 0, 0, k(random),
                                              3 * k(random), k(random), k(random)});
    }
    const CameraModel camera(info, {});
    for (int i = 0; i < 10000; ++i) {
      const Eigen::Vector3d p =
          Eigen::Vector3d(axis(random), axis(random), axis(random)).normalized();
      const auto pixel = camera.project(9.0 * p);
      if (!pixel || !inImage(pixel->x(), pixel->y(), camera.imageSize())) continue;
      ++in_image;
      ASSERT_LE(camera.theta(p), camera.maxThetaRad());
      ASSERT_TRUE(model == 0 || p.z() > 0.0);
      if (i % 4 != 0) continue;
      const auto ray = camera.ray(*pixel);
      ASSERT_TRUE(ray) << "lens " << lens << " point " << p.transpose();
      // Near the fold-over a pixel fixes the angle only to the square root of the rounding.
      ASSERT_LT((*ray - p).norm(), 1e-5) << "lens " << lens << " point " << p.transpose();
    }
  }
  EXPECT_GT(in_image, 50000);
}

TEST(CameraModel, MaxThetaLimitsEveryModel) {
  for (const CameraInfo& info :
       {fisheyeInfo(), baseInfo("plumb_bob", {0.01, 0, 0, 0, 0}), baseInfo("", {})}) {
    for (const double limit : {20.0, 50.0}) {
      CameraModelOptions options;
      options.max_theta_deg = limit;
      const CameraModel camera(info, options);
      EXPECT_NEAR(camera.maxThetaRad(), deg(limit), 1e-12);
      EXPECT_TRUE(camera.project(direction(deg(limit - 0.01), 2.0)));
      EXPECT_FALSE(camera.project(direction(deg(limit + 0.01), 2.0)));
    }
  }
  CameraModelOptions wide;
  wide.max_theta_deg = 100.0;
  EXPECT_FALSE(CameraModel(baseInfo("", {}), wide).project(direction(deg(95.0), 0.0)));
  EXPECT_TRUE(CameraModel(fisheyeInfo(), wide).project(direction(deg(95.0), 0.0)));
  CameraModelOptions rectified;
  rectified.rectified = true;
  rectified.max_theta_deg = 40.0;
  EXPECT_FALSE(CameraModel(fisheyeInfo(), rectified).project(direction(deg(41.0), 0.0)));
}

TEST(CameraModel, RawAndRectifiedShowTheSameScenePixel) {
  // What OpenCV's rectification maps do: rectified pixel -> ray -> R^T -> lens -> raw pixel. A
  // point must land on the raw pixel that the rectifier copies to the point's rectified pixel.
  const Eigen::Matrix3d r =
      Eigen::AngleAxisd(0.07, Eigen::Vector3d(0.3, 1.0, -0.4).normalized()).toRotationMatrix();
  for (CameraInfo info : {fisheyeInfo(), baseInfo("plumb_bob", {-0.3, 0.1, 0.001, -0.002, 0.0})}) {
    Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(info.r.data()) = r;
    const cv::Matx33d new_k(info.p[0], 0, info.p[2], 0, info.p[5], info.p[6], 0, 0, 1);
    cv::Mat map_x, map_y;
    const cv::Size size(info.size.width, info.size.height);
    if (info.distortion_model == "equidistant") {
      cv::fisheye::initUndistortRectifyMap(cvK(info), info.d, cv::Matx33d(info.r.data()), new_k,
                                           size, CV_32FC1, map_x, map_y);
    } else {
      cv::initUndistortRectifyMap(cvK(info), info.d, cv::Matx33d(info.r.data()), new_k, size,
                                  CV_32FC1, map_x, map_y);
    }
    CameraModelOptions rectified_options;
    rectified_options.rectified = true;
    const CameraModel raw(info, {});
    const CameraModel rectified(info, rectified_options);
    int compared = 0;
    for (int v = 10; v < size.height; v += 97) {
      for (int u = 10; u < size.width; u += 101) {
        const auto ray = rectified.ray(Eigen::Vector2d(u, v));
        ASSERT_TRUE(ray);
        const Eigen::Vector3d p = 6.5 * *ray;
        const auto in_rectified = rectified.project(p);
        const auto in_raw = raw.project(p);
        if (!in_raw) continue;
        EXPECT_NEAR(in_rectified->x(), u, 1e-9);
        EXPECT_NEAR(in_rectified->y(), v, 1e-9);
        // float maps: 1e3 px * 6e-8
        EXPECT_NEAR(in_raw->x(), map_x.at<float>(v, u), 5e-4);
        EXPECT_NEAR(in_raw->y(), map_y.at<float>(v, u), 5e-4);
        ++compared;
      }
    }
    EXPECT_GT(compared, 150);
    // All zero means none.
    CameraInfo none = info, identity = info;
    none.r.fill(0.0);
    identity.r = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    EXPECT_EQ(*CameraModel(none, {}).project({1, 2, 9}),
              *CameraModel(identity, {}).project({1, 2, 9}));
  }
}

TEST(CameraModel, RectifiedUsesTheFourthColumn) {
  CameraInfo info = baseInfo("plumb_bob", {-0.3, 0.1, 0.001, -0.002, 0.0});
  info.p[3] = -450.0;  // 0.5 m
  info.p[7] = 91.0;
  CameraModelOptions options;
  options.rectified = true;
  const CameraModel camera(info, options);
  const Eigen::Vector3d p(1.5, -0.4, 8.0);
  const auto pixel = camera.project(p);
  ASSERT_TRUE(pixel);
  EXPECT_NEAR(pixel->x(), (900.0 * 1.5 + 950.0 * 8.0 - 450.0) / 8.0, 1e-9);
  EXPECT_NEAR(pixel->y(), (910.0 * -0.4 + 600.0 * 8.0 + 91.0) / 8.0, 1e-9);
  EXPECT_LT((camera.opticalCentre() - Eigen::Vector3d(0.5, -0.1, 0.0)).norm(), 1e-12);
  const auto ray = camera.ray(*pixel);
  ASSERT_TRUE(ray);
  EXPECT_LT(((p - camera.opticalCentre()).normalized() - *ray).norm(), 1e-12);
  // Distortion and R do not matter.
  info.d = {5.0};
  info.r = {0, 1, 0, -1, 0, 0, 0, 0, 1};
  EXPECT_EQ(*CameraModel(info, options).project(p), *pixel);
}

TEST(CameraModel, BinningAndRegionFollowImageGeometry) {
  CameraInfo info = fisheyeInfo();
  info.k[1] = 6.0;
  info.p[3] = 30.0;
  info.p[7] = -20.0;
  const Eigen::Vector3d p(0.8, -0.3, 2.0);
  for (const bool rectified : {false, true}) {
    CameraModelOptions options;
    options.rectified = rectified;
    const auto full = CameraModel(info, options).project(p);
    CameraInfo reduced = info;
    reduced.roi_x = 100;
    reduced.roi_y = 40;
    reduced.roi_width = 801;
    reduced.roi_height = 602;
    reduced.binning_x = 2;
    reduced.binning_y = 4;
    const CameraModel camera(reduced, options);
    EXPECT_EQ(camera.imageSize().width, 400);
    EXPECT_EQ(camera.imageSize().height, 150);
    const auto pixel = camera.project(p);
    ASSERT_TRUE(full && pixel);
    EXPECT_NEAR(pixel->x(), (full->x() - 100.0) / 2.0, 1e-9);
    EXPECT_NEAR(pixel->y(), (full->y() - 40.0) / 4.0, 1e-9);
    EXPECT_NEAR(camera.cx(), ((rectified ? 950.0 : 970.5) - 100.0) / 2.0, 1e-12);
    EXPECT_NEAR(camera.fy(), (rectified ? 910.0 : 1150.0) / 4.0, 1e-12);
    const auto ray = camera.ray(*pixel);
    ASSERT_TRUE(ray);
    EXPECT_LT((*ray - (p - camera.opticalCentre()).normalized()).norm(), 1e-9);
  }
}

TEST(CameraModel, SkewIsHonouredForEquidistantOnly) {
  CameraInfo info = baseInfo("plumb_bob", {-0.1, 0, 0, 0, 0});
  const auto straight = CameraModel(info, {}).project({1, 1, 5});
  info.k[1] = 50.0;
  EXPECT_EQ(*CameraModel(info, {}).project({1, 1, 5}), *straight);
  EXPECT_EQ(CameraModel(info, {}).skew(), 0.0);
  info = fisheyeInfo();
  info.k[1] = 58.3;
  EXPECT_DOUBLE_EQ(CameraModel(info, {}).skew(), 58.3 / 1166.0);
}

TEST(CameraModel, FisheyeIsAnAlias) {
  CameraInfo info = fisheyeInfo();
  const auto expected = CameraModel(info, {}).project({1, -1, 0.2});
  info.distortion_model = "fisheye";
  EXPECT_EQ(*CameraModel(info, {}).project({1, -1, 0.2}), *expected);
}

TEST(CameraModel, NonFinitePointsHaveNoPixel) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const double infinity = std::numeric_limits<double>::infinity();
  for (const CameraInfo& info :
       {fisheyeInfo(), baseInfo("plumb_bob", {-0.1, 0, 0, 0, 0}), baseInfo("", {})}) {
    const CameraModel camera(info, {});
    EXPECT_FALSE(camera.project({nan, 0, 1}));
    EXPECT_FALSE(camera.project({0, nan, 1}));
    EXPECT_FALSE(camera.project({0, 0, nan}));
    EXPECT_FALSE(camera.project({infinity, 0, infinity}));
  }
}

TEST(CameraModel, ARejectedInfoNamesFieldValueAndRule) {
  struct Case {
    const char* name;
    std::function<void(CameraInfo*, CameraModelOptions*)> spoil;
    std::vector<std::string> words;  // field, value, rule
  };
  const double nan = std::numeric_limits<double>::quiet_NaN();
  using Info = CameraInfo*;
  using Options = CameraModelOptions*;
  const std::vector<Case> cases = {
      {"unknown model",
       [](Info i, Options) { i->distortion_model = "omni"; },
       {"distortion_model", "'omni'", "equidistant"}},
      {"case matters",
       [](Info i, Options) { i->distortion_model = "Plumb_bob"; },
       {"distortion_model", "'Plumb_bob'", "must be"}},
      {"unknown model, rectified",
       [](Info i, Options o) { i->distortion_model = "omni", o->rectified = true; },
       {"distortion_model", "'omni'"}},
      {"three for equidistant",
       [](Info i, Options) {
         i->d = {0, 0, 0};
       },
       {"D.size", "3", "must be 4"}},
      {"none for equidistant", [](Info i, Options) { i->d.clear(); }, {"D.size", "0", "must be 4"}},
      {"five for equidistant",
       [](Info i, Options) {
         i->d = {1, 2, 3, 4, 5};
       },
       {"D.size", "5", "must be 4"}},
      {"eight for plumb_bob",
       [](Info i, Options) { i->distortion_model = "plumb_bob", i->d.assign(8, 0.1); },
       {"D.size", "8", "must be 5"}},
      {"five for rational",
       [](Info i, Options) { i->distortion_model = "rational_polynomial", i->d.assign(5, 0.0); },
       {"D.size", "5", "must be 8"}},
      {"thin prism",
       [](Info i, Options) {
         i->distortion_model = "rational_polynomial", i->d.assign(12, 0.0), i->d[9] = 0.01;
       },
       {"D[8..]", "thin prism"}},
      {"coefficients without a model",
       [](Info i, Options) { i->distortion_model = ""; },
       {"distortion_model", "''", "D holds 4"}},
      {"NaN coefficient", [nan](Info i, Options) { i->d[2] = nan; }, {"D[2]", "nan", "finite"}},
      {"zero K", [](Info i, Options) { i->k.fill(0.0); }, {"K[0]", "= 0", "above 0"}},
      {"negative fy", [](Info i, Options) { i->k[4] = -5.0; }, {"K[4]", "-5", "above 0"}},
      {"NaN fx", [nan](Info i, Options) { i->k[0] = nan; }, {"K[0]", "nan", "above 0"}},
      {"fx that binning makes 0",
       [](Info i, Options) {
         i->k[0] = 5e-324;
         i->binning_x = 2;
       },
       {"K[0]", "above 0"}},
      {"NaN cx", [nan](Info i, Options) { i->k[2] = nan; }, {"K[2]", "nan", "finite"}},
      {"infinite skew",
       [](Info i, Options) { i->k[1] = std::numeric_limits<double>::infinity(); },
       {"K[1]", "inf", "finite"}},
      {"width 0", [](Info i, Options) { i->size.width = 0; }, {"width", "= 0", "must lie in 1"}},
      {"height negative", [](Info i, Options) { i->size.height = -3; }, {"height", "-3", "1.."}},
      {"width of billions",
       [](Info i, Options) { i->size.width = 2000000000; },
       {"width", "2000000000", "32767"}},
      {"zero P, rectified",
       [](Info i, Options o) { i->p.fill(0.0), o->rectified = true; },
       {"P[0]", "= 0", "above 0"}},
      {"NaN P[3], rectified",
       [nan](Info i, Options o) { i->p[3] = nan, o->rectified = true; },
       {"P[3]", "nan", "finite"}},
      {"roi beyond the image",
       [](Info i, Options) {
         i->roi_x = 1900, i->roi_y = 0, i->roi_width = 29, i->roi_height = 100;
       },
       {"roi.width", "29", "1..28"}},
      {"roi offset outside",
       [](Info i, Options) { i->roi_y = 1208, i->roi_width = 10, i->roi_height = 1; },
       {"roi.y_offset", "1208", "inside"}},
      {"roi offset negative",
       [](Info i, Options) { i->roi_x = -1, i->roi_width = 10, i->roi_height = 1; },
       {"roi.x_offset", "-1", "inside"}},
      {"roi without a height",
       [](Info i, Options) { i->roi_width = 10; },
       {"roi.height", "= 0", "1..1208"}},
      {"negative binning",
       [](Info i, Options) { i->binning_x = -2; },
       {"binning_x", "-2", "0 (= 1) or more"}},
      {"binning eats the image",
       [](Info i, Options) { i->binning_y = 5000; },
       {"binning_y", "5000", "no pixel"}},
      {"R is no rotation",
       [](Info i, Options) { i->r = {2, 0, 0, 0, 1, 0, 0, 0, 1}; },
       {"R = [2", "rotation"}},
      {"R is a reflection",
       [](Info i, Options) { i->r = {-1, 0, 0, 0, 1, 0, 0, 0, 1}; },
       {"R = [-1", "rotation"}},
      {"NaN R",
       [nan](Info i, Options) { i->r = {1, 0, 0, 0, 1, 0, 0, 0, nan}; },
       {"R[8]", "nan", "finite"}},
      {"negative limit",
       [](Info, Options o) { o->max_theta_deg = -1.0; },
       {"max_theta_deg", "-1", "0..180"}},
      {"NaN limit",
       [nan](Info, Options o) { o->max_theta_deg = nan; },
       {"max_theta_deg", "nan", "0..180"}},
  };
  for (const Case& test : cases) {
    CameraInfo info = fisheyeInfo();
    CameraModelOptions options;
    test.spoil(&info, &options);
    try {
      const CameraModel camera(info, options);
      ADD_FAILURE() << test.name << " was accepted";
    } catch (const DataError& error) {
      const std::string message = error.what();
      EXPECT_NE(message.find("'camera'"), std::string::npos) << message;
      for (const std::string& word : test.words) {
        EXPECT_NE(message.find(word), std::string::npos) << test.name << ": " << message;
      }
    }
  }
}

TEST(CameraModel, RaysAreUnitVectorsOrAbsentForAnyFocalLength) {
  for (const double focal : {1e-320, 1e-300, 1e-160, 1e-20, 1e20, 1e160, 1e300}) {
    for (const char* model : {"equidistant", ""}) {
      CameraInfo info = fisheyeInfo();
      info.distortion_model = model;
      if (*model == '\0') info.d.clear();
      info.k[0] = info.k[4] = focal;
      const CameraModel camera(info, CameraModelOptions());
      for (const Eigen::Vector2d& pixel :
           {Eigen::Vector2d(0, 0), Eigen::Vector2d(700, 300), Eigen::Vector2d(1e219, -1e219)}) {
        const auto ray = camera.ray(pixel);
        if (!ray) continue;
        EXPECT_NEAR(ray->norm(), 1.0, 1e-9) << model << " " << focal;
      }
      const auto seen = camera.project({0.3, 0.2, 1.0});
      EXPECT_TRUE(!seen || seen->allFinite()) << model << " " << focal;
    }
  }
}

TEST(CameraModel, RectifiedNeedsNoLensParameters) {
  CameraInfo info = fisheyeInfo();
  info.k.fill(0.0);
  info.d.clear();
  CameraModelOptions options;
  options.rectified = true;
  EXPECT_TRUE(CameraModel(info, options).project({0.1, 0.1, 1.0}));
}

TEST(CameraInfo, ComparesEveryField) {
  const CameraInfo info = fisheyeInfo();
  EXPECT_TRUE(info == fisheyeInfo());
  const std::vector<std::function<void(CameraInfo*)>> changes = {
      [](CameraInfo* i) { i->frame_id = "b"; },
      [](CameraInfo* i) { i->size.width = 5; },
      [](CameraInfo* i) { i->distortion_model = ""; },
      [](CameraInfo* i) { i->d[3] = 1; },
      [](CameraInfo* i) { i->k[8] = 2; },
      [](CameraInfo* i) { i->r[0] = 1; },
      [](CameraInfo* i) { i->p[11] = 1; },
      [](CameraInfo* i) { i->binning_x = 2; },
      [](CameraInfo* i) { i->binning_y = 2; },
      [](CameraInfo* i) { i->roi_x = 2; },
      [](CameraInfo* i) { i->roi_y = 2; },
      [](CameraInfo* i) { i->roi_width = 2; },
      [](CameraInfo* i) { i->roi_height = 2; }};
  for (const auto& change : changes) {
    CameraInfo other = info;
    change(&other);
    EXPECT_FALSE(info == other);
  }
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
// Covariances of pixels against Monte Carlo: the errors themselves are drawn, and the whole way of
// a point from the beam to the pixel is gone again for each draw.
#include <gtest/gtest.h>

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>
#include <random>

#include "semantic_lidar_fusion/projection/rolling_shutter.h"
#include "semantic_lidar_fusion/uncertainty/pixel_covariance.h"
#include "semantic_lidar_fusion/uncertainty/view_errors.h"
#include "uncertainty/covariance_kernels.h"

namespace semantic_lidar_fusion {
namespace {

constexpr double kRadPerDeg = kPi / 180.0;
constexpr int kDraws = 2500;

Eigen::Matrix3d rotation(const Eigen::Vector3d& phi) {
  if (phi.norm() == 0.0) return Eigen::Matrix3d::Identity();
  return Eigen::AngleAxisd(phi.norm(), phi.normalized()).toRotationMatrix();
}

/// Exp([along; around]), by its series.
Transform exponential(const Vector6d& motion) {
  Eigen::Matrix4d generator = Eigen::Matrix4d::Zero();
  const Eigen::Vector3d w = motion.tail<3>();
  generator.topLeftCorner<3, 3>() << 0, -w.z(), w.y(), w.z(), 0, -w.x(), -w.y(), w.x(), 0;
  generator.topRightCorner<3, 1>() = motion.head<3>();
  Eigen::Matrix4d sum = Eigen::Matrix4d::Identity(), term = sum;
  for (int k = 1; k < 20; ++k) sum += term = term * generator / k;
  Transform T = Transform::Identity();
  T.matrix() = sum;
  return T;
}

struct LensCase {
  const char* model;
  std::vector<double> d;
  double focal;
};

const std::vector<LensCase>& lensCases() {
  static const std::vector<LensCase> cases = {
      {"pinhole", {}, 700},
      {"plumb_bob", {-0.3, 0.1, 0.001, -0.002, 0.0}, 700},
      {"rational_polynomial", {8.2, 5.1, 0.0002, -0.0003, 0.27, 8.6, 7.9, 1.4}, 700},
      {"equidistant", {-0.054, -0.078, 0.096, -0.0515}, 700},
      {"equidistant", {0.01, -0.002, 0.0, 0.0}, 450},
      {"omni", {1.5, -0.3, 0.05, 0.01, -0.01}, 1500},
      {"double_sphere", {-0.27, 0.57}, 350},
      {"eucm", {0.6, 1.1}, 500},
      {"ucm", {0.6}, 800},
      {"ftheta", {0.0, 700.0, 10.0, -50.0, 5.0}, 1},
      {"ocam", {0.999, 0.0002, -0.0001, 536.85, 300.0, -20.0, 15.0, 30.0, 10.0, -3.0}, 1}};
  return cases;
}

enum Source : unsigned {
  kOdometry = 1,
  kStamps = 2,
  kRange = 4,
  kBeam = 8,
  kExtrinsics = 16,
  kIntrinsics = 32,
  kCell = 64,
  kAll = 127,
};

/// A rig, a point, and what of it errs.
struct Scene {
  std::shared_ptr<CameraModel> camera;
  RigErrors rig;
  CameraErrors own;
  Eigen::Vector2d cell_px = Eigen::Vector2d::Zero();
  Transform T_vehicle_lidar, T_camera_lidar;
  Twist vehicle;
  double t_reference = 0, t_image = 0, t_point = 0;
  Eigen::Vector3d p_lidar;  ///< as measured, at t_point
  bool rolling = false;

  Transform pose(double t) const {
    Vector6d motion;
    motion << vehicle.velocity, vehicle.turn;
    return exponential(t * motion);
  }
  /// The point at the camera at the image's time, with errors.
  Eigen::Vector3d seenFrom(const Eigen::Vector3d& p, const Transform& T_camera, double t_i,
                           double t_c, const Vector6d& odometry) const {
    const Transform T_ic = exponential(odometry) * pose(t_c).inverse() * pose(t_i);
    return T_camera * T_vehicle_lidar.inverse() * T_ic * T_vehicle_lidar * p;
  }
  std::optional<Eigen::Vector2d> pixel(const Eigen::Vector3d& p_camera) const {
    const Twist motion = twistOf(T_camera_lidar * T_vehicle_lidar.inverse(), vehicle);
    const auto seen = seePoint(*camera, rolling ? &motion : nullptr, p_camera);
    if (!seen) return std::nullopt;
    return seen->pixel;
  }
};

Eigen::Vector3d normal3(std::mt19937* random) {
  std::normal_distribution<double> normal;
  return {normal(*random), normal(*random), normal(*random)};
}

Scene randomScene(const LensCase& lens, bool rolling, unsigned sources, std::mt19937* random) {
  std::uniform_real_distribution<double> unit(-1.0, 1.0), part(0.0, 1.0);
  Scene scene;
  auto calibration = std::make_shared<LensCalibration>();
  calibration->lens = {"test", lens.model, lens.d};
  calibration->size = {1280, 800};
  calibration->fx = lens.focal;
  calibration->fy = lens.focal * (1.0 + 0.02 * unit(*random));
  calibration->cx = 640 + 20 * unit(*random);
  calibration->cy = 400 + 20 * unit(*random);
  CameraModelOptions options;
  options.lens = calibration;
  scene.rolling = rolling;
  if (rolling) options.shutter.readout_s = 0.03;
  scene.camera = std::make_shared<CameraModel>(CameraInfo{}, options);

  scene.vehicle.velocity = {15.0 * unit(*random), unit(*random), 0.3 * unit(*random)};
  scene.vehicle.turn =
      kRadPerDeg * Eigen::Vector3d(3 * unit(*random), 3 * unit(*random), 30 * unit(*random));
  scene.t_reference = 0.05 * unit(*random);
  scene.t_image = scene.t_reference + 0.02 * unit(*random);
  scene.t_point = scene.t_reference + 0.03 * unit(*random);
  scene.T_vehicle_lidar = Transform::Identity();
  scene.T_vehicle_lidar.linear() = rotation(0.05 * normal3(random));
  scene.T_vehicle_lidar.translation() = normal3(random);
  Eigen::Matrix3d optical;
  optical << 0, -1, 0, 0, 0, -1, 1, 0, 0;
  scene.T_camera_lidar = Transform::Identity();
  scene.T_camera_lidar.linear() = rotation(0.1 * normal3(random)) * optical *
                                  Eigen::AngleAxisd(kPi * unit(*random), Eigen::Vector3d::UnitZ());
  scene.T_camera_lidar.translation() = 0.5 * normal3(random);

  if (sources & kOdometry) {
    scene.rig.motion.velocity_mps = {0.5, 0.3, 0.2};
    scene.rig.motion.rate_deg_s = {2, 3, 5};
    scene.rig.motion.correlation_s = part(*random) < 0.5 ? 1.0 : 0.01;
    scene.rig.motion.scale = 0.01;
  }
  if (sources & kStamps) {
    scene.rig.lidar_stamp_s = 0.001;
    scene.rig.camera_stamp_s = 0.002;
  }
  if (sources & kRange) scene.rig.lidar.range_m = 0.03;
  if (sources & kBeam) scene.rig.lidar.beam_deg = {0.3, 0.15};
  if (sources & kExtrinsics) {
    Matrix6d factor;
    std::normal_distribution<double> normal;
    for (int k = 0; k < 36; ++k) factor.data()[k] = normal(*random);
    Vector6d scale;
    scale << 0.008, 0.008, 0.008, 0.15 * kRadPerDeg, 0.15 * kRadPerDeg, 0.15 * kRadPerDeg;
    scene.own.extrinsics =
        scale.asDiagonal() * (factor * factor.transpose() / 6.0) * scale.asDiagonal();
  }
  if (sources & kIntrinsics) scene.own.intrinsics_px = 1.6;
  if (sources & kCell) scene.cell_px = {4.0, 6.0};

  // A point in the middle of the image, from 4 to 40 m away.
  for (;;) {
    const Eigen::Vector2d aim(640 + 480 * unit(*random), 400 + 300 * unit(*random));
    const auto ray = scene.camera->ray(aim);
    if (!ray || std::acos(std::min(1.0, ray->z())) > 60 * kRadPerDeg) continue;
    const Eigen::Vector3d p_camera =
        std::exp(std::log(4.0) + std::log(10.0) * part(*random)) * *ray;
    const Transform T_ic = scene.pose(scene.t_image).inverse() * scene.pose(scene.t_point);
    scene.p_lidar = scene.T_vehicle_lidar.inverse() * T_ic.inverse() * scene.T_vehicle_lidar *
                    scene.T_camera_lidar.inverse() * p_camera;
    return scene;
  }
}

/// What the package says of the scene's point.
Eigen::Matrix2d covarianceOf(const Scene& scene) {
  const Transform T_reference = scene.T_vehicle_lidar.inverse() *
                                scene.pose(scene.t_reference).inverse() *
                                scene.pose(scene.t_point) * scene.T_vehicle_lidar;
  const Eigen::Vector3d p = T_reference * scene.p_lidar;
  Cloud cloud;
  cloud.resize(1);
  cloud.x[0] = static_cast<float>(p.x());
  cloud.y[0] = static_cast<float>(p.y());
  cloud.z[0] = static_cast<float>(p.z());
  cloud.dt[0] = static_cast<float>(scene.t_point - scene.t_reference);
  cloud.status[0] = 0;
  const Transform T_camera_vehicle = scene.T_camera_lidar * scene.T_vehicle_lidar.inverse();
  const Transform T_camera_lidar = T_camera_vehicle * scene.pose(scene.t_image).inverse() *
                                   scene.pose(scene.t_reference) * scene.T_vehicle_lidar;
  const ViewMotion moving{T_camera_vehicle, scene.T_vehicle_lidar, scene.vehicle};
  const ViewErrors errors =
      viewErrors(scene.rig, scene.own, moving, scene.t_image - scene.t_reference);
  const Twist motion = twistOf(T_camera_vehicle, scene.vehicle);
  const ProjectedPoints points =
      projectCloud(cloud, T_camera_lidar, *scene.camera, 400.0, scene.rolling ? &motion : nullptr);
  EXPECT_EQ(points.size(), 1u);
  if (points.size() != 1) return Eigen::Matrix2d::Zero();
  const PixelCovariances result =
      pixelCovariances(cloud, points, {0}, T_camera_lidar, *scene.camera,
                       scene.rolling ? &motion : nullptr, errors, scene.cell_px);
  Eigen::Matrix2d covariance;
  covariance << result.uu[0], result.uv[0], result.uv[0], result.vv[0];
  return covariance;
}

struct Drawn {
  Eigen::Matrix2d covariance;
  double held = 0;  ///< part of the pixels in the 95 % ellipse of `said`
};

Drawn draw(const Scene& scene, const Eigen::Matrix2d& said, std::mt19937* random) {
  std::normal_distribution<double> normal;
  std::uniform_real_distribution<double> unit(-1.0, 1.0);
  const Eigen::SelfAdjointEigenSolver<Matrix6d> extrinsics(scene.own.extrinsics);
  const Matrix6d root =
      extrinsics.eigenvectors() * extrinsics.eigenvalues().cwiseMax(0.0).cwiseSqrt().asDiagonal();
  const double tau = scene.rig.motion.correlation_s;
  // Of a rolling shutter the time is that of the row, which differs little from draw to draw.
  double row_s = 0.0;
  if (scene.rolling) {
    const auto nominal = scene.pixel(scene.seenFrom(
        scene.p_lidar, scene.T_camera_lidar, scene.t_point, scene.t_image, Vector6d::Zero()));
    row_s = clampedRowTime(*scene.camera, nominal->x(), nominal->y());
  }
  const double way = std::abs(scene.t_point - scene.t_image - row_s);
  const double g = 2.0 * tau * tau * (way / tau - 1.0 + std::exp(-way / tau));
  Vector6d deviation;
  deviation << scene.rig.motion.velocity_mps, kRadPerDeg * scene.rig.motion.rate_deg_s;
  deviation[0] = std::hypot(deviation[0], scene.rig.motion.scale * scene.vehicle.velocity.norm());

  const double range = scene.p_lidar.norm();
  const Eigen::Vector3d d = scene.p_lidar / range;
  const Eigen::Vector3d side = Eigen::Vector3d::UnitZ().cross(d).normalized(), up = d.cross(side);
  Eigen::Vector2d mean = Eigen::Vector2d::Zero();
  std::vector<Eigen::Vector2d> pixels;
  for (int k = 0; k < kDraws; ++k) {
    double right, high;
    do {
      right = unit(*random), high = unit(*random);
    } while (right * right + high * high > 1.0);
    const Eigen::Vector2d tilt =
        0.5 * kRadPerDeg * scene.rig.lidar.beam_deg.cwiseProduct(Eigen::Vector2d(right, high));
    const Eigen::Vector3d p = (range + scene.rig.lidar.range_m * normal(*random)) *
                              (d + tilt.x() * side + tilt.y() * up).normalized();
    Vector6d odometry, extrinsic;
    for (double& value : odometry) value = normal(*random);
    for (double& value : extrinsic) value = normal(*random);
    const Transform T_camera = exponential(root * extrinsic) * scene.T_camera_lidar;
    const Eigen::Vector3d p_camera =
        scene.seenFrom(p, T_camera, scene.t_point + scene.rig.lidar_stamp_s * normal(*random),
                       scene.t_image + scene.rig.camera_stamp_s * normal(*random),
                       std::sqrt(g) * deviation.cwiseProduct(odometry));
    const auto pixel = scene.pixel(p_camera);
    if (!pixel) continue;
    Eigen::Vector2d noisy = *pixel;
    for (int axis = 0; axis < 2; ++axis) {
      noisy[axis] +=
          scene.own.intrinsics_px * normal(*random) + 0.5 * scene.cell_px[axis] * unit(*random);
    }
    pixels.push_back(noisy);
    mean += noisy;
  }
  EXPECT_GT(pixels.size(), 0.999 * kDraws);
  mean /= static_cast<double>(pixels.size());
  Drawn drawn;
  drawn.covariance.setZero();
  for (const Eigen::Vector2d& pixel : pixels) {
    const Eigen::Vector2d e = pixel - mean;
    drawn.covariance += e * e.transpose();
    drawn.held += e.dot(said.inverse() * e) < 5.991 ? 1.0 : 0.0;
  }
  drawn.covariance /= static_cast<double>(pixels.size());
  drawn.held /= static_cast<double>(pixels.size());
  return drawn;
}

/// Ratios of standard deviations along both axes of the drawn ellipse.
void addRatios(const Eigen::Matrix2d& said, const Eigen::Matrix2d& drawn,
               std::vector<double>* ratios) {
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> axes(drawn);
  const double largest = axes.eigenvalues()[1];
  for (int k = 0; k < 2; ++k) {
    // Of one error alone the ellipse may be a line, whose width is of the second order.
    if (axes.eigenvalues()[k] < 0.01 * largest) continue;
    const Eigen::Vector2d axis = axes.eigenvectors().col(k);
    ratios->push_back(std::sqrt(axis.dot(said * axis) / axes.eigenvalues()[k]));
  }
}

double quantile(std::vector<double> values, double part) {
  std::sort(values.begin(), values.end());
  return values[static_cast<std::size_t>(part * static_cast<double>(values.size() - 1) + 0.5)];
}

class FromEverySource : public testing::TestWithParam<unsigned> {};

/// Of 2500 draws the standard deviation is known to 1.4 %, so that 1 to 99 % lie within 3.3 % if
/// the covariance is right.
TEST_P(FromEverySource, TheEllipseIsThatOfMonteCarlo) {
  const unsigned source = GetParam();
  std::mt19937 random(100 + source);
  std::vector<double> ratios;
  double held = 0;
  int scenes = 0;
  for (const LensCase& lens : lensCases()) {
    for (const bool rolling : {false, true}) {
      const Scene scene = randomScene(lens, rolling, source, &random);
      const Eigen::Matrix2d said = covarianceOf(scene);
      ASSERT_TRUE(said.allFinite()) << lens.model;
      const Drawn drawn = draw(scene, said + 1e-6 * Eigen::Matrix2d::Identity(), &random);
      addRatios(said, drawn.covariance, &ratios);
      held += drawn.held;
      ++scenes;
    }
  }
  ASSERT_GT(ratios.size(), 15u);
  EXPECT_NEAR(quantile(ratios, 0.5), 1.0, 0.01);
  EXPECT_GT(quantile(ratios, 0.01), 0.95);
  EXPECT_LT(quantile(ratios, 0.99), 1.05);
  // What is not normal does not leave 5 % outside: a disc, a square, a line.
  if (source == kAll || source == kExtrinsics) {
    EXPECT_NEAR(held / scenes, 0.95, 0.01);
  }
}

INSTANTIATE_TEST_SUITE_P(AloneAndTogether, FromEverySource,
                         testing::Values(kOdometry, kStamps, kRange, kBeam, kExtrinsics,
                                         kIntrinsics, kCell, kAll));

TEST(MotionVariance, IsTheDoubleIntegralOfTheCorrelation) {
  for (const double tau : {0.01, 0.2, 3.0}) {
    for (const double D : {0.0, 0.002, 0.05, -0.05, 0.4}) {
      constexpr int kSteps = 400;
      const double step = std::abs(D) / kSteps;
      double sum = 0;
      for (int a = 0; a < kSteps; ++a) {
        for (int b = 0; b < kSteps; ++b) sum += std::exp(-std::abs(a - b) * step / tau);
      }
      EXPECT_NEAR(motionVariance(D, tau), sum * step * step, 1e-3 * sum * step * step + 1e-15)
          << tau << " " << D;
    }
  }
  // Both sides of the border between series and formula.
  EXPECT_NEAR(motionVariance(0.29999999, 1.0), motionVariance(0.30000001, 1.0), 3e-8 * 0.09 + 1e-8);
}

TEST(ViewErrors, AreNoneWhereNoneAreKnown) {
  EXPECT_FALSE(viewErrors({}, {}, ViewMotion{}, 0.01).any());
  RigErrors rig;
  rig.lidar_stamp_s = 0.01;
  // A stamp's error shows only where something moves.
  EXPECT_FALSE(viewErrors(rig, {}, ViewMotion{}, 0.0).any());
  EXPECT_FALSE(viewErrors(rig, {}, std::nullopt, 0.0).any());
  ViewMotion moving;
  moving.vehicle.velocity.x() = 3.0;
  const ViewErrors errors = viewErrors(rig, {}, moving, 0.0);
  EXPECT_TRUE(errors.any());
  EXPECT_NEAR(errors.common(0, 0), 9.0 * 1e-4, 1e-12);
}

/// Both versions of the kernels, byte by byte, on numbers of every size.
TEST(CovarianceKernels, GiveTheSameBytes) {
  const CovarianceKernelList list = usableCovarianceKernels();
  if (list.count < 2) GTEST_SKIP() << "the machine has one version";
  std::mt19937 random(7);
  std::normal_distribution<float> normal;
  CovarianceBlock one{}, two{};
  CovarianceConstants constants{};
  for (float& value : constants.common) value = normal(random);
  for (float& value : constants.odometry) value = normal(random);
  for (float& value : constants.rotation) value = normal(random);
  constants.range_m2 = constants.side_rad2 = constants.up_rad2 = 0.01f;
  constants.own_uu = constants.own_vv = 0.5f;
  const RadialFit lens{700.0f, 710.0f, 0.01f, {-0.05f, -0.08f, 0.1f, -0.05f}};
  for (const int count : {1, 7, 8, 100, kCovarianceBlock}) {
    for (int i = 0; i < count; ++i) {
      one.x[i] = i % 9 == 0 ? 0.0f : 5.0f * normal(random);
      one.y[i] = i % 9 == 0 ? 0.0f : 5.0f * normal(random);
      one.z[i] = 1.0f + 9.0f * std::abs(normal(random));
      one.theta[i] = std::atan2(std::hypot(one.x[i], one.y[i]), one.z[i]);
      one.beam_x[i] = normal(random), one.beam_y[i] = normal(random),
      one.beam_z[i] = normal(random);
      one.flat_range[i] = std::hypot(one.beam_x[i], one.beam_y[i]);
      one.range[i] = std::hypot(one.flat_range[i], one.beam_z[i]);
      one.motion_s2[i] = 0.01f * std::abs(normal(random));
    }
    for (const bool odometry : {false, true}) {
      two = one;
      list.kernels[0]->equidistant(lens, count, &one);
      list.kernels[0]->covariances(constants, odometry, true, count, &one);
      list.kernels[1]->equidistant(lens, count, &two);
      list.kernels[1]->covariances(constants, odometry, true, count, &two);
      EXPECT_EQ(std::memcmp(&one, &two, sizeof(one)), 0) << count;
      EXPECT_TRUE(std::isfinite(one.uu[0]));
    }
  }
}

/// A pixel on the optical axis has the Jacobian of its neighbours.
TEST(PixelCovariance, OfTheAxisIsThatBesideIt) {
  CameraInfo info;
  info.size = {200, 200};
  info.distortion_model = "equidistant";
  info.d = {-0.05, 0.01, 0.0, 0.0};
  info.k = {100, 0, 100, 0, 110, 100, 0, 0, 1};
  const CameraModel camera(info, {});
  Cloud cloud;
  cloud.resize(2);
  cloud.x = {0.0f, 0.02f}, cloud.y = {0.0f, 0.0f}, cloud.z = {10.0f, 10.0f};
  CameraErrors own;
  own.extrinsics.diagonal() << 1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5;
  const Transform T = Transform::Identity();
  const auto points = projectCloud(cloud, T, camera, 0.0);
  ASSERT_EQ(points.size(), 2u);
  const auto result = pixelCovariances(cloud, points, {0, 1}, T, camera, nullptr,
                                       viewErrors({}, own, std::nullopt, 0.0), {0, 0});
  // f^2 (s_t^2 / z^2 + s_r^2)
  EXPECT_NEAR(result.uu[0], 1e4 * (1e-6 + 1e-5), 1e-4);
  EXPECT_NEAR(result.vv[0], 1.21e4 * (1e-6 + 1e-5), 1e-4);
  EXPECT_NEAR(result.uv[0], 0.0, 1e-6);
  EXPECT_NEAR(result.uu[1], result.uu[0], 1e-3 * result.uu[0]);
}

TEST(SigmaPoints, HaveTheMomentsOfTheEllipse) {
  std::mt19937 random(3);
  std::normal_distribution<double> normal;
  for (int k = 0; k < 200; ++k) {
    Eigen::Matrix2d factor;
    factor << normal(random), normal(random), normal(random), normal(random);
    const Eigen::Matrix2d covariance = 30.0 * factor * factor.transpose();
    const SigmaPoints points =
        sigmaPoints(static_cast<float>(covariance(0, 0)), static_cast<float>(covariance(0, 1)),
                    static_cast<float>(covariance(1, 1)), 0.0f);
    ASSERT_EQ(points.count, 9);
    double total = 0;
    Eigen::Vector2d mean = Eigen::Vector2d::Zero();
    Eigen::Matrix2d second = Eigen::Matrix2d::Zero();
    double fourth = 0;
    for (int i = 0; i < points.count; ++i) {
      const Eigen::Vector2d at(points.du[i], points.dv[i]);
      total += points.weight[i];
      mean += points.weight[i] * at;
      second += points.weight[i] * at * at.transpose();
      fourth += points.weight[i] * std::pow(at.dot(covariance.inverse() * at), 2);
    }
    EXPECT_NEAR(total, 1.0, 1e-6);
    EXPECT_LT(mean.norm(), 1e-5 * std::sqrt(covariance.trace()));
    EXPECT_LT((second - covariance).norm(), 1e-4 * covariance.norm());
    // E (x' S^-1 x)^2 = n (n + 2) of a normal distribution.
    EXPECT_NEAR(fourth, 8.0,
                1e-2 * (1.0 + covariance.trace() / std::sqrt(covariance.determinant())));
    EXPECT_EQ(points.du[0], 0.0f);
  }
}

TEST(SigmaPoints, LeaveOutAxesThatAreNegligible) {
  EXPECT_EQ(sigmaPoints(0.9f, 0.0f, 0.5f, 1.0f).count, 1);
  const SigmaPoints three = sigmaPoints(0.5f, 0.0f, 16.0f, 1.0f);
  ASSERT_EQ(three.count, 3);
  EXPECT_NEAR(std::abs(three.dv[1]), std::sqrt(3.0) * 4.0, 1e-5);
  EXPECT_NEAR(three.du[1], 0.0, 1e-5);
  EXPECT_NEAR(three.weight[0], 2.0 / 3.0, 1e-7);
  EXPECT_EQ(sigmaPoints(2.0f, 0.0f, 16.0f, 1.0f).count, 9);
  const float nan = std::numeric_limits<float>::quiet_NaN();
  EXPECT_EQ(sigmaPoints(nan, 0.0f, 16.0f, 1.0f).count, 1);
}

}  // namespace
}  // namespace semantic_lidar_fusion

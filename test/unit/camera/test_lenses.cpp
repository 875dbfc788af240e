// SPDX-License-Identifier: MIT
// What every lens promises, whatever its model, and its equations against other implementations.
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <functional>
#include <opencv2/calib3d.hpp>
#ifdef SLF_TEST_CCALIB
#include <opencv2/ccalib/omnidir.hpp>
#endif
#include <random>

#include "direction.h"
#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/camera/lens.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

/// Of the issue.
constexpr double kRoundTrip_rad = 1e-9;

std::shared_ptr<const Lens> makeLens(const std::string& model, const std::vector<double>& d,
                                     double max_theta_rad = kPi,
                                     std::vector<std::string>* notes = nullptr) {
  std::vector<std::string> ignored;
  for (const LensKind& kind : lensKinds()) {
    if (kind.name == model)
      return kind.make({"test", model, d}, max_theta_rad, notes ? notes : &ignored);
  }
  throw DataError("no lens " + model);
}

/// KITTI-360's published image_02: xi k1 k2 p1 p2.
const std::vector<double> kKitti360 = {2.2134047507854890, 1.6798235660113681e-2,
                                       1.6548773243373522, 4.2223943394772046e-4,
                                       4.2462134260997584e-4};

struct NamedLens {
  std::string model;
  std::vector<double> d;
};

std::vector<NamedLens> lenses() {
  return {{"pinhole", {}},
          {"plumb_bob", {-0.36, 0.18, 0.0004, -0.0007, -0.05}},
          {"plumb_bob", {-0.3, 0.0, 0.01, -0.02}},
          {"rational_polynomial", {8.2, 5.1, 0.0002, -0.0003, 0.27, 8.6, 7.9, 1.4}},
          {"equidistant", {-0.0557, 0.0173, -0.0019, 0.00007}},
          {"equidistant", {-0.05, -0.02, 0.01, -0.003}},
          {"omni", kKitti360},
          {"omni", {0.8}},
          {"omni", {1.0, -0.2, 0.01, 0.001, 0.001}},
          {"omni", {1.5, -0.3, 0.05, 0.01, -0.01}},
          {"omni", {0.5, -0.3, 0.05, 0.001, -0.001}},
          {"double_sphere", {-0.27, 0.57}},
          {"double_sphere", {0.5, 0.5}},
          {"double_sphere", {0.3, 0.4}},
          {"double_sphere", {1.0, 0.7}},
          {"double_sphere", {-0.8, 0.3}},
          {"eucm", {0.6, 1.1}},
          {"eucm", {0.4, 0.5}},
          {"eucm", {0.9, 3.0}},
          {"ucm", {0.6}},
          {"ucm", {0.3}},
          {"ucm", {0.0}},
          {"ucm", {1.0}},
          {"ftheta", {0.0, 1000.0, 10.0, -50.0, 5.0}},
          {"ftheta", {0.0, 500.0, 0.0, -40.0}},
          {"ocam", {0.999, 0.0002, -0.0001, 536.85, 300.0, -20.0, 15.0, 30.0, 10.0, -3.0}}};
}

std::string nameOf(const NamedLens& lens) {
  std::string text = lens.model;
  for (const double d : lens.d) text += " " + std::to_string(d);
  return text;
}

Eigen::Vector3d randomDirection(std::mt19937* random) {
  std::normal_distribution<double> axis(0.0, 1.0);
  return Eigen::Vector3d(axis(*random), axis(*random), axis(*random)).normalized();
}

double angleBetween(const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
  return std::atan2(a.cross(b).norm(), a.dot(b));
}

/// What must hold of any lens: each point that has a place on the plane is the one that the place's
/// ray shows, and it is in the domain. 1e6 directions over all lenses.
void expectOneToOne(const Lens& lens, int directions, std::uint32_t seed, const std::string& name) {
  std::mt19937 random(seed);
  int seen = 0;
  for (int i = 0; i < directions; ++i) {
    const Eigen::Vector3d p = randomDirection(&random);
    const auto a = lens.project(3.0 * p);
    if (!a) continue;
    ++seen;
    ASSERT_LE(std::atan2(std::hypot(p.x(), p.y()), p.z()), lens.maxThetaRad() + 1e-12) << name;
    const auto ray = lens.ray(*a);
    ASSERT_TRUE(ray) << name << ": " << p.transpose();
    ASSERT_NEAR(ray->norm(), 1.0, 1e-12) << name;
    // A place on the plane is known to its rounding, 1e-16 of it, and fixes the angle the less the
    // flatter the radius is there: a step of 1e-9 rad must move the place by more than that.
    const Matrix23d j = lens.jacobian(p);
    const double flattest = Eigen::JacobiSVD<Eigen::Matrix<double, 2, 3>>(j).singularValues()[1];
    const double rounding = 8.0 * 2.3e-16 * (1.0 + a->norm()) / flattest;
    ASSERT_LT(angleBetween(*ray, p), kRoundTrip_rad + rounding) << name << ": " << p.transpose();
  }
  EXPECT_GT(seen, directions / 20) << name;
}

void expectJacobianOfDifferences(const Lens& lens, std::uint32_t seed, const std::string& name) {
  std::mt19937 random(seed);
  constexpr double kStep = 1e-5;
  int compared = 0;
  for (int i = 0; i < 2000; ++i) {
    // A margin to the edge, where the derivatives of some lenses grow without bound.
    const Eigen::Vector3d p = 2.5 * randomDirection(&random);
    if (std::atan2(std::hypot(p.x(), p.y()), p.z()) > 0.9 * lens.maxThetaRad()) continue;
    const Matrix23d j = lens.jacobian(p);
    for (int axis = 0; axis < 3; ++axis) {
      const Eigen::Vector3d step = kStep * Eigen::Vector3d::Unit(axis);
      const auto ahead = lens.project(p + step), behind = lens.project(p - step);
      if (!ahead || !behind) continue;
      const Eigen::Vector2d difference = (*ahead - *behind) / (2.0 * kStep);
      // Third derivatives grow as 1 / (distance to the edge)^3: with a tenth of the angle, by 1e3.
      ASSERT_LT((difference - j.col(axis)).norm(), 1e-5 * (1.0 + j.norm()))
          << name << ": " << p.transpose();
      ++compared;
    }
  }
  EXPECT_GT(compared, 300) << name;
}

TEST(Lenses, NoPointFoldsInAndEveryRayLeadsBack) {
  const auto all = lenses();
  const int each = 1000000 / static_cast<int>(all.size());
  for (std::size_t i = 0; i < all.size(); ++i) {
    expectOneToOne(*makeLens(all[i].model, all[i].d), each, 10 + static_cast<std::uint32_t>(i),
                   nameOf(all[i]));
  }
}

TEST(Lenses, PointsWhoseSquaresOverflowDoNotFoldIn) {
  for (const auto& one : lenses()) {
    const auto lens = makeLens(one.model, one.d);
    for (const Eigen::Vector3d& p :
         {Eigen::Vector3d(1e200, 1.0, 1e-200), Eigen::Vector3d(-3e170, 4e170, 1e170),
          Eigen::Vector3d(-9.8e307, 1.0, 1e-200)}) {
      const auto a = lens->project(p);
      if (!a || !a->allFinite()) continue;
      const auto same = lens->project(p / p.stableNorm());
      ASSERT_TRUE(same) << nameOf(one);
      EXPECT_LT((*a - *same).norm(), 1e-9 * (1.0 + same->norm())) << nameOf(one);
    }
  }
}

TEST(Lenses, RandomCoefficientsKeepThePromise) {
  std::mt19937 random(2);
  std::uniform_real_distribution<double> unit(0.0, 1.0);
  std::normal_distribution<double> k(0.0, 0.2);
  for (int i = 0; i < 60; ++i) {
    // c d e, then a polynomial that is 0 on the axis, at -90 deg.
    NamedLens ocam{"ocam",
                   {1.0, k(random) * 0.01, k(random) * 0.01, 0.0, 250.0, 100 * k(random),
                    100 * k(random), 50 * k(random)}};
    for (std::size_t n = 4; n < ocam.d.size(); ++n) {
      ocam.d[3] -= ocam.d[n] * std::pow(-0.5 * kPi, static_cast<double>(n) - 3.0);
    }
    const std::vector<NamedLens> made = {
        {"plumb_bob", {k(random), k(random), 0.02 * k(random), 0.02 * k(random), k(random)}},
        {"omni", {3.0 * unit(random), k(random), k(random), 0.02 * k(random), 0.02 * k(random)}},
        {"double_sphere", {2.0 * unit(random) - 0.999, unit(random)}},
        {"eucm", {unit(random), 0.1 + 3.0 * unit(random)}},
        {"ftheta", {0.0, 600.0, 100 * k(random), 100 * k(random), 50 * k(random)}},
        ocam};
    for (const NamedLens& one : made) {
      std::shared_ptr<const Lens> lens;
      try {
        lens = makeLens(one.model, one.d);
      } catch (const DataError&) {
        EXPECT_TRUE(one.model == "ocam" || one.model == "ftheta") << nameOf(one);
        continue;  // does not rise on the axis
      }
      std::mt19937 directions(static_cast<std::uint32_t>(i));
      for (int n = 0; n < 300; ++n) {
        const Eigen::Vector3d p = randomDirection(&directions);
        const auto a = lens->project(p);
        if (!a) continue;
        const auto ray = lens->ray(*a);
        ASSERT_TRUE(ray) << nameOf(one) << ": " << p.transpose();
        // Near the fold-over a place fixes the angle only to the square root of the rounding.
        ASSERT_LT(angleBetween(*ray, p), 1e-6) << nameOf(one) << ": " << p.transpose();
      }
    }
  }
}

TEST(Lenses, JacobianIsTheDerivative) {
  const auto all = lenses();
  for (std::size_t i = 0; i < all.size(); ++i) {
    expectJacobianOfDifferences(*makeLens(all[i].model, all[i].d),
                                50 + static_cast<std::uint32_t>(i), nameOf(all[i]));
  }
}

TEST(Lenses, TheAxisAndItsScale) {
  for (const NamedLens& one : lenses()) {
    const auto lens = makeLens(one.model, one.d);
    const auto axis = lens->project({0.0, 0.0, 2.0});
    ASSERT_TRUE(axis) << nameOf(one);
    EXPECT_EQ(axis->norm(), 0.0) << nameOf(one);
    EXPECT_LT((*lens->ray({0.0, 0.0}) - Eigen::Vector3d::UnitZ()).norm(), 1e-15) << nameOf(one);
    EXPECT_FALSE(lens->project({0.0, 0.0, 0.0})) << nameOf(one);
    if (lens->maxThetaRad() < 3.1) {
      EXPECT_FALSE(lens->project({0.0, 0.0, -2.0})) << nameOf(one);
    }
    // Of the sensor's stretch too, which is within 1e-3 of 1 in this table.
    const Eigen::Vector3d near_axis(0.001, 0.0, 1.0);
    const double scale = (*lens->project(near_axis)).norm() / 0.001;
    if (one.model != "ocam") {  // whose radius on the axis is not quite 0
      EXPECT_NEAR(scale / lens->axialScale(), 1.0, 1e-4) << nameOf(one);
    }
    EXPECT_NEAR(lens->jacobian({0.0, 0.0, 2.0})(0, 0) * 2.0 / lens->axialScale(), 1.0, 2e-3)
        << nameOf(one);
  }
}

TEST(Lenses, NoPointWithinARadiusIsBeyondItsAngle) {
  std::mt19937 random(4);
  for (const NamedLens& one : lenses()) {
    const auto lens = makeLens(one.model, one.d);
    for (const double part : {0.1, 0.5, 1.0, 3.0}) {
      const double radius = part * lens->axialScale();
      const double most = lens->maxThetaWithin(radius);
      EXPECT_LE(most, lens->maxThetaRad()) << nameOf(one);
      for (int i = 0; i < 2000; ++i) {
        const Eigen::Vector3d p = randomDirection(&random);
        const auto a = lens->project(p);
        if (!a || a->norm() > radius) continue;
        ASSERT_LE(std::atan2(std::hypot(p.x(), p.y()), p.z()), most + 1e-9) << nameOf(one);
      }
    }
  }
}

TEST(Lenses, TheLargestAngleNarrowsEachOne) {
  for (const NamedLens& one : lenses()) {
    for (const double limit : {0.2, 0.5}) {
      const auto lens = makeLens(one.model, one.d, limit);
      EXPECT_LE(lens->maxThetaRad(), limit + 1e-12) << nameOf(one);
      EXPECT_TRUE(lens->project(direction(limit - 1e-4, 2.0))) << nameOf(one);
      EXPECT_FALSE(lens->project(direction(limit + 1e-4, 2.0))) << nameOf(one);
    }
  }
}

// ------------------------------------------------------------------------ equations and oracles

/// The equations of basalt's headers, written down independently.
Eigen::Vector2d doubleSphere(double xi, double alpha, const Eigen::Vector3d& p) {
  const double d1 = std::sqrt(p.x() * p.x() + p.y() * p.y() + p.z() * p.z());
  const double k = xi * d1 + p.z();
  const double d2 = std::sqrt(p.x() * p.x() + p.y() * p.y() + k * k);
  return p.head<2>() / (alpha * d2 + (1 - alpha) * k);
}

TEST(Lenses, DoubleSphereFollowsItsPaper) {
  // w1 and w2 of the paper decide the domain, points of both sides.
  for (const auto& [xi, alpha] :
       std::vector<std::pair<double, double>>{{-0.27, 0.57}, {0.3, 0.4}}) {
    const auto lens = makeLens("double_sphere", {xi, alpha});
    const double w1 = alpha <= 0.5 ? alpha / (1 - alpha) : (1 - alpha) / alpha;
    const double w2 = (w1 + xi) / std::sqrt(2 * w1 * xi + xi * xi + 1);
    std::mt19937 random(6);
    for (int i = 0; i < 5000; ++i) {
      const Eigen::Vector3d p = 4.0 * randomDirection(&random);
      const auto a = lens->project(p);
      ASSERT_EQ(a.has_value(), p.z() > -w2 * p.norm()) << p.transpose();
      if (a) {
        ASSERT_LT((*a - doubleSphere(xi, alpha, p)).norm(), 1e-12 * (1 + a->norm()));
      }
    }
  }
}

TEST(Lenses, EucmAndUcmFollowTheirPaper) {
  for (const auto& [alpha, beta] : std::vector<std::pair<double, double>>{{0.6, 1.1}, {0.3, 1.0}}) {
    const auto lens = makeLens("eucm", {alpha, beta});
    const double w = alpha <= 0.5 ? alpha / (1 - alpha) : (1 - alpha) / alpha;
    std::mt19937 random(7);
    for (int i = 0; i < 5000; ++i) {
      const Eigen::Vector3d p = 4.0 * randomDirection(&random);
      const double d = std::sqrt(beta * (p.x() * p.x() + p.y() * p.y()) + p.z() * p.z());
      const auto a = lens->project(p);
      ASSERT_EQ(a.has_value(), p.z() > -w * d) << p.transpose();
      if (!a) continue;
      const Eigen::Vector2d expected = p.head<2>() / (alpha * d + (1 - alpha) * p.z());
      ASSERT_LT((*a - expected).norm(), 1e-12 * (1 + a->norm()));
      if (beta == 1.0) {
        ASSERT_EQ(*makeLens("ucm", {alpha})->project(p), *a);
      }
    }
  }
}

TEST(Lenses, OmniFollowsItsPaper) {
  const std::vector<double>& d = kKitti360;
  const auto lens = makeLens("omni", d);
  std::mt19937 random(8);
  int behind = 0;
  for (int i = 0; i < 5000; ++i) {
    const Eigen::Vector3d p = 4.0 * randomDirection(&random);
    const auto a = lens->project(p);
    ASSERT_EQ(a.has_value(), p.z() > -p.norm() / d[0]) << p.transpose();
    if (!a) continue;
    behind += p.z() < 0.0;
    const Eigen::Vector3d q = p.normalized();
    const double x = q.x() / (q.z() + d[0]), y = q.y() / (q.z() + d[0]), s = x * x + y * y;
    const double radial = 1 + d[1] * s + d[2] * s * s;
    const Eigen::Vector2d expected(x * radial + 2 * d[3] * x * y + d[4] * (s + 2 * x * x),
                                   y * radial + d[3] * (s + 2 * y * y) + 2 * d[4] * x * y);
    ASSERT_LT((*a - expected).norm(), 1e-14);
  }
  EXPECT_GT(behind, 300);
  EXPECT_NEAR(lens->maxThetaRad(), std::acos(-1.0 / d[0]), 1e-12);
  // xi = 0 is plumb_bob.
  EXPECT_EQ(*makeLens("omni", {0.0, -0.3, 0.1, 0.001, 0.002})->project({0.3, 0.2, 1.0}),
            *makeLens("plumb_bob", {-0.3, 0.1, 0.001, 0.002})->project({0.3, 0.2, 1.0}));
}

#ifdef SLF_TEST_CCALIB
TEST(Lenses, OmniMatchesOpencv) {
  const auto lens = makeLens("omni", kKitti360);
  std::mt19937 random(9);
  std::vector<cv::Point3d> points;
  std::vector<Eigen::Vector2d> ours;
  while (points.size() < 5000) {
    const Eigen::Vector3d p = 4.0 * randomDirection(&random);
    const auto a = lens->project(p);
    if (!a) continue;
    points.emplace_back(p.x(), p.y(), p.z());
    ours.push_back(*a);
  }
  std::vector<cv::Point2d> expected;
  const cv::Mat d =
      (cv::Mat_<double>(1, 4) << kKitti360[1], kKitti360[2], kKitti360[3], kKitti360[4]);
  cv::omnidir::projectPoints(points, expected, cv::Vec3d(0, 0, 0), cv::Vec3d(0, 0, 0),
                             cv::Matx33d::eye(), kKitti360[0], d);
  for (std::size_t i = 0; i < points.size(); ++i) {
    ASSERT_NEAR(ours[i].x(), expected[i].x, 1e-9);
    ASSERT_NEAR(ours[i].y(), expected[i].y, 1e-9);
  }
}
#endif

TEST(Lenses, PolynomialsFollowTheirEquations) {
  const auto ftheta = makeLens("ftheta", {0.0, 500.0, 8.0, -40.0});
  const auto ocam = makeLens("ocam", {0.999, 0.002, -0.001, 578.75, 300.0, -20.0, 15.0});
  for (double theta = 0.05; theta < 2.0; theta += 0.05) {
    for (double phi = 0.1; phi < 6.0; phi += 0.7) {
      const double r = 500 * theta + 8 * theta * theta - 40 * theta * theta * theta;
      const auto a = ftheta->project(7.0 * direction(theta, phi));
      if (500 + 16 * theta - 120 * theta * theta > 0) {
        ASSERT_TRUE(a) << theta;
        EXPECT_LT((*a - r * Eigen::Vector2d(std::cos(phi), std::sin(phi))).norm(), 1e-10);
      } else {
        EXPECT_FALSE(a) << theta;
      }
      // world2cam of the toolbox, whose x runs down, y to the right and z backwards.
      const Eigen::Vector3d p = direction(theta, phi);
      const double norm = std::hypot(p.y(), p.x());
      const double t = std::atan(-p.z() / norm);
      const double rho = 578.75 + 300 * t - 20 * t * t + 15 * t * t * t;
      const double row_part = p.y() / norm * rho, column_part = p.x() / norm * rho;
      const double row = row_part * 0.999 + column_part * 0.002;
      const double column = row_part * -0.001 + column_part;
      const auto b = ocam->project(p);
      ASSERT_TRUE(b) << theta;
      EXPECT_LT((*b - Eigen::Vector2d(column, row)).norm(), 1e-10) << theta;
    }
  }
}

// --------------------------------------------------------------------------------- coefficients

TEST(Lenses, ZerosBehindTheLastCoefficientAreLeftOutAndSaid) {
  const std::vector<NamedLens> longer = {{"equidistant", {0.1, 0.01, 0, 0, 0}},
                                         {"plumb_bob", {0.1, 0.01, 0, 0, 0, 0, 0, 0}},
                                         {"rational_polynomial", std::vector<double>(15, 0.0)},
                                         {"omni", {0.5, 0, 0, 0, 0, 0, 0}},
                                         {"double_sphere", {0.1, 0.5, 0, 0}},
                                         {"eucm", {0.5, 1.0, 0}},
                                         {"ucm", {0.5, 0, 0, 0}}};
  for (const NamedLens& one : longer) {
    std::vector<std::string> notes;
    const auto lens = makeLens(one.model, one.d, kPi, &notes);
    ASSERT_EQ(notes.size(), 1u) << nameOf(one);
    EXPECT_NE(notes[0].find(std::to_string(one.d.size()) + " coefficients"), std::string::npos)
        << notes[0];
    NamedLens spoiled = one;
    spoiled.d.back() = 0.1;
    EXPECT_THROW(makeLens(spoiled.model, spoiled.d), DataError) << nameOf(spoiled);
  }
  std::vector<std::string> notes;
  makeLens("equidistant", {0.1, 0, 0, 0}, kPi, &notes);
  makeLens("rational_polynomial", std::vector<double>(14, 0.0), kPi, &notes);
  EXPECT_TRUE(notes.empty()) << notes[0];
}

TEST(Lenses, RefusedCoefficientsNameTheRule) {
  const double nan = std::nan("");
  struct Case {
    NamedLens lens;
    const char* words;
  };
  const std::vector<Case> cases = {
      {{"omni", {-0.1}}, "xi = -0.1: must lie in 0..100"},
      {{"omni", {1.0, 0.1}}, "D.size = 2: must be 5"},
      {{"omni", {nan}}, "D[0] = nan: must be finite"},
      {{"double_sphere", {-1.0, 0.5}}, "xi = -1: must lie above -1"},
      {{"double_sphere", {0.1, 1.5}}, "alpha = 1.5: must lie in 0..1"},
      {{"eucm", {0.5, 0.0}}, "beta = 0: must lie in"},
      {{"ucm", {-0.5}}, "alpha = -0.5"},
      {{"ftheta", {0.0, -100.0}}, "d r / d theta on the axis = -100: must be above 0"},
      {{"ftheta", {1.0}}, "D.size = 1: must be 2 to 40"},
      {{"ftheta", {-500.0, 100.0}}, "r on the axis = -500: must be 0 px"},
      {{"ocam", {0.0, 0.0, 0.0, 100.0, 100.0}}, "c - d e = 0: must be about 1"}};
  for (const Case& one : cases) {
    try {
      makeLens(one.lens.model, one.lens.d);
      ADD_FAILURE() << nameOf(one.lens) << " was accepted";
    } catch (const DataError& error) {
      EXPECT_NE(std::string(error.what()).find(one.words), std::string::npos) << error.what();
    }
  }
}

// ------------------------------------------------------------------- a lens of one's own: a dummy

/// Stereographic: |a| = 2 tan(theta / 2).
class StereographicLens : public Lens {
 public:
  std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& p) const override {
    const double d = p.norm();
    if (!(p.z() > -0.999 * d)) return std::nullopt;
    return p.head<2>() * (2.0 / (d + p.z()));
  }
  std::optional<Eigen::Vector3d> ray(const Eigen::Vector2d& a) const override {
    const double s = a.squaredNorm() / 4.0;
    return Eigen::Vector3d(a.x(), a.y(), 1.0 - s) / (1.0 + s);
  }
  Matrix23d jacobian(const Eigen::Vector3d& p) const override {
    const double d = p.norm(), sum = d + p.z();
    Matrix23d j = -2.0 / (sum * sum) * p.head<2>() * (p / d + Eigen::Vector3d::UnitZ()).transpose();
    j(0, 0) += 2.0 / sum;
    j(1, 1) += 2.0 / sum;
    return j;
  }
  double maxThetaRad() const override { return std::acos(-0.999); }
};

std::unique_ptr<const Lens> makeStereographic(const LensParameters&, double,
                                              std::vector<std::string>*) {
  return std::make_unique<StereographicLens>();
}

TEST(Lenses, AClassAndARowAddALens) {
  std::vector<LensKind> kinds = lensKinds();
  kinds.push_back({"stereographic", {"stereographic"}, true, makeStereographic});
  expectOneToOne(StereographicLens(), 5000, 1, "stereographic");
  expectJacobianOfDifferences(StereographicLens(), 1, "stereographic");

  CameraInfo info;
  info.size = {640, 480};
  info.distortion_model = "stereographic";
  info.k = {200.0, 4.0, 319.5, 0.0, 210.0, 239.5, 0.0, 0.0, 1.0};
  EXPECT_THROW(CameraModel(info, {}), DataError);
  const CameraModel camera(info, {}, kinds);
  const Eigen::Vector3d p = 5.0 * direction(1.8, 0.4);
  const double r = 2.0 * std::tan(0.9);
  const auto pixel = camera.project(p);
  ASSERT_TRUE(pixel);
  EXPECT_NEAR(pixel->x(), 319.5 + 200 * r * std::cos(0.4) + 4.0 * r * std::sin(0.4), 1e-9);
  EXPECT_NEAR(pixel->y(), 239.5 + 210 * r * std::sin(0.4), 1e-9);
  EXPECT_LT(angleBetween(*camera.ray(*pixel), p), 1e-12);
}

}  // namespace
}  // namespace semantic_lidar_fusion

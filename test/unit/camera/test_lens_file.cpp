// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <fstream>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/camera/lens_file.h"
#include "semantic_lidar_fusion/common/error.h"
#include "temporary_folder.h"

namespace semantic_lidar_fusion {
namespace {

const char* const kCamchain = R"(cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.05, 0.02, -0.01, 0.002]
  distortion_model: equidistant
  intrinsics: [460.5, 461.5, 320.25, 240.75]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.25]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: omni
  distortion_coeffs: [-0.2, 0.05, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [1.25, 900.0, 901.0, 321.0, 241.0]
  resolution: [640, 480]
cam2:
  camera_model: ds
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [-0.27, 0.57, 300.0, 301.0, 322.0, 242.0]
  resolution: [640, 480]
cam3:
  camera_model: eucm
  distortion_model: none
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  intrinsics: [0.6, 1.1, 300.0, 301.0, 322.0, 242.0]
  resolution: [640, 480]
cam4:
  camera_model: pinhole
  distortion_model: radtan
  distortion_coeffs: [-0.3, 0.1, 0.001, 0.002]
  intrinsics: [300.0, 301.0, 322.0, 242.0]
  resolution: [640, 480]
)";

/// KITTI-360's own form and published numbers.
const char* const kKitti360File = R"(%YAML:1.0
---
model_type: MEI
camera_name: image_02
image_width: 1400
image_height: 1400
mirror_parameters:
   xi: 2.2134047507854890e+00
distortion_parameters:
   k1: 1.6798235660113681e-02
   k2: 1.6548773243373522e+00
   p1: 4.2223943394772046e-04
   p2: 4.2462134260997584e-04
projection_parameters:
   gamma1: 1.3363220825849971e+03
   gamma2: 1.3357883350012958e+03
   u0: 7.1694323510126321e+02
   v0: 7.0576498308221585e+02
)";

const char* const kOcam = R"(model: ocam
resolution: [1280, 800]
centre: [640.5, 399.25]
coefficients: [0.999, 0.0002, -0.0001, 536.85, 300.0, -20.0, 15.0, 30.0, 10.0, -3.0]
)";

std::string write(const TemporaryFolder& folder, const std::string& name, const std::string& text) {
  const std::string path = folder.path() + "/" + name;
  std::ofstream(path) << text;
  return path;
}

std::string replaced(std::string text, const std::string& from, const std::string& to) {
  text.replace(text.find(from), from.size(), to);
  return text;
}

TEST(LensFile, ReadsKalibrCamchains) {
  const TemporaryFolder folder;
  const std::string path = write(folder, "camchain.yaml", kCamchain);
  struct Expected {
    const char* camera;
    const char* model;
    std::vector<double> coefficients;
    double fx, fy, cx, cy;
  };
  const std::vector<Expected> all = {
      {"cam0", "equidistant", {-0.05, 0.02, -0.01, 0.002}, 460.5, 461.5, 320.25, 240.75},
      {"cam1", "omni", {1.25, -0.2, 0.05, 0.001, -0.002}, 900.0, 901.0, 321.0, 241.0},
      {"cam2", "double_sphere", {-0.27, 0.57}, 300.0, 301.0, 322.0, 242.0},
      {"cam3", "eucm", {0.6, 1.1}, 300.0, 301.0, 322.0, 242.0},
      {"cam4", "plumb_bob", {-0.3, 0.1, 0.001, 0.002}, 300.0, 301.0, 322.0, 242.0}};
  for (const Expected& expected : all) {
    const LensCalibration lens = loadLens(path, expected.camera);
    EXPECT_EQ(lens.lens.model, expected.model);
    EXPECT_EQ(lens.lens.coefficients, expected.coefficients) << expected.camera;
    EXPECT_EQ(lens.fx, expected.fx);
    EXPECT_EQ(lens.fy, expected.fy);
    EXPECT_EQ(lens.cx, expected.cx);
    EXPECT_EQ(lens.cy, expected.cy);
    EXPECT_EQ(lens.size, (ImageSize{640, 480}));
  }
  EXPECT_TRUE(loadLens(path, "cam0").T_camera_body->isApprox(Transform::Identity()));
  const auto T_cam1_body = loadLens(path, "cam1").T_camera_body;
  ASSERT_TRUE(T_cam1_body);
  EXPECT_EQ(T_cam1_body->translation().x(), -0.25);
  EXPECT_FALSE(loadLens(path, "cam2").T_camera_body);
}

TEST(LensFile, ReadsKitti360AndItsPublishedLens) {
  const TemporaryFolder folder;
  const LensCalibration lens = loadLens(write(folder, "image_02.yaml", kKitti360File), "");
  EXPECT_EQ(lens.size, (ImageSize{1400, 1400}));
  CameraModelOptions options;
  options.lens = std::make_shared<const LensCalibration>(lens);
  const CameraModel camera(CameraInfo(), options);
  EXPECT_EQ(camera.imageSize(), (ImageSize{1400, 1400}));
  // Straight ahead is the centre; a paraxial step moves by gamma / (1 + xi).
  EXPECT_EQ(*camera.project({0, 0, 3}),
            Eigen::Vector2d(7.1694323510126321e+02, 7.0576498308221585e+02));
  EXPECT_NEAR(camera.axialFocalX(), 1336.3220825849971 / 3.2134047507854890, 1e-9);
  // 90 deg to the right, from the equations by hand: q = (1, 0, 0), x = 1 / xi, s = x^2.
  const double x = 1.0 / 2.2134047507854890, s = x * x;
  const double radial = 1 + 1.6798235660113681e-02 * s + 1.6548773243373522 * s * s;
  const auto side = camera.project({2, 0, 0});
  ASSERT_TRUE(side);
  EXPECT_NEAR(
      side->x(),
      1336.3220825849971 * (x * radial + 4.2462134260997584e-04 * 3 * s) + 716.94323510126321,
      1e-9);
  EXPECT_NEAR(side->y(), 1335.7883350012958 * 4.2223943394772046e-04 * s + 705.76498308221585,
              1e-9);
}

TEST(LensFile, ReadsThePackagesOwnForm) {
  const TemporaryFolder folder;
  const LensCalibration ocam = loadLens(write(folder, "ocam.yaml", kOcam), "");
  EXPECT_EQ(ocam.lens.model, "ocam");
  EXPECT_EQ(ocam.lens.coefficients.size(), 10u);
  EXPECT_EQ(ocam.fx, 1.0);
  EXPECT_EQ(ocam.cx, 640.5);
  const LensCalibration skewed = loadLens(
      write(
          folder, "skewed.yaml",
          "{model: equidistant, resolution: [1920, 1208], focal: [1166, 1167], centre: [960, 604],"
          " skew: 0.01, coefficients: [0.1, 0, 0, 0, 0]}"),
      "");
  CameraModelOptions options;
  options.lens = std::make_shared<const LensCalibration>(skewed);
  const CameraModel camera(CameraInfo(), options);
  EXPECT_DOUBLE_EQ(camera.skew(), 0.01);
  EXPECT_EQ(camera.fy(), 1167.0);
  ASSERT_EQ(camera.notes().size(), 1u);
  EXPECT_NE(camera.notes()[0].find("skewed.yaml: D holds 5"), std::string::npos)
      << camera.notes()[0];
}

TEST(LensFile, CameraInfoGivesSizeBinningAndRegionOnly) {
  const TemporaryFolder folder;
  CameraModelOptions options;
  options.lens = std::make_shared<const LensCalibration>(
      loadLens(write(folder, "camchain.yaml", kCamchain), "cam1"));
  const CameraModel plain(CameraInfo(), options);
  CameraInfo info;
  info.frame_id = "front";
  info.size = {640, 480};
  info.distortion_model = "whatever";
  info.d = {1, 2, 3};
  info.k = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  info.binning_x = 2, info.binning_y = 4;
  info.roi_x = 40, info.roi_y = 80, info.roi_width = 400, info.roi_height = 200;
  const CameraModel reduced(info, options);
  EXPECT_EQ(reduced.imageSize(), (ImageSize{200, 50}));
  const Eigen::Vector3d p(0.3, -0.2, 0.9);
  EXPECT_NEAR(reduced.project(p)->x(), (plain.project(p)->x() - 40) / 2, 1e-9);
  EXPECT_NEAR(reduced.project(p)->y(), (plain.project(p)->y() - 80) / 4, 1e-9);
  info.size = {1280, 960};
  try {
    const CameraModel other(info, options);
    ADD_FAILURE() << "a calibration of another resolution was accepted";
  } catch (const DataError& error) {
    EXPECT_NE(
        std::string(error.what()).find("1280x960: must be the resolution 640x480 of the lens cam1"),
        std::string::npos)
        << error.what();
  }
}

TEST(LensFile, EveryProblemIsNamed) {
  const TemporaryFolder folder;
  struct Case {
    std::string text, camera, words;
  };
  const std::vector<Case> cases = {
      {kCamchain, "", "must be one of cam0, cam1, cam2, cam3, cam4"},
      {kCamchain, "cam9", "camera = 'cam9'"},
      {replaced(kCamchain, "equidistant", "fov"), "cam0", "cam0.distortion_model = fov"},
      {replaced(kCamchain, "[460.5, 461.5, 320.25, 240.75]", "[460.5, 461.5]"), "cam0",
       "cam0.intrinsics = (a list of 2): must hold 4 numbers (fu fv pu pv)"},
      {replaced(kCamchain, "460.5", "-460.5"), "cam0", "fx = -460.5: must be above 0"},
      {replaced(kCamchain, "-0.05, 0.02", "-0.05, abc"), "cam0", "cam0.distortion_coeffs"},
      {replaced(kCamchain, "[640, 480]", "[640.5, 480]"), "cam0", "whole numbers of pixels"},
      {replaced(kCamchain, "cam_overlaps", "cam_overlap"), "cam0", "cam_overlap"},
      {replaced(kCamchain, "[1.0, 0.0, 0.0, -0.25]", "[2.0, 0.0, 0.0, -0.25]"), "cam1",
       "cam1.T_cn_cnm1"},
      {replaced(kCamchain, "[1.25,", "[-1.25,"), "cam1", "xi = -1.25: must lie in 0..100"},
      {replaced(kKitti360File, "MEI", "SCARAMUZZA"), "", "model_type = SCARAMUZZA: must be MEI"},
      {replaced(kKitti360File, "   k2: 1.6548773243373522e+00\n", ""), "",
       "distortion_parameters.k2 = (missing): must be given"},
      {kKitti360File, "image_03", "camera_name = image_02: must be the camera 'image_03'"},
      {replaced(kOcam, "ocam", "ocamm"), "", "model = ocamm: must be one of pinhole"},
      {replaced(kOcam, "coefficients", "coefficient"), "", "coefficient"},
      {kOcam, "front", "must be left out"},
      {"a: 1", "", "must be a Kalibr camchain"},
      {"[1, 2]", "", "must be a Kalibr camchain"}};
  for (const Case& one : cases) {
    const std::string path = write(folder, "lens.yaml", one.text);
    try {
      loadLens(path, one.camera);
      ADD_FAILURE() << "accepted, where this was expected: " << one.words;
    } catch (const ConfigError& error) {
      EXPECT_NE(std::string(error.what()).find(one.words), std::string::npos) << error.what();
      EXPECT_NE(std::string(error.what()).find(path), std::string::npos) << error.what();
    }
  }
  EXPECT_THROW(loadLens(folder.path() + "/absent.yaml", ""), ConfigError);
}

TEST(LensFile, AMountingThatTfContradictsIsSaid) {
  const TemporaryFolder folder;
  const std::string path = write(folder, "camchain.yaml", kCamchain);
  const auto lens = [&](const char* camera) {
    return std::make_shared<const LensCalibration>(loadLens(path, camera));
  };
  Transform T_left_lidar = Transform::Identity();
  T_left_lidar.translation() = Eigen::Vector3d(1.0, 2.0, 3.0);
  T_left_lidar.linear() = Eigen::AngleAxisd(0.7, Eigen::Vector3d(1, 2, 3).normalized()).matrix();
  const Transform T_right_left = *lens("cam1")->T_camera_body;
  const auto said = [&](const Transform& error) {
    return mountingContradictions({{"left", lens("cam0"), T_left_lidar},
                                   {"right", lens("cam1"), error * T_right_left * T_left_lidar},
                                   {"other", nullptr, Transform::Identity()},
                                   {"unknown", lens("cam2"), Transform::Identity()}});
  };
  EXPECT_TRUE(said(Transform::Identity()).empty());
  Transform off = Transform::Identity();
  off.translation().y() = 0.04;  // below what counts
  EXPECT_TRUE(said(off).empty());
  off.translation().y() = 0.06;
  ASSERT_EQ(said(off).size(), 1u);
  EXPECT_NE(said(off)[0].find("camera right: " + path), std::string::npos) << said(off)[0];
  EXPECT_NE(said(off)[0].find("0.06 m"), std::string::npos) << said(off)[0];
  off = Transform::Identity();
  off.linear() = Eigen::AngleAxisd(2.0 * M_PI / 180.0, Eigen::Vector3d::UnitX()).matrix();
  ASSERT_EQ(said(off).size(), 1u);
  EXPECT_NE(said(off)[0].find("2 deg"), std::string::npos) << said(off)[0];
}

}  // namespace
}  // namespace semantic_lidar_fusion

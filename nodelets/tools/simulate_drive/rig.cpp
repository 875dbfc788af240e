// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/rig.h"

#include <cmath>

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

struct Mount {
  const char* name;
  const char* frame;
  double x, y, yaw_deg;
};
constexpr Mount kMounts[] = {{"A0", "gmsl_centre_link", 1.45, 0.0, 0.0},
                             {"A1", "gmsl_left_link", 1.40, 0.25, 55.0},
                             {"A2", "gmsl_right_link", 1.40, -0.25, -55.0},
                             {"B0", "gmsl_left_side_link", 0.95, 0.55, 110.0},
                             {"B1", "gmsl_right_side_link", 0.95, -0.55, -110.0}};
constexpr double kLidarX = 1.2, kLidarZ = 1.37, kLidarPitchDeg = 7.0;

/// The paper's kind of fisheye.
CameraInfo fisheyeInfo(double scale) {
  CameraInfo info;
  info.size = {static_cast<int>(std::lround(scale * kFullWidth)),
               static_cast<int>(std::lround(scale * kFullHeight))};
  info.distortion_model = "equidistant";
  info.d = {-0.070, -0.008, 0.004, -0.0015};
  const double fx = 1166.0 * scale, fy = 1165.2 * scale;
  const double cx = 961.3 * scale - 0.5, cy = 602.6 * scale - 0.5;
  info.k = {fx, 0, cx, 0, fy, cy, 0, 0, 1};
  info.r = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  info.p = {fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0};
  return info;
}

/// What a driver can say of a lens from a file: where camera_info has no name for it, a reader
/// that does not know the file refuses it.
CameraInfo infoOf(const LensCalibration& lens) {
  CameraInfo info;
  info.size = lens.size;
  info.distortion_model = lens.lens.model == "pinhole" ? "" : lens.lens.model;
  info.d = lens.lens.coefficients;
  info.k = {lens.fx, lens.fx * lens.skew, lens.cx, 0, lens.fy, lens.cy, 0, 0, 1};
  info.r = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  info.p = {lens.fx, 0, lens.cx, 0, 0, lens.fy, lens.cy, 0, 0, 0, 1, 0};
  return info;
}

Camera realCamera(const CameraInfo& said, const Optics& optics, const Transform& T_base_said,
                  std::size_t camera, const DrawnErrors& errors) {
  const Intrinsics real =
      errors.real({said.k[0], said.k[4], said.k[2], said.k[5]}, camera, optics.imageScale());
  CameraInfo info = said;
  info.k[0] = real.fx;
  info.k[4] = real.fy;
  info.k[2] = real.cx;
  info.k[5] = real.cy;
  std::shared_ptr<LensCalibration> lens;
  if (optics.lens) {
    lens = std::make_shared<LensCalibration>(*optics.lens);
    lens->fx = real.fx;
    lens->fy = real.fy;
    lens->cx = real.cx;
    lens->cy = real.cy;
  }
  return Camera(info, lens, T_base_said * errors.ofPose(camera));
}

}  // namespace

Transform lidarPose() {
  Transform T = Transform::Identity();
  T.translation() = Eigen::Vector3d(kLidarX, 0.0, kLidarZ);
  T.linear() =
      Eigen::AngleAxisd(kLidarPitchDeg * kRadPerDeg, Eigen::Vector3d::UnitY()).toRotationMatrix();
  return T;
}

std::vector<MountedCamera> makeCameras(const Optics& optics, double drop_m,
                                       const DrawnErrors& errors) {
  Eigen::Matrix3d R_body_optical;
  R_body_optical << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  std::vector<MountedCamera> cameras;
  for (const Mount& mount : kMounts) {
    CameraInfo info = optics.lens ? infoOf(*optics.lens) : fisheyeInfo(optics.scale);
    info.frame_id = mount.frame;
    Transform T = Transform::Identity();
    T.translation() = Eigen::Vector3d(mount.x, mount.y, kLidarZ - drop_m);
    T.linear() =
        Eigen::AngleAxisd(mount.yaw_deg * kRadPerDeg, Eigen::Vector3d::UnitZ()).toRotationMatrix() *
        R_body_optical;
    cameras.push_back({mount.name, info, T, Camera(info, optics.lens, T),
                       realCamera(info, optics, T, cameras.size(), errors)});
  }
  return cameras;
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

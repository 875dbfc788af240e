// SPDX-License-Identifier: MIT
/// Mode `adaptive` on a whole turn of a VLP-16 in a street of boxes: the beam grid once a scan, the
/// masks once a camera (full-size and half-size images).
#include <benchmark/benchmark.h>

#include <random>

#include "ray_scene.h"
#include "semantic_lidar_fusion/projection/cloud_projector.h"
#include "semantic_lidar_fusion/projection/occlusion_mask.h"

namespace semantic_lidar_fusion {
namespace {

Cloud streetCloud() {
  RayScene scene;
  scene.addGround(-1.9);
  scene.addPanel(-50.0, 9.0, 80.0, 9.0, -1.9, 9.0);
  scene.addPanel(-50.0, -10.0, 80.0, -10.0, -1.9, 9.0);
  scene.addPanel(60.0, -30.0, 60.0, 30.0, -1.9, 12.0);
  scene.addPanel(-40.0, -30.0, -40.0, 30.0, -1.9, 12.0);
  std::mt19937 random(4);
  std::uniform_real_distribution<double> along(-30.0, 35.0), across(3.0, 7.0);
  for (int i = 0; i < 12; ++i) {
    const double side = i % 2 == 0 ? 1.0 : -1.0;
    scene.addBox({along(random), side * across(random), -1.1}, {4.3, 1.8, 1.5}, 0.0);
    scene.addPole(along(random), side * across(random), 0.08, -1.9, 3.0);
  }
  return scanScene(scene, Transform::Identity(), LidarPattern::vlp16(0.2), 4).cloud;
}

const Cloud& street() {
  static const Cloud cloud = streetCloud();
  return cloud;
}

void grid(benchmark::State& state) {
  const OcclusionConfig config;
  for (auto _ : state) benchmark::DoNotOptimize(beamGrid(street(), config));
  state.counters["points"] = static_cast<double>(street().size());
}
BENCHMARK(grid)->Name("occlusion/grid")->Unit(benchmark::kMicrosecond);

/// Argument: width of the images.
void masks(benchmark::State& state) {
  const int width = static_cast<int>(state.range(0));
  const double scale = width / 1920.0;
  CameraInfo info;
  info.size = {width, static_cast<int>(1208 * scale)};
  info.distortion_model = "equidistant";
  info.d = {-0.0557, 0.0173, -0.0019, 0.00007};
  info.k = {1166.0 * scale, 0.0, 959.5 * scale, 0.0, 1166.0 * scale, 603.5 * scale, 0.0, 0.0, 1.0};
  const CameraModel camera(info, {});
  Transform T_lidar_camera = Transform::Identity();
  T_lidar_camera.linear() << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  T_lidar_camera.translation() = Eigen::Vector3d(0.3, 0.3, -0.5);
  const Transform T_camera_lidar = T_lidar_camera.inverse();
  const OcclusionConfig config;
  const BeamGrid grid = beamGrid(street(), config);
  const ProjectedPoints points =
      projectCloud(street(), T_camera_lidar, camera, castMarginPx(camera, grid, config));
  for (auto _ : state) {
    benchmark::DoNotOptimize(visiblePoints(street(), points, T_camera_lidar, camera, grid, config));
  }
  state.counters["points"] = static_cast<double>(points.size());
}
BENCHMARK(masks)->Name("occlusion/masks")->Arg(960)->Arg(1920)->Unit(benchmark::kMicrosecond);

}  // namespace
}  // namespace semantic_lidar_fusion

BENCHMARK_MAIN();

// SPDX-License-Identifier: MIT
// sensor_msgs/CameraInfo to a camera model, and what the model says of points and pixels.
#include "edge/conversions.h"
#include "fuzz_target.h"
#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace fuzz {
namespace {

const char* const kModels[] = {"",           "equidistant",         "fisheye",
                               "plumb_bob",  "rational_polynomial", "pinhole",
                               "thin_prism", "EQUIDISTANT"};
constexpr unsigned kModelCount = sizeof(kModels) / sizeof(kModels[0]);
constexpr unsigned kMaxCoefficients = 15;

Bytes infoOf(unsigned model, const std::vector<double>& d, unsigned options, unsigned skew) {
  Writer writer;
  writer.byte(options).put(0.0).byte(model).byte(static_cast<unsigned>(d.size()));
  for (const double k : d) writer.put(k);
  writer.put(std::uint32_t{1920}).put(std::uint32_t{1208});
  for (const double k : {1160.0, double(skew), 959.5, 0.0, 1160.0, 603.5, 0.0, 0.0, 1.0}) {
    writer.put(k);
  }
  for (const double r : {1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0}) writer.put(r);
  for (const double p : {1100.0, 0.0, 950.0, -110.0, 0.0, 1100.0, 600.0, 0.0, 0.0, 0.0, 1.0, 0.0}) {
    writer.put(p);
  }
  for (int i = 0; i < 6; ++i) writer.put(std::uint32_t{0});  // binning, roi
  for (const double x : {0.4, -0.2, 1.0, 3.0, 0.1, -0.5, 1e6, 1e6, 1e-3, 0.0, 0.0, 0.0}) {
    writer.put(x);
  }
  return writer.bytes();
}

std::vector<Bytes> seeds() {
  return {Bytes{},
          infoOf(0, {}, 0, 0),
          infoOf(1, {-0.05, 0.01, -0.003, 0.0004}, 0, 2),
          infoOf(2, {-0.05, -0.02, 0.01, -0.003}, 0, 0),
          infoOf(3, {-0.3, 0.1, 0.001, -0.002, -0.01}, 0, 0),
          infoOf(3, {-0.3, 0.1, 0.001, -0.002}, 2, 0),
          infoOf(4, {0.3, 0.1, 0.001, -0.002, 0.01, 0.6, 0.2, 0.02}, 0, 0),
          infoOf(4, {0.3, 0.1, 0.001, -0.002, 0.01, 0.6, 0.2, 0.02, 0, 0, 0, 0}, 1, 0)};
}

void run(const std::uint8_t* data, std::size_t size) {
  Reader reader(data, size);
  const unsigned flags = reader.take<std::uint8_t>();
  CameraModelOptions options;
  options.rectified = flags & 1u;
  options.max_theta_deg = reader.take<double>();
  sensor_msgs::CameraInfo message;
  message.header.frame_id = "camera";
  message.distortion_model = kModels[reader.choice(kModelCount)];
  message.D.resize(reader.choice(kMaxCoefficients + 1));
  for (double& value : message.D) value = reader.take<double>();
  message.width = reader.take<std::uint32_t>();
  message.height = reader.take<std::uint32_t>();
  for (double& value : message.K) value = reader.take<double>();
  for (double& value : message.R) value = reader.take<double>();
  for (double& value : message.P) value = reader.take<double>();
  message.binning_x = reader.take<std::uint32_t>();
  message.binning_y = reader.take<std::uint32_t>();
  message.roi.x_offset = reader.take<std::uint32_t>();
  message.roi.y_offset = reader.take<std::uint32_t>();
  message.roi.width = reader.take<std::uint32_t>();
  message.roi.height = reader.take<std::uint32_t>();
  if (flags & 2u) {  // the identity is what random bytes never make
    message.R = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    options.max_theta_deg = 0;
  }

  std::shared_ptr<const CameraModel> model;
  try {
    model = std::make_shared<const CameraModel>(cameraInfo(message), options);
  } catch (const DataError& error) {
    expectMessage(error);
    return;
  }
  const ImageSize image = model->imageSize();
  expect(image.width >= 1 && image.height >= 1, "an image has pixels");
  expect(std::isfinite(model->fx()) && model->fx() > 0 && std::isfinite(model->fy()) &&
             model->fy() > 0 && std::isfinite(model->cx()) && std::isfinite(model->cy()) &&
             std::isfinite(model->skew()),
         "intrinsics are finite");
  expect(model->maxThetaRad() >= 0 && model->maxThetaRad() <= 3.1416, "the limit is an angle");
  std::vector<Eigen::Vector3d> points = {{0, 0, 0},  {0, 0, 1},     {0, 0, -1},        {1, 1, 0},
                                         {-2, 3, 4}, {5, -1, -0.1}, {1e30, 1e30, 1e30}};
  for (int i = 0; i < 4; ++i) {
    Eigen::Vector3d point;
    for (int axis = 0; axis < 3; ++axis) point[axis] = reader.take<double>();
    points.push_back(point);
  }
  for (const Eigen::Vector3d& point : points) {
    const auto pixel = model->project(point);
    if (!pixel) continue;
    expect(pixel->allFinite(), "pixels are finite");
    expect(point.allFinite(), "only finite points have a pixel");
    expect(model->theta(point) <= model->maxThetaRad() + 1e-9,
           "points beyond the valid angle have no pixel");
    if (const auto ray = model->ray(*pixel)) {
      expect(ray->allFinite() && std::abs(ray->norm() - 1.0) < 1e-6, "rays are unit vectors");
    }
  }
  for (const double u : {-0.5, 0.0, 0.5 * image.width, 1.0 * image.width}) {
    for (const double v : {-0.5, 0.25 * image.height, 1.0 * image.height}) {
      const auto ray = model->ray({u, v});
      if (!ray) continue;
      expect(ray->allFinite() && std::abs(ray->norm() - 1.0) < 1e-6, "rays are unit vectors");
    }
  }
}

const char* const kWords[] = {nullptr};
const Registration kRegistered({"camera_info", seeds, run, kWords});

}  // namespace
}  // namespace fuzz
}  // namespace semantic_lidar_fusion

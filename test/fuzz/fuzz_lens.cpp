// SPDX-License-Identifier: MIT
// Lens files as texts, and lenses of arbitrary coefficients: what is accepted keeps every promise
// of a lens.
#include "fuzz_target.h"
#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/camera/lens_file.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"

namespace semantic_lidar_fusion {
namespace fuzz {
namespace {

enum Kind : unsigned { kCoefficients, kFile, kKinds };
constexpr unsigned kMaxCoefficients = 20;

Bytes coefficientsSeed(unsigned model, double max_theta_rad, const std::vector<double>& d) {
  Writer writer;
  writer.byte(kCoefficients).byte(model).put(max_theta_rad).byte(static_cast<unsigned>(d.size()));
  for (const double k : d) writer.put(k);
  for (const double x : {0.4, -0.2, 1.0, 3.0, 0.1, -0.5, 1e6, 1e6, 1e-3}) writer.put(x);
  return writer.bytes();
}

Bytes fileSeed(const std::string& text) { return Writer().byte(kFile).text(text).bytes(); }

std::vector<Bytes> seeds() {
  return {Bytes{},
          coefficientsSeed(1, 3.0, {-0.3, 0.1, 0.001, -0.002, -0.01}),
          coefficientsSeed(4, 3.0, {2.2, 0.0168, 1.65, 0.0004, 0.0004}),
          coefficientsSeed(5, 3.0, {-0.27, 0.57}),
          coefficientsSeed(6, 3.0, {0.6, 1.1}),
          coefficientsSeed(7, 3.0, {0.6}),
          coefficientsSeed(8, 3.0, {1, 0, 0, 396.1, 300, -20, 15, 30}),
          coefficientsSeed(9, 3.0, {0, 1000, 10, -50, 5}),
          fileSeed("cam0:\n  camera_model: omni\n  intrinsics: [1.2, 900, 901, 320, 240]\n"
                   "  distortion_model: radtan\n  distortion_coeffs: [-0.2, 0.1, 0, 0]\n"
                   "  resolution: [640, 480]\n"
                   "  T_cam_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"),
          fileSeed("model_type: MEI\ncamera_name: c\nimage_width: 64\nimage_height: 48\n"
                   "mirror_parameters: {xi: 2.2}\n"
                   "distortion_parameters: {k1: 0.1, k2: 0.1, p1: 0, p2: 0}\n"
                   "projection_parameters: {gamma1: 90, gamma2: 90, u0: 32, v0: 24}\n"),
          fileSeed("{model: ocam, resolution: [64, 48], centre: [32, 24], "
                   "coefficients: [1, 0, 0, 57.88, 30, -2, 1.5]}")};
}

void useLens(const Lens& lens, Reader* reader, bool tame) {
  expect(lens.maxThetaRad() >= 0 && lens.maxThetaRad() <= 3.1416, "the limit is an angle");
  std::vector<Eigen::Vector3d> points = {{0, 0, 0}, {0, 0, 1},     {0, 0, -1},
                                         {1, 1, 0}, {5, -1, -0.1}, {1e200, 1, 1e-200}};
  for (int i = 0; i < 4; ++i) {
    Eigen::Vector3d point;
    for (int axis = 0; axis < 3; ++axis) point[axis] = reader->take<double>();
    points.push_back(point);
  }
  for (const Eigen::Vector3d& point : points) {
    const auto a = lens.project(point);
    if (!a || !a->allFinite()) continue;
    expect(std::atan2(std::hypot(point.x(), point.y()), point.z()) <= lens.maxThetaRad() + 1e-9,
           "points beyond the valid angle have no place");
    const auto ray = lens.ray(*a);
    if (!tame || point.norm() > 1e6 || point.norm() < 1e-6 || a->norm() > 1e4) continue;
    expect(ray.has_value(), "every place has its ray");
    expect(std::abs(ray->norm() - 1.0) < 1e-6, "rays are unit vectors");
    const auto again = lens.project(*ray);
    // By rounding a ray may come out just beyond the edge.
    expect(!again || (*again - *a).norm() < 1e-5 * (1.0 + a->norm()), "the ray leads back");
  }
}

void run(const std::uint8_t* data, std::size_t size) {
  Reader reader(data, size);
  if (reader.choice(kKinds) == kFile) {
    try {
      CameraModelOptions options;
      options.lens = std::make_shared<const LensCalibration>(
          lensFromYaml(parseYaml(reader.text(reader.left()), "input"), "input", ""));
      const CameraModel camera(CameraInfo(), options);  // what a file's check lets through is used
      expect(camera.imageSize().width >= 1, "an image has pixels");
      if (const auto pixel = camera.project({0.1, 0.1, 1.0})) {
        expect(pixel->allFinite(), "pixels are finite");
      }
    } catch (const ConfigError& error) {
      for (const std::string& problem : error.problems()) {
        expect(!problem.empty() && problem.find('\n') == std::string::npos,
               "a problem is one line");
      }
    }
    return;
  }
  const std::vector<LensKind>& kinds = lensKinds();
  const LensKind& kind = kinds[reader.choice(static_cast<unsigned>(kinds.size()))];
  const double limit = reader.take<double>();
  const double max_theta_rad = limit > 0.01 && limit < 3.14 ? limit : 3.14;
  LensParameters parameters{"input", kind.name, {}};
  parameters.coefficients.resize(reader.choice(kMaxCoefficients + 1));
  bool tame = true;  // coefficients of which single steps of rounding do not add up
  for (double& d : parameters.coefficients) {
    d = reader.take<double>();
    tame = tame && std::abs(d) < 1e3 && (d == 0.0 || std::abs(d) > 1e-6);
  }
  std::vector<std::string> notes;
  std::unique_ptr<const Lens> lens;
  try {
    lens = kind.make(parameters, max_theta_rad, &notes);
  } catch (const DataError& error) {
    expectMessage(error);
    return;
  }
  useLens(*lens, &reader, tame);
}

const char* const kWords[] = {"model: ", "camera_model: ", "ds",   "eucm", "[", "]",    "-1",
                              ".nan",    "1e999",          "omni", "{",    "}", nullptr};
const Registration kRegistered({"lens", seeds, run, kWords});

}  // namespace
}  // namespace fuzz
}  // namespace semantic_lidar_fusion

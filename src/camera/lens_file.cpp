// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/camera/lens_file.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <sstream>

#include "polynomial.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/rotation.h"
#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"

namespace semantic_lidar_fusion {
namespace {

using Problems = std::vector<std::string>;

constexpr NumberRange kFocal{0, 1e6, true};
constexpr NumberRange kCentre{-1e6, 1e6};
constexpr double kContradiction_deg = 1.0;
constexpr double kContradiction_m = 0.05;
/// Transforms are written with fewer digits than a double has.
constexpr double kTransformTolerance = 1e-3;

bool hasKey(const YAML::Node& node, const char* key) {
  return node.IsMap() && const_cast<const YAML::Node&>(node)[key].IsDefined();
}

bool requireKey(YamlSection& section, const std::string& key) {
  if (section.has(key)) return true;
  section.problem(key, "must be given");
  return false;
}

void required(YamlSection& section, const std::string& key, double* value,
              const NumberRange& range = {}) {
  if (requireKey(section, key)) section.number(key, value, range);
}

std::vector<double> requiredList(YamlSection& section, const std::string& key, std::size_t count,
                                 const std::string& meaning, const NumberRange& range = {}) {
  std::vector<double> values;
  if (requireKey(section, key)) {
    section.numbers(key, &values, range);
    if (values.size() != count) {
      section.problem(key, "must hold " + std::to_string(count) + " numbers (" + meaning + ")");
    }
  }
  values.resize(count, 1.0);
  return values;
}

void readSize(YamlSection& section, const std::string& key, ImageSize* size) {
  const auto values =
      requiredList(section, key, 2, "width and height, px", {0, kMaxImageSide, true});
  if (values[0] != std::floor(values[0]) || values[1] != std::floor(values[1])) {
    section.problem(key, "must hold whole numbers of pixels");
  }
  *size = {static_cast<int>(values[0]), static_cast<int>(values[1])};
}

std::optional<Transform> readTransform(YamlSection& section, const std::string& key) {
  const YAML::Node rows = section.get(key);
  if (!rows.IsDefined()) return std::nullopt;
  const auto refused = [&]() -> std::optional<Transform> {
    section.problem(key, "must be a transform of four rows of four numbers");
    return std::nullopt;
  };
  if (!rows.IsSequence() || rows.size() != 4) return refused();
  Transform result;
  for (std::size_t row = 0; row < 4; ++row) {
    if (!rows[row].IsSequence() || rows[row].size() != 4) return refused();
    for (std::size_t column = 0; column < 4; ++column) {
      double value = NAN;
      if (!rows[row][column].IsScalar() ||
          !YAML::convert<double>::decode(rows[row][column], value) || !std::isfinite(value)) {
        return refused();
      }
      result.matrix()(static_cast<int>(row), static_cast<int>(column)) = value;
    }
  }
  if (rotationError(result.linear()) > kTransformTolerance) {
    section.problem(key, "must hold a rotation matrix");
    return std::nullopt;
  }
  return result;
}

// ------------------------------------------------------------------------------ Kalibr's camchain

/// How Kalibr names a lens, and how its intrinsics begin (before fu fv pu pv).
struct KalibrLens {
  const char* camera_model;
  const char* distortion_model;
  const char* lens;
  std::size_t own_intrinsics;
  std::size_t coefficients;
};

constexpr KalibrLens kKalibrLenses[] = {{"pinhole", "none", "pinhole", 0, 0},
                                        {"pinhole", "radtan", "plumb_bob", 0, 4},
                                        {"pinhole", "equidistant", "equidistant", 0, 4},
                                        {"omni", "none", "omni", 1, 0},
                                        {"omni", "radtan", "omni", 1, 4},
                                        {"ds", "none", "double_sphere", 2, 0},
                                        {"eucm", "none", "eucm", 2, 0}};

void readKalibrLens(YamlSection& section, LensCalibration* result) {
  std::string model, distortion = "none";
  if (requireKey(section, "camera_model")) section.text("camera_model", &model);
  section.text("distortion_model", &distortion);
  const auto kind =
      std::find_if(std::begin(kKalibrLenses), std::end(kKalibrLenses), [&](const KalibrLens& one) {
        return one.camera_model == model && one.distortion_model == distortion;
      });
  if (kind == std::end(kKalibrLenses)) {
    section.problem("distortion_model",
                    "with camera_model " + model +
                        " is not known; known are pinhole with none, radtan or equidistant, omni "
                        "with none or radtan, ds and eucm");
    for (const char* key : {"intrinsics", "distortion_coeffs"}) section.get(key);
    return;
  }
  result->lens.model = kind->lens;
  const std::size_t own = kind->own_intrinsics;
  const auto intrinsics = requiredList(section, "intrinsics", own + 4,
                                       std::string(own == 0          ? ""
                                                   : model == "omni" ? "xi "
                                                   : model == "ds"   ? "xi alpha "
                                                                     : "alpha beta ") +
                                           "fu fv pu pv");
  result->lens.coefficients.assign(intrinsics.begin(),
                                   intrinsics.begin() + static_cast<std::ptrdiff_t>(own));
  result->fx = intrinsics[own];
  result->fy = intrinsics[own + 1];
  result->cx = intrinsics[own + 2];
  result->cy = intrinsics[own + 3];
  std::vector<double> bent;
  section.numbers("distortion_coeffs", &bent);
  // Kalibr writes zeros where there is no distortion.
  while (bent.size() > kind->coefficients && bent.back() == 0.0) bent.pop_back();
  if (bent.size() != kind->coefficients) {
    section.problem("distortion_coeffs", "must hold " + std::to_string(kind->coefficients) +
                                             " numbers for " + distortion);
  }
  result->lens.coefficients.insert(result->lens.coefficients.end(), bent.begin(), bent.end());
}

std::vector<std::string> camerasOf(const YAML::Node& root) {
  std::vector<std::string> names;
  for (const auto& item : root) {
    if (item.first.IsScalar() && hasKey(item.second, "camera_model")) {
      names.push_back(item.first.Scalar());
    }
  }
  return names;
}

/// From the body to `camera`, over the cameras before it if need be.
std::optional<Transform> chainTransform(const YAML::Node& root,
                                        const std::vector<std::string>& names, std::size_t camera,
                                        Problems* problems) {
  Problems ignored;  // of other cameras
  Transform T_camera_here = Transform::Identity();
  for (std::size_t i = camera + 1; i-- > 0;) {
    YamlSection section(const_cast<const YAML::Node&>(root)[names[i]], names[i],
                        i == camera ? problems : &ignored);
    const auto T_here_imu = readTransform(section, "T_cam_imu");
    if (T_here_imu) return Transform(T_camera_here * *T_here_imu);
    const auto T_here_before = readTransform(section, "T_cn_cnm1");
    if (i == 0) return T_camera_here;
    if (!T_here_before) return std::nullopt;
    T_camera_here = T_camera_here * *T_here_before;
  }
  return std::nullopt;
}

LensCalibration readCamchain(const YAML::Node& root, const std::string& wanted,
                             Problems* problems) {
  const std::vector<std::string> names = camerasOf(root);
  std::string all;
  for (const std::string& name : names) all += (all.empty() ? "" : ", ") + name;
  std::string camera = wanted;
  if (camera.empty() && names.size() == 1) camera = names.front();
  const auto place = std::find(names.begin(), names.end(), camera);
  LensCalibration result;
  if (place == names.end()) {
    problems->push_back("camera = '" + camera + "': must be one of " + all);
    return result;
  }
  YamlSection section(const_cast<const YAML::Node&>(root)[camera], camera, problems);
  readKalibrLens(section, &result);
  readSize(section, "resolution", &result.size);
  result.T_camera_body =
      chainTransform(root, names, static_cast<std::size_t>(place - names.begin()), problems);
  // What else Kalibr writes, and this package does not need.
  for (const char* key : {"T_cam_imu", "T_cn_cnm1", "cam_overlaps", "rostopic", "timeshift_cam_imu",
                          "T_imu_cam", "line_delay"}) {
    section.get(key);
  }
  section.finish();
  return result;
}

// ----------------------------------------------------------------- camodocal, so also KITTI-360

LensCalibration readCamodocal(const YAML::Node& root, const std::string& wanted,
                              Problems* problems) {
  LensCalibration result;
  YamlSection section(root, "", problems);
  std::string model, name;
  section.text("model_type", &model);
  section.text("camera_name", &name);
  if (!wanted.empty() && wanted != name) {
    section.problem("camera_name", "must be the camera '" + wanted + "' that the rig names");
  }
  double width = 1, height = 1;
  required(section, "image_width", &width, {1, kMaxImageSide});
  required(section, "image_height", &height, {1, kMaxImageSide});
  result.size = {static_cast<int>(width), static_cast<int>(height)};
  YamlSection mirror(section.get("mirror_parameters"), "mirror_parameters", problems);
  YamlSection bent(section.get("distortion_parameters"), "distortion_parameters", problems);
  YamlSection projection(section.get("projection_parameters"), "projection_parameters", problems);
  const auto read = [&](YamlSection& from, std::initializer_list<const char*> keys) {
    for (const char* key : keys) {
      result.lens.coefficients.push_back(0.0);
      required(from, key, &result.lens.coefficients.back());
    }
  };
  std::array<const char*, 4> keys{"fx", "fy", "cx", "cy"};
  if (model == "MEI") {
    result.lens.model = "omni";
    read(mirror, {"xi"});
    read(bent, {"k1", "k2", "p1", "p2"});
    keys = {"gamma1", "gamma2", "u0", "v0"};
  } else if (model == "PINHOLE") {
    result.lens.model = "plumb_bob";
    read(bent, {"k1", "k2", "p1", "p2"});
  } else if (model == "KANNALA_BRANDT") {
    result.lens.model = "equidistant";
    read(projection, {"k2", "k3", "k4", "k5"});
    keys = {"mu", "mv", "u0", "v0"};
  } else {
    section.problem("model_type", "must be MEI, PINHOLE or KANNALA_BRANDT");
    return result;
  }
  required(projection, keys[0], &result.fx);
  required(projection, keys[1], &result.fy);
  required(projection, keys[2], &result.cx);
  required(projection, keys[3], &result.cy);
  for (YamlSection* part : {&mirror, &bent, &projection, &section}) part->finish();
  return result;
}

// --------------------------------------------------------------------------- this package's own

const LensKind* kindNamed(const std::string& name) {
  const auto& kinds = lensKinds();
  const auto kind = std::find_if(kinds.begin(), kinds.end(),
                                 [&](const LensKind& one) { return one.name == name; });
  return kind == kinds.end() ? nullptr : &*kind;
}

LensCalibration readOwn(const YAML::Node& root, const std::string& wanted, Problems* problems) {
  LensCalibration result;
  YamlSection section(root, "", problems);
  section.text("model", &result.lens.model);
  if (kindNamed(result.lens.model) == nullptr) {
    std::string names;
    for (const LensKind& one : lensKinds()) names += (names.empty() ? "" : ", ") + one.name;
    section.problem("model", "must be one of " + names);
    return result;
  }
  if (!wanted.empty()) {
    problems->push_back("camera = '" + wanted +
                        "': must be left out, as the file is of one camera");
  }
  readSize(section, "resolution", &result.size);
  const bool in_px = result.lens.model == "ocam" || result.lens.model == "ftheta";
  if (!in_px) {
    const auto focal = requiredList(section, "focal", 2, "fx and fy, px");
    result.fx = focal[0];
    result.fy = focal[1];
    section.number("skew", &result.skew, {-1, 1});
  }
  const auto centre = requiredList(section, "centre", 2, "cx and cy, px");
  result.cx = centre[0];
  result.cy = centre[1];
  section.numbers("coefficients", &result.lens.coefficients);
  section.finish();
  return result;
}

// ------------------------------------------------------------------------------------------------

void checkRanges(const LensCalibration& lens, Problems* problems) {
  const auto check = [&](const char* key, double value, const NumberRange& range,
                         const char* rule) {
    if (value >= range.least && value <= range.most &&
        !(range.open_least && value == range.least)) {
      return;
    }
    std::ostringstream text;
    text << key << " = " << value << ": must be " << rule;
    problems->push_back(text.str());
  };
  check("fx", lens.fx, kFocal, "above 0 and at most 1e6 px");
  check("fy", lens.fy, kFocal, "above 0 and at most 1e6 px");
  check("cx", lens.cx, kCentre, "within 1e6 px");
  check("cy", lens.cy, kCentre, "within 1e6 px");
}

/// Whether the coefficients make a lens.
void checkLens(const LensCalibration& lens, Problems* problems) {
  LensParameters unnamed = lens.lens;
  unnamed.source = "coefficients";
  try {
    Problems notes;
    kindNamed(lens.lens.model)->make(unnamed, kPi, &notes);
  } catch (const DataError& error) {
    problems->push_back(error.what());
  }
}

std::string degreesAndMetres(double angle_deg, double distance_m) {
  std::ostringstream text;
  text.precision(3);
  text << angle_deg << " deg and " << distance_m << " m";
  return text.str();
}

}  // namespace

LensCalibration lensFromYaml(const YAML::Node& root, const std::string& path,
                             const std::string& camera) {
  Problems problems;
  LensCalibration result;
  if (hasKey(root, "model_type")) {
    result = readCamodocal(root, camera, &problems);
  } else if (hasKey(root, "model")) {
    result = readOwn(root, camera, &problems);
  } else if (root.IsMap() && !camerasOf(root).empty()) {
    result = readCamchain(root, camera, &problems);
  } else {
    problems.push_back(
        "must be a Kalibr camchain (cam0: {camera_model: ...}), a file with "
        "`model_type` (KITTI-360) or one with `model`");
  }
  result.file = path;
  result.lens.source = "lens" + (camera.empty() ? "" : " " + camera) + " of " + path;
  if (problems.empty()) checkRanges(result, &problems);
  if (problems.empty()) checkLens(result, &problems);
  for (std::string& problem : problems) problem = result.lens.source + ": " + problem;
  if (!problems.empty()) throw ConfigError(std::move(problems));
  return result;
}

LensCalibration loadLens(const std::string& path, const std::string& camera) {
  return lensFromYaml(parseYamlFile(path), path, camera);
}

std::vector<std::string> mountingContradictions(const std::vector<MountedLens>& cameras) {
  std::vector<std::string> result;
  std::map<std::string, const MountedLens*> first_of_file;
  for (const MountedLens& camera : cameras) {
    if (!camera.lens || !camera.lens->T_camera_body) continue;
    const MountedLens*& first = first_of_file[camera.lens->file];
    if (first == nullptr) {
      first = &camera;
      continue;
    }
    const Transform by_file =
        *camera.lens->T_camera_body * first->lens->T_camera_body->inverse(Eigen::Isometry);
    const Transform by_tf = camera.T_camera_lidar * first->T_camera_lidar.inverse(Eigen::Isometry);
    const Transform between = by_file * by_tf.inverse(Eigen::Isometry);
    const double angle_deg = Eigen::AngleAxisd(between.linear()).angle() * 180.0 / kPi;
    const double distance_m = (by_file.translation() - by_tf.translation()).norm();
    if (angle_deg <= kContradiction_deg && distance_m <= kContradiction_m) continue;
    result.push_back("camera " + camera.camera + ": " + camera.lens->file + " and tf mount it " +
                     degreesAndMetres(angle_deg, distance_m) + " apart, relative to camera " +
                     first->camera + "; tf is used, and one of the two is wrong");
  }
  return result;
}

}  // namespace semantic_lidar_fusion

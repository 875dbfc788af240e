// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/config/rig.h"

#include <algorithm>
#include <cctype>
#include <filesystem>
#include <fstream>
#include <set>
#include <system_error>
#include <utility>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/thread_pool.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"

namespace semantic_lidar_fusion {
namespace {

using Problems = std::vector<std::string>;

/// Offsets may span epochs (GPS and UNIX time differ by 3e8 s), waits may not.
constexpr double kMaxOffset_s = 1e9;
constexpr double kMaxWait_s = 60.0;
constexpr double kMaxTimeDifference_s = 10.0;
constexpr NumberRange kWait{0, kMaxWait_s, true};
constexpr NumberRange kOffset{-kMaxOffset_s, kMaxOffset_s};

bool isLetter(char c) { return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z'); }
bool isWordCharacter(char c) { return isLetter(c) || (c >= '0' && c <= '9') || c == '_'; }

bool isCameraName(const std::string& name) {
  return !name.empty() && name.size() <= 64 && isLetter(name[0]) &&
         std::all_of(name.begin(), name.end(), isWordCharacter);
}

/// A ROS graph name, relative or global.
bool isTopic(const std::string& topic) {
  if (topic.empty() || topic.back() == '/' || topic.find("//") != std::string::npos) return false;
  return (isLetter(topic[0]) || topic[0] == '/') &&
         std::all_of(topic.begin(), topic.end(),
                     [](char c) { return isWordCharacter(c) || c == '/'; });
}

void readTopic(YamlSection& section, const std::string& key, std::string* topic) {
  section.text(key, topic);
  if (!isTopic(*topic)) {
    section.problem(key, "must be a ROS name of letters, digits, _ and / (such as /gmsl/A0)");
  }
}

/// Frame ids carry no leading slash in tf2.
void readFrame(YamlSection& section, const std::string& key, bool required, std::string* frame) {
  section.text(key, frame);
  if (!frame->empty() && frame->front() == '/') frame->erase(0, 1);
  const bool blank = std::any_of(frame->begin(), frame->end(), [](char c) {
    return std::isspace(static_cast<unsigned char>(c)) ||
           std::iscntrl(static_cast<unsigned char>(c));
  });
  if (blank || (required && frame->empty())) {
    section.problem(key, "must be a tf frame, without blanks");
  }
  section.keep(key, YamlTree::text(*frame));
}

std::string resolved(const std::string& path, const std::string& base_directory) {
  return (std::filesystem::path(base_directory) / path).lexically_normal().string();
}

bool isReadableFile(const std::string& path) {
  std::error_code error;
  return std::filesystem::is_regular_file(path, error) && std::ifstream(path).good();
}

std::string unreadable(const std::string& path) {
  return "must be a readable file; '" + path + "' is not";
}

/// Replaces a path by its resolved form; a file that cannot be read is a problem.
void readPath(YamlSection& section, const std::string& key, const std::string& base_directory,
              std::string* path) {
  section.text(key, path);
  if (path->empty()) return;
  *path = resolved(*path, base_directory);
  if (!isReadableFile(*path)) section.problem(key, unreadable(*path));
  // What is kept must hold wherever it is read again.
  std::error_code error;
  const std::filesystem::path absolute = std::filesystem::absolute(*path, error);
  if (!error) section.keep(key, YamlTree::text(absolute.lexically_normal().string()));
}

/// `key`: where `node` stands, "classes" or "classes.file".
LabelSet readClasses(const YAML::Node& node, const std::string& key,
                     const std::string& base_directory, const std::string& source_name,
                     Problems* problems) {
  try {
    if (node.IsScalar()) {
      const std::string path = resolved(node.Scalar(), base_directory);
      if (isReadableFile(path)) return LabelSet::fromFile(path);
      problems->push_back(source_name + ": " + key + " = " + describeValue(node) + ": " +
                          unreadable(path));
      return {};
    }
    if (!node.IsMap() || !const_cast<const YAML::Node&>(node)["file"].IsDefined()) {
      return LabelSet::fromYaml(node, source_name + ": classes");
    }
  } catch (const ConfigError& error) {
    problems->insert(problems->end(), error.problems().begin(), error.problems().end());
    return {};
  }
  Problems own;
  std::string file;
  YamlSection section(node, "classes", &own);
  section.text("file", &file);
  section.finish();
  for (const std::string& problem : own) problems->push_back(source_name + ": " + problem);
  return own.empty()
             ? readClasses(YAML::Node(file), "classes.file", base_directory, source_name, problems)
             : LabelSet();
}

/// The set in place, as the key `classes` takes it.
YamlTree classesTree(const LabelSet& set) {
  const auto names = [&](const std::vector<int>& ids) {
    YamlTree list = YamlTree::list();
    for (const int id : ids) list.add(YamlTree::text(set[id].name));
    return list;
  };
  YamlTree classes = YamlTree::list();
  for (const ClassInfo& info : set.classes()) {
    YamlTree color = YamlTree::list();
    for (const std::uint8_t value : info.color_rgb) color.add(YamlTree::integer(value));
    YamlTree entry = YamlTree::map();
    entry.put("name", YamlTree::text(info.name));
    entry.put("color", std::move(color));
    entry.put("dynamic", YamlTree::boolean(info.dynamic));
    classes.add(std::move(entry));
  }
  YamlTree merge = YamlTree::map();
  for (const MergedClass& merged : set.merged()) merge.put(merged.name, names(merged.members));
  YamlTree evaluation = YamlTree::map();
  evaluation.put("discard", names(set.discarded()));
  evaluation.put("merge", std::move(merge));
  YamlTree tree = YamlTree::map();
  tree.put("classes", std::move(classes));
  tree.put("evaluation", std::move(evaluation));
  return tree;
}

LensFileConfig readLens(YamlSection section, const std::string& base_directory,
                        Problems* problems) {
  LensFileConfig lens;
  const std::size_t before = problems->size();
  readPath(section, "file", base_directory, &lens.file);
  section.text("camera", &lens.camera);
  readFrame(section, "frame", false, &lens.frame);
  section.finish();
  if (lens.file.empty() && !(lens.camera.empty() && lens.frame.empty())) {
    section.problem("file", "must be given with `camera` and `frame`");
  }
  if (lens.file.empty() || problems->size() > before) return lens;
  try {
    lens.calibration = std::make_shared<const LensCalibration>(loadLens(lens.file, lens.camera));
  } catch (const ConfigError& error) {
    problems->insert(problems->end(), error.problems().begin(), error.problems().end());
  }
  return lens;
}

ShutterConfig readShutter(YamlSection section) {
  ShutterConfig shutter;
  section.number("readout_s", &shutter.readout_s, {0, 1});
  section.choice<ShutterDirection>("direction", &shutter.direction,
                                   {{"down", ShutterDirection::kDown},
                                    {"up", ShutterDirection::kUp},
                                    {"right", ShutterDirection::kRight},
                                    {"left", ShutterDirection::kLeft}});
  section.choice<StampRow>(
      "stamp_row", &shutter.stamp_row,
      {{"first", StampRow::kFirst}, {"middle", StampRow::kMiddle}, {"last", StampRow::kLast}});
  section.finish();
  return shutter;
}

RowBand readRows(YamlSection section) {
  RowBand rows;
  section.number("first", &rows.first, {0, 1});
  section.number("last", &rows.last, {0, 1});
  if (!(rows.first < rows.last)) section.problem("last", "must be above `first`");
  section.finish();
  return rows;
}

/// Three numbers of a list, each within the range.
void readTriple(YamlSection* section, const std::string& key, std::array<double, 3>* values,
                double most) {
  std::vector<double> list(values->begin(), values->end());
  if (!section->numbers(key, &list, {-most, most})) return;
  if (list.size() != values->size()) {
    section->problem(key, "must be three numbers, for x, y and z");
    return;
  }
  std::copy(list.begin(), list.end(), values->begin());
}

CameraNudge readNudge(YamlSection section) {
  CameraNudge nudge;
  readTriple(&section, "deg", &nudge.deg, 180.0);
  readTriple(&section, "m", &nudge.m, 10.0);
  section.finish();
  return nudge;
}

/// `count` standard deviations.
void readDeviations(YamlSection& section, const std::string& key, std::size_t count, double most,
                    double* values) {
  std::vector<double> read(values, values + count);
  section.numbers(key, &read, {0, most});
  if (read.size() == count) {
    std::copy(read.begin(), read.end(), values);
  } else if (section.get(key).IsSequence() && section.get(key).size() != count) {
    section.problem(key, "must be a list of " + std::to_string(count) + " numbers");
  }
}

CameraErrors readCameraErrors(YamlSection section, const std::string& base_directory,
                              Problems* problems) {
  CameraErrors errors;
  Vector6d deviations = Vector6d::Zero();  // m, then deg
  YamlSection extrinsics = section.child("extrinsics");
  readDeviations(extrinsics, "deg", 3, 90, deviations.data() + 3);
  readDeviations(extrinsics, "m", 3, 10, deviations.data());
  extrinsics.finish();
  deviations.tail<3>() *= kRadPerDeg;
  errors.extrinsics.diagonal() = deviations.cwiseAbs2();
  std::string runs;
  const std::size_t before = problems->size();
  readPath(section, "extrinsic_runs", base_directory, &runs);
  section.number("intrinsics_px", &errors.intrinsics_px, {0, 1000});
  section.finish();
  if (runs.empty() || problems->size() > before) return errors;
  if (!deviations.isZero(0.0)) {
    section.problem("extrinsic_runs", "must be left out where `extrinsics` is not 0");
    return errors;
  }
  try {
    errors.extrinsics = readCalibrationRuns(runs).covariance;
  } catch (const ConfigError& error) {
    problems->insert(problems->end(), error.problems().begin(), error.problems().end());
  }
  return errors;
}

CameraConfig readCamera(const YAML::Node& node, std::size_t index,
                        const std::string& base_directory, Problems* problems, YamlTree* list) {
  CameraConfig camera;
  std::string path = "cameras[" + std::to_string(index) + "]";
  // A camera's problems are named the way its overrides are.
  if (node.IsMap()) {
    const YAML::Node name = const_cast<const YAML::Node&>(node)["name"];
    if (name.IsDefined() && name.IsScalar() && isCameraName(name.Scalar())) {
      path = "cameras." + name.Scalar();
    }
  }
  YamlSection section(node, path, problems);
  section.text("name", &camera.name);
  if (node.IsMap() && !isCameraName(camera.name)) {
    section.problem("name", "must be a letter, then letters, digits and _ (64 at most)");
  }
  camera.ns = isCameraName(camera.name) ? camera.name : "camera";
  readTopic(section, "namespace", &camera.ns);
  readTopic(section, "image", &camera.image);
  readTopic(section, "camera_info", &camera.camera_info);
  section.choice<CameraInput>("input", &camera.input,
                              {{"scores", CameraInput::kScores},
                               {"labels", CameraInput::kLabels},
                               {"probabilities", CameraInput::kProbabilities}});
  if (camera.input == CameraInput::kLabels) camera.scores = "labels";
  if (camera.input == CameraInput::kProbabilities) camera.scores = "probabilities";
  readTopic(section, "scores", &camera.scores);
  section.choice<ImageTransport>(
      "transport", &camera.transport,
      {{"raw", ImageTransport::kRaw}, {"compressed", ImageTransport::kCompressed}});
  section.boolean("rectified", &camera.rectified);
  readPath(section, "mask", base_directory, &camera.mask);
  section.number("score_scale", &camera.score_format.scale);
  if (camera.score_format.scale == 0) section.problem("score_scale", "must not be 0");
  section.number("score_offset", &camera.score_format.offset);
  section.number("max_theta_deg", &camera.max_theta_deg, {0, 180});
  if (section.has("lidar_rows") && section.get("lidar_rows").IsScalar()) {
    section.choice<bool>("lidar_rows", &camera.finds_lidar_rows, {{"auto", true}});
  } else {
    camera.lidar_rows = readRows(section.child("lidar_rows"));
  }
  camera.lens = readLens(section.child("lens"), base_directory, problems);
  if (camera.lens.calibration && camera.rectified) {
    section.problem("lens", "must be left out where `rectified` is true");
  }
  camera.shutter = readShutter(section.child("shutter"));
  camera.nudge = readNudge(section.child("nudge"));
  section.number("time_offset", &camera.time_offset_s, kOffset);
  section.number("max_time_difference", &camera.max_time_difference_s, {0, kMaxTimeDifference_s});
  section.number("timeout", &camera.timeout_s, kWait);
  section.number("reorder_window", &camera.reorder_window_s, {0, 1});
  camera.errors = readCameraErrors(section.child("errors"), base_directory, problems);
  section.finish();
  list->add(section.resolved());
  return camera;
}

/// The topic of a name below a namespace; a global name stands for itself.
std::string topicBelow(const std::string& ns, const std::string& name) {
  return name[0] == '/' ? name : ns + "/" + name;
}

std::vector<CameraConfig> readCameras(const YAML::Node& node, const std::string& base_directory,
                                      Problems* problems, YamlTree* list) {
  std::vector<CameraConfig> cameras;
  if (!node.IsDefined() || node.IsNull()) return cameras;
  if (!node.IsSequence()) {
    problems->push_back("cameras = " + describeValue(node) + ": must be a list of cameras");
    return cameras;
  }
  if (node.size() > static_cast<std::size_t>(kMaxCameras)) {
    problems->push_back("cameras = " + describeValue(node) + ": must be at most " +
                        std::to_string(kMaxCameras) + " cameras (the bits of the field `cameras`)");
  }
  std::set<std::string> names, topics;
  for (std::size_t i = 0; i < node.size(); ++i) {
    CameraConfig camera = readCamera(node[i], i, base_directory, problems, list);
    const std::string path = "cameras[" + std::to_string(i) + "]";
    if (isCameraName(camera.name)) {
      const std::string topic = topicBelow(camera.ns, camera.image);
      if (!names.insert(camera.name).second) {
        problems->push_back(path + ".name = " + camera.name + ": two cameras have this name");
      } else if (!topics.insert(topic).second) {
        problems->push_back(path + ".image = " + describeValue(YAML::Node(topic)) +
                            ": two cameras have this topic");
      }
    }
    cameras.push_back(std::move(camera));
  }
  return cameras;
}

void readModel(YamlSection& section, const LidarSpec** model) {
  std::string text = "auto";
  section.text("model", &text);
  if (text == "auto") return;
  *model = findLidarSpec(text);
  if (!*model) section.problem("model", "must be one of auto, " + lidarSpecNames());
}

LidarConfig readLidar(YamlSection section, const Problems* problems) {
  LidarConfig lidar;
  section.choice<LidarInput>("input", &lidar.input,
                             {{"packets", LidarInput::kPackets}, {"points", LidarInput::kPoints}});
  lidar.topic = lidar.input == LidarInput::kPackets ? "velodyne_packets" : "points";
  readTopic(section, "topic", &lidar.topic);
  readModel(section, &lidar.model);
  readFrame(section, "frame", false, &lidar.frame);
  section.number("min_range_m", &lidar.min_range_m, {0});
  section.number("max_range_m", &lidar.max_range_m, {0});
  section.number("largest_coordinate_m", &lidar.largest_coordinate_m, {1, 1e9});
  section.number("longest_scan_s", &lidar.longest_scan_s, {0.001, 60});
  if (lidar.max_range_m > 0 && lidar.max_range_m <= lidar.min_range_m) {
    section.problem("max_range_m", "must be above min_range_m, or 0 for no limit");
  }
  section.text("time_field", &lidar.time_field);
  section.choice<TimeUnit>("time_unit", &lidar.time_unit,
                           {{"auto", TimeUnit::kAuto},
                            {"s", TimeUnit::kSeconds},
                            {"ms", TimeUnit::kMilliseconds},
                            {"us", TimeUnit::kMicroseconds},
                            {"ns", TimeUnit::kNanoseconds},
                            {"seconds", TimeUnit::kSeconds},
                            {"milliseconds", TimeUnit::kMilliseconds},
                            {"microseconds", TimeUnit::kMicroseconds},
                            {"nanoseconds", TimeUnit::kNanoseconds}});
  section.choice<TimeReference>("time_reference", &lidar.time_reference,
                                {{"auto", TimeReference::kAuto},
                                 {"stamp", TimeReference::kStamp},
                                 {"absolute", TimeReference::kAbsolute},
                                 {"scan_end", TimeReference::kScanEnd}});
  section.choice<WithoutTime>("without_time", &lidar.without_time,
                              {{"reject", WithoutTime::kReject},
                               {"instant", WithoutTime::kInstant},
                               {"azimuth", WithoutTime::kAzimuth}});
  section.choice<PacketStamp>("packet_stamp", &lidar.packet_stamp,
                              {{"start", PacketStamp::kStart},
                               {"middle", PacketStamp::kMiddle},
                               {"end", PacketStamp::kEnd}});
  section.number("time_offset", &lidar.time_offset_s, kOffset);
  const std::size_t problems_before = problems->size();
  section.numbers("vertical_offsets_m", &lidar.vertical_offsets_m, {-1, 1});
  if (problems->size() == problems_before && !lidar.vertical_offsets_m.empty() && lidar.model &&
      lidar.vertical_offsets_m.size() != static_cast<std::size_t>(lidar.model->laserCount())) {
    section.problem("vertical_offsets_m", "must be empty or hold one number for each of the " +
                                              std::to_string(lidar.model->laserCount()) +
                                              " lasers of the model, lowest first");
  }
  section.finish();
  return lidar;
}

SuperpixelConfig readSuperpixels(YamlSection section) {
  SuperpixelConfig superpixels;
  section.integer("count", &superpixels.count, 1, 10000000);
  section.number("compactness", &superpixels.compactness, {0, 1e6, true});
  section.integer("iterations", &superpixels.iterations, 1, 100);
  section.number("scale", &superpixels.scale, {0, 4});
  section.boolean("warm_start", &superpixels.warm_start);
  section.finish();
  return superpixels;
}

UncertaintyConfig readUncertainty(YamlSection section) {
  UncertaintyConfig uncertainty;
  section.number("temperature", &uncertainty.temperature, {0, 1e6, true});
  section.number("exponent", &uncertainty.exponent, {0, 100});
  section.number("blend", &uncertainty.blend, {0, 1});
  section.finish();
  return uncertainty;
}

void readMotion(YamlSection section, Rig* rig) {
  section.boolean("enabled", &rig->motion_enabled);
  section.choice<MotionGranularity>(
      "granularity", &rig->motion_granularity,
      {{"firing", MotionGranularity::kFiring}, {"packet", MotionGranularity::kPacket}});
  section.finish();
}

OdometryConfig readOdometry(YamlSection section) {
  OdometryConfig odometry;
  section.choice<OdometrySource>("source", &odometry.source,
                                 {{"tf", OdometrySource::kTf}, {"topic", OdometrySource::kTopic}});
  readTopic(section, "topic", &odometry.topic);
  section.number("time_offset", &odometry.time_offset_s, kOffset);
  section.choice<OdometryLookup>(
      "lookup", &odometry.lookup,
      {{"interpolate", OdometryLookup::kInterpolate}, {"closest", OdometryLookup::kClosest}});
  section.choice<OnMissingOdometry>("on_missing", &odometry.on_missing,
                                    {{"mark", OnMissingOdometry::kMark},
                                     {"drop", OnMissingOdometry::kDrop},
                                     {"hold", OnMissingOdometry::kHold},
                                     {"extrapolate", OnMissingOdometry::kExtrapolate}});
  section.number("max_extrapolation", &odometry.max_extrapolation_s, {0, 10});
  section.number("largest_coordinate_m", &odometry.largest_coordinate_m, {1, 1e12});
  section.number("fastest_mps", &odometry.fastest_mps, {0});
  section.number("timeout", &odometry.timeout_s, kWait);
  section.finish();
  return odometry;
}

ReferenceConfig readReference(YamlSection section, const std::vector<CameraConfig>& cameras) {
  ReferenceConfig reference;
  if (!cameras.empty()) reference.camera = cameras.front().name;
  section.choice<ReferenceChoice>("choose", &reference.choose,
                                  {{"closest_image", ReferenceChoice::kClosestImage},
                                   {"scan_start", ReferenceChoice::kScanStart},
                                   {"scan_middle", ReferenceChoice::kScanMiddle},
                                   {"scan_end", ReferenceChoice::kScanEnd}});
  std::string name = reference.camera;
  section.text("camera", &name);
  if (!name.empty()) reference.camera = name;
  section.keep("camera", YamlTree::text(reference.camera));
  std::vector<std::string> names;
  for (const CameraConfig& camera : cameras) names.push_back(camera.name);
  if (section.has("camera") && !name.empty() &&
      std::find(names.begin(), names.end(), name) == names.end()) {
    const std::string nearest = nearestName(name, names);
    section.problem("camera", "must be the name of a camera" +
                                  (nearest.empty() ? "" : "; did you mean '" + nearest + "'?"));
  }
  section.number("timeout", &reference.timeout_s, kWait);
  section.finish();
  return reference;
}

SegmentationConfig readSegmentation(YamlSection section, const std::string& base_directory) {
  SegmentationConfig segmentation;
  readPath(section, "model", base_directory, &segmentation.model);
  section.choice<SegmentationMode>("mode", &segmentation.mode,
                                   {{"on_request", SegmentationMode::kOnRequest},
                                    {"free_running", SegmentationMode::kFreeRunning}});
  // The package's own network waits for selected images; selection would wait for its scores.
  if (segmentation.mode == SegmentationMode::kFreeRunning && !segmentation.model.empty()) {
    section.problem("mode", "must be on_request where `model` is given");
  }
  section.finish();
  return segmentation;
}

OcclusionConfig readOcclusion(YamlSection section) {
  OcclusionConfig occlusion;
  // YAML 1.1 parsers, rosparam's among them, read a plain `off` as false.
  std::vector<std::pair<const char*, const OcclusionMode*>> modes;
  for (const OcclusionMode* mode : occlusionModes()) modes.emplace_back(mode->name, mode);
  modes.emplace_back("false", &OcclusionMode::kOff);
  section.choice<const OcclusionMode*>("mode", &occlusion.mode, modes);
  section.number("vertical_step_deg", &occlusion.vertical_step_deg, {0, 90});
  section.number("horizontal_step_deg", &occlusion.horizontal_step_deg, {0, 90});
  section.number("depth_margin_m", &occlusion.depth_margin_m, {0, 1000});
  section.number("depth_margin_ratio", &occlusion.depth_margin_ratio, {0, 100});
  section.finish();
  return occlusion;
}

RigErrors readErrors(YamlSection section) {
  RigErrors errors;
  YamlSection stamps = section.child("stamps_s");
  stamps.number("lidar", &errors.lidar_stamp_s, {0, 1});
  stamps.number("camera", &errors.camera_stamp_s, {0, 1});
  stamps.finish();
  YamlSection lidar = section.child("lidar");
  lidar.number("range_m", &errors.lidar.range_m, {0, 10});
  readDeviations(lidar, "beam_deg", 2, 10, errors.lidar.beam_deg.data());
  lidar.finish();
  YamlSection motion = section.child("motion");
  readDeviations(motion, "velocity_mps", 3, 100, errors.motion.velocity_mps.data());
  readDeviations(motion, "rate_deg_s", 3, 360, errors.motion.rate_deg_s.data());
  motion.number("correlation_s", &errors.motion.correlation_s, {0, 1e6, true});
  motion.number("scale", &errors.motion.scale, {0, 1});
  motion.finish();
  section.finish();
  return errors;
}

SmoothingConfig readSmoothing(YamlSection section) {
  SmoothingConfig smoothing;
  section.integer("iterations", &smoothing.iterations, 0, SmoothingConfig::kMostIterations);
  section.number("distance_m", &smoothing.distance_m, {0, 100, true});
  section.number("intensity", &smoothing.intensity, {0, 1000});
  section.finish();
  return smoothing;
}

CheckConfig readCheck(YamlSection section) {
  CheckConfig check;
  section.boolean("live", &check.live);
  section.finish();
  return check;
}

Rig readRig(const YAML::Node& root, const std::string& base_directory,
            const std::string& source_name, Problems* problems) {
  Rig rig;
  // Class sets name their own source; the other problems get the rig's.
  Problems own;
  YamlSection section(root, "", &own);
  rig.name = std::filesystem::path(source_name).stem().string();
  section.text("name", &rig.name);

  const YAML::Node classes = section.get("classes");
  YamlTree cameras = YamlTree::list();
  rig.cameras = readCameras(section.get("cameras"), base_directory, &own, &cameras);
  if (classes.IsDefined() && !classes.IsNull()) {
    rig.classes = readClasses(classes, "classes", base_directory, source_name, problems);
  } else if (!rig.cameras.empty()) {
    section.problem("classes", "must be {file: PATH} or a class set where there are cameras");
  }
  section.keep("classes", rig.classes.size() > 0 ? classesTree(rig.classes) : YamlTree());
  section.keep("cameras", std::move(cameras));
  rig.lidar = readLidar(section.child("lidar"), &own);
  for (const CameraConfig& camera : rig.cameras) {
    if (!camera.finds_lidar_rows || (rig.lidar.model && !rig.lidar.frame.empty())) continue;
    own.push_back("cameras." + camera.name +
                  ".lidar_rows = auto: needs the lidar's rings and place; name lidar.model and "
                  "lidar.frame, or the rows {first, last}");
  }
  {
    YamlSection tf = section.child("tf");
    readTopic(tf, "topic", &rig.tf_topic);
    readTopic(tf, "static_topic", &rig.tf_static_topic);
    tf.finish();
  }
  readFrame(section, "fixed_frame", true, &rig.fixed_frame);
  readFrame(section, "vehicle_frame", true, &rig.vehicle_frame);
  rig.superpixels = readSuperpixels(section.child("superpixels"));
  rig.uncertainty = readUncertainty(section.child("uncertainty"));
  readMotion(section.child("motion"), &rig);
  if (rig.motion_enabled && rig.fixed_frame == rig.vehicle_frame) {
    section.problem("vehicle_frame", "must differ from fixed_frame unless motion.enabled is false");
  }
  rig.odometry = readOdometry(section.child("odometry"));
  rig.reference = readReference(section.child("reference"), rig.cameras);
  section.choice<ImageChoice>("image_choice", &rig.image_choice,
                              {{"closest_to_reference", ImageChoice::kClosestToReference},
                               {"closest_to_sweep", ImageChoice::kClosestToSweep}});
  rig.segmentation = readSegmentation(section.child("segmentation"), base_directory);
  rig.occlusion = readOcclusion(section.child("occlusion"));
  rig.errors = readErrors(section.child("errors"));
  section.choice<TransferRule>(
      "transfer", &rig.transfer,
      {{"pixel", TransferRule::kPixel}, {"expected", TransferRule::kExpected}});
  section.choice<OverlapRule>("overlap", &rig.overlap,
                              {{"mean", OverlapRule::kMean},
                               {"product", OverlapRule::kProduct},
                               {"nearest_in_time", OverlapRule::kNearestInTime},
                               {"most_central", OverlapRule::kMostCentral},
                               {"geometric_mean", OverlapRule::kGeometricMean}});
  rig.smoothing = readSmoothing(section.child("smoothing"));
  section.boolean("keep_unlabelled", &rig.keep_unlabelled);
  rig.check = readCheck(section.child("check"));
  section.integer("threads", &rig.threads, 1, ThreadPool::kMaxThreads);
  section.finish();
  for (const std::string& problem : own) problems->push_back(source_name + ": " + problem);
  rig.yaml = section.resolved().toYaml();
  return rig;
}

/// The element of `list` that an override's `segment` means: by its `name`, else by its position.
int elementIndex(const YAML::Node& list, const std::string& segment) {
  for (std::size_t i = 0; i < list.size(); ++i) {
    const YAML::Node element = list[i];
    if (!element.IsMap()) continue;
    const YAML::Node name = const_cast<const YAML::Node&>(element)["name"];
    if (name.IsDefined() && name.IsScalar() && name.Scalar() == segment) return static_cast<int>(i);
  }
  for (std::size_t i = 0; i < list.size(); ++i) {
    if (std::to_string(i) == segment) return static_cast<int>(i);
  }
  return -1;
}

/// What an override's `segment` names within `node`, made if absent from a map; the problem if it
/// can't be.
std::string descend(const std::string& segment, YAML::Node* node) {
  if (node->IsNull()) *node = YAML::Node(YAML::NodeType::Map);
  if (node->IsMap()) {
    if (!const_cast<const YAML::Node&>(*node)[segment].IsDefined()) {
      node->force_insert(segment, YAML::Node(YAML::NodeType::Null));
    }
    node->reset((*node)[segment]);
    return {};
  }
  if (!node->IsSequence()) return "has no keys";
  const int index = elementIndex(*node, segment);
  if (index >= 0) {
    node->reset((*node)[static_cast<std::size_t>(index)]);
    return {};
  }
  std::string names;
  for (std::size_t i = 0; i < node->size(); ++i) {
    const YAML::Node element = (*node)[i];
    if (!element.IsMap() || !const_cast<const YAML::Node&>(element)["name"].IsDefined()) continue;
    names += (names.empty() ? " (" : ", ") + describeValue(element["name"]);
  }
  return "is a list that has no '" + segment + "'" + (names.empty() ? "" : names + ")");
}

void applyOverride(const std::string& text, YAML::Node root) {
  const std::string source = "override '" + describeValue(YAML::Node(text)) + "'";
  const auto fail = [&](const std::string& rule) { throw ConfigError({source + ": " + rule}); };
  const std::size_t equals = text.find('=');
  if (equals == std::string::npos || equals == 0) fail("must be key=value");

  const std::string value_text = text.substr(equals + 1);
  const bool blank = value_text.find_first_not_of(" \t") == std::string::npos;
  const YAML::Node value = blank ? YAML::Node("") : parseYaml(value_text, source);

  std::vector<std::string> segments;
  for (std::size_t begin = 0; begin <= equals;) {
    const std::size_t end = std::min(text.find('.', begin), equals);
    segments.push_back(text.substr(begin, end - begin));
    if (segments.back().empty()) fail("the key has an empty part");
    begin = end + 1;
  }
  YAML::Node node;
  node.reset(root);
  std::string path;
  for (const std::string& segment : segments) {
    const std::string rule = descend(segment, &node);
    if (!rule.empty()) fail((path.empty() ? "the rig" : path) + " " + rule);
    path += (path.empty() ? "" : ".") + segment;
  }
  node = value;
}

}  // namespace

PacketDecoderConfig LidarConfig::packetConfig() const {
  PacketDecoderConfig config;
  config.model = model;
  config.packet_stamp = packet_stamp;
  config.time_offset_ns = toNs(time_offset_s);
  config.min_range_m = min_range_m;
  config.max_range_m = max_range_m;
  config.longest_scan_ns = toNs(longest_scan_s);
  config.vertical_offsets_m = vertical_offsets_m;
  return config;
}

PointCloudReaderConfig LidarConfig::cloudConfig() const {
  PointCloudReaderConfig config;
  config.time_field = time_field;
  config.time_unit = time_unit;
  config.time_reference = time_reference;
  config.without_time = without_time;
  config.time_offset_ns = toNs(time_offset_s);
  config.min_range_m = min_range_m;
  config.max_range_m = max_range_m;
  config.largest_coordinate_m = largest_coordinate_m;
  config.longest_scan_ns = toNs(longest_scan_s);
  return config;
}

Transform CameraNudge::applied(const Transform& T_camera_lidar) const {
  if (*this == CameraNudge{}) return T_camera_lidar;
  const auto about = [this](std::size_t axis) {
    return Eigen::AngleAxisd(deg[axis] * kPi / 180.0,
                             Eigen::Vector3d::Unit(static_cast<Eigen::Index>(axis)));
  };
  Transform T_lidar_camera = T_camera_lidar.inverse(Eigen::Isometry);
  const Eigen::Matrix3d turn = (about(2) * about(1) * about(0)).toRotationMatrix();
  T_lidar_camera.linear() = turn * T_lidar_camera.linear();
  T_lidar_camera.translation() += Eigen::Vector3d(m[0], m[1], m[2]);
  return T_lidar_camera.inverse(Eigen::Isometry);
}

void Rig::retune(const Rig& other) {
  yaml = other.yaml;
  uncertainty = other.uncertainty;
  occlusion = other.occlusion;
  overlap = other.overlap;
  smoothing = other.smoothing;
  threads = other.threads;
  for (std::size_t i = 0; i < cameras.size() && i < other.cameras.size(); ++i) {
    cameras[i].time_offset_s = other.cameras[i].time_offset_s;
    cameras[i].nudge = other.cameras[i].nudge;
  }
}

int Rig::referenceCamera() const {
  for (std::size_t i = 0; i < cameras.size(); ++i) {
    if (cameras[i].name == reference.camera) return static_cast<int>(i);
  }
  return -1;
}

SelectorConfig Rig::selectorConfig() const {
  SelectorConfig config;
  config.choose = reference.choose;
  config.reference_camera = std::max(0, referenceCamera());
  config.reference_timeout_ns = toNs(reference.timeout_s);
  config.image_choice = image_choice;
  StampNs wait_ns = config.reference_timeout_ns;
  StampNs reach_ns = config.reference_timeout_ns;
  for (const CameraConfig& camera : cameras) {
    SelectorCamera selector;
    selector.time_offset_ns = toNs(camera.time_offset_s);
    selector.max_time_difference_ns = toNs(camera.max_time_difference_s);
    selector.timeout_ns = toNs(camera.timeout_s);
    selector.reorder_window_ns = toNs(camera.reorder_window_s);
    wait_ns = std::max(wait_ns, selector.timeout_ns);
    reach_ns = std::max(reach_ns, selector.max_time_difference_ns);
    config.cameras.push_back(selector);
  }
  // A scan that waits the longest still finds its images: t_ref is within reach of the scan and an
  // image within reach of t_ref, to either side.
  config.image_history_ns =
      std::max(config.image_history_ns, wait_ns + 4 * reach_ns + kNsPerSecond);
  return config;
}

CompensationConfig Rig::compensationConfig() const {
  CompensationConfig config;
  config.enabled = motion_enabled;
  config.granularity = motion_granularity;
  config.lookup = odometry.lookup;
  config.on_missing = odometry.on_missing;
  config.max_extrapolation_ns = toNs(odometry.max_extrapolation_s);
  return config;
}

Rig rigFromYaml(const YAML::Node& root, const std::string& base_directory,
                const std::string& source_name, const std::vector<std::string>& overrides) {
  YAML::Node tree = copyTree(root, source_name);
  Problems problems;
  for (const std::string& text : overrides) {
    try {
      applyOverride(text, tree);
    } catch (const ConfigError& error) {
      problems.insert(problems.end(), error.problems().begin(), error.problems().end());
    }
  }
  Rig rig = readRig(tree, base_directory, source_name, &problems);
  if (!problems.empty()) throw ConfigError(std::move(problems));
  return rig;
}

Rig loadRig(const std::string& path, const std::vector<std::string>& overrides) {
  return rigFromYaml(parseYamlFile(path), std::filesystem::path(path).parent_path().string(), path,
                     overrides);
}

}  // namespace semantic_lidar_fusion

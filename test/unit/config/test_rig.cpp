// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <filesystem>
#include <fstream>
#include <functional>
#include <random>
#include <sstream>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "temporary_folder.h"

namespace semantic_lidar_fusion {
namespace {

const std::string kConfigFolder = std::string(SLF_SOURCE_DIR) + "/config";

Rig parse(const std::string& text, const std::vector<std::string>& overrides = {}) {
  return rigFromYaml(parseYaml(text, "rig.yaml"), kConfigFolder, "rig.yaml", overrides);
}

std::vector<std::string> problemsOf(const std::string& text,
                                    const std::vector<std::string>& overrides = {}) {
  try {
    parse(text, overrides);
  } catch (const ConfigError& error) {
    return error.problems();
  }
  return {};
}

/// The one problem of a text that has one.
std::string problemOf(const std::string& text, const std::vector<std::string>& overrides = {}) {
  const std::vector<std::string> problems = problemsOf(text, overrides);
  EXPECT_EQ(problems.size(), 1u) << text
                                 << (problems.empty() ? "" : "\n" + problems[1 % problems.size()]);
  return problems.empty() ? "(no problem)" : problems[0];
}

/// A rig of two cameras, to which a test adds its own lines.
const std::string kTwoCameras = R"(
classes: classes_usyd12.yaml
cameras:
  - {name: left, image: image_raw}
  - {name: right, namespace: /rig/right, timeout: 0.4, max_time_difference: 0.02, time_offset: -0.01}
)";

TEST(RigTest, EmptyRigHasTheDefaultsOfTheStructs) {
  const Rig rig = parse("");
  EXPECT_EQ(rig.name, "rig");
  EXPECT_TRUE(rig.cameras.empty());
  EXPECT_EQ(rig.referenceCamera(), -1);
  EXPECT_EQ(rig.lidar.topic, "velodyne_packets");
  EXPECT_EQ(rig.fixed_frame, "odom");
  EXPECT_EQ(rig.vehicle_frame, "base_link");
  EXPECT_EQ(rig.superpixels.count, 1000);
  EXPECT_EQ(rig.superpixels.compactness, 10.0);
  EXPECT_EQ(rig.superpixels.iterations, 10);
  EXPECT_EQ(rig.uncertainty.temperature, 1.0);
  EXPECT_EQ(rig.uncertainty.exponent, 2.0);
  EXPECT_EQ(rig.uncertainty.blend, 0.0);
  EXPECT_EQ(rig.odometry.lookup, OdometryLookup::kInterpolate);
  EXPECT_EQ(rig.odometry.on_missing, OnMissingOdometry::kMark);
  EXPECT_EQ(rig.motion_granularity, MotionGranularity::kFiring);
  EXPECT_EQ(rig.reference.choose, ReferenceChoice::kClosestImage);
  EXPECT_EQ(rig.image_choice, ImageChoice::kClosestToReference);
  EXPECT_EQ(rig.occlusion.mode, &OcclusionMode::kAdaptive);
  EXPECT_EQ(rig.occlusion.depth_margin_m, 0.3);
  EXPECT_EQ(rig.occlusion.depth_margin_ratio, 0.10);
  EXPECT_EQ(rig.lidar.without_time, WithoutTime::kInstant);
  EXPECT_EQ(rig.overlap, OverlapRule::kMean);
  EXPECT_EQ(rig.smoothing.iterations, 0);
  EXPECT_EQ(rig.smoothing.distance_m, 0.6);
  EXPECT_EQ(rig.smoothing.intensity, 20.0);
  EXPECT_TRUE(rig.keep_unlabelled);
  EXPECT_EQ(rig.threads, 1);
  EXPECT_EQ(CameraConfig().max_time_difference_s, 0.05);
}

TEST(RigTest, CameraDefaultsDependOnNameAndInput) {
  const Rig rig = parse(kTwoCameras, {"cameras.right.input=labels"});
  ASSERT_EQ(rig.cameras.size(), 2u);
  EXPECT_EQ(rig.cameras[0].ns, "left");
  EXPECT_EQ(rig.cameras[0].image, "image_raw");
  EXPECT_EQ(rig.cameras[0].scores, "scores");
  EXPECT_EQ(rig.cameras[1].ns, "/rig/right");
  EXPECT_EQ(rig.cameras[1].image, "image");
  EXPECT_EQ(rig.cameras[1].scores, "labels");
  EXPECT_EQ(rig.reference.camera, "left");
  EXPECT_EQ(rig.referenceCamera(), 0);
  EXPECT_EQ(rig.classes.size(), 12);
  EXPECT_EQ(parse("lidar: {input: points}").lidar.topic, "points");
}

TEST(RigTest, ReadsEveryKey) {
  const Rig rig = parse(R"(
name: vehicle
classes: {classes: [{name: road, color: [1, 2, 3]}]}
cameras:
  - {name: c0, namespace: /a/b, image: i, camera_info: ci, scores: s, transport: compressed,
     rectified: true, input: probabilities, mask: usyd.yaml, score_scale: -0.5, score_offset: 3,
     max_theta_deg: 50, lidar_rows: {first: 0.25, last: 0.75}, time_offset: 0.25, max_time_difference: 0, timeout: 1.5,
     reorder_window: 0.1,
     errors: {extrinsics: {deg: [0, 0.5, 1], m: [0.01, 0.02, 0]}, intrinsics_px: 1.5}}
  - {name: c1}
lidar: {input: points, topic: /ouster/points, model: VLP-32C, frame: /os, min_range_m: 1,
        max_range_m: 90, largest_coordinate_m: 500, longest_scan_s: 2, time_field: t, time_unit: us, time_reference: scan_end,
        without_time: azimuth, packet_stamp: middle, time_offset: -18,
        vertical_offsets_m: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
                             0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.01]}
fixed_frame: /map
vehicle_frame: chassis
superpixels: {count: 500, compactness: 2.5, iterations: 4, scale: 0.5, warm_start: false}
uncertainty: {temperature: 1.5, exponent: 0, blend: 0.25}
motion: {enabled: false, granularity: packet}
odometry: {source: topic, topic: /odo, time_offset: 0.01, lookup: closest, on_missing: extrapolate,
           max_extrapolation: 0.05, timeout: 0.3, fastest_mps: 30, largest_coordinate_m: 1e7}
reference: {choose: scan_end, camera: c1, timeout: 0.5}
image_choice: closest_to_sweep
segmentation: {model: usyd.yaml, mode: on_request}
occlusion: {mode: paper, vertical_step_deg: 2, horizontal_step_deg: 0.1, depth_margin_m: 0,
            depth_margin_ratio: 0.2}
errors: {stamps_s: {lidar: 0.001, camera: 0.002}, lidar: {range_m: 0.03, beam_deg: [0.2, 0.1]},
         motion: {velocity_mps: [0.1, 0.2, 0.3], rate_deg_s: [1, 2, 3], correlation_s: 2, scale: 0.01}}
transfer: pixel
overlap: most_central
smoothing: {iterations: 4, distance_m: 0.5, intensity: 0}
keep_unlabelled: false
threads: 3
)");
  EXPECT_EQ(rig.name, "vehicle");
  EXPECT_EQ(rig.classes.size(), 1);
  const CameraConfig& camera = rig.cameras.at(0);
  EXPECT_EQ(camera.ns, "/a/b");
  EXPECT_EQ(camera.image, "i");
  EXPECT_EQ(camera.camera_info, "ci");
  EXPECT_EQ(camera.scores, "s");
  EXPECT_EQ(camera.transport, ImageTransport::kCompressed);
  EXPECT_TRUE(camera.rectified);
  EXPECT_EQ(camera.input, CameraInput::kProbabilities);
  EXPECT_EQ(camera.mask, kConfigFolder + "/usyd.yaml");
  EXPECT_EQ(camera.score_format.scale, -0.5);
  EXPECT_EQ(camera.score_format.offset, 3);
  EXPECT_EQ(camera.max_theta_deg, 50);
  EXPECT_EQ(camera.lidar_rows.first, 0.25);
  EXPECT_EQ(camera.lidar_rows.last, 0.75);
  EXPECT_EQ(camera.time_offset_s, 0.25);
  EXPECT_EQ(camera.max_time_difference_s, 0);
  EXPECT_EQ(camera.timeout_s, 1.5);
  EXPECT_EQ(camera.reorder_window_s, 0.1);
  Vector6d deviations;
  deviations << 0.01, 0.02, 0, 0, 0.5 * kPi / 180, kPi / 180;
  EXPECT_TRUE(camera.errors.extrinsics.isApprox(
      Matrix6d(deviations.cwiseAbs2().asDiagonal().toDenseMatrix())));
  EXPECT_EQ(camera.errors.intrinsics_px, 1.5);
  EXPECT_EQ(rig.lidar.input, LidarInput::kPoints);
  EXPECT_EQ(rig.lidar.topic, "/ouster/points");
  EXPECT_EQ(rig.lidar.model, findLidarSpec("VLP32C"));
  EXPECT_EQ(rig.lidar.frame, "os");
  EXPECT_EQ(rig.lidar.min_range_m, 1);
  EXPECT_EQ(rig.lidar.max_range_m, 90);
  EXPECT_EQ(rig.lidar.largest_coordinate_m, 500);
  EXPECT_EQ(rig.lidar.longest_scan_s, 2);
  EXPECT_EQ(rig.lidar.time_field, "t");
  EXPECT_EQ(rig.lidar.time_unit, TimeUnit::kMicroseconds);
  EXPECT_EQ(rig.lidar.time_reference, TimeReference::kScanEnd);
  EXPECT_EQ(rig.lidar.without_time, WithoutTime::kAzimuth);
  EXPECT_EQ(rig.lidar.packet_stamp, PacketStamp::kMiddle);
  EXPECT_EQ(rig.lidar.time_offset_s, -18);
  ASSERT_EQ(rig.lidar.vertical_offsets_m.size(), 32u);
  EXPECT_EQ(rig.lidar.vertical_offsets_m[31], 0.01);
  EXPECT_EQ(rig.fixed_frame, "map");
  EXPECT_EQ(rig.vehicle_frame, "chassis");
  EXPECT_EQ(rig.superpixels.count, 500);
  EXPECT_EQ(rig.superpixels.compactness, 2.5);
  EXPECT_EQ(rig.superpixels.iterations, 4);
  EXPECT_EQ(rig.superpixels.scale, 0.5);
  EXPECT_FALSE(rig.superpixels.warm_start);
  EXPECT_EQ(rig.uncertainty.temperature, 1.5);
  EXPECT_EQ(rig.uncertainty.exponent, 0);
  EXPECT_EQ(rig.uncertainty.blend, 0.25);
  EXPECT_FALSE(rig.motion_enabled);
  EXPECT_EQ(rig.motion_granularity, MotionGranularity::kPacket);
  EXPECT_EQ(rig.odometry.source, OdometrySource::kTopic);
  EXPECT_EQ(rig.odometry.topic, "/odo");
  EXPECT_EQ(rig.odometry.time_offset_s, 0.01);
  EXPECT_EQ(rig.odometry.lookup, OdometryLookup::kClosest);
  EXPECT_EQ(rig.odometry.on_missing, OnMissingOdometry::kExtrapolate);
  EXPECT_EQ(rig.odometry.max_extrapolation_s, 0.05);
  EXPECT_EQ(rig.odometry.timeout_s, 0.3);
  EXPECT_EQ(rig.odometry.fastest_mps, 30);
  EXPECT_EQ(rig.odometry.largest_coordinate_m, 1e7);
  EXPECT_EQ(rig.reference.choose, ReferenceChoice::kScanEnd);
  EXPECT_EQ(rig.referenceCamera(), 1);
  EXPECT_EQ(rig.reference.timeout_s, 0.5);
  EXPECT_EQ(rig.image_choice, ImageChoice::kClosestToSweep);
  EXPECT_EQ(rig.segmentation.model, kConfigFolder + "/usyd.yaml");
  EXPECT_EQ(rig.segmentation.mode, SegmentationMode::kOnRequest);
  EXPECT_EQ(rig.occlusion.mode, &OcclusionMode::kPaper);
  EXPECT_EQ(rig.occlusion.vertical_step_deg, 2);
  EXPECT_EQ(rig.occlusion.horizontal_step_deg, 0.1);
  EXPECT_EQ(rig.occlusion.depth_margin_m, 0);
  EXPECT_EQ(rig.occlusion.depth_margin_ratio, 0.2);
  EXPECT_EQ(rig.errors.lidar_stamp_s, 0.001);
  EXPECT_EQ(rig.errors.camera_stamp_s, 0.002);
  EXPECT_EQ(rig.errors.lidar.range_m, 0.03);
  EXPECT_EQ(rig.errors.lidar.beam_deg, Eigen::Vector2d(0.2, 0.1));
  EXPECT_EQ(rig.errors.motion.velocity_mps, Eigen::Vector3d(0.1, 0.2, 0.3));
  EXPECT_EQ(rig.errors.motion.rate_deg_s, Eigen::Vector3d(1, 2, 3));
  EXPECT_EQ(rig.errors.motion.correlation_s, 2.0);
  EXPECT_EQ(rig.errors.motion.scale, 0.01);
  EXPECT_EQ(rig.transfer, TransferRule::kPixel);
  EXPECT_EQ(rig.overlap, OverlapRule::kMostCentral);
  EXPECT_EQ(rig.smoothing.iterations, 4);
  EXPECT_EQ(rig.smoothing.distance_m, 0.5);
  EXPECT_EQ(rig.smoothing.intensity, 0.0);
  EXPECT_FALSE(rig.keep_unlabelled);
  EXPECT_EQ(rig.threads, 3);

  const CompensationConfig compensation = rig.compensationConfig();
  EXPECT_FALSE(compensation.enabled);
  EXPECT_EQ(compensation.granularity, MotionGranularity::kPacket);
  EXPECT_EQ(compensation.lookup, OdometryLookup::kClosest);
  EXPECT_EQ(compensation.on_missing, OnMissingOdometry::kExtrapolate);
  EXPECT_EQ(compensation.max_extrapolation_ns, 50000000);
}

TEST(RigTest, SelectorConfigHoldsTheTimesInNanoseconds) {
  const SelectorConfig config =
      parse(kTwoCameras,
            {"reference.camera=right", "reference.timeout=0.3", "cameras.right.timeout=30"})
          .selectorConfig();
  ASSERT_EQ(config.cameras.size(), 2u);
  EXPECT_EQ(config.reference_camera, 1);
  EXPECT_EQ(config.reference_timeout_ns, 300000000);
  EXPECT_EQ(config.cameras[0].timeout_ns, 200000000);
  EXPECT_EQ(config.cameras[0].max_time_difference_ns, 50000000);
  EXPECT_EQ(config.cameras[1].timeout_ns, 30000000000);
  EXPECT_EQ(config.cameras[1].max_time_difference_ns, 20000000);
  EXPECT_EQ(config.cameras[1].time_offset_ns, -10000000);
  EXPECT_GT(config.image_history_ns, 30020000000);
  EXPECT_NO_THROW(ScanSelector{config});
  EXPECT_NO_THROW(ScanSelector{parse("").selectorConfig()});
}

TEST(RigTest, ClassesMayBeAPathAFileKeyOrInPlace) {
  EXPECT_EQ(parse("classes: classes_camvid12.yaml").classes.size(), 12);
  EXPECT_EQ(parse("classes: {file: classes_camvid12.yaml}").classes.size(), 12);
  EXPECT_EQ(parse("classes: {file: " + kConfigFolder + "/classes_camvid12.yaml}").classes.size(),
            12);
  EXPECT_EQ(parse("classes: {classes: [{name: a, color: [0, 0, 0]}], evaluation: {discard: [a]}}")
                .classes.discarded()
                .size(),
            1u);
  EXPECT_EQ(parse("classes: [{name: a, color: [0, 0, 0]}]").classes.size(), 1);
}

TEST(RigTest, FindsTheRowsOfALidarThatItKnows) {
  const std::string text =
      "classes: classes_usyd12.yaml\ncameras: [{name: a, lidar_rows: auto}, {name: b}]\n";
  const Rig rig = parse(text + "lidar: {model: VLP16, frame: velodyne}");
  EXPECT_TRUE(rig.cameras[0].finds_lidar_rows);
  EXPECT_FALSE(rig.cameras[1].finds_lidar_rows);
  EXPECT_TRUE(parse(rig.yaml).cameras[0].finds_lidar_rows);
  EXPECT_THROW(parse(text + "lidar: {model: VLP16}"), ConfigError);
  EXPECT_THROW(parse(text + "lidar: {frame: velodyne}"), ConfigError);
}

TEST(RigTest, KnowsTheLidarsByTheirMakersNamesToo) {
  const std::pair<const char*, const char*> names[] = {
      {"VLP16", "VLP16"},         {"VLP-16", "VLP16"},     {"Puck LITE", "VLP16"},
      {"PuckHiRes", "PuckHiRes"}, {"Hi-Res", "PuckHiRes"}, {"Puck Hi-Res", "PuckHiRes"},
      {"VLP-32C", "VLP32C"},      {"HDL-32E", "HDL32E"},   {"VLS-128", "VLS128"},
      {"alpha prime", "VLS128"},  {"Ultra Puck", "VLP32C"}};
  for (const auto& [name, model] : names) {
    const LidarSpec* const found = parse("lidar: {model: " + std::string(name) + "}").lidar.model;
    ASSERT_NE(found, nullptr) << name;
    EXPECT_EQ(found->name, model) << name;
  }
}

struct BadCase {
  const char* text;
  const char* problem;  ///< the start of the one problem
};

TEST(RigTest, EachBrokenRuleIsNamedWithKeyAndValue) {
  const std::string cameras = "classes: classes_usyd12.yaml\ncameras: ";
  for (const BadCase& bad : {
           BadCase{"[1, 2]", "rig.yaml: (a list of 2): must be a map"},
           {"just text", "rig.yaml: just text: must be a map"},
           {"lidar: {longest_scan_s: 0}",
            "rig.yaml: lidar.longest_scan_s = 0: must be a number from 0.001 to 60"},
           {"lidar: {model: HDL-64E}",
            "rig.yaml: lidar.model = HDL-64E: must be one of auto, VLP16, "},
           {"odometry: {fastest_mps: -1}", "rig.yaml: odometry.fastest_mps = -1: must be "},
           {"occlusion: {mdoe: off}",
            "rig.yaml: occlusion.mdoe = off: unknown key; did you mean "
            "'mode'?"},
           {"ocluson: {}",
            "rig.yaml: ocluson = (a map of 0): unknown key; did you mean "
            "'occlusion'?"},
           {"<<: {a: 1}", "rig.yaml: << = (a map of 1): unknown key; known here: name, "},
           {"transfer: mean", "rig.yaml: transfer = mean: must be one of pixel, expected"},
           {"errors: {stamps: 1}",
            "rig.yaml: errors.stamps = 1: unknown key; did you mean 'stamps_s'?"},
           {"errors: {stamps_s: {lidar: -1}}", "rig.yaml: errors.stamps_s.lidar = -1: must be "},
           {"errors: {lidar: {beam_deg: [0.1]}}",
            "rig.yaml: errors.lidar.beam_deg = (a list of 1): must be a list of 2 numbers"},
           {"errors: {lidar: {beam_deg: 0.1}}",
            "rig.yaml: errors.lidar.beam_deg = 0.1: must be a list of numbers"},
           {"errors: {motion: {velocity_mps: [0, .inf, 0]}}",
            "rig.yaml: errors.motion.velocity_mps[1] = .inf: must be "},
           {"errors: {motion: {correlation_s: 0}}",
            "rig.yaml: errors.motion.correlation_s = 0: must be "},
           {"errors: {motion: {scale: 2}}", "rig.yaml: errors.motion.scale = 2: must be "},
           {"overlap: last",
            "rig.yaml: overlap = last: must be one of mean, product, "
            "nearest_in_time, most_central, geometric_mean"},
           {"overlap: geometric", "rig.yaml: overlap = geometric: must be one of mean, product, "},
           {"smoothing: {iterations: -1}",
            "rig.yaml: smoothing.iterations = -1: must be a whole number from 0 to 100"},
           {"smoothing: {distance_m: 0}", "rig.yaml: smoothing.distance_m = 0: must be "},
           {"smoothing: {intensity: -1}", "rig.yaml: smoothing.intensity = -1: must be "},
           {"overlap: [mean]", "rig.yaml: overlap = (a list of 1): must be one of mean"},
           {"keep_unlabelled: maybe", "rig.yaml: keep_unlabelled = maybe: must be true or false"},
           {"threads: 0", "rig.yaml: threads = 0: must be a whole number from 1 to 64"},
           {"keep_unlabelled: 1", "rig.yaml: keep_unlabelled = 1: must be true or false"},
           {"fixed_frame: ''", "rig.yaml: fixed_frame = '': must be a tf frame"},
           {"fixed_frame: a b", "rig.yaml: fixed_frame = a b: must be a tf frame"},
           {"fixed_frame: [odom]", "rig.yaml: fixed_frame = (a list of 1): must be a text"},
           {"vehicle_frame: odom", "rig.yaml: vehicle_frame = odom: must differ from fixed_frame"},
           {"superpixels: 1000", "rig.yaml: superpixels = 1000: must be a map"},
           {"superpixels: {count: 0}",
            "rig.yaml: superpixels.count = 0: must be a whole number "
            "from 1 to 10000000"},
           {"superpixels: {count: 99999999999999999999}", "rig.yaml: superpixels.count = 999999"},
           {"superpixels: {count: 10.5}", "rig.yaml: superpixels.count = 10.5: must be a whole"},
           {"superpixels: {count: many}", "rig.yaml: superpixels.count = many: must be a whole"},
           {"superpixels: {compactness: 0}", "rig.yaml: superpixels.compactness = 0: must be"},
           {"superpixels: {compactness: .nan}", "rig.yaml: superpixels.compactness = .nan: must"},
           {"superpixels: {iterations: 0}", "rig.yaml: superpixels.iterations = 0: must be"},
           {"superpixels: {iterations: 101}", "rig.yaml: superpixels.iterations = 101: must be"},
           {"superpixels: {scale: -1}",
            "rig.yaml: superpixels.scale = -1: must be a number from "
            "0 to 4"},
           {"superpixels: {warm_start: 3}", "rig.yaml: superpixels.warm_start = 3: must be true"},
           {"uncertainty: {temperature: 0}",
            "rig.yaml: uncertainty.temperature = 0: must be a "
            "number above 0"},
           {"uncertainty: {exponent: -2}", "rig.yaml: uncertainty.exponent = -2: must be"},
           {"uncertainty: {blend: 1.5}", "rig.yaml: uncertainty.blend = 1.5: must be"},
           {"motion: {granularity: point}",
            "rig.yaml: motion.granularity = point: must be one of "
            "firing, packet"},
           {"motion: {enabled: {}}", "rig.yaml: motion.enabled = (a map of 0): must be true"},
           {"odometry: {source: gps}", "rig.yaml: odometry.source = gps: must be one of tf, topic"},
           {"odometry: {topic: 'a b'}", "rig.yaml: odometry.topic = a b: must be a ROS name"},
           {"odometry: {lookup: spline}", "rig.yaml: odometry.lookup = spline: must be one of"},
           {"odometry: {on_missing: ignore}", "rig.yaml: odometry.on_missing = ignore: must be"},
           {"odometry: {timeout: 0}", "rig.yaml: odometry.timeout = 0: must be a number above 0"},
           {"odometry: {timeout: 1e300}", "rig.yaml: odometry.timeout = 1e300: must be a number"},
           {"odometry: {max_extrapolation: -1}", "rig.yaml: odometry.max_extrapolation = -1: must"},
           {"odometry: {time_offset: .inf}", "rig.yaml: odometry.time_offset = .inf: must be"},
           {"reference: {choose: first}",
            "rig.yaml: reference.choose = first: must be one of "
            "closest_image, scan_start, scan_middle, scan_end"},
           {"reference: {camera: A0}",
            "rig.yaml: reference.camera = A0: must be the name of a "
            "camera"},
           {"reference: {timeout: -0.1}", "rig.yaml: reference.timeout = -0.1: must be"},
           {"image_choice: newest", "rig.yaml: image_choice = newest: must be one of"},
           {"segmentation: {model: none.yaml}",
            "rig.yaml: segmentation.model = none.yaml: must be "
            "a readable file; '"},
           {"segmentation: {model: .}", "rig.yaml: segmentation.model = .: must be a readable"},
           {"segmentation: {mode: sometimes}", "rig.yaml: segmentation.mode = sometimes: must be"},
           {"segmentation: {mode: free_running, model: usyd.yaml}",
            "rig.yaml: segmentation.mode = free_running: must be on_request"},
           {"occlusion: {mode: zbuffer}",
            "rig.yaml: occlusion.mode = zbuffer: must be one of off, "
            "paper, adaptive"},
           {"occlusion: {vertical_step_deg: -2}", "rig.yaml: occlusion.vertical_step_deg = -2:"},
           {"occlusion: {horizontal_step_deg: nan}", "rig.yaml: occlusion.horizontal_step_deg ="},
           {"occlusion: {depth_margin_m: -1}", "rig.yaml: occlusion.depth_margin_m = -1: must be"},
           {"occlusion: {depth_margin_ratio: a}", "rig.yaml: occlusion.depth_margin_ratio = a: "},
           {"lidar: {input: pcap}", "rig.yaml: lidar.input = pcap: must be one of packets, points"},
           {"lidar: {model: HDL64E}", "rig.yaml: lidar.model = HDL64E: must be one of auto, VLP16"},
           {"lidar: {min_range_m: -1}", "rig.yaml: lidar.min_range_m = -1: must be a number of"},
           {"lidar: {min_range_m: 5, max_range_m: 5}",
            "rig.yaml: lidar.max_range_m = 5: must be "
            "above min_range_m"},
           {"lidar: {time_unit: min}",
            "rig.yaml: lidar.time_unit = min: must be one of auto, s, "
            "ms, us, ns"},
           {"lidar: {time_reference: gps}", "rig.yaml: lidar.time_reference = gps: must be one of"},
           {"lidar: {without_time: guess}", "rig.yaml: lidar.without_time = guess: must be one of"},
           {"lidar: {packet_stamp: last}", "rig.yaml: lidar.packet_stamp = last: must be one of"},
           {"lidar: {vertical_offsets_m: 3}",
            "rig.yaml: lidar.vertical_offsets_m = 3: must be a "
            "list of numbers"},
           {"lidar: {vertical_offsets_m: [0, x]}", "rig.yaml: lidar.vertical_offsets_m[1] = x: "},
           {"lidar: {model: VLP16, vertical_offsets_m: [0, 0]}",
            "rig.yaml: lidar.vertical_offsets_m = (a list of 2): must be empty or hold one number "
            "for each of the 16 lasers"},
           {"lidar: {frame: 1, frame: 2}", "rig.yaml: lidar.frame = 2: the key is given twice"},
           {"cameras: 5", "rig.yaml: cameras = 5: must be a list of cameras"},
           {"cameras: [{name: A0}]", "rig.yaml: classes = (missing): must be"},
           {"classes: none.yaml", "rig.yaml: classes = none.yaml: must be a readable file; '"},
           {"classes: {file: none.yaml}", "rig.yaml: classes.file = none.yaml: must be a readable"},
           {"classes: {file: [a]}", "rig.yaml: classes.file = (a list of 1): must be a text"},
           {"classes: {file: classes_usyd12.yaml, classes: []}",
            "rig.yaml: classes.classes = (a list of 0): unknown key"},
           {"classes: [{name: A, color: [0, 0, 0]}]", "rig.yaml: classes: classes[0].name = A:"},
       }) {
    const std::string problem = problemOf(bad.text);
    EXPECT_NE(problem.find(bad.problem), std::string::npos) << bad.text << "\n" << problem;
  }
  for (const BadCase& bad : {
           BadCase{"[A0]", "rig.yaml: cameras[0] = A0: must be a map"},
           {"[{}]", "rig.yaml: cameras[0].name = (missing): must be a letter"},
           {"[{name: 0A}]", "rig.yaml: cameras[0].name = 0A: must be a letter"},
           {"[{name: a/b}]", "rig.yaml: cameras[0].name = a/b: must be a letter"},
           {"[{name: a}, {name: a}]", "rig.yaml: cameras[1].name = a: two cameras have this name"},
           {"[{name: a, namespace: /x}, {name: b, namespace: /x}]",
            "rig.yaml: cameras[1].image = /x/image: two cameras have this topic"},
           {"[{name: A0, namespace: '/gmsl/A0/'}]", "rig.yaml: cameras.A0.namespace = /gmsl/A0/: "},
           {"[{name: A0, image: ''}]", "rig.yaml: cameras.A0.image = '': must be a ROS name"},
           {"[{name: A0, camera_info: 'a b'}]", "rig.yaml: cameras.A0.camera_info = a b: must be"},
           {"[{name: A0, transport: theora}]",
            "rig.yaml: cameras.A0.transport = theora: must be "
            "one of raw, compressed"},
           {"[{name: A0, input: colours}]", "rig.yaml: cameras.A0.input = colours: must be one of"},
           {"[{name: A0, rectified: }]", "rig.yaml: cameras.A0.rectified = (empty): must be true"},
           {"[{name: A0, mask: no.png}]",
            "rig.yaml: cameras.A0.mask = no.png: must be a readable "
            "file; '"},
           {"[{name: A0, score_scale: 0}]", "rig.yaml: cameras.A0.score_scale = 0: must not be 0"},
           {"[{name: A0, score_offset: .nan}]", "rig.yaml: cameras.A0.score_offset = .nan: must"},
           {"[{name: A0, max_theta_deg: 181}]", "rig.yaml: cameras.A0.max_theta_deg = 181: must"},
           {"[{name: A0, lidar_rows: {last: 1.1}}]",
            "rig.yaml: cameras.A0.lidar_rows.last = 1.1: must"},
           {"[{name: A0, lidar_rows: {first: 0.5, last: 0.5}}]",
            "rig.yaml: cameras.A0.lidar_rows.last = 0.5: must be above `first`"},
           {"[{name: A0, lidar_rows: yes}]",
            "rig.yaml: cameras.A0.lidar_rows = yes: must be one of auto"},
           {"[{name: A0, lidar_rows: auto}]",
            "rig.yaml: cameras.A0.lidar_rows = auto: needs the lidar's rings and place; name "
            "lidar.model and lidar.frame"},
           {"[{name: A0, lens: {file: no.yaml}}]",
            "rig.yaml: cameras.A0.lens.file = no.yaml: must be a readable file; '"},
           {"[{name: A0, lens: {camera: cam0}}]",
            "rig.yaml: cameras.A0.lens.file = (missing): must be given with `camera` and"},
           {"[{name: A0, shutter: {readout_s: 2}}]",
            "rig.yaml: cameras.A0.shutter.readout_s = 2: must be a number from 0 to 1"},
           {"[{name: A0, shutter: {direction: sideways}}]",
            "rig.yaml: cameras.A0.shutter.direction = sideways: must be one of down, up, right, "
            "left"},
           {"[{name: A0, shutter: {stamp_row: 5}}]",
            "rig.yaml: cameras.A0.shutter.stamp_row = 5: must be one of first, middle, last"},
           {"[{name: A0, nudge: {deg: [1, 2]}}]", "rig.yaml: cameras.A0.nudge.deg"},
           {"[{name: A0, nudge: {m: [0, 0, 11]}}]", "rig.yaml: cameras.A0.nudge.m"},
           {"[{name: A0, time_offset: 1e10}]", "rig.yaml: cameras.A0.time_offset = 1e10: must be"},
           {"[{name: A0, max_time_difference: -1}]", "rig.yaml: cameras.A0.max_time_difference ="},
           {"[{name: A0, timeout: 0}]", "rig.yaml: cameras.A0.timeout = 0: must be a number above"},
           {"[{name: A0, time_ofset: 1}]",
            "rig.yaml: cameras.A0.time_ofset = 1: unknown key; did "
            "you mean 'time_offset'?"},
           {"[{name: A0}]\nreference: {camera: A1}",
            "rig.yaml: reference.camera = A1: must be the "
            "name of a camera; did you mean 'A0'?"},
       }) {
    const std::string problem = problemOf(cameras + bad.text);
    EXPECT_EQ(problem.find(bad.problem), 0u) << bad.text << "\n" << problem;
  }
}

TEST(RigTest, ANudgeTurnsAndShiftsTheCameraInTheLidarsAxes) {
  const Rig rig = parse(
      "classes: classes_usyd12.yaml\ncameras: [{name: a, nudge: {deg: [0, 0, 90], m: [1, 2, 3]}}]");
  // A camera at (5, 0, 0) that looks along the lidar's x: its z axis.
  Transform T_lidar_camera = Transform::Identity();
  T_lidar_camera.linear() << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  T_lidar_camera.translation() << 5, 0, 0;
  const Transform nudged =
      rig.cameras[0].nudge.applied(T_lidar_camera.inverse(Eigen::Isometry)).inverse();
  EXPECT_TRUE(nudged.translation().isApprox(Eigen::Vector3d(6, 2, 3)));
  EXPECT_TRUE((nudged.linear() * Eigen::Vector3d::UnitZ()).isApprox(Eigen::Vector3d::UnitY()));
  EXPECT_TRUE((nudged.linear() * Eigen::Vector3d::UnitY()).isApprox(-Eigen::Vector3d::UnitZ()));
  EXPECT_EQ(rigFromYaml(parseYaml(rig.yaml, "x"), "/nowhere", "x.yaml").yaml, rig.yaml);
  EXPECT_TRUE(CameraNudge{}.applied(T_lidar_camera).matrix() == T_lidar_camera.matrix());
}

TEST(RigTest, RetuningTakesOverWhatMayChangeAlone) {
  const std::string cameras = "classes: classes_usyd12.yaml\ncameras: [{name: a";
  Rig rig = parse(cameras + "}]");
  const CameraConfig* camera = rig.cameras.data();
  const Rig other = parse(cameras +
                          ", time_offset: 0.5, timeout: 1, nudge: {m: [1, 0, 0]}}]\nthreads: 3\n"
                          "occlusion: {mode: paper}\noverlap: product\nfixed_frame: map");
  rig.retune(other);
  EXPECT_EQ(rig.cameras.data(), camera);
  EXPECT_EQ(rig.cameras[0].time_offset_s, 0.5);
  EXPECT_EQ(rig.cameras[0].nudge, other.cameras[0].nudge);
  EXPECT_EQ(rig.cameras[0].timeout_s, 0.2);
  EXPECT_EQ(rig.occlusion.mode, &OcclusionMode::kPaper);
  EXPECT_EQ(rig.overlap, OverlapRule::kProduct);
  EXPECT_EQ(rig.threads, 3);
  EXPECT_EQ(rig.fixed_frame, "odom");
}

TEST(RigTest, ReadsLensFilesAndShutters) {
  const TemporaryFolder folder;
  const std::string path = folder.path() + "/lens.yaml";
  std::ofstream(path) << "{model: ucm, resolution: [640, 480], focal: [500, 510], "
                         "centre: [320, 240], coefficients: [0.6]}\n";
  const std::string lens = "lens: {file: " + path + ", frame: /left_optical}";
  const Rig rig = parse("classes: classes_usyd12.yaml\ncameras: [{name: a, " + lens +
                        ", shutter: {readout_s: 0.02, direction: left, stamp_row: last}}]");
  const CameraConfig& camera = rig.cameras.at(0);
  EXPECT_EQ(camera.lens.frame, "left_optical");
  EXPECT_EQ(camera.shutter.readout_s, 0.02);
  EXPECT_EQ(camera.shutter.direction, ShutterDirection::kLeft);
  EXPECT_EQ(camera.shutter.stamp_row, StampRow::kLast);
  EXPECT_TRUE(camera.withoutCameraInfo());
  const CameraModel model(camera.assumedInfo(), camera.modelOptions());
  EXPECT_EQ(model.imageSize(), (ImageSize{640, 480}));
  EXPECT_EQ(model.fy(), 510.0);
  EXPECT_TRUE(model.rollingShutter());
  EXPECT_EQ(rigFromYaml(parseYaml(rig.yaml, "x"), "/nowhere", "x.yaml").yaml, rig.yaml);
  EXPECT_EQ(
      problemOf("classes: classes_usyd12.yaml\ncameras: [{name: A0, lens: {file: usyd.yaml}}]")
          .find("rig.yaml: lens of " + kConfigFolder + "/usyd.yaml: must be a Kalibr camchain"),
      0u);
  // What the file breaks is said with its own name, and it replaces camera_info of raw images only.
  EXPECT_EQ(
      problemOf("classes: classes_usyd12.yaml\ncameras: [{name: a, rectified: true, " + lens + "}]")
          .find("rig.yaml: cameras.a.lens = (a map of 2): must be left out where `rectified`"),
      0u);
  std::ofstream(path) << "{model: ucm, resolution: [640, 480], focal: [500, 510], "
                         "centre: [320, 240], coefficients: [1.6]}\n";
  const std::string problem =
      problemOf("classes: classes_usyd12.yaml\ncameras: [{name: a, " + lens + "}]");
  EXPECT_NE(problem.find(path + ": coefficients: alpha = 1.6: must lie in 0..1"), std::string::npos)
      << problem;
}

TEST(RigTest, TakesTheWholeCovarianceOfCalibrationRuns) {
  const TemporaryFolder folder;
  const std::string path = folder.path() + "/runs.csv";
  {
    std::ofstream file(path);
    // Roll and y of the camera's pose hang together.
    for (int k = -4; k <= 4; ++k) file << 1e-3 * k << ",0,0,0.1," << 0.01 * k << ",0.2\n";
  }
  const auto rigOf = [](const std::string& errors) {
    return "classes: classes_usyd12.yaml\ncameras: [{name: a, errors: {" + errors + "}}]";
  };
  const Rig rig = parse(rigOf("extrinsic_runs: " + path));
  const Matrix6d& covariance = rig.cameras.at(0).errors.extrinsics;
  // Of -4..4 the variance is 7.5. The camera's motion is the run's turned around: both change sign.
  EXPECT_NEAR(covariance(3, 3), 7.5e-6, 1e-9);
  EXPECT_NEAR(covariance(1, 1), 7.5e-4, 1e-7);
  EXPECT_NEAR(covariance(1, 3), 7.5e-5, 1e-8);
  EXPECT_EQ(rigFromYaml(parseYaml(rig.yaml, "x"), "/nowhere", "x.yaml").yaml, rig.yaml);

  EXPECT_EQ(problemOf(rigOf("extrinsics: {deg: [1, 1, 1]}, extrinsic_runs: " + path)),
            "rig.yaml: cameras.a.errors.extrinsic_runs = " + path +
                ": must be left out where `extrinsics` is not 0");
  EXPECT_EQ(problemOf(rigOf("extrinsic_runs: usyd.yaml")).find(kConfigFolder + "/usyd.yaml "), 10u);
  EXPECT_EQ(
      problemOf(rigOf("extrinsics: {deg: [1, 1]}")),
      "rig.yaml: cameras.a.errors.extrinsics.deg = (a list of 2): must be a list of 3 numbers");
  EXPECT_EQ(problemOf(rigOf("intrinsics_px: -1"))
                .find("rig.yaml: cameras.a.errors.intrinsics_px = -1: must be "),
            0u);
}

TEST(RigTest, SaysTheResolvedPathOfAMissingFile) {
  const std::string problem = problemOf("segmentation: {model: models/none.yaml}");
  EXPECT_NE(problem.find("'" + kConfigFolder + "/models/none.yaml' is not"), std::string::npos)
      << problem;
}

TEST(RigTest, ReportsAllProblemsAtOnce) {
  const std::vector<std::string> problems = problemsOf(R"(
classes: {file: nowhere.yaml}
cameras:
  - {name: 1, timeout: -1}
  - {name: B, mask: none.png, colour: red}
lidar: {model: X, min_range_m: near}
superpixels: [1]
overlap: best
)",
                                                       {"nonsense", "occlusion.mode=sharp"});
  EXPECT_EQ(problems.size(), 11u) << ConfigError(problems).what();
  for (const std::string& problem : problems) {
    EXPECT_EQ(problem.find('\n'), std::string::npos) << problem;
  }
}

TEST(RigTest, SixteenCamerasAndNoMore) {
  std::string text = "classes: classes_usyd12.yaml\ncameras:\n";
  for (int i = 0; i < 16; ++i) text += "  - {name: c" + std::to_string(i) + "}\n";
  EXPECT_EQ(parse(text).cameras.size(), 16u);
  EXPECT_NE(problemOf(text + "  - {name: c16}\n").find("(a list of 17): must be at most 16"),
            std::string::npos);
}

TEST(RigTest, KnowsEveryModeOfOcclusionByItsName) {
  ASSERT_EQ(occlusionModes().size(), 3u);
  for (const OcclusionMode* mode : occlusionModes()) {
    EXPECT_EQ(parse("occlusion: {mode: " + std::string(mode->name) + "}").occlusion.mode, mode);
  }
}

TEST(OverrideTest, SetsValuesMakesSectionsAndWorksInOrder) {
  const Rig rig =
      parse(kTwoCameras, {"occlusion.mode=paper", "cameras.right.max_theta_deg=50",
                          "cameras.0.max_theta_deg=40", "overlap=mean", "overlap=product",
                          "lidar.vertical_offsets_m=[0.1, 0.2]", "lidar.vertical_offsets_m.1=0.3",
                          "lidar.frame=", "uncertainty={temperature: 2, exponent: 1}", "name=a b"});
  EXPECT_EQ(rig.occlusion.mode, &OcclusionMode::kPaper);
  EXPECT_EQ(rig.cameras[1].max_theta_deg, 50);
  EXPECT_EQ(rig.cameras[0].max_theta_deg, 40);
  EXPECT_EQ(rig.overlap, OverlapRule::kProduct);
  EXPECT_EQ(rig.lidar.vertical_offsets_m, (std::vector<double>{0.1, 0.3}));
  EXPECT_EQ(rig.uncertainty.temperature, 2);
  EXPECT_EQ(rig.name, "a b");
  EXPECT_TRUE(parse(kTwoCameras, {"cameras=[]"}).cameras.empty());
  EXPECT_EQ(parse("occlusion:\n", {"occlusion.mode=off"}).occlusion.mode, &OcclusionMode::kOff);
  EXPECT_EQ(parse("", {"motion.enabled=false"}).motion_enabled, false);
}

TEST(OverrideTest, LeavesTheCallersTreeAndAliasesAlone) {
  const YAML::Node root = YAML::Load(
      "a: &cam {name: a, timeout: 0.1}\n"
      "classes: classes_usyd12.yaml\n"
      "cameras: [*cam]\n");
  YAML::Node tree = YAML::Clone(root);
  tree.remove("a");
  EXPECT_EQ(rigFromYaml(tree, kConfigFolder, "r", {"cameras.a.timeout=0.5"}).cameras[0].timeout_s,
            0.5);
  EXPECT_EQ(rigFromYaml(tree, kConfigFolder, "r").cameras[0].timeout_s, 0.1);
}

TEST(OverrideTest, IsInTheTreeThatTheRigKeeps) {
  const Rig rig = parse(kTwoCameras, {"cameras.right.timeout=0.75", "overlap=product"});
  const YAML::Node kept = YAML::Load(rig.yaml);
  EXPECT_EQ(kept["overlap"].as<std::string>(), "product");
  EXPECT_EQ(kept["cameras"][1]["timeout"].as<double>(), 0.75);
  const Rig again = rigFromYaml(kept, kConfigFolder, "rig.yaml");
  EXPECT_EQ(again.overlap, rig.overlap);
  EXPECT_EQ(again.cameras[1].timeout_s, 0.75);
  EXPECT_EQ(again.yaml, rig.yaml);
}

TEST(OverrideTest, NamesWhatIsWrong) {
  const auto problem = [](const std::string& text) { return problemOf(kTwoCameras, {text}); };
  EXPECT_EQ(problem("overlap"), "override 'overlap': must be key=value");
  EXPECT_EQ(problem("=3"), "override '=3': must be key=value");
  EXPECT_EQ(problem("a..b=3"), "override 'a..b=3': the key has an empty part");
  EXPECT_EQ(problem("cameras.middle.mask=x"),
            "override 'cameras.middle.mask=x': cameras is a list that has no 'middle' (left, "
            "right)");
  EXPECT_EQ(problem("cameras.left.name.x=3"),
            "override 'cameras.left.name.x=3': cameras.left.name has no keys");
  EXPECT_NE(problem("overlap=[1").find("override 'overlap=[1':1:"), std::string::npos);
  EXPECT_NE(problem("occlusion.mod=off").find("did you mean 'mode'?"), std::string::npos);
}

TEST(LoadRigTest, EveryShippedRigLoads) {
  int rigs = 0;
  for (const auto& entry : std::filesystem::directory_iterator(kConfigFolder)) {
    const std::string name = entry.path().filename().string();
    if (entry.path().extension() != ".yaml" || name.rfind("classes_", 0) == 0) continue;
    const YAML::Node root = parseYamlFile(entry.path().string());
    if (!root["cameras"] && !root["lidar"]) continue;  // a network's model file
    EXPECT_NO_THROW(loadRig(entry.path().string())) << name;
    ++rigs;
  }
  EXPECT_GE(rigs, 2);
}

TEST(LoadRigTest, UsydIsThePapersRig) {
  const Rig rig = loadRig(kConfigFolder + "/usyd.yaml");
  ASSERT_EQ(rig.cameras.size(), 5u);
  const char* const names[] = {"A0", "A1", "A2", "B0", "B1"};
  for (std::size_t i = 0; i < 5; ++i) {
    EXPECT_EQ(rig.cameras[i].name, names[i]);
    EXPECT_EQ(rig.cameras[i].ns, std::string("/gmsl/") + names[i]);
    EXPECT_EQ(rig.cameras[i].image, "image_color");
    EXPECT_EQ(rig.cameras[i].camera_info, "camera_info");
    EXPECT_FALSE(rig.cameras[i].rectified);
  }
  EXPECT_EQ(rig.lidar.topic, "/velodyne/front/velodyne_packets");
  EXPECT_EQ(rig.occlusion.vertical_step_deg, 2.0);
  EXPECT_EQ(rig.occlusion.horizontal_step_deg, 0.1);
  EXPECT_EQ(rig.classes.size(), 12);
}

/// Calls `visit` with the name of each section (empty: the root) and each key that the loader knows
/// there.
void forEveryKey(const std::function<void(const std::string&, const std::string&)>& visit) {
  const auto visitKeys = [&](const std::string& section, const std::string& text) {
    // The unknown-key message lists the keys that the loader knows.
    const std::string problem = problemOf(text);
    const std::size_t list = problem.find("known here: ");
    ASSERT_NE(list, std::string::npos) << problem;
    std::istringstream words(problem.substr(list + 12));
    for (std::string key; std::getline(words >> std::ws, key, ',');) visit(section, key);
  };
  visitKeys("", "qqqqqqqqqqqq: 1");
  visitKeys("cameras", "classes: classes_usyd12.yaml\ncameras: [{name: A0, qqqqqqqqqqqq: 1}]");
  const YAML::Node resolved = YAML::Load(parse("").yaml);
  for (const auto& item : resolved) {
    const auto name = item.first.as<std::string>();
    if (item.second.IsMap()) visitKeys(name, name + ": {qqqqqqqqqqqq: 1}");
  }
}

/// usyd.yaml documents every key: what the loader knows, the file shows with the default's comment.
TEST(LoadRigTest, UsydNamesEveryKeyOfTheLoader) {
  const YAML::Node root = parseYamlFile(kConfigFolder + "/usyd.yaml");
  forEveryKey([&](const std::string& section, const std::string& key) {
    const YAML::Node node = section.empty()        ? root
                            : section == "cameras" ? root["cameras"][0]
                                                   : root[section];
    EXPECT_TRUE(node[key]) << section << "." << key << " is not in usyd.yaml";
  });
}

/// What is printed, published and written into bags holds every key: none can be forgotten.
TEST(ResolvedRig, HasEveryKeyThatTheLoaderAccepts) {
  const YAML::Node resolved = YAML::Load(parse(kTwoCameras).yaml);
  int keys = 0;
  forEveryKey([&](const std::string& section, const std::string& key) {
    const YAML::Node node = section.empty()        ? resolved
                            : section == "cameras" ? resolved["cameras"][0]
                                                   : resolved[section];
    EXPECT_TRUE(node[key]) << section << "." << key;
    ++keys;
  });
  EXPECT_GT(keys, 60);
}

TEST(ResolvedRig, LoadsAgainAsTheSameRig) {
  for (const char* file : {"usyd.yaml", "kitti.yaml", "demo.yaml"}) {
    const Rig rig = loadRig(kConfigFolder + "/" + file, {"occlusion.mode=off", "threads=2"});
    // Nothing in it is relative to a folder, or to the name of the file.
    const Rig again = rigFromYaml(parseYaml(rig.yaml, "x"), "/nowhere", "another.yaml");
    EXPECT_EQ(again.yaml, rig.yaml) << file;
    EXPECT_EQ(again.name, rig.name);
    EXPECT_EQ(again.classes.toJson(), rig.classes.toJson());
    EXPECT_EQ(again.occlusion.mode, &OcclusionMode::kOff);
    EXPECT_EQ(again.threads, 2);
    ASSERT_EQ(again.cameras.size(), rig.cameras.size());
    for (std::size_t i = 0; i < rig.cameras.size(); ++i) {
      EXPECT_EQ(again.cameras[i].ns, rig.cameras[i].ns);
      EXPECT_EQ(again.cameras[i].scores, rig.cameras[i].scores);
    }
  }
}

TEST(ResolvedRig, SaysWhatTheDefaultsCameTo) {
  const YAML::Node resolved =
      YAML::Load(parse(kTwoCameras, {"motion={enabled: false}", "cameras.left.input=labels"}).yaml);
  EXPECT_FALSE(resolved["motion"]["enabled"].as<bool>());
  EXPECT_EQ(resolved["motion"]["granularity"].as<std::string>(), "firing");
  EXPECT_EQ(resolved["reference"]["camera"].as<std::string>(), "left");
  EXPECT_EQ(resolved["cameras"][0]["scores"].as<std::string>(), "labels");
  EXPECT_EQ(resolved["cameras"][1]["scores"].as<std::string>(), "scores");
  EXPECT_EQ(resolved["cameras"][1]["timeout"].as<double>(), 0.4);
  EXPECT_EQ(resolved["lidar"]["topic"].as<std::string>(), "velodyne_packets");
  EXPECT_EQ(resolved["classes"]["classes"].size(), 12u);
}

TEST(LoadRigTest, NamesTheFileOfEachProblem) {
  const std::string folder =
      (std::filesystem::path(testing::TempDir()) / "slf_rig_test").lexically_normal().string();
  std::filesystem::create_directories(folder);
  std::ofstream(folder + "/classes.yaml") << "classes: [{name: a}]\n";
  std::ofstream(folder + "/rig.yaml") << "classes: classes.yaml\noverlap: best\n";
  try {
    loadRig(folder + "/rig.yaml");
    ADD_FAILURE() << "no error";
  } catch (const ConfigError& error) {
    ASSERT_EQ(error.problems().size(), 2u) << error.what();
    EXPECT_EQ(error.problems()[0].find(folder + "/classes.yaml: classes[0].color"), 0u);
    EXPECT_EQ(error.problems()[1].find(folder + "/rig.yaml: overlap = best"), 0u);
  }
  std::filesystem::remove_all(folder);
  EXPECT_THROW(loadRig(folder + "/rig.yaml"), ConfigError);
  EXPECT_THROW(loadRig(kConfigFolder), ConfigError);
}

/// Anything but a ConfigError or a Rig is a failure: mutations of a real rig file, and of values.
TEST(RigTest, HostileTextsOnlyEverThrowConfigError) {
  std::ifstream file(kConfigFolder + "/usyd.yaml");
  std::string good, line;
  while (std::getline(file, line)) {
    const std::size_t comment = line.find('#');
    const std::string code = line.substr(0, comment);
    if (code.find_first_not_of(' ') != std::string::npos) good += code + "\n";
  }
  ASSERT_NO_THROW(parse(good));
  const std::vector<std::string> pieces = {"[",           "]",
                                           "{",           "}",
                                           ":",           "- ",
                                           "? ",          "&a ",
                                           "*a",          "!!int ",
                                           "|",           ">",
                                           "'",           "\"",
                                           "\n",          "\t",
                                           "%",           "---\n",
                                           "...\n",       "<<",
                                           "~",           ".nan",
                                           "-0",          "1e999",
                                           "\\x",         "\xff",
                                           ",",           "!<",
                                           "@",           "`",
                                           "#",           "  ",
                                           "\r",          "999999999999999999999",
                                           "0x7f",        std::string(1, '\0'),
                                           "&a [*a]",     "null",
                                           "\xef\xbb\xbf"};
  std::mt19937 random(7);
  const auto below = [&](std::size_t n) { return std::size_t{random() % n}; };
  int loaded = 0;
  for (int round = 0; round < 1500; ++round) {
    std::string text = good;
    for (std::size_t edits = 1 + below(4); edits > 0; --edits) {
      const std::size_t at = below(text.size());
      switch (below(4)) {
        case 0:
          text.insert(at, pieces[below(pieces.size())]);
          break;
        case 1:
          text.erase(at, 1 + below(30));
          break;
        case 2:
          text[at] = static_cast<char>(random() & 255u);
          break;
        default:
          text.insert(at, text.substr(below(text.size()), below(60)));
      }
    }
    try {
      parse(text);
      ++loaded;
    } catch (const ConfigError& error) {
      EXPECT_STRNE(error.what(), "");
    } catch (const std::exception& error) {
      ADD_FAILURE() << error.what() << "\n" << text;
    }
  }
  EXPECT_GT(loaded, 0);
  EXPECT_LT(loaded, 1500);
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// The rig file: one YAML for a vehicle or data set, shared by all nodelets and tools.
///
/// Loading checks everything and reports every problem at once, each with key, value and rule;
/// unknown keys are errors (with the nearest known key). Relative paths are relative to the rig
/// file. The keys are documented in config/usyd.yaml; a key's name equals the field's.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "semantic_lidar_fusion/common/label_set.h"
#include "semantic_lidar_fusion/config/overlap_rule.h"
#include "semantic_lidar_fusion/lidar/lidar_spec.h"
#include "semantic_lidar_fusion/lidar/packet_decoder.h"
#include "semantic_lidar_fusion/lidar/point_cloud_reader.h"
#include "semantic_lidar_fusion/motion/compensation.h"
#include "semantic_lidar_fusion/projection/occlusion_config.h"
#include "semantic_lidar_fusion/smoothing/surface_smoother.h"
#include "semantic_lidar_fusion/superpixel/uncertainty.h"
#include "semantic_lidar_fusion/sync/scan_selector.h"
#include "semantic_lidar_fusion/uncertainty/errors.h"

namespace YAML {
class Node;
}

namespace semantic_lidar_fusion {

enum class ImageTransport : std::uint8_t { kRaw, kCompressed };
enum class CameraInput : std::uint8_t { kScores, kLabels, kProbabilities };

/// A file that calibrates the lens, in place of camera_info (see camera/lens_file.h).
struct LensFileConfig {
  std::string file;    ///< path; empty = camera_info calibrates it
  std::string camera;  ///< the camera's key in a file of several
  std::string frame;   ///< the camera's tf frame; empty = camera_info's, which must come then
  std::shared_ptr<const LensCalibration> calibration;  ///< what the file holds; null without one
};

/// A correction of where tf puts a camera, as one finds it by eye: the camera is turned about the
/// axes of the lidar (roll, then pitch, then yaw) and shifted along them.
struct CameraNudge {
  std::array<double, 3> deg{};  ///< about x, y, z
  std::array<double, 3> m{};    ///< along x, y, z

  bool operator==(const CameraNudge& other) const { return deg == other.deg && m == other.m; }
  /// The corrected extrinsics; those given, bit by bit, without a correction.
  Transform applied(const Transform& T_camera_lidar) const;
};

struct CameraConfig {
  std::string name;  ///< [A-Za-z][A-Za-z0-9_]*; output topics live in /<name>/
  std::string ns;    ///< key `namespace`: topics of the camera, e.g. /gmsl/A0; default: name
  std::string image = "image";  ///< topic below `namespace`
  std::string camera_info = "camera_info";
  std::string scores = "scores";  ///< or labels / probabilities, after `input`
  ImageTransport transport = ImageTransport::kRaw;
  bool rectified = false;
  CameraInput input = CameraInput::kScores;
  std::string mask;          ///< path of an 8-bit image, 0 = never transfer; empty = none
  ScoreFormat score_format;  ///< keys score_scale, score_offset
  double max_theta_deg = 0.0;
  RowBand lidar_rows;             ///< that the lidar's points can reach
  bool finds_lidar_rows = false;  ///< `lidar_rows: auto`: they are found, see LidarRows
  LensFileConfig lens;
  ShutterConfig shutter;
  CameraNudge nudge;
  double time_offset_s = 0.0;           ///< key time_offset
  double max_time_difference_s = 0.05;  ///< key max_time_difference
  double timeout_s = 0.2;               ///< key timeout
  double reorder_window_s = 0.0;        ///< key reorder_window; see SelectorCamera
  CameraErrors errors;  ///< keys extrinsics {deg, m} or extrinsic_runs, a file; intrinsics_px

  /// Whether the rig file says all of the camera that camera_info could.
  bool withoutCameraInfo() const { return lens.calibration && !lens.frame.empty(); }
  /// The camera_info of such a camera.
  CameraInfo assumedInfo() const {
    CameraInfo info;
    info.frame_id = lens.frame;
    return info;
  }
  CameraModelOptions modelOptions() const {
    return {rectified, max_theta_deg, lens.calibration, shutter};
  }
};

enum class LidarInput : std::uint8_t { kPackets, kPoints };

struct LidarConfig {
  LidarInput input = LidarInput::kPackets;
  std::string topic;                 ///< default: velodyne_packets or points, after `input`
  const LidarSpec* model = nullptr;  ///< key `model: auto|NAME`; null = auto, see lidarSpecs()
  std::string frame;                 ///< overrides the messages' frame; empty = theirs
  double min_range_m = 0.0;          ///< 0 = no limit
  double max_range_m = 0.0;
  double largest_coordinate_m = 10000.0;  ///< of a point; beyond it none is measured
  double longest_scan_s =
      1.0;                 ///< points and packets farther than this from the middle are outliers
  std::string time_field;  ///< empty = detect
  TimeUnit time_unit = TimeUnit::kAuto;
  TimeReference time_reference = TimeReference::kAuto;
  WithoutTime without_time = WithoutTime::kInstant;
  PacketStamp packet_stamp = PacketStamp::kStart;
  double time_offset_s = 0.0;              ///< key time_offset
  std::vector<double> vertical_offsets_m;  ///< per ring, lowest first; empty = none

  PacketDecoderConfig packetConfig() const;
  PointCloudReaderConfig cloudConfig() const;
};

enum class OdometrySource : std::uint8_t { kTf, kTopic };

struct OdometryConfig {
  OdometrySource source = OdometrySource::kTf;
  std::string topic = "odom";  ///< nav_msgs/Odometry, for `source: topic`
  double time_offset_s = 0.0;  ///< key time_offset
  OdometryLookup lookup = OdometryLookup::kInterpolate;
  OnMissingOdometry on_missing = OnMissingOdometry::kMark;
  double max_extrapolation_s = 0.1;   ///< key max_extrapolation
  double timeout_s = 0.1;             ///< key timeout
  double largest_coordinate_m = 1e8;  ///< of any pose and transform; beyond it they are refused
  double fastest_mps = 100.0;  ///< faster steps are jumps, and not interpolated; 0 = no limit
};

struct ReferenceConfig {
  ReferenceChoice choose = ReferenceChoice::kClosestImage;
  std::string camera;      ///< default: the first camera
  double timeout_s = 0.2;  ///< key timeout
};

struct SuperpixelConfig {
  int count = 1000;
  double compactness = 10.0;
  int iterations = 10;
  double scale = 0.0;  ///< of the image; 0 (absent) = the size of the scores
  bool warm_start = true;
};

enum class SegmentationMode : std::uint8_t { kOnRequest, kFreeRunning };

struct SegmentationConfig {
  std::string model;  ///< path of a model file (see segmentation/model.h); empty = none
  SegmentationMode mode = SegmentationMode::kOnRequest;
};

/// What is looked at beside the rules that always run; see check/rig_watch.h.
struct CheckConfig {
  bool live = false;  ///< nodelets: the lidar's edges against those of the images, one scan in 100
};

struct Rig {
  /// Every key that the loader knows, with what it came to: overrides applied, defaults filled in,
  /// paths absolute, the class set in place. A rig file of its own: it loads again as this rig.
  std::string yaml;
  std::string name;                   ///< default: the rig file's, without extension
  LabelSet classes;                   ///< key `classes`: {file: PATH}, a path or a set in place
  std::vector<CameraConfig> cameras;  ///< at most 16; the position is the bit in `cameras`
  LidarConfig lidar;
  std::string fixed_frame = "odom";
  std::string vehicle_frame = "base_link";
  std::string tf_topic = "/tf";                ///< key tf.topic, of nodelets and input bags
  std::string tf_static_topic = "/tf_static";  ///< key tf.static_topic
  SuperpixelConfig superpixels;
  UncertaintyConfig uncertainty;
  bool motion_enabled = true;                                         ///< key motion.enabled
  MotionGranularity motion_granularity = MotionGranularity::kFiring;  ///< key motion.granularity
  OdometryConfig odometry;
  ReferenceConfig reference;
  ImageChoice image_choice = ImageChoice::kClosestToReference;
  SegmentationConfig segmentation;
  OcclusionConfig occlusion;
  RigErrors errors;
  TransferRule transfer = TransferRule::kExpected;
  OverlapRule overlap = OverlapRule::kMean;
  SmoothingConfig smoothing;
  bool keep_unlabelled = true;
  CheckConfig check;
  int threads = 1;  ///< that share the cameras of a scan; results do not depend on it

  /// Index of the reference camera; -1 without cameras.
  int referenceCamera() const;
  SelectorConfig selectorConfig() const;
  /// Takes over from a rig of the same cameras what may change while it runs: occlusion,
  /// uncertainty, smoothing, overlap, threads, and the cameras' time offsets and nudges. All else
  /// stays, and so do the addresses of the cameras.
  void retune(const Rig& other);
  CompensationConfig compensationConfig() const;
};

/// Loads and checks. `overrides`: "key=value", keys with dots ("occlusion.mode=paper"), cameras by
/// name ("cameras.A0.max_theta_deg=50"), other list elements by position, values in YAML, no value
/// for an empty text; applied in order before checking. Throws ConfigError with every problem.
Rig loadRig(const std::string& path, const std::vector<std::string>& overrides = {});
/// The same for a tree that is already in memory; relative paths are relative to `base_directory`.
Rig rigFromYaml(const YAML::Node& root, const std::string& base_directory,
                const std::string& source_name, const std::vector<std::string>& overrides = {});

}  // namespace semantic_lidar_fusion

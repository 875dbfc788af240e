// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/drive_simulation.h"

#include <nav_msgs/Odometry.h>
#include <sensor_msgs/CameraInfo.h>
#include <sensor_msgs/CompressedImage.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/PointCloud2.h>
#include <std_msgs/String.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <cmath>
#include <iterator>
#include <map>
#include <memory>
#include <opencv2/imgcodecs.hpp>
#include <set>
#include <sstream>
#include <vector>

#include "edge/conversions.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/fusion/scan_pipeline.h"
#include "semantic_lidar_fusion/lidar/packet_decoder.h"
#include "semantic_lidar_fusion/sync/scan_selector.h"
#include "tools/common/bag_output.h"
#include "tools/common/progress_bar.h"
#include "tools/simulate_drive/camera.h"
#include "tools/simulate_drive/drive_path.h"
#include "tools/simulate_drive/errors.h"
#include "tools/simulate_drive/exposure.h"
#include "tools/simulate_drive/lidar.h"
#include "tools/simulate_drive/network.h"
#include "tools/simulate_drive/noise.h"
#include "tools/simulate_drive/odometry.h"
#include "tools/simulate_drive/rig.h"
#include "tools/simulate_drive/street.h"
#include "tools/simulate_drive/visibility.h"

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

constexpr StampNs kStartNs = StampNs{1535562000} * kNsPerSecond;  // stamp of time 0
constexpr double kOdometryHz = 100.0;
constexpr double kOdometryMarginS = 0.4;  // before and after the drive
constexpr double kImageMarginS = 0.1;
constexpr double kImagePhaseS = 0.0113;  // images keep no step with the lidar
constexpr int kReferenceCamera = 0;
constexpr StampNs kScoreDelayNs = 40000000;
constexpr int kScoreStride = 8;  // full-resolution pixels a cell
constexpr int kJpegQuality = 92;

std_msgs::Header headerOf(StampNs stamp, const std::string& frame) {
  std_msgs::Header header;
  header.stamp = rosTime(stamp);
  header.frame_id = frame;
  return header;
}

geometry_msgs::TransformStamped transformMessage(const Transform& T, StampNs stamp,
                                                 const std::string& parent,
                                                 const std::string& child) {
  const Eigen::Quaterniond q(T.linear());
  geometry_msgs::TransformStamped message;
  message.header = headerOf(stamp, parent);
  message.child_frame_id = child;
  message.transform.translation.x = T.translation().x();
  message.transform.translation.y = T.translation().y();
  message.transform.translation.z = T.translation().z();
  message.transform.rotation.x = q.x();
  message.transform.rotation.y = q.y();
  message.transform.rotation.z = q.z();
  message.transform.rotation.w = q.w();
  return message;
}

nav_msgs::Odometry odometryMessage(const Transform& T, double speed, double yaw_rate, StampNs stamp,
                                   const std::string& parent, const std::string& child) {
  const Eigen::Quaterniond q(T.linear());
  nav_msgs::Odometry message;
  message.header = headerOf(stamp, parent);
  message.child_frame_id = child;
  message.pose.pose.position.x = T.translation().x();
  message.pose.pose.position.y = T.translation().y();
  message.pose.pose.position.z = T.translation().z();
  message.pose.pose.orientation.x = q.x();
  message.pose.pose.orientation.y = q.y();
  message.pose.pose.orientation.z = q.z();
  message.pose.pose.orientation.w = q.w();
  message.twist.twist.linear.x = speed;
  message.twist.twist.angular.z = yaw_rate;
  return message;
}

struct Scan {
  SimulatedScan simulated;
  TimedCloud cloud;  ///< as the package decodes it
  ScanInterval interval;
  /// Bit i: PointView of camera i.
  std::vector<std::uint16_t> visible, catchable, apart, silhouette;
  std::vector<float> edge_px;  ///< point by point, the cameras in turn; negative: not seen
  StampNs record_ns = 0;
};

class Simulation {
 public:
  Simulation(const SimulationOptions& options, void (*checkpoint)())
      : options_(options),
        checkpoint_(checkpoint),
        path_(options.duration_s, options.speed_mps),
        errors_(options.errors, options.seed),
        cameras_(makeCameras(options.optics, options.camera_drop_m, errors_)),
        odometry_(path_, options.errors, options.seed, options.exact_odometry) {}

  void run() {
    BagOutput bag(options_.output, "simulate_drive",
                  options_.force ? Existing::kReplace : Existing::kRefuse);
    bag.compress();
    StreetOptions street;
    street.seed = options_.seed;
    street.moving = options_.moving;
    buildStreet(path_, street, &world_);
    simulateScans();
    listImages();
    selectImages();
    writeStatic(&bag);
    ProgressBar progress("images", images_.size(), !options_.quiet);
    std::size_t done = 0;
    for (const StampNs stamp : images_) {
      writeUntil(stamp, &bag);
      renderImages(stamp, &bag);
      checkpoint_();
      progress.update(++done);
    }
    writeUntil(kStartNs + toNs(options_.duration_s + 2.0 * kOdometryMarginS), &bag);
    bag.commit();
  }

 private:
  void simulateScans() {
    LidarOptions lidar;
    lidar.seed = options_.seed;
    lidar.start_ns = kStartNs;
    lidar.T_base_lidar = lidarPose();
    lidar.range_noise = options_.range_noise;
    lidar.threads = options_.threads;
    const PacketDecoder decoder{PacketDecoderConfig{}};
    const int count = static_cast<int>(std::floor(10.0 * options_.duration_s + 1e-6));
    ProgressBar progress("lidar scans", static_cast<std::size_t>(count), !options_.quiet);
    for (int i = 0; i < count; ++i) {
      Scan scan;
      scan.simulated =
          simulateScan(path_, lidar, firstPacketOfScan(i), firstPacketOfScan(i + 1), &world_);
      const StampNs last = scan.simulated.packets.back().stamp;
      scan.record_ns = last + packetPeriodNs();
      scan.cloud = decoder.decode(scan.simulated.packets, last, kLidarFrame).cloud;
      if (scan.cloud.size() != scan.simulated.echoes.size()) {
        throw Error("the decoder finds other points than were simulated");
      }
      scan.interval = scanInterval(scan.cloud);
      scan.visible.assign(scan.cloud.size(), 0);
      scan.catchable = scan.apart = scan.silhouette = scan.visible;
      scan.edge_px.assign(scan.cloud.size() * cameras_.size(), -1.0F);
      scans_.push_back(std::move(scan));
      checkpoint_();
      progress.update(static_cast<std::size_t>(i) + 1);
    }
  }

  void listImages() {
    const double period = 1.0 / options_.image_rate_hz;
    const int first = static_cast<int>(std::ceil((-kImageMarginS - kImagePhaseS) / period));
    for (int k = first; k * period + kImagePhaseS <= options_.duration_s + kImageMarginS; ++k) {
      images_.push_back(kStartNs + toNs(k * period + kImagePhaseS));
    }
  }

  /// Which scans use which images: what the package itself decides on these stamps.
  void selectImages() {
    SelectorConfig config;
    config.cameras.resize(cameras_.size());
    config.image_choice = options_.image_choice;
    const bool sweeps = options_.image_choice == ImageChoice::kClosestToSweep;
    ScanSelector selector(config);
    std::map<StampNs, std::size_t> scan_of;
    std::size_t next_image = 0;
    const auto take = [&](const SelectorDecisions& decisions) {
      for (const SelectionDecision& decision : decisions.selections) {
        if (!decision.image_stamp) continue;
        used_[*decision.image_stamp][decision.camera].push_back(scan_of.at(decision.scan_ns));
      }
    };
    const auto addImagesUntil = [&](StampNs until) {
      for (; next_image < images_.size() && images_[next_image] <= until; ++next_image) {
        for (std::size_t c = 0; c < cameras_.size(); ++c) {
          selector.addImage(static_cast<int>(c), images_[next_image]);
        }
        take(selector.advance(images_[next_image]));
      }
    };
    for (std::size_t i = 0; i < scans_.size(); ++i) {
      addImagesUntil(scans_[i].record_ns);
      scan_of[scans_[i].interval.first_ns] = i;
      SelectorScan scan{scans_[i].interval, {}};
      for (const MountedCamera& mounted : cameras_) {
        if (!sweeps) break;
        const Transform T_camera_lidar = mounted.T_base_said.inverse() * lidarPose();
        scan.sweep_ns.push_back(
            sweepTime(scans_[i].cloud, {mounted.said.sharedModel(), T_camera_lidar}));
      }
      selector.addScan(scan, scans_[i].record_ns);
      take(selector.advance(scans_[i].record_ns));
    }
    addImagesUntil(images_.back());
    take(selector.finish());
    // Live, the choice for the last scan is settled by a later image of the reference camera.
    const auto later = std::upper_bound(images_.begin(), images_.end(),
                                        used_.empty() ? kStartNs : std::prev(used_.end())->first);
    if (later != images_.end()) used_[*later][kReferenceCamera];
    if (!options_.all_images) {
      images_.erase(std::remove_if(images_.begin(), images_.end(),
                                   [&](StampNs stamp) { return used_.count(stamp) == 0; }),
                    images_.end());
    }
  }

  void writeStatic(BagOutput* bag) {
    const StampNs stamp = kStartNs - toNs(kOdometryMarginS);
    tf2_msgs::TFMessage transforms;
    transforms.transforms.push_back(transformMessage(lidarPose(), stamp, "base_link", kLidarFrame));
    for (const MountedCamera& mounted : cameras_) {
      transforms.transforms.push_back(
          transformMessage(mounted.T_base_said, stamp, "base_link", mounted.said_info.frame_id));
    }
    bag->writeLatched("/tf_static", stamp, transforms);
    if (told()) {
      std_msgs::String message;
      message.data = errorsText();
      bag->writeLatched("/truth/errors", stamp, message);
    }
  }

  /// Whether the rig of the bag differs from that of the drive.
  bool told() const {
    const ErrorSizes& sizes = options_.errors;
    return sizes.rotation_deg > 0.0 || sizes.translation_m > 0.0 || sizes.stamp_s > 0.0 ||
           sizes.focal_share > 0.0 || sizes.centre_px > 0.0 || sizes.ofOdometry() ||
           options_.shutter.readout_s > 0.0;
  }

  /// What the bag gets wrong, as JSON (docs/simulator.md lists it).
  std::string errorsText() const {
    std::ostringstream text;
    text.precision(17);
    const ErrorSizes& sizes = options_.errors;
    text << "{\"seed\": " << options_.seed
         << ", \"odometry\": {\"velocity_mps\": " << sizes.velocity_mps
         << ", \"rate_dps\": " << sizes.rate_dps << ", \"correlation_s\": " << sizes.correlation_s
         << "}, \"readout_s\": " << options_.shutter.readout_s << ", \"cameras\": {";
    const auto list = [&text](const char* name, const auto& values, std::size_t count) {
      text << "\"" << name << "\": [";
      for (std::size_t i = 0; i < count; ++i) {
        text << (i == 0 ? "" : ", ") << values[static_cast<int>(i)];
      }
      text << "]";
    };
    for (std::size_t c = 0; c < cameras_.size(); ++c) {
      const Transform T = errors_.ofPose(c);
      const Eigen::AngleAxisd turn(T.linear());
      const Eigen::Vector3d rotation = turn.angle() * turn.axis();
      const CameraInfo& info = cameras_[c].real.info();
      text << (c == 0 ? "\"" : ", \"") << cameras_[c].name << "\": {";
      list("translation_m", T.translation(), 3);
      text << ", ";
      list("rotation_rad", rotation, 3);
      text << ", ";
      const double lens[4] = {info.k[0], info.k[4], info.k[2], info.k[5]};
      list("fx_fy_cx_cy", lens, 4);
      text << ", \"exposed_late_s\": {";
      for (std::size_t i = 0; i < images_.size(); ++i) {
        text << (i == 0 ? "\"" : ", \"") << images_[i] << "\": " << errors_.ofStamp(images_[i], c);
      }
      text << "}}";
    }
    text << "}}";
    return text.str();
  }

  /// Odometry, camera_info and scans, as they come in time.
  void writeUntil(StampNs until, BagOutput* bag) {
    const int last =
        static_cast<int>(std::floor((options_.duration_s + kOdometryMarginS) * kOdometryHz));
    const int first = -static_cast<int>(kOdometryMarginS * kOdometryHz);
    for (; first + readings_ <= last; ++readings_) {
      const double time = (first + readings_) / kOdometryHz;
      const StampNs stamp = kStartNs + toNs(time);
      if (stamp > until) break;
      const Transform T = odometry_.next(time);
      tf2_msgs::TFMessage transforms;
      transforms.transforms.push_back(transformMessage(T, stamp, "odom", "base_link"));
      bag->write("/tf", stamp, transforms);
      bag->write(
          "/zio/odometry/rear", stamp,
          odometryMessage(T, path_.speed(time), path_.yawRate(time), stamp, "odom", "base_link"));
      bag->write("/truth/poses", stamp,
                 odometryMessage(path_.pose(time), path_.speed(time), path_.yawRate(time), stamp,
                                 "world", "base_link"));
      if (readings_ % static_cast<int>(kOdometryHz) == 0) writeCameraInfos(stamp, bag);
    }
    for (; written_scans_ < scans_.size() && scans_[written_scans_].record_ns <= until;
         ++written_scans_) {
      writeScan(scans_[written_scans_], bag);
    }
  }

  void writeCameraInfos(StampNs stamp, BagOutput* bag) {
    for (const MountedCamera& mounted : cameras_) {
      const CameraInfo& info = mounted.said_info;
      sensor_msgs::CameraInfo message;
      message.header = headerOf(stamp, info.frame_id);
      message.width = static_cast<std::uint32_t>(info.size.width);
      message.height = static_cast<std::uint32_t>(info.size.height);
      message.distortion_model = info.distortion_model;
      message.D = info.d;
      std::copy(info.k.begin(), info.k.end(), message.K.begin());
      std::copy(info.r.begin(), info.r.end(), message.R.begin());
      std::copy(info.p.begin(), info.p.end(), message.P.begin());
      bag->writeLatched("/gmsl/" + mounted.name + "/camera_info", stamp, message);
    }
  }

  void writeScan(const Scan& scan, BagOutput* bag) {
    VelodyneScan message;
    message.header = headerOf(scan.simulated.packets.back().stamp, kLidarFrame);
    for (const Packet& packet : scan.simulated.packets) {
      VelodynePacket raw;
      raw.stamp = rosTime(packet.stamp);
      std::copy(packet.data.begin(), packet.data.end(), raw.data.begin());
      message.packets.push_back(raw);
    }
    bag->write(kLidarTopic, scan.record_ns, message);
    bag->write("/points_truth", scan.record_ns, truthMessage(scan));
  }

  sensor_msgs::PointCloud2 truthMessage(const Scan& scan) const {
    sensor_msgs::PointCloud2 message;
    message.header = headerOf(scan.interval.first_ns, kLidarFrame);
    std::uint32_t offset = 0;
    const auto addField = [&](const std::string& name, std::uint32_t at, std::uint8_t type,
                              std::uint32_t size) {
      sensor_msgs::PointField field;
      field.name = name;
      field.offset = at;
      field.datatype = type;
      field.count = 1;
      message.fields.push_back(field);
      offset = at + size;
    };
    addField("x", 0, sensor_msgs::PointField::FLOAT32, 4);
    addField("y", 4, sensor_msgs::PointField::FLOAT32, 4);
    addField("z", 8, sensor_msgs::PointField::FLOAT32, 4);
    addField("label", 12, sensor_msgs::PointField::UINT8, 1);
    addField("visible", 14, sensor_msgs::PointField::UINT16, 2);
    addField("surface", 16, sensor_msgs::PointField::UINT32, 4);
    addField("edge_px", 20, sensor_msgs::PointField::FLOAT32, 4);
    for (const MountedCamera& mounted : cameras_) {
      addField("edge_px_" + mounted.name, offset, sensor_msgs::PointField::FLOAT32, 4);
    }
    const std::uint32_t flags_at = offset;
    addField("catchable", flags_at, sensor_msgs::PointField::UINT16, 2);
    addField("silhouette", flags_at + 2, sensor_msgs::PointField::UINT16, 2);
    addField("apart", flags_at + 4, sensor_msgs::PointField::UINT16, 2);
    message.height = 1;
    message.width = static_cast<std::uint32_t>(scan.cloud.size());
    message.point_step = offset;
    message.row_step = message.point_step * message.width;
    message.is_dense = 1;
    message.data.assign(message.row_step, 0);
    for (std::size_t i = 0; i < scan.cloud.size(); ++i) {
      const Echo& echo = scan.simulated.echoes[i];
      std::uint8_t* point = &message.data[i * message.point_step];
      const float xyz[3] = {scan.cloud.x[i], scan.cloud.y[i], scan.cloud.z[i]};
      std::memcpy(point, xyz, 12);
      point[12] = static_cast<std::uint8_t>(echo.kind);
      std::memcpy(point + 14, &scan.visible[i], 2);
      std::memcpy(point + 16, &echo.surface, 4);
      const float* edges = &scan.edge_px[i * cameras_.size()];
      float least = -1.0F;
      for (std::size_t c = 0; c < cameras_.size(); ++c) {
        if (edges[c] >= 0.0F && (least < 0.0F || edges[c] < least)) least = edges[c];
      }
      std::memcpy(point + 20, &least, 4);
      std::memcpy(point + 24, edges, 4 * cameras_.size());
      std::memcpy(point + flags_at, &scan.catchable[i], 2);
      std::memcpy(point + flags_at + 2, &scan.silhouette[i], 2);
      std::memcpy(point + flags_at + 4, &scan.apart[i], 2);
    }
    return message;
  }

  void renderImages(StampNs stamp, BagOutput* bag) {
    const auto found = used_.find(stamp);
    for (std::size_t c = 0; c < cameras_.size(); ++c) {
      const Camera& camera = cameras_[c].real;
      const bool used = found != used_.end() && found->second.count(static_cast<int>(c)) != 0;
      if (!used && !options_.all_images) continue;
      const std::uint64_t key = mixKeys(options_.seed, static_cast<std::uint64_t>(stamp), c);
      const Exposure exposure(options_.shutter, camera.info().size,
                              toSeconds(stamp - kStartNs) + errors_.ofStamp(stamp, c));
      const Picture picture = camera.render(path_, exposure, key, options_.threads, &world_);
      const std_msgs::Header header = headerOf(stamp, camera.info().frame_id);
      const std::string ns = "/gmsl/" + cameras_[c].name;
      writeImage(picture, ns, stamp, header, bag);
      if (!used) continue;
      bag->write(ns + "/labels_truth", stamp, *imageMessage(picture.labels, header));
      const cv::Mat scores =
          options_.perfect_network
              ? perfectScores(picture.labels)
              : imitateNetwork(picture, scoreSize(), 1.0 / camera.model().axialFocalX(),
                               {options_.seed, key});
      bag->write(ns + "/scores", stamp + kScoreDelayNs, *imageMessage(scores, header));
      savePicture(c, picture);
      const cv::Mat edges = distanceToClassEdge(picture.labels);
      for (const std::size_t scan : found->second.at(static_cast<int>(c))) {
        lookForPoints(c, exposure, picture.labels, edges, &scans_[scan]);
      }
    }
  }

  ImageSize scoreSize() const {
    const ImageSize full =
        options_.optics.lens ? options_.optics.lens->size : ImageSize{kFullWidth, kFullHeight};
    return {std::max(full.width / kScoreStride, 1), std::max(full.height / kScoreStride, 1)};
  }

  void writeImage(const Picture& picture, const std::string& ns, StampNs stamp,
                  const std_msgs::Header& header, BagOutput* bag) const {
    if (options_.raw_images) {
      bag->write(ns + "/image_color", stamp, *imageMessage(picture.image, header));
      return;
    }
    sensor_msgs::CompressedImage message;
    message.header = header;
    message.format = "bgr8; jpeg compressed bgr8";
    if (!cv::imencode(".jpg", picture.image, message.data,
                      {cv::IMWRITE_JPEG_QUALITY, kJpegQuality})) {
      throw Error("OpenCV cannot write JPEG");
    }
    bag->write(ns + "/image_color/compressed", stamp, message);
  }

  void savePicture(std::size_t c, const Picture& picture) {
    if (options_.pictures.empty() || !saved_.insert(c).second) return;
    const std::string name = options_.pictures + "/" + cameras_[c].name;
    if (!cv::imwrite(name + ".png", picture.image) ||
        !cv::imwrite(name + "_labels.png", picture.labels * 20)) {
      throw Error(options_.pictures + ": pictures cannot be written");
    }
  }

  /// A point where an image shows it.
  struct Showing {
    std::size_t point;
    double time_s;  ///< of the line that shows it
    Eigen::Vector2d pixel;
  };

  /// The points of a scan that are before a camera, by lines of the image.
  std::vector<Showing> showingsOf(const Camera& camera, const Exposure& exposure,
                                  const Scan& scan) const {
    constexpr int kMostRounds = 20;
    constexpr double kSettledS = 1e-8;
    std::vector<Showing> showings;
    const ImageSize& size = camera.model().imageSize();
    for (std::size_t i = 0; i < scan.simulated.echoes.size(); ++i) {
      const Echo& echo = scan.simulated.echoes[i];
      // The line follows from the pixel, and the pixel from the line's time.
      double time = exposure.time();
      std::optional<Eigen::Vector2d> pixel;
      for (int round = 0; round < kMostRounds; ++round) {
        const Transform T_camera_world = (path_.pose(time) * camera.T_base_camera()).inverse();
        pixel = camera.model().project(T_camera_world *
                                       world_.toWorld(echo.object, echo.p_object, time));
        if (!pixel) break;
        const double next = exposure.timeAt(
            {std::min(std::max(pixel->x(), -1.0 * size.width), 2.0 * size.width),
             std::min(std::max(pixel->y(), -1.0 * size.height), 2.0 * size.height)});
        if (std::abs(next - time) < kSettledS) break;
        time = next;
      }
      if (pixel && inImage(pixel->x(), pixel->y(), size)) showings.push_back({i, time, *pixel});
    }
    if (exposure.rolling()) {
      std::stable_sort(showings.begin(), showings.end(),
                       [](const Showing& a, const Showing& b) { return a.time_s < b.time_s; });
    }
    return showings;
  }

  /// Marks the points of a scan that the camera sees, by a ray to where each is when it is exposed.
  void lookForPoints(std::size_t c, const Exposure& exposure, const cv::Mat& labels,
                     const cv::Mat& edges, Scan* scan) {
    const Camera& camera = cameras_[c].real;
    const ReturnsAround returns(scan->simulated, path_, lidarPose(), kStartNs, exposure.time());
    const auto mark = [c](std::uint16_t* bits, bool set) {
      if (set) *bits = static_cast<std::uint16_t>(*bits | (1U << c));
    };
    // The world moves on once a line is over.
    const double line_s = options_.shutter.readout_s / exposure.lines();
    double set_s = exposure.time();
    world_.setInstant(set_s);
    for (const Showing& showing : showingsOf(camera, exposure, *scan)) {
      if (std::abs(showing.time_s - set_s) > line_s) world_.setInstant(set_s = showing.time_s);
      const std::size_t i = showing.point;
      const Echo& echo = scan->simulated.echoes[i];
      const Transform T_world_camera = path_.pose(showing.time_s) * camera.T_base_camera();
      const PointView view = viewPoint(world_, returns, T_world_camera.translation(), echo.object,
                                       world_.toWorld(echo.object, echo.p_object, showing.time_s));
      mark(&scan->visible[i], view.visible);
      mark(&scan->catchable[i], view.catchable);
      mark(&scan->apart[i], view.apart);
      mark(&scan->silhouette[i], view.silhouette);
      if (!view.visible) continue;
      // Through a gap smaller than a pixel, the pixel's centre shows something else: an edge.
      const int u = pixelIndex(showing.pixel.x()), v = pixelIndex(showing.pixel.y());
      const bool shown = labels.at<std::uint8_t>(v, u) == static_cast<std::uint8_t>(echo.kind);
      scan->edge_px[i * cameras_.size() + c] = shown ? edges.at<float>(v, u) : 0.0F;
    }
  }

  const SimulationOptions& options_;
  void (*checkpoint_)();
  DrivePath path_;
  DrawnErrors errors_;
  std::vector<MountedCamera> cameras_;
  Odometry odometry_;
  World world_;
  std::vector<Scan> scans_;
  std::vector<StampNs> images_;
  std::map<StampNs, std::map<int, std::vector<std::size_t>>> used_;  ///< by stamp and camera: scans
  std::set<std::size_t> saved_;
  int readings_ = 0;
  std::size_t written_scans_ = 0;
};

}  // namespace

void simulateDrive(const SimulationOptions& options, void (*checkpoint)()) {
  Simulation(options, checkpoint).run();
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
// Bad inputs by hand, row by row of the table of failure modes (test/README.md): what is said of
// each, and that nothing that is not finite comes out.
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <functional>
#include <limits>
#include <map>
#include <opencv2/core.hpp>
#include <set>

#include "edge/conversions.h"
#include "edge/lidar_decoder.h"
#include "edge/tf_pose_source.h"
#include "packet_encoder.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"
#include "semantic_lidar_fusion/config/rig.h"
#include "semantic_lidar_fusion/fusion/semantic_projector.h"
#include "semantic_lidar_fusion/superpixel/uncertainty.h"

namespace semantic_lidar_fusion {
namespace {

const double kNan = std::numeric_limits<double>::quiet_NaN();
const double kInf = std::numeric_limits<double>::infinity();
const float kNanF = std::numeric_limits<float>::quiet_NaN();
const float kInfF = std::numeric_limits<float>::infinity();
constexpr int kClasses = 3;

struct Case {
  int row;
  std::string name;
  std::function<std::string()> run;  ///< what is said: the error, or what was counted
  std::string expected;              ///< a part of it
};

/// The error of `work`, or what it returns.
std::string said(const std::function<std::string()>& work) {
  try {
    return work();
  } catch (const Error& error) {
    return error.what();
  }
}

// --- Row 8: camera_info

sensor_msgs::CameraInfo goodInfo(const std::string& model = "equidistant") {
  sensor_msgs::CameraInfo info;
  info.header.frame_id = "camera";
  info.width = 640;
  info.height = 400;
  info.distortion_model = model;
  info.D = {-0.05, 0.01, -0.003, 0.0004};
  if (model == "plumb_bob") info.D = {-0.2, 0.05, 0.001, 0.001, 0.0};
  if (model == "rational_polynomial") info.D.assign(8, 0.01);
  if (model.empty()) info.D.clear();
  info.K = {300, 0, 319.5, 0, 300, 199.5, 0, 0, 1};
  info.R = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  info.P = {300, 0, 319.5, 0, 0, 300, 199.5, 0, 0, 0, 1, 0};
  return info;
}

void cameraInfoCases(std::vector<Case>* cases) {
  const auto add = [&](const std::string& name, const std::string& model, bool rectified,
                       std::function<void(sensor_msgs::CameraInfo&)> spoil,
                       const std::string& expected) {
    cases->push_back({8, name,
                      [=] {
                        return said([&] {
                          sensor_msgs::CameraInfo info = goodInfo(model);
                          spoil(info);
                          CameraModelOptions options;
                          options.rectified = rectified;
                          const CameraModel camera(cameraInfo(info), options);
                          return std::string("accepted");
                        });
                      },
                      expected});
  };
  using Info = sensor_msgs::CameraInfo;
  const char* const kFisheye = "equidistant";
  for (const char* model : {"pear_shaped", "Equidistant", "equidistant ", "kannala_brandt4", "fov",
                            "omnidirectional", "thin_prism_fisheye", "PLUMB_BOB", "none"}) {
    add(
        std::string("model '") + model + "'", kFisheye, false,
        [model](Info& i) { i.distortion_model = model; },
        std::string("distortion_model = '") + model + "'");
  }
  for (const std::size_t count : {0u, 1u, 3u, 5u, 8u}) {
    add(
        "equidistant with " + std::to_string(count) + " coefficients", kFisheye, false,
        [count](Info& i) { i.D.assign(count, 0.001); }, "D.size = " + std::to_string(count));
  }
  for (const std::size_t count : {1u, 3u, 6u, 8u}) {
    add(
        "plumb_bob with " + std::to_string(count) + " coefficients", "plumb_bob", false,
        [count](Info& i) { i.D.assign(count, 0.001); }, "D.size = " + std::to_string(count));
  }
  for (const std::size_t count : {0u, 4u, 5u, 9u, 15u}) {
    add(
        "rational_polynomial with " + std::to_string(count) + " coefficients",
        "rational_polynomial", false, [count](Info& i) { i.D.assign(count, 0.001); },
        "D.size = " + std::to_string(count));
  }
  add(
      "coefficients without a model", "", false, [](Info& i) { i.D.assign(4, 0.1); }, "D holds 4");
  for (const double bad : {kNan, kInf, -kInf}) {
    const std::string text = std::isnan(bad) ? "nan" : bad > 0 ? "inf" : "-inf";
    add(
        "D[2] is " + text, kFisheye, false, [bad](Info& i) { i.D[2] = bad; }, "D[2]");
    add(
        "K[0] is " + text, kFisheye, false, [bad](Info& i) { i.K[0] = bad; }, "K[0]");
    add(
        "K[2] is " + text, kFisheye, false, [bad](Info& i) { i.K[2] = bad; }, "K[2]");
    add(
        "R[4] is " + text, kFisheye, false, [bad](Info& i) { i.R[4] = bad; }, "R");
    add(
        "P[3] is " + text + ", rectified", kFisheye, true, [bad](Info& i) { i.P[3] = bad; },
        "P[3]");
  }
  add(
      "K of zeros", kFisheye, false, [](Info& i) { i.K.fill(0); }, "K[0]");
  add(
      "skew beyond all numbers", kFisheye, false, [](Info& i) { i.K[0] = 1e-300, i.K[1] = 1e20; },
      "K[1]");
  add(
      "fy of zero", kFisheye, false, [](Info& i) { i.K[4] = 0; }, "K[4]");
  add(
      "fx negative", kFisheye, false, [](Info& i) { i.K[0] = -300; }, "K[0]");
  add(
      "P of zeros, rectified", kFisheye, true, [](Info& i) { i.P.fill(0); }, "P[0]");
  add(
      "width of zero", kFisheye, false, [](Info& i) { i.width = 0; }, "width");
  add(
      "height of zero", kFisheye, false, [](Info& i) { i.height = 0; }, "height");
  add(
      "size beyond all", kFisheye, false, [](Info& i) { i.width = 0xFFFFFFFF; }, "width");
  add(
      "R is a scaling", kFisheye, false, [](Info& i) { i.R = {2, 0, 0, 0, 2, 0, 0, 0, 2}; },
      "rotation");
  add(
      "R is a reflection", kFisheye, false, [](Info& i) { i.R[0] = -1; }, "rotation");
  add(
      "ROI beside the image", kFisheye, false,
      [](Info& i) { i.roi.x_offset = 640, i.roi.width = 1, i.roi.height = 1; }, "roi.x_offset");
  add(
      "ROI too wide", kFisheye, false,
      [](Info& i) { i.roi.x_offset = 600, i.roi.width = 41, i.roi.height = 9; }, "roi.width");
  add(
      "ROI without height", kFisheye, false, [](Info& i) { i.roi.width = 5; }, "roi.height");
  add(
      "binning beyond the image", kFisheye, false, [](Info& i) { i.binning_x = 700; }, "binning_x");
  add(
      "binning overflows", kFisheye, false, [](Info& i) { i.binning_y = 0x80000000; }, "binning_y");
}

// --- Rows 10, 11, 13: images of scores, shares, labels and probabilities

sensor_msgs::Image imageOf(const std::string& encoding, std::uint32_t width, std::uint32_t height,
                           std::uint32_t pixel_bytes) {
  sensor_msgs::Image message;
  message.encoding = encoding;
  message.width = width;
  message.height = height;
  message.step = width * pixel_bytes;
  message.data.assign(static_cast<std::size_t>(message.step) * height, 1);
  return message;
}

sensor_msgs::Image scoresOf(const std::vector<float>& cell, std::uint32_t width = 4,
                            std::uint32_t height = 3) {
  sensor_msgs::Image message = imageOf("32FC" + std::to_string(cell.size()), width, height,
                                       static_cast<std::uint32_t>(4 * cell.size()));
  for (std::size_t i = 0; i < message.data.size() / 4; ++i) {
    std::memcpy(&message.data[4 * i], &cell[i % cell.size()], 4);
  }
  return message;
}

SuperpixelMap twoHalves(int columns, int rows) {
  SuperpixelMap map;
  map.ids.create(rows, columns, CV_32SC1);
  map.count = columns > 1 ? 2 : 1;
  map.sizes.assign(static_cast<std::size_t>(map.count), 0);
  for (int row = 0; row < rows; ++row) {
    for (int column = 0; column < columns; ++column) {
      const int id = column < (columns + 1) / 2 ? 0 : 1;
      map.ids.at<int>(row, column) = id;
      ++map.sizes[static_cast<std::size_t>(id)];
    }
  }
  return map;
}

std::shared_ptr<const CameraModel> pinhole() {
  sensor_msgs::CameraInfo info = goodInfo("");
  return std::make_shared<const CameraModel>(cameraInfo(info), CameraModelOptions());
}

Cloud wall() {
  Cloud cloud;
  cloud.frame_id = "lidar";
  cloud.stamp = 100 * kNsPerSecond;
  cloud.resize(30);
  for (std::size_t i = 0; i < 30; ++i) {
    cloud.x[i] = -2.0f + static_cast<float>(i % 6);
    cloud.y[i] = -1.0f + 0.5f * static_cast<float>(i / 6);
    cloud.z[i] = 5.0f;
    cloud.ring[i] = static_cast<std::uint16_t>(i / 6);
    cloud.intensity[i] = cloud.dt[i] = 0.0f;
    cloud.status[i] = 0;
  }
  return cloud;
}

/// The fused wall, in words: how many points are uniform, fused, or of no class.
std::string fusedWall(const ImageSemantics& semantics) {
  FusionConfig config;
  config.class_count = kClasses;
  config.occlusion.mode = &OcclusionMode::kOff;
  CameraView view;
  view.name = "camera";
  view.model = pinhole();
  view.has_image = true;
  view.image_ns = 100 * kNsPerSecond;
  view.semantics = semantics;
  const SemanticCloud cloud = SemanticProjector(config).fuse(wall(), {view}).cloud;
  std::size_t uniform = 0, fused = 0;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const float* p = &cloud.probabilities[i * kClasses];
    if (cloud.points.status[i] == 0) {
      ++fused;
      EXPECT_NEAR(double{p[0]} + p[1] + p[2], 1.0, 1e-5);
      uniform += std::abs(p[0] - 1.0f / 3) < 1e-6f && std::abs(p[1] - 1.0f / 3) < 1e-6f;
    }
    for (int c = 0; c < kClasses; ++c) EXPECT_TRUE(std::isfinite(p[c]));
    EXPECT_TRUE(std::isfinite(cloud.confidence[i]) && std::isfinite(cloud.entropy[i]));
  }
  EXPECT_GT(fused, 0u);
  return uniform == fused ? "uniform" : uniform == 0 ? "fused" : "partly uniform";
}

std::string fusedScores(const sensor_msgs::Image& message) {
  return said([&] {
    const cv::Mat image = pixelView(message);
    ImageSemantics semantics;
    semantics.scores = ScoreMap(image, kClasses, {});
    const ShareMap share = computeShare(twoHalves(image.cols, image.rows), semantics.scores);
    semantics.share = share.share;
    for (const float spp : share.superpixel) EXPECT_TRUE(spp > 0 && spp <= 1);
    const std::string fused = fusedWall(semantics);
    return fused + ", " + std::to_string(share.nonfinite_cells) + " cells without a vote";
  });
}

std::string fusedShare(float share) {
  return said([&] {
    const sensor_msgs::Image scores = scoresOf({1, 5, 2});
    ImageSemantics semantics;
    semantics.scores = ScoreMap(pixelView(scores), kClasses, {});
    semantics.share = cv::Mat(3, 4, CV_32FC1, cv::Scalar(share));
    return fusedWall(semantics);
  });
}

std::string fusedProbabilities(const sensor_msgs::Image& message) {
  return said([&] {
    ImageSemantics semantics;
    semantics.probabilities = pixelView(message);
    return fusedWall(semantics);
  });
}

void imageCases(std::vector<Case>* cases) {
  // Row 10: six encodings, four sizes, three numbers of channels. Any size serves; a wrong number
  // of channels or another type does not.
  const struct {
    const char* prefix;
    std::uint32_t bytes;
    bool is_score;
  } kTypes[] = {{"32FC", 4, true},  {"16UC", 2, true},  {"8UC", 1, true},
                {"64FC", 8, false}, {"32SC", 4, false}, {"16SC", 2, false}};
  const std::pair<std::uint32_t, std::uint32_t> kSizes[] = {{1, 1}, {4, 3}, {37, 5}, {640, 400}};
  for (const auto& type : kTypes) {
    for (const auto& size : kSizes) {
      for (const std::uint32_t channels : {1u, 3u, 12u}) {
        const std::string encoding = type.prefix + std::to_string(channels);
        const auto bytes = type.bytes * channels;
        const std::string expected = !type.is_score         ? "depth"
                                     : channels != kClasses ? std::to_string(channels)
                                                            : "without a vote";
        cases->push_back(
            {10,
             "scores " + encoding + " of " + std::to_string(size.first) + "x" +
                 std::to_string(size.second),
             [=] { return fusedScores(imageOf(encoding, size.first, size.second, bytes)); },
             expected});
      }
    }
  }
  const auto broken = [&](const std::string& name, std::function<void(sensor_msgs::Image&)> spoil,
                          const std::string& expected, int row = 10) {
    cases->push_back({row, name,
                      [spoil] {
                        sensor_msgs::Image message = scoresOf({1, 2, 3});
                        spoil(message);
                        return fusedScores(message);
                      },
                      expected});
  };
  using Image = sensor_msgs::Image;
  for (const char* encoding : {"klingon16", "32fc3", "32FC", "32FC0", "32FC-3", "32FC3 ", "C3",
                               "32F3", "99UC3", "32FC99999"}) {
    broken(
        std::string("encoding '") + encoding + "'", [encoding](Image& m) { m.encoding = encoding; },
        std::string("encoding '") + encoding + "' is not known");
  }
  broken(
      "encoding without a name", [](Image& m) { m.encoding = ""; }, "encoding '' is not known");
  broken(
      "more channels than OpenCV has", [](Image& m) { m.encoding = "32FC600"; }, "600 channels");
  broken(
      "colours in place of scores", [](Image& m) { m = imageOf("bgra8", 4, 3, 4); }, "4");
  broken(
      "data cut off", [](Image& m) { m.data.resize(m.data.size() / 2); }, "72 bytes");
  broken(
      "data missing", [](Image& m) { m.data.clear(); }, "0 bytes");
  broken(
      "data too long", [](Image& m) { m.data.resize(200); }, "200 bytes");
  broken(
      "step too small", [](Image& m) { m.step = 47; }, "step 47");
  broken(
      "step that splits a number", [](Image& m) { m.step = 49, m.data.resize(49 * 3); }, "step 49");
  broken(
      "step of zero", [](Image& m) { m.step = 0; }, "step 0");
  broken(
      "step beyond the data", [](Image& m) { m.step = 0xFFFFFFFC; }, "bytes");
  broken(
      "width times pixel overflows", [](Image& m) { m.width = 0x20000000; }, "536870912x3");
  broken(
      "height beyond the data", [](Image& m) { m.height = 1000; }, "bytes");
  broken(
      "other endianness", [](Image& m) { m.is_bigendian = 1; }, "endianness");
  broken(
      "image of 0x0", [](Image& m) { m.width = m.height = 0; }, "0x0", 13);
  broken(
      "image without rows", [](Image& m) { m.height = 0; }, "4x0", 13);
  broken(
      "image without columns", [](Image& m) { m.width = 0; }, "0x3", 13);

  // Row 11: values.
  const auto values = [&](const std::string& name, const std::vector<float>& cell,
                          const std::string& expected) {
    cases->push_back({11, name, [cell] { return fusedScores(scoresOf(cell)); }, expected});
  };
  values("scores NaN", {kNanF, kNanF, kNanF}, "uniform, 12 cells");
  values("one score NaN", {1, kNanF, 2}, "uniform, 12 cells");
  values("one score +Inf", {1, kInfF, 2}, "uniform, 12 cells");
  values("one score -Inf", {1, -kInfF, 2}, "uniform, 12 cells");
  values("scores +Inf and -Inf", {kInfF, -kInfF, 0}, "uniform, 12 cells");
  values("scores all zero", {0, 0, 0}, "uniform, 0 cells");
  values("scores all equal", {7, 7, 7}, "uniform, 0 cells");
  values("scores at the end of float", {3e38f, -3e38f, 0}, "fused, 0 cells");
  values("scores huge and equal", {3e38f, 3e38f, 3e38f}, "uniform, 0 cells");
  values("scores huge and negative", {-3e38f, -3e38f, -1e38f}, "fused, 0 cells");
  values("scores denormal", {1e-42f, 2e-42f, 0}, "uniform, 0 cells");
  values("scores of a million", {1e6f, -1e6f, 1e6f}, "fused, 0 cells");
  for (const float share : {0.0f, -1.0f, 1.5f, kNanF, kInfF, -kInfF}) {
    cases->push_back({11, "share of " + std::to_string(share),
                      [share] { return fusedShare(share); }, "uniform"});
  }
  cases->push_back({11, "share of next to nothing", [] { return fusedShare(1e-30f); }, "uniform"});
  const auto probabilities = [&](const std::string& name, const std::vector<float>& cell,
                                 const std::string& expected) {
    cases->push_back({11, name, [cell] { return fusedProbabilities(scoresOf(cell)); }, expected});
  };
  probabilities("probabilities NaN", {kNanF, 0.5f, 0.5f}, "uniform");
  probabilities("probabilities infinite", {kInfF, 0, 0}, "uniform");
  probabilities("probabilities negative", {1.2f, -0.1f, -0.1f}, "uniform");
  probabilities("probabilities all zero", {0, 0, 0}, "uniform");
  probabilities("probabilities that sum to 20", {10, 5, 5}, "fused");
  probabilities("probabilities at the end of float", {3e38f, 3e38f, 0}, "fused");
  probabilities("probabilities of two classes", {0.5f, 0.5f}, "2 channels");
  cases->push_back({11, "labels beyond the classes",
                    [] {
                      const sensor_msgs::Image labels = imageOf("mono8", 4, 3, 1);
                      cv::Mat ids = pixelView(labels).clone();
                      ids.setTo(200);
                      ImageSemantics semantics;
                      semantics.probabilities = histogramProbabilities(twoHalves(4, 3), ids, 3);
                      return fusedWall(semantics);
                    },
                    "uniform"});
  cases->push_back({10, "labels in colour",
                    [] {
                      return said([] {
                        const sensor_msgs::Image labels = imageOf("bgr8", 4, 3, 3);
                        histogramProbabilities(twoHalves(4, 3), pixelView(labels), 3);
                        return std::string("accepted");
                      });
                    },
                    "label"});
  const auto compressed = [&](const std::string& name, std::vector<std::uint8_t> data) {
    cases->push_back({10, name,
                      [data] {
                        return said([&] {
                          sensor_msgs::CompressedImage message;
                          message.format = "jpeg";
                          message.data = data;
                          decodedImage(message);
                          return std::string("accepted");
                        });
                      },
                      "compressed image"});
  };
  compressed("compressed image without bytes", {});
  compressed("compressed image of one byte", {0xFF});
  compressed("JPEG that is a header only", {0xFF, 0xD8, 0xFF, 0xE0, 0, 16, 'J', 'F', 'I', 'F'});
  compressed("PNG that is a header only", {0x89, 'P', 'N', 'G', 0x0D, 0x0A, 0x1A, 0x0A});
  compressed("text in place of an image", {'h', 'e', 'l', 'l', 'o'});
}

// --- Rows 12, 13, 14, 16: clouds

struct Layout {
  sensor_msgs::PointCloud2 message;

  explicit Layout(std::uint32_t points) {
    message.header.frame_id = "velodyne";
    message.header.stamp = ros::Time(1546300800, 0);
    message.width = points;
    message.height = 1;
    message.point_step = 20;
    message.row_step = 20 * points;
    message.data.assign(message.row_step, 0);
    const char* const names[] = {"x", "y", "z", "intensity", "t"};
    for (std::uint32_t i = 0; i < 5; ++i) {
      sensor_msgs::PointField field;
      field.name = names[i];
      field.offset = 4 * i;
      field.datatype = i == 4 ? sensor_msgs::PointField::UINT32 : sensor_msgs::PointField::FLOAT32;
      field.count = 1;
      message.fields.push_back(field);
    }
    for (std::uint32_t p = 0; p < points; ++p) {
      set(p, 0, 5.0f + static_cast<float>(p));
      set(p, 2, 1.0f);
      const std::uint32_t t = p * 1000000;
      std::memcpy(&message.data[20 * p + 16], &t, 4);
    }
  }
  void set(std::uint32_t point, std::uint32_t field, float value) {
    std::memcpy(&message.data[20 * point + 4 * field], &value, 4);
  }
};

std::string decoded(const sensor_msgs::PointCloud2& message, const LidarConfig& config = {}) {
  return said([&] {
    std::string counted;
    LidarDecoder decoder(config, [&](const std::string& reason, std::uint64_t count) {
      if (count > 0) counted += ", " + std::to_string(count) + " " + reason;
    });
    const TimedCloud cloud = decoder.decode(message);
    for (std::size_t i = 0; i < cloud.size(); ++i) {
      EXPECT_TRUE(std::isfinite(cloud.x[i]) && std::isfinite(cloud.y[i]) &&
                  std::isfinite(cloud.z[i]) && std::isfinite(cloud.intensity[i]));
    }
    return std::to_string(cloud.size()) + " points" + counted;
  });
}

std::string compensatedOf(const sensor_msgs::PointCloud2& message) {
  return said([&] {
    const Cloud cloud = compensatedCloud(message);
    for (std::size_t i = 0; i < cloud.size(); ++i) EXPECT_TRUE(std::isfinite(cloud.intensity[i]));
    return std::to_string(cloud.size()) + " points";
  });
}

void cloudCases(std::vector<Case>* cases) {
  const auto add = [&](int row, const std::string& name, std::function<void(Layout&)> spoil,
                       const std::string& expected, std::uint32_t points = 6) {
    cases->push_back({row, name,
                      [=] {
                        Layout layout(points);
                        spoil(layout);
                        return decoded(layout.message);
                      },
                      expected});
  };
  // Row 12
  for (const std::uint32_t field : {0u, 1u, 2u}) {
    for (const float bad : {kNanF, kInfF, -kInfF}) {
      add(
          12, "coordinate " + std::to_string(field) + " is " + std::to_string(bad),
          [=](Layout& l) { l.set(2, field, bad); }, "5 points, 1 points that are not finite");
    }
  }
  add(
      12, "dense by its flag, NaN in truth",
      [](Layout& l) {
        l.message.is_dense = true;
        for (std::uint32_t p = 0; p < 6; ++p) l.set(p, 0, kNanF);
      },
      "0 points, 6 points that are not finite");
  add(
      12, "intensity NaN", [](Layout& l) { l.set(1, 3, kNanF); }, "6 points");
  add(
      12, "intensity infinite", [](Layout& l) { l.set(1, 3, kInfF); }, "6 points");
  add(
      12, "coordinates at the end of float", [](Layout& l) { l.set(0, 0, 3e38f); }, "points");
  add(
      12, "points at the sensor's origin", [](Layout& l) { l.set(0, 0, 0), l.set(0, 2, 0); },
      "points");

  // Row 13
  add(
      13, "cloud without points", [](Layout&) {}, "0 points", 0);
  add(
      13, "cloud of no rows", [](Layout& l) { l.message.height = 0, l.message.data.clear(); },
      "0 points");
  add(
      13, "cloud without points and fields",
      [](Layout& l) { l.message = sensor_msgs::PointCloud2(), l.message.header.frame_id = "v"; },
      "0 points", 0);

  // Row 14
  using Field = sensor_msgs::PointField;
  add(
      14, "big-endian", [](Layout& l) { l.message.is_bigendian = true; }, "is_bigendian");
  add(
      14, "data cut off", [](Layout& l) { l.message.data.pop_back(); }, "119 bytes");
  add(
      14, "data missing", [](Layout& l) { l.message.data.clear(); }, "0 bytes");
  add(
      14, "data too long", [](Layout& l) { l.message.data.push_back(0); }, "121 bytes");
  add(
      14, "row_step too small for data that fit", [](Layout& l) { l.message.row_step = 119; },
      "6 points");
  add(
      14, "row_step of zero", [](Layout& l) { l.message.row_step = 0; }, "6 points");
  add(
      14, "row_step beyond all", [](Layout& l) { l.message.row_step = 0xFFFFFFFF; }, "6 points");
  add(
      14, "row_step and data too small",
      [](Layout& l) { l.message.row_step = 119, l.message.data.pop_back(); }, "row_step is 119");
  add(
      14, "point_step of zero", [](Layout& l) { l.message.point_step = 0; }, "point_step of 0");
  add(
      14, "point_step too small", [](Layout& l) { l.message.point_step = 10; }, "point_step of 10");
  add(
      14, "point_step beyond all", [](Layout& l) { l.message.point_step = 0xFFFFFFFF; }, "width 6");
  add(
      14, "width beyond the data", [](Layout& l) { l.message.width = 7; }, "width 7");
  add(
      14, "width beyond all", [](Layout& l) { l.message.width = 0xFFFFFFFF; }, "width 4294967295");
  add(
      14, "height beyond the data", [](Layout& l) { l.message.height = 2; }, "height 2");
  add(
      14, "height beyond all", [](Layout& l) { l.message.height = 0xFFFFFFFF; },
      "height 4294967295");
  add(
      14, "width and height that multiply to 2^32",
      [](Layout& l) { l.message.width = l.message.height = 65536; }, "width 65536");
  add(
      14, "no fields", [](Layout& l) { l.message.fields.clear(); }, "no field 'x'");
  for (const std::size_t field : {0u, 1u, 2u}) {
    const std::string name(1, "xyz"[field]);
    const std::string quoted = std::string("'") + name + "'";
    add(
        14, "no " + name,
        [=](Layout& l) {
          l.message.fields.erase(l.message.fields.begin() + static_cast<std::ptrdiff_t>(field));
        },
        "no field " + quoted);
    add(
        14, name + " in capitals",
        [=](Layout& l) { l.message.fields[field].name = std::string(1, "XYZ"[field]); },
        "no field " + quoted);
    add(
        14, name + " is an integer",
        [=](Layout& l) { l.message.fields[field].datatype = Field::INT32; }, quoted + " is int32");
    add(
        14, name + " of an unknown type", [=](Layout& l) { l.message.fields[field].datatype = 99; },
        "datatype 99");
    add(
        14, name + " of type 0", [=](Layout& l) { l.message.fields[field].datatype = 0; },
        "datatype 0");
    add(
        14, name + " beyond the point", [=](Layout& l) { l.message.fields[field].offset = 17; },
        "does not fit");
    add(
        14, name + " at the end of all offsets",
        [=](Layout& l) { l.message.fields[field].offset = 0xFFFFFFFF; }, "does not fit");
  }
  add(
      14, "time beyond the point", [](Layout& l) { l.message.fields[4].offset = 18; },
      "does not fit");
  add(
      14, "time of billions of elements", [](Layout& l) { l.message.fields[4].count = 0xFFFFFFFF; },
      "does not fit");
  add(
      14, "time is text of one byte", [](Layout& l) { l.message.fields[4].datatype = 255; },
      "datatype 255");
  cases->push_back({14, "the time field that is wanted is absent",
                    [] {
                      LidarConfig config;
                      config.time_field = "when";
                      return decoded(Layout(6).message, config);
                    },
                    "no field 'when'"});
  cases->push_back({14, "no time field where one is demanded",
                    [] {
                      LidarConfig config;
                      config.without_time = WithoutTime::kReject;
                      Layout layout(6);
                      layout.message.fields.pop_back();
                      return decoded(layout.message, config);
                    },
                    "time"});

  // Row 16
  add(
      16, "frame_id empty", [](Layout& l) { l.message.header.frame_id = ""; }, "frame_id is empty");
  add(
      16, "frame_id of slashes", [](Layout& l) { l.message.header.frame_id = "///"; },
      "frame_id is empty");
  add(
      16, "frame_id with a leading slash",
      [](Layout& l) { l.message.header.frame_id = "/velodyne"; }, "6 points");

  // `points_compensated` of another node: rows 12 and 14
  const auto compensated = [&](int row, const std::string& name,
                               std::function<void(sensor_msgs::PointCloud2&)> spoil,
                               const std::string& expected) {
    cases->push_back({row, "compensated: " + name,
                      [=] {
                        auto message = compensatedCloudMessage(wall());
                        spoil(*message);
                        return compensatedOf(*message);
                      },
                      expected});
  };
  using Message = sensor_msgs::PointCloud2;
  const auto overwrite = [](std::size_t field, auto value) {
    return [=](Message& m) {
      std::memcpy(&m.data[2 * m.point_step + m.fields[field].offset], &value, sizeof(value));
    };
  };
  compensated(12, "x NaN", overwrite(0, kNanF), "point 2 is not finite");
  compensated(12, "z infinite", overwrite(2, kInfF), "point 2 is not finite");
  compensated(12, "intensity NaN", overwrite(3, kNanF), "30 points");
  compensated(12, "dt NaN", overwrite(5, kNanF), "point 2 has dt nan");
  compensated(12, "dt infinite", overwrite(5, -kInfF), "point 2 has dt -inf");
  compensated(12, "dt of a year", overwrite(5, 3e7f), "a day at most");
  compensated(14, "a status that does not exist", overwrite(6, std::uint8_t{9}), "status 9");
  compensated(
      14, "point_step of zero", [](Message& m) { m.point_step = 0; }, "point_step 0");
  compensated(
      14, "a billion points of zero bytes",
      [](Message& m) {
        m.point_step = m.row_step = 0, m.width = m.height = 1u << 30, m.data.clear();
      },
      "point_step 0");
  compensated(
      14, "data cut off", [](Message& m) { m.data.resize(10); }, "10 bytes");
  compensated(
      14, "no y", [](Message& m) { m.fields[1].name = "Y"; }, "no field 'y'");
  compensated(
      14, "x in double", [](Message& m) { m.fields[0].datatype = Field::FLOAT64; }, "datatype 8");
  compensated(
      14, "dt in double", [](Message& m) { m.fields[5].datatype = Field::FLOAT64; }, "datatype 8");
  compensated(
      14, "status beyond the point", [](Message& m) { m.fields[6].offset = 28; },
      "beyond point_step");
  compensated(
      14, "other endianness", [](Message& m) { m.is_bigendian = true; }, "endianness");
  compensated(
      13, "rows without points", [](Message& m) { m.width = 0, m.height = 2, m.data.clear(); },
      "0 points");
  compensated(
      13, "no points", [](Message& m) { m = *compensatedCloudMessage(Cloud()); }, "0 points");
}

// --- Rows 15, 16: packets

std::string decodedPackets(const std::function<void(std::vector<Packet>&)>& spoil,
                           const std::string& frame = "velodyne",
                           const LidarSpec* model = nullptr) {
  return said([&] {
    PacketEncoder::Config encoder_config;
    encoder_config.start_ns = 1546300800 * kNsPerSecond;
    std::vector<Packet> sent = PacketEncoder(encoder_config).packets(4, [](const Shot&) {
      return Echoes{{10.0, 9}, {}};
    });
    spoil(sent);
    VelodyneScan scan;
    scan.header.frame_id = frame;
    for (const Packet& packet : sent) {
      VelodynePacket message;
      message.stamp = rosTime(packet.stamp);
      std::memcpy(message.data.data(), packet.data.data(), kPacketBytes);
      scan.packets.push_back(message);
    }
    LidarConfig config;
    config.model = model;
    std::string counted;
    LidarDecoder decoder(config, [&](const std::string& reason, std::uint64_t count) {
      if (count > 0) counted += ", " + std::to_string(count) + " " + reason;
    });
    const TimedCloud cloud = decoder.decode(scan);
    for (std::size_t i = 0; i < cloud.size(); ++i) {
      EXPECT_TRUE(std::isfinite(cloud.x[i]) && std::isfinite(cloud.y[i]) &&
                  std::isfinite(cloud.z[i]));
    }
    std::set<StampNs> stamps;
    for (const Packet& packet : sent) stamps.insert(packet.stamp);
    if (stamps.size() == sent.size()) {  // packets of one stamp are of one time, by their stamps
      EXPECT_TRUE(
          std::is_sorted(cloud.firings.begin(), cloud.firings.end(),
                         [](const Firing& a, const Firing& b) { return a.begin_ns < b.begin_ns; }));
    }
    return std::to_string(cloud.size()) + " points" + counted;
  });
}

void packetCases(std::vector<Case>* cases) {
  const auto add = [&](const std::string& name, std::function<void(std::vector<Packet>&)> spoil,
                       const std::string& expected) {
    cases->push_back({15, name, [spoil] { return decodedPackets(spoil); }, expected});
  };
  using Packets = std::vector<Packet>;
  add(
      "packets out of order", [](Packets& p) { std::swap(p[0], p[3]), std::swap(p[1], p[2]); },
      "1536 points");
  add(
      "a packet twice", [](Packets& p) { p.push_back(p[1]); }, "1536 points, 1 duplicate packets");
  add(
      "a packet four times", [](Packets& p) { p.insert(p.end(), 3, p[0]); },
      "1536 points, 3 duplicate packets");
  add(
      "a packet missing", [](Packets& p) { p.erase(p.begin() + 1); }, "1152 points");
  add(
      "no packets", [](Packets& p) { p.clear(); }, "0 points");
  add(
      "a packet of zeros", [](Packets& p) { p[2].data.fill(0); },
      "1152 points, 1 packets of zeros");
  add(
      "all packets of zeros",
      [](Packets& p) {
        for (Packet& q : p) q.data.fill(0);
      },
      "0 points, 4 packets of zeros");
  add(
      "a packet of ones", [](Packets& p) { p[2].data.fill(0xFF); }, "1152 points");
  add(
      "a bad flag", [](Packets& p) { p[1].data[200] = 0; }, "1504 points, 1 bad packet blocks");
  add(
      "all flags bad",
      [](Packets& p) {
        for (int b = 0; b < 12; ++b) p[1].data[100 * b] = 1;
      },
      "1152 points, 12 bad packet blocks");
  add(
      "an azimuth of 360 deg", [](Packets& p) { p[0].data[102] = 0xA0, p[0].data[103] = 0x8C; },
      "1504 points, 1 bad packet blocks");
  add(
      "an azimuth beyond all", [](Packets& p) { p[0].data[102] = p[0].data[103] = 0xFF; },
      "1504 points, 1 bad packet blocks");
  add(
      "azimuths that stand still",
      [](Packets& p) {
        for (Packet& q : p) {
          for (int b = 0; b < 12; ++b) q.data[100 * b + 2] = q.data[100 * b + 3] = 0;
        }
      },
      "1536 points");
  add(
      "azimuths that go back", [](Packets& p) { p[0].data[302] = 0x10, p[0].data[303] = 0x80; },
      "1536 points");
  add(
      "an unknown product", [](Packets& p) { p[0].data[1205] = 0x77; }, "0x77");
  add(
      "an unknown return mode", [](Packets& p) { p[0].data[1204] = 0x01; }, "0x01");
  add(
      "products that change", [](Packets& p) { p[3].data[1205] = 0x28; }, "points");
  add(
      "no echo at all",
      [](Packets& p) {
        for (Packet& q : p) {
          for (int b = 0; b < 12; ++b) {
            for (int i = 4; i < 100; ++i) q.data[static_cast<std::size_t>(100 * b + i)] = 0;
          }
        }
      },
      "0 points");
  add(
      "stamps all equal",
      [](Packets& p) {
        for (Packet& q : p) q.stamp = p[0].stamp;
      },
      "1536 points");
  cases->push_back({16, "packets with stamp 0",
                    [] {
                      return decodedPackets([](Packets& p) {
                        for (Packet& q : p) q.stamp = 0;
                      });
                    },
                    "points"});
  cases->push_back({16, "packets at the end of time",
                    [] {
                      return decodedPackets([](Packets& p) {
                        for (Packet& q : p) q.stamp = (kNsPerSecond << 32) - 1;
                      });
                    },
                    "points"});
  cases->push_back({16, "scan without a frame", [] { return decodedPackets([](Packets&) {}, ""); },
                    "frame_id is empty"});
}

// --- Row 16: transforms and odometry

void transformCases(std::vector<Case>* cases) {
  const auto add = [&](const std::string& name,
                       std::function<void(geometry_msgs::TransformStamped&)> spoil) {
    cases->push_back({16, "transform: " + name,
                      [spoil] {
                        TfPoseSource source{TfPoseSourceConfig{}};
                        geometry_msgs::TransformStamped message;
                        message.header.frame_id = "odom";
                        message.header.stamp = ros::Time(10, 0);
                        message.child_frame_id = "base_link";
                        message.transform.rotation.w = 1;
                        spoil(message);
                        const bool taken = source.add(message, false);
                        return std::string(taken ? "taken" : "refused") + ", " +
                               std::to_string(source.counters().rejected) + " rejected";
                      },
                      "refused, 1 rejected"});
  };
  using Message = geometry_msgs::TransformStamped;
  add("stamp 0", [](Message& m) { m.header.stamp = ros::Time(); });
  add("no parent", [](Message& m) { m.header.frame_id = ""; });
  add("no child", [](Message& m) { m.child_frame_id = ""; });
  add("child is its parent", [](Message& m) { m.child_frame_id = "/odom"; });
  add("translation NaN", [](Message& m) { m.transform.translation.x = kNan; });
  add("translation infinite", [](Message& m) { m.transform.translation.z = -kInf; });
  add("rotation NaN", [](Message& m) { m.transform.rotation.y = kNan; });
  add("rotation of zeros", [](Message& m) { m.transform.rotation.w = 0; });
  add("rotation of length 2", [](Message& m) { m.transform.rotation.w = 2; });
}

// --- Row 28: the rig file

void rigCases(std::vector<Case>* cases) {
  // key=value, and what the complaint holds beside the key
  const std::pair<const char*, const char*> kOverrides[] = {
      {"lidar.input=sonar", "packets"},
      {"lidar.model=VLP64", "VLP16"},
      {"lidar.min_range_m=-1", "-1"},
      {"lidar.max_range_m=.nan", "nan"},
      {"lidar.max_range_m=far", "far"},
      {"lidar.time_unit=fortnights", "fortnights"},
      {"lidar.time_reference=yesterday", "yesterday"},
      {"lidar.without_time=guess", "guess"},
      {"lidar.packet_stamp=beginning", "start"},
      {"lidar.time_offset=1e12", "1e12"},
      {"lidar.time_offset=soon", "soon"},
      {"lidar.vertical_offsets_m=[1, 2]", "vertical_offsets_m"},
      {"lidar.vertical_offsets_m=3", "list"},
      {"lidar.topic=points cloud", "ROS name"},
      {"lidar.frame=a b", "tf frame"},
      {"lidar.inptu=points", "input"},
      {"lidar=packets", "map"},
      {"cameras.front.name=1front", "letter"},
      {"cameras.front.namespace=/a//b", "ROS name"},
      {"cameras.front.image=", "ROS name"},
      {"cameras.front.transport=pigeon", "raw"},
      {"cameras.front.rectified=perhaps", "perhaps"},
      {"cameras.front.input=depth", "scores"},
      {"cameras.front.mask=/no/such/mask.png", "readable file"},
      {"cameras.front.score_scale=0", "not be 0"},
      {"cameras.front.score_offset=.inf", "inf"},
      {"cameras.front.max_theta_deg=181", "181"},
      {"cameras.front.max_theta_deg=-1", "-1"},
      {"cameras.front.time_offset=[1]", "time_offset"},
      {"cameras.front.max_time_difference=11", "11"},
      {"cameras.front.max_time_difference=-0.1", "-0.1"},
      {"cameras.front.timeout=0", "timeout"},
      {"cameras.front.timeout=61", "61"},
      {"cameras.front.reorder_window=2", "2"},
      {"cameras.front.colour=red", "colour"},
      {"cameras.rear.timeout=1", "rear"},
      {"cameras=front", "list"},
      {"superpixels.count=0", "0"},
      {"superpixels.count=1.5", "1.5"},
      {"superpixels.count=99999999999", "99999999999"},
      {"superpixels.compactness=0", "0"},
      {"superpixels.compactness=.nan", "nan"},
      {"superpixels.iterations=0", "0"},
      {"superpixels.iterations=101", "101"},
      {"superpixels.scale=5", "5"},
      {"superpixels.scale=-0.5", "-0.5"},
      {"superpixels.warm_start=warm", "warm"},
      {"uncertainty.temperature=0", "0"},
      {"uncertainty.temperature=-1", "-1"},
      {"uncertainty.exponent=.inf", "inf"},
      {"uncertainty.exponent=two", "two"},
      {"motion.enabled=2", "2"},
      {"motion.granularity=point", "firing"},
      {"odometry.source=stars", "tf"},
      {"odometry.lookup=nearest", "closest"},
      {"odometry.on_missing=panic", "mark"},
      {"odometry.max_extrapolation=100", "100"},
      {"odometry.timeout=-1", "-1"},
      {"reference.choose=best", "closest_image"},
      {"reference.camera=rear", "rear"},
      {"reference.timeout=never", "never"},
      {"image_choice=nicest", "closest_to_reference"},
      {"segmentation.mode=sometimes", "on_request"},
      {"segmentation.model=/no/such/model.yaml", "readable file"},
      {"occlusion.mode=magic", "adaptive"},
      {"occlusion.vertical_step_deg=91", "91"},
      {"occlusion.depth_margin_m=-1", "-1"},
      {"occlusion.depth_margin_ratio=101", "101"},
      {"overlap=last_wins", "mean"},
      {"keep_unlabelled=maybe", "maybe"},
      {"fixed_frame=", "tf frame"},
      {"vehicle_frame=odom", "fixed_frame"},
      {"oclusion.mode=off", "occlusion"},
  };
  for (const auto& [override_text, expected] : kOverrides) {
    const std::string text = override_text;
    cases->push_back({28, text,
                      [text] {
                        return said([&] {
                          rigFromYaml(parseYaml("classes: {classes: [{name: road, color: [1, 2, "
                                                "3]}]}\ncameras: [{name: front}]\n",
                                                "rig"),
                                      "/nowhere", "rig", {text});
                          return std::string("accepted");
                        });
                      },
                      expected});
  }
  const std::pair<const char*, const char*> kTexts[] = {
      {"classes: {classes: []}", "classes"},
      {"classes: {classes: [{name: Road, color: [1, 2, 3]}]}", "Road"},
      {"classes: {classes: [{name: a, color: [1, 2]}]}", "color"},
      {"classes: {classes: [{name: a, color: [1, 2, 256]}]}", "256"},
      {"classes: {classes: [{name: a, color: [1, 2, 3]}, {name: a, color: [1, 2, 3]}]}", "a"},
      {"classes: /no/such/classes.yaml", "/no/such/classes.yaml"},
      {"cameras: [{name: a}]", "classes"},
      {"cameras: [{name: a}, {name: a}]", "a"},
      {"cameras: [{}]", "name"},
      {"cameras: [7]", "cameras[0]"},
      {"- a\n- b", "map"},
      {"a: {b: [", "is not YAML"},
      {"lidar: {}\nlidar: {}", "lidar"},
      {"a: &x [*x]", "refers to itself"},
      {"\ttab: 1", "is not YAML"},
  };
  for (const auto& [rig_text, expected] : kTexts) {
    const std::string text = rig_text;
    cases->push_back({28, text,
                      [text] {
                        return said([&] {
                          rigFromYaml(parseYaml(text, "rig"), "/nowhere", "rig");
                          return std::string("accepted");
                        });
                      },
                      expected});
  }
}

std::vector<Case> allCases() {
  std::vector<Case> cases;
  cameraInfoCases(&cases);
  imageCases(&cases);
  cloudCases(&cases);
  packetCases(&cases);
  transformCases(&cases);
  rigCases(&cases);
  return cases;
}

TEST(BadInputs, EachIsToldAndNothingThatIsNotFiniteComesOut) {
  for (const Case& test : allCases()) {
    SCOPED_TRACE("row " + std::to_string(test.row) + ", " + test.name);
    const std::string text = test.run();
    EXPECT_NE(text.find(test.expected), std::string::npos)
        << "'" << text << "' lacks '" << test.expected << "'";
  }
}

TEST(BadInputs, AreAtLeastTwoHundredOverTheirRows) {
  std::map<int, int> of_row;
  std::map<std::string, int> of_name;
  for (const Case& test : allCases()) {
    ++of_row[test.row];
    EXPECT_EQ(++of_name[std::to_string(test.row) + test.name], 1) << test.name << " is there twice";
  }
  int total = 0;
  for (const int row : {8, 10, 11, 12, 13, 14, 15, 16, 28}) {
    EXPECT_GE(of_row[row], 6) << "row " << row;
    total += of_row[row];
  }
  EXPECT_GE(total, 200);
}

}  // namespace
}  // namespace semantic_lidar_fusion

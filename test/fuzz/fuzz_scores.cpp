// SPDX-License-Identifier: MIT
// Score, share, label and probability images of other nodes, through superpixels, softmax and
// fusion, to the bytes of `points_semantic`.
#include <cmath>
#include <opencv2/core.hpp>

#include "edge/conversions.h"
#include "fuzz_target.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"
#include "semantic_lidar_fusion/fusion/semantic_projector.h"
#include "semantic_lidar_fusion/superpixel/uncertainty.h"

namespace semantic_lidar_fusion {
namespace fuzz {
namespace {

constexpr int kClasses = 3;
const char* const kEncodings[] = {"32FC3", "16UC3", "8UC3",   "32FC1",   "mono8",   "8UC1",
                                  "bgr8",  "32FC4", "32FC12", "64FC3",   "rgb8",    "mono16",
                                  "",      "32FC",  "8UC0",   "32FC513", "32FC600", "32SC1"};
constexpr unsigned kEncodingCount = sizeof(kEncodings) / sizeof(kEncodings[0]);

enum Kind : unsigned { kScores, kShare, kLabels, kProbabilities, kKinds };

Bytes imageSeed(unsigned kind, unsigned encoding, std::uint32_t width, std::uint32_t height,
                std::uint32_t pixel_bytes, const Bytes& pixels) {
  Writer writer;
  writer.byte(kind).byte(0).put(1.0).put(0.0).put(2.0);
  for (int i = 0; i < 8; ++i) writer.put(1.5f * static_cast<float>(i));
  writer.byte(encoding).put(width).put(height).put(width * pixel_bytes).byte(0);
  writer.raw(pixels.data(), pixels.size());
  return writer.bytes();
}

template <typename T>
Bytes pixelsOf(const std::vector<T>& values) {
  Writer writer;
  for (const T value : values) writer.put(value);
  return writer.bytes();
}

std::vector<Bytes> seeds() {
  std::vector<float> scores, shares, probabilities;
  std::vector<std::uint16_t> words;
  Bytes labels;
  for (int cell = 0; cell < 12; ++cell) {
    shares.push_back(0.25f + 0.05f * static_cast<float>(cell));
    labels.push_back(static_cast<std::uint8_t>(cell % 5));
    for (int c = 0; c < kClasses; ++c) {
      scores.push_back(static_cast<float>((cell * 7 + c * 5) % 11) - 5.0f);
      words.push_back(static_cast<std::uint16_t>(1000 * c + cell));
      probabilities.push_back(c == cell % 3 ? 0.6f : 0.2f);
    }
  }
  std::vector<float> hostile = scores;
  hostile[4] = std::nanf("");
  hostile[7] = INFINITY;
  hostile[10] = -3e38f;
  return {Bytes{},
          imageSeed(kScores, 0, 4, 3, 12, pixelsOf(scores)),
          imageSeed(kScores, 0, 4, 3, 12, pixelsOf(hostile)),
          imageSeed(kScores, 1, 4, 3, 6, pixelsOf(words)),
          imageSeed(kShare, 3, 4, 3, 4, pixelsOf(shares)),
          imageSeed(kLabels, 4, 4, 3, 1, labels),
          imageSeed(kProbabilities, 0, 4, 3, 12, pixelsOf(probabilities))};
}

const LabelSet& classes() {
  static const LabelSet set = LabelSet::fromYaml(
      parseYaml("classes: [{name: a, color: [1, 2, 3]}, {name: b, color: [4, 5, 6]}, "
                "{name: c, color: [7, 8, 9]}]",
                "seed"),
      "seed");
  return set;
}

std::shared_ptr<const CameraModel> camera() {
  static const auto model = [] {
    CameraInfo info;
    info.frame_id = "camera";
    info.size = {32, 24};
    info.k = {16, 0, 15.5, 0, 16, 11.5, 0, 0, 1};
    return std::make_shared<const CameraModel>(info, CameraModelOptions{});
  }();
  return model;
}

/// A grid of points in front of the camera, and 8 coordinates of the input.
Cloud cloudOf(Reader* reader) {
  Cloud cloud;
  cloud.frame_id = "lidar";
  cloud.stamp = 1546300800 * kNsPerSecond;
  cloud.resize(24 + 2);
  for (std::size_t i = 0; i < 24; ++i) {
    cloud.x[i] = -3.0f + static_cast<float>(i % 6);
    cloud.y[i] = -2.0f + static_cast<float>(i / 6);
    cloud.z[i] = 5.0f;
    cloud.intensity[i] = 1.0f;
    cloud.ring[i] = static_cast<std::uint16_t>(i / 6);
    cloud.dt[i] = 0.001f * static_cast<float>(i);
    cloud.status[i] = 0;
  }
  for (std::size_t i = 24; i < 26; ++i) {
    for (float* value : {&cloud.x[i], &cloud.y[i], &cloud.z[i], &cloud.intensity[i]}) {
      const float given = reader->take<float>();
      *value = std::isfinite(given) ? given : 0.0f;
    }
    cloud.ring[i] = static_cast<std::uint16_t>(i);
    cloud.dt[i] = 0.0f;
    cloud.status[i] = 0;
  }
  return cloud;
}

/// `width` x `height` pixels in 2 x 2 blocks.
SuperpixelMap blocks(const ImageSize& size) {
  SuperpixelMap map;
  const int columns = (size.width + 1) / 2;
  map.ids.create(size.height, size.width, CV_32SC1);
  for (int row = 0; row < size.height; ++row) {
    for (int column = 0; column < size.width; ++column) {
      map.ids.at<int>(row, column) = row / 2 * columns + column / 2;
    }
  }
  map.count = columns * ((size.height + 1) / 2);
  map.sizes.assign(static_cast<std::size_t>(map.count), 0);
  for (int row = 0; row < size.height; ++row) {
    for (int column = 0; column < size.width; ++column) {
      ++map.sizes[static_cast<std::size_t>(map.ids.at<int>(row, column))];
    }
  }
  return map;
}

void expectDistributions(const cv::Mat& image) {
  for (int row = 0; row < image.rows; ++row) {
    const float* p = image.ptr<float>(row);
    for (int column = 0; column < image.cols; ++column, p += image.channels()) {
      double sum = 0;
      for (int c = 0; c < image.channels(); ++c) {
        expect(std::isfinite(p[c]) && p[c] >= 0, "probabilities are numbers of 0 or more");
        sum += p[c];
      }
      expect(std::abs(sum - 1.0) < 1e-5, "probabilities sum to 1");
    }
  }
}

void expectCloud(const SemanticCloud& cloud) {
  const Cloud& points = cloud.points;
  for (const auto* values : {&points.x, &points.y, &points.z, &points.intensity, &points.dt,
                             &cloud.confidence, &cloud.entropy, &cloud.probabilities}) {
    expectFinite(*values, "what is published is finite");
  }
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    expect(cloud.entropy[i] >= 0 && cloud.entropy[i] <= 1, "entropy is in 0..1");
    double sum = 0;
    for (int c = 0; c < kClasses; ++c) sum += cloud.probabilities[i * kClasses + c];
    const bool fused = points.status[i] == 0;
    expect(points.status[i] <= 4, "the status is one of five");
    expect(fused ? cloud.label[i] < kClasses : cloud.label[i] == kNoLabel, "a label, or none");
    expect(std::abs(sum - (fused ? 1.0 : 0.0)) < 1e-5, "distributions sum to 1, or are absent");
  }
}

void run(const std::uint8_t* data, std::size_t size) {
  Reader reader(data, size);
  const unsigned kind = reader.choice(kKinds);
  const unsigned more = reader.take<std::uint8_t>();
  ScoreFormat format;
  UncertaintyConfig uncertainty;
  const auto finite = [&](double fallback) {
    const double value = reader.take<double>();
    return std::isfinite(value) ? value : fallback;
  };
  format.scale = finite(1.0);
  format.offset = finite(0.0);
  uncertainty.exponent = std::min(100.0, std::abs(finite(2.0)));
  FusionConfig config;
  config.class_count = kClasses;
  config.uncertainty = uncertainty;
  config.occlusion.mode = occlusionModes()[more % occlusionModes().size()];
  config.overlap = static_cast<OverlapRule>((more >> 2) % 4);
  config.keep_unlabelled = more & 64u;
  const Cloud cloud = cloudOf(&reader);

  sensor_msgs::Image message;
  message.header.frame_id = "camera";
  message.encoding = kEncodings[reader.choice(kEncodingCount)];
  message.width = reader.take<std::uint32_t>();
  message.height = reader.take<std::uint32_t>();
  message.step = reader.take<std::uint32_t>();
  message.is_bigendian = reader.take<std::uint8_t>();
  message.data = reader.rest();

  try {
    const cv::Mat image = pixelView(message);
    const ImageSize grid = {std::min(image.cols, 16), std::min(image.rows, 16)};
    const SuperpixelMap map = blocks(grid);
    ImageSemantics semantics;
    const cv::Mat plain_scores(grid.height, grid.width, CV_32FC(kClasses), cv::Scalar(1, 2, 3));
    switch (kind) {
      case kScores: {
        const ScoreMap scores(image, kClasses, format);
        const ShareMap share = computeShare(map, scores);
        for (const float spp : share.superpixel) expect(spp > 0 && spp <= 1, "shares are in 0..1");
        expectDistributions(denseProbabilities(scores, share.share, uncertainty));
        semantics.scores = scores;
        semantics.share = share.share;
        break;
      }
      case kShare:
        semantics.scores = ScoreMap(plain_scores, kClasses, {});
        semantics.share = image;
        if (image.type() == CV_32FC1) {
          expectDistributions(denseProbabilities(semantics.scores, image, uncertainty));
        }
        break;
      case kLabels:
        semantics.probabilities = histogramProbabilities(map, image, kClasses);
        expectDistributions(semantics.probabilities);
        break;
      default:
        semantics.probabilities = image;
    }
    CameraView view;
    view.name = "camera";
    view.model = camera();
    view.has_image = true;
    view.image_ns = cloud.stamp;
    view.semantics = semantics;
    const FusionResult result = SemanticProjector(config).fuse(cloud, {view});
    expectCloud(result.cloud);
    expect(!config.keep_unlabelled || result.cloud.size() == cloud.size(), "no point is lost");
    semanticCloudMessage(result.cloud, classes());
  } catch (const DataError& error) {
    expectMessage(error);
  }
}

const char* const kWords[] = {"\x7f\xc0", "\x7f\x80", nullptr};
const Registration kRegistered({"scores", seeds, run, kWords});

}  // namespace
}  // namespace fuzz
}  // namespace semantic_lidar_fusion

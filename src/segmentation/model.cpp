// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/segmentation/model.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <fstream>
#include <limits>
#include <opencv2/dnn.hpp>
#include <opencv2/imgproc.hpp>
#include <utility>
#include <vector>

#include "opencv_error.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/types.h"
#include "semantic_lidar_fusion/common/yaml_reader.h"
#include "semantic_lidar_fusion/segmentation/network_check.h"

namespace semantic_lidar_fusion {
namespace {

/// Distance below the cell's least score of a class that the network does not know.
constexpr float kMissingClassGap = 20.0f;
constexpr int kMaxSide = 16384;

using Problems = std::vector<std::string>;

/// What the model file says, class names resolved to ids.
struct Description {
  std::string network_path;
  ImageSize input;
  bool rgb = true;
  double scale = 1.0 / 255.0;
  std::vector<double> mean{0, 0, 0};
  std::vector<double> std_dev{1, 1, 1};
  std::vector<std::vector<int>> channels_of_class;  ///< by class id; empty = not known
  std::vector<int> ignored;
};

std::string directoryOf(const std::string& path) {
  const std::size_t slash = path.find_last_of('/');
  return slash == std::string::npos ? "." : path.substr(0, slash);
}

std::string readNetworkPath(const std::string& model_file, YamlSection* root) {
  std::string file;
  root->text("file", &file);
  if (file.empty()) {
    root->problem("file", "must be the path of an ONNX network");
    return {};
  }
  const std::string path = file[0] == '/' ? file : directoryOf(model_file) + "/" + file;
  if (std::ifstream(path).good()) return path;
  root->problem("file", "cannot read '" + path +
                            "'; a relative path starts at the model file's folder: put the "
                            "network there, or copy the model file beside the network");
  return {};
}

void readSide(YamlSection* input, const std::string& key, int* side) {
  if (!input->has(key)) {
    input->problem(key, "must be given: the size that the network takes");
  }
  input->integer(key, side, 1, kMaxSide);
}

void readTriple(YamlSection* input, const std::string& key, const NumberRange& range,
                std::vector<double>* values) {
  std::vector<double> read = *values;
  const bool is_list = input->has(key) && input->get(key).IsSequence();
  const std::size_t size = is_list ? input->get(key).size() : 3;
  input->numbers(key, &read, range);
  if (size != 3) input->problem(key, "must have three numbers");
  if (read.size() == 3) *values = read;
}

void readInput(const YAML::Node& node, Problems* problems, Description* out) {
  YamlSection input(node, "input", problems);
  readSide(&input, "width", &out->input.width);
  readSide(&input, "height", &out->input.height);
  input.choice("channels", &out->rgb, {{"rgb", true}, {"bgr", false}});
  const NumberRange positive{0, 1e9, true};
  input.number("scale", &out->scale, positive);
  readTriple(&input, "mean", {-1e9, 1e9, false}, &out->mean);
  readTriple(&input, "std", positive, &out->std_dev);
  input.finish();
}

/// A list of output channels; absent, it leaves `channels` empty.
void readChannels(YamlSection* section, const std::string& key, std::vector<int>* channels) {
  std::vector<double> read;
  section->numbers(key, &read, {0, kMaxNetworkChannels - 1, false});
  for (const double channel : read) {
    if (channel == std::floor(channel)) {
      channels->push_back(static_cast<int>(channel));
    } else {
      section->problem(key, "must hold whole numbers");
    }
  }
}

/// Reads `classes` and `ignore` of one section.
void readMapping(YamlSection* section, const LabelSet& classes, Problems* problems,
                 Description* out) {
  out->channels_of_class.assign(static_cast<std::size_t>(classes.size()), {});
  out->ignored.clear();
  YamlSection names(section->get("classes"), section->pathOf("classes"), problems);
  for (int id = 0; id < classes.size(); ++id) {
    const std::string& name = classes[id].name;
    std::vector<int>& channels = out->channels_of_class[static_cast<std::size_t>(id)];
    const std::size_t problems_before = problems->size();
    readChannels(&names, name, &channels);
    if (names.has(name) && channels.empty() && problems->size() == problems_before) {
      names.problem(name, "must hold at least one channel; leave an unknown class out");
    }
  }
  names.finish();
  readChannels(section, "ignore", &out->ignored);
}

/// Names of a mapping that the rig's class set lacks, separated by commas.
std::string unknownNames(const YAML::Node& names, const LabelSet& classes) {
  std::string unknown;
  for (const auto& item : names) {
    if (item.first.IsScalar() && classes.idOf(item.first.Scalar())) continue;
    unknown += (unknown.empty() ? "" : ", ") + describeValue(item.first);
  }
  return unknown;
}

void readClasses(YamlSection* root, const LabelSet& classes, Problems* problems, Description* out) {
  const YAML::Node node = root->get("classes");
  if (node.IsDefined() && node.IsMap()) {
    readMapping(root, classes, problems, out);
    return;
  }
  if (!node.IsDefined() || !node.IsSequence() || node.size() == 0) {
    root->problem("classes",
                  "must be a map from class names to output channels, or a list of {classes, "
                  "ignore}");
    return;
  }
  std::string unfit;
  for (std::size_t i = 0; i < node.size(); ++i) {
    const std::string path = "classes[" + std::to_string(i) + "]";
    YamlSection entry(node[i], path, problems);
    const YAML::Node names = entry.get("classes");
    if (!names.IsDefined() || !names.IsMap()) {
      entry.problem("classes", "must be a map from class names to output channels");
      return;
    }
    const std::string unknown = unknownNames(names, classes);
    if (unknown.empty()) {
      readMapping(&entry, classes, problems, out);
      entry.finish();
      return;
    }
    unfit += "; " + path + ": " + unknown;
  }
  root->problem("classes", "no entry fits the rig's class set, which lacks" + unfit.substr(1));
}

/// Every one of the network's output channels must be used once.
void checkChannels(const Description& description, int output_channels, Problems* problems) {
  std::vector<int> uses(static_cast<std::size_t>(output_channels), 0);
  std::vector<int> named = description.ignored;
  for (const std::vector<int>& channels : description.channels_of_class) {
    named.insert(named.end(), channels.begin(), channels.end());
  }
  for (const int channel : named) {
    if (channel >= output_channels) {
      problems->push_back("classes: output channel " + std::to_string(channel) +
                          " does not exist; the network has 0.." +
                          std::to_string(output_channels - 1));
    } else {
      ++uses[static_cast<std::size_t>(channel)];
    }
  }
  for (int channel = 0; channel < output_channels; ++channel) {
    const int count = uses[static_cast<std::size_t>(channel)];
    if (count == 1) continue;
    problems->push_back("classes: output channel " + std::to_string(channel) +
                        (count == 0 ? " is missing" : " occurs more than once") +
                        "; each must occur once in `classes` or `ignore`");
  }
}

}  // namespace

struct SegmentationModel::Impl {
  Description description;
  cv::dnn::Net net;
  int output_channels = 0;
  cv::Mat blob;  ///< 1 x 3 x height x width
  /// Normalised value of each of the 256 input values, by channel in the network's order.
  std::array<std::array<float, 256>, 3> normalised{};

  void fillBlob(const cv::Mat& image);
  void writeClass(const std::vector<cv::Mat>& planes, int id, cv::Mat* scores) const;
};

SegmentationModel::SegmentationModel(const std::string& model_file, const LabelSet& classes)
    : impl_(new Impl) {
  const YAML::Node root = parseYamlFile(model_file);
  Problems problems;
  Description& description = impl_->description;
  YamlSection section(root, "", &problems);
  description.network_path = readNetworkPath(model_file, &section);
  readInput(section.get("input"), &problems, &description);
  readClasses(&section, classes, &problems, &description);
  section.finish();

  if (!description.network_path.empty()) {
    const std::string network = "file: network '" + description.network_path + "' ";
    try {
      const ImageSize& input = description.input;
      if (input.width > 0 && input.height > 0) {
        impl_->output_channels = examineNetworkApart(description.network_path, input).channels;
        impl_->net = cv::dnn::readNetFromONNX(description.network_path);
        impl_->net.setPreferableBackend(cv::dnn::DNN_BACKEND_OPENCV);
        impl_->net.setPreferableTarget(cv::dnn::DNN_TARGET_CPU);
        if (!description.channels_of_class.empty()) {
          checkChannels(description, impl_->output_channels, &problems);
        }
      }
    } catch (const DataError& error) {
      problems.push_back(network + error.what());
    } catch (const cv::Exception& error) {
      problems.push_back(network + "cannot be read by OpenCV " CV_VERSION ": " +
                         firstLine(error.err));
    }
  }
  if (!problems.empty()) {
    for (std::string& problem : problems) problem = model_file + ": " + problem;
    throw ConfigError(problems);
  }

  for (std::size_t c = 0; c < 3; ++c) {
    for (std::size_t value = 0; value < 256; ++value) {
      impl_->normalised[c][value] = static_cast<float>(
          (description.scale * static_cast<double>(value) - description.mean[c]) /
          description.std_dev[c]);
    }
  }
  const int shape[] = {1, 3, description.input.height, description.input.width};
  impl_->blob.create(4, shape, CV_32F);
}

SegmentationModel::~SegmentationModel() = default;

void SegmentationModel::Impl::fillBlob(const cv::Mat& image) {
  const cv::Size size(description.input.width, description.input.height);
  cv::Mat resized = image;
  if (image.size() != size) {
    const bool shrinks = size.width <= image.cols && size.height <= image.rows;
    cv::resize(image, resized, size, 0, 0, shrinks ? cv::INTER_AREA : cv::INTER_LINEAR);
  }
  const int channels = image.channels();
  for (int c = 0; c < 3; ++c) {
    const std::array<float, 256>& table = normalised[static_cast<std::size_t>(c)];
    const int source = channels == 1 ? 0 : description.rgb ? 2 - c : c;
    for (int y = 0; y < size.height; ++y) {
      const std::uint8_t* in = resized.ptr<std::uint8_t>(y) + source;
      float* out = blob.ptr<float>(0, c) + static_cast<std::ptrdiff_t>(y) * size.width;
      for (int x = 0; x < size.width; ++x) out[x] = table[in[x * channels]];
    }
  }
}

/// Log-sum-exp of the class's output channels into channel `id` of `scores`; a non-finite input
/// gives a non-finite score.
void SegmentationModel::Impl::writeClass(const std::vector<cv::Mat>& planes, int id,
                                         cv::Mat* scores) const {
  const std::vector<int>& channels = description.channels_of_class[static_cast<std::size_t>(id)];
  const int stride = scores->channels();
  for (int y = 0; y < scores->rows; ++y) {
    float* out = scores->ptr<float>(y) + id;
    for (int x = 0; x < scores->cols; ++x, out += stride) {
      float largest = planes[static_cast<std::size_t>(channels[0])].at<float>(y, x);
      if (channels.size() > 1) {
        for (const int channel : channels) {
          largest = std::max(largest, planes[static_cast<std::size_t>(channel)].at<float>(y, x));
        }
        float sum = 0;
        for (const int channel : channels) {
          sum += std::exp(planes[static_cast<std::size_t>(channel)].at<float>(y, x) - largest);
        }
        largest += std::log(sum);
      }
      *out = largest;
    }
  }
}

cv::Mat SegmentationModel::scores(const cv::Mat& image) {
  if (image.empty()) throw DataError("segmentation: the image is empty");
  if (image.type() != CV_8UC1 && image.type() != CV_8UC3) {
    throw DataError("segmentation: the image has " + std::to_string(image.channels()) +
                    " channels of depth " + std::to_string(image.depth()) +
                    ", must have 1 or 3 of 8 bits");
  }
  cv::Mat output;
  try {
    impl_->fillBlob(image);
    impl_->net.setInput(impl_->blob);
    output = impl_->net.forward();
  } catch (const cv::Exception& error) {
    throw DataError("segmentation: OpenCV DNN failed: " + firstLine(error.err));
  }
  if (output.dims != 4 || output.type() != CV_32F || output.size[0] != 1 ||
      output.size[1] != impl_->output_channels) {
    throw DataError("segmentation: the network's output is not 1 x " +
                    std::to_string(impl_->output_channels) + " x rows x columns in 32-bit float");
  }

  std::vector<cv::Mat> planes;
  for (int c = 0; c < impl_->output_channels; ++c) {
    planes.emplace_back(output.size[2], output.size[3], CV_32FC1, output.ptr<float>(0, c));
  }
  const int class_count = static_cast<int>(impl_->description.channels_of_class.size());
  cv::Mat scores(output.size[2], output.size[3], CV_32FC(class_count));
  std::vector<int> known, missing;
  for (int id = 0; id < class_count; ++id) {
    const bool has = !impl_->description.channels_of_class[static_cast<std::size_t>(id)].empty();
    (has ? known : missing).push_back(id);
    if (has) impl_->writeClass(planes, id, &scores);
  }
  if (missing.empty()) return scores;
  for (int y = 0; y < scores.rows; ++y) {
    float* cell = scores.ptr<float>(y);
    for (int x = 0; x < scores.cols; ++x, cell += class_count) {
      float least = std::numeric_limits<float>::infinity();
      for (const int id : known) least = std::min(least, cell[id]);
      for (const int id : missing) cell[id] = least - kMissingClassGap;
    }
  }
  return scores;
}

}  // namespace semantic_lidar_fusion

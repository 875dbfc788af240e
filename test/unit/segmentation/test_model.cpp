// SPDX-License-Identifier: MIT
#include <dirent.h>
#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <limits>
#include <opencv2/dnn.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <random>
#include <set>
#include <sstream>
#include <string>
#include <vector>

#include "onnx_writer.h"
#include "optional_data.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/segmentation/model.h"
#include "temporary_folder.h"

namespace semantic_lidar_fusion {
namespace {

/// A class set of black classes.
LabelSet classSet(const std::vector<std::string>& names) {
  std::string text = "classes:\n";
  for (const std::string& name : names) text += "  - {name: " + name + ", color: [0, 0, 0]}\n";
  return LabelSet::fromYaml(YAML::Load(text), "test");
}

class SegmentationModelTest : public ::testing::Test {
 protected:
  std::string path(const std::string& name) const { return folder_.path() + "/" + name; }
  std::string writeModelFile(const std::string& text) {
    const std::string file = path("model.yaml");
    std::ofstream(file) << text;
    return file;
  }
  /// Four output channels: r, 2 g, b - 3 and a constant 1.
  void writeNetwork(int width, int height, int stride = 1) {
    writeConvolution(path("net.onnx"), width, height, stride, {1, 0, 0, 0, 2, 0, 0, 0, 1, 0, 0, 0},
                     {0, 0, -3, 1});
  }
  std::vector<std::string> problems(const std::string& text, const LabelSet& classes) {
    try {
      SegmentationModel model(writeModelFile(text), classes);
    } catch (const ConfigError& error) {
      return error.problems();
    }
    return {};
  }

 private:
  const TemporaryFolder folder_;
};

void expectProblem(const std::vector<std::string>& problems, const std::string& part) {
  std::string all;
  for (const std::string& problem : problems) {
    if (problem.find(part) != std::string::npos) return;
    all += problem + "\n";
  }
  ADD_FAILURE() << "no problem says '" << part << "', only:\n" << all;
}

cv::Mat colourImage() {
  cv::Mat image(2, 3, CV_8UC3);
  for (int i = 0; i < 6; ++i) {
    image.at<cv::Vec3b>(i / 3, i % 3) =
        cv::Vec3b(static_cast<std::uint8_t>(40 * i), static_cast<std::uint8_t>(255 - 30 * i),
                  static_cast<std::uint8_t>(7 * i + 1));
  }
  return image;
}

TEST_F(SegmentationModelTest, NormalisesInTheNetworksChannelOrder) {
  writeNetwork(3, 2);
  const std::string rest =
      " scale: 0.5, mean: [10, 20, 30], std: [2, 4, 8]}\n"
      "classes: {a: [0], b: [1], c: [2], d: [3]}\n";
  const LabelSet classes = classSet({"a", "b", "c", "d"});
  const cv::Mat image = colourImage();
  for (const bool rgb : {true, false}) {
    SegmentationModel model(
        writeModelFile(std::string("file: net.onnx\ninput: {width: 3, height: 2, channels: ") +
                       (rgb ? "rgb," : "bgr,") + rest),
        classes);
    const cv::Mat scores = model.scores(image);
    ASSERT_EQ(scores.type(), CV_32FC(4));
    ASSERT_EQ(scores.size(), cv::Size(3, 2));
    for (int y = 0; y < 2; ++y) {
      for (int x = 0; x < 3; ++x) {
        const cv::Vec3b bgr = image.at<cv::Vec3b>(y, x);
        const float first = static_cast<float>((0.5 * bgr[rgb ? 2 : 0] - 10) / 2);
        const float second = static_cast<float>((0.5 * bgr[1] - 20) / 4);
        const float third = static_cast<float>((0.5 * bgr[rgb ? 0 : 2] - 30) / 8);
        const cv::Vec4f score = scores.at<cv::Vec4f>(y, x);
        EXPECT_NEAR(score[0], first, 1e-4);
        EXPECT_NEAR(score[1], 2 * second, 1e-4);
        EXPECT_NEAR(score[2], third - 3, 1e-4);
        EXPECT_NEAR(score[3], 1, 1e-6);
      }
    }
  }
}

TEST_F(SegmentationModelTest, TakesGrayImagesAsThreeEqualChannels) {
  writeNetwork(3, 2);
  SegmentationModel model(writeModelFile("file: net.onnx\ninput: {width: 3, height: 2}\n"
                                         "classes: {a: [0], b: [1], c: [2], d: [3]}\n"),
                          classSet({"a", "b", "c", "d"}));
  cv::Mat gray(2, 3, CV_8UC1, cv::Scalar(51));
  const cv::Vec4f score = model.scores(gray).at<cv::Vec4f>(1, 2);
  EXPECT_NEAR(score[0], 0.2, 1e-6);
  EXPECT_NEAR(score[1], 0.4, 1e-6);
  EXPECT_NEAR(score[2], -2.8, 1e-6);
  // Colour of the same gray gives the same.
  cv::Mat colour;
  cv::cvtColor(gray, colour, cv::COLOR_GRAY2BGR);
  EXPECT_EQ(cv::norm(model.scores(gray), model.scores(colour), cv::NORM_INF), 0);
}

TEST_F(SegmentationModelTest, MapsChannelsByLogSumExp) {
  writeNetwork(3, 2);
  // `merged` = channels 0 and 1, `absent` has none, channel 3 belongs to nothing.
  SegmentationModel model(writeModelFile("file: net.onnx\ninput: {width: 3, height: 2, scale: 1}\n"
                                         "classes: {c: [2], merged: [1, 0]}\nignore: [3]\n"),
                          classSet({"absent", "merged", "c"}));
  const cv::Mat image = colourImage();
  const cv::Mat scores = model.scores(image);
  ASSERT_EQ(scores.type(), CV_32FC(3));
  for (int y = 0; y < 2; ++y) {
    for (int x = 0; x < 3; ++x) {
      const cv::Vec3b bgr = image.at<cv::Vec3b>(y, x);
      const double r = bgr[2], two_g = 2.0 * bgr[1], c = bgr[0] - 3.0;
      const double merged = std::max(r, two_g) + std::log1p(std::exp(-std::abs(r - two_g)));
      const cv::Vec3f score = scores.at<cv::Vec3f>(y, x);
      EXPECT_NEAR(score[1], merged, 1e-4);
      EXPECT_NEAR(score[2], c, 1e-4);
      EXPECT_NEAR(score[0], std::min(merged, c) - 20, 1e-4);
    }
  }
}

TEST_F(SegmentationModelTest, GivesScoresAtTheNetworksOwnSize) {
  writeNetwork(8, 6, 2);
  SegmentationModel model(writeModelFile("file: net.onnx\ninput: {width: 8, height: 6, scale: 1}\n"
                                         "classes: {a: [0], b: [1], c: [2], d: [3]}\n"),
                          classSet({"a", "b", "c", "d"}));
  // Halved by area: each input value is the mean of four pixels.
  cv::Mat image(12, 16, CV_8UC3);
  for (int y = 0; y < 12; ++y) {
    for (int x = 0; x < 16; ++x) {
      const int block = y / 2 * 8 + x / 2;
      image.at<cv::Vec3b>(y, x) =
          cv::Vec3b(0, 0, static_cast<std::uint8_t>(4 * block + (x % 2 ? 2 : 0)));
    }
  }
  const cv::Mat scores = model.scores(image);
  ASSERT_EQ(scores.size(), cv::Size(4, 3));
  for (int y = 0; y < 3; ++y) {
    for (int x = 0; x < 4; ++x) {
      EXPECT_NEAR(scores.at<cv::Vec4f>(y, x)[0], 4 * (2 * y * 8 + 2 * x) + 1, 1e-4);
    }
  }
}

TEST_F(SegmentationModelTest, KeepsNonFiniteScoresNonFinite) {
  const float infinity = std::numeric_limits<float>::infinity();
  writeConvolution(path("net.onnx"), 1, 1, 1, std::vector<float>(9, 0.0f),
                   {std::numeric_limits<float>::quiet_NaN(), 1, infinity});
  SegmentationModel model(writeModelFile("file: net.onnx\ninput: {width: 1, height: 1}\n"
                                         "classes: {a: [1, 0], b: [2]}\n"),
                          classSet({"a", "b"}));
  const cv::Vec2f score = model.scores(cv::Mat(1, 1, CV_8UC1, cv::Scalar(0))).at<cv::Vec2f>(0, 0);
  EXPECT_FALSE(std::isfinite(score[0]));
  EXPECT_FALSE(std::isfinite(score[1]));
}

TEST_F(SegmentationModelTest, ScoresDoNotAliasEarlierOnes) {
  writeNetwork(3, 2);
  SegmentationModel model(writeModelFile("file: net.onnx\ninput: {width: 3, height: 2}\n"
                                         "classes: {a: [0], b: [1], c: [2], d: [3]}\n"),
                          classSet({"a", "b", "c", "d"}));
  const cv::Mat first = model.scores(cv::Mat(2, 3, CV_8UC1, cv::Scalar(0)));
  const cv::Mat copy = first.clone();
  model.scores(cv::Mat(2, 3, CV_8UC1, cv::Scalar(255)));
  EXPECT_EQ(cv::norm(first, copy, cv::NORM_INF), 0);
}

TEST_F(SegmentationModelTest, ChoosesTheMappingOfTheRigsClassSet) {
  writeNetwork(3, 2);
  const std::string text =
      "file: net.onnx\ninput: {width: 3, height: 2}\nclasses:\n"
      "  - classes: {a: [0], b: [1], c: [2]}\n    ignore: [3]\n"
      "  - classes: {car: [0], road: [1, 2, 3]}\n";
  EXPECT_EQ(problems(text, classSet({"a", "b", "c"})), std::vector<std::string>{});
  EXPECT_EQ(problems(text, classSet({"road", "car", "tree"})), std::vector<std::string>{});
  const std::vector<std::string> none = problems(text, classSet({"a", "road"}));
  ASSERT_EQ(none.size(), 1u);
  expectProblem(none, "classes[0]: b, c; classes[1]: car");
}

TEST_F(SegmentationModelTest, ReportsEveryProblemOfTheFileAtOnce) {
  const std::vector<std::string> found = problems(
      "file: nowhere.onnx\n"
      "input: {width: 0, channels: gray, scale: -1, mean: [1, 2], std: [1, 0, 1], heigth: 4}\n"
      "classes: {a: [0], b: [], c: 2, d: [-1], roof: [3], e: [1.5]}\n"
      "colours: true\n",
      classSet({"a", "b", "c", "d", "e", "root"}));
  expectProblem(found, "cannot read '");
  expectProblem(found, "input.width");
  expectProblem(found, "input.height");
  expectProblem(found, "input.heigth");
  expectProblem(found, "input.channels");
  expectProblem(found, "input.scale");
  expectProblem(found, "input.mean");
  expectProblem(found, "input.std");
  expectProblem(found, "classes.b");
  expectProblem(found, "classes.c");
  expectProblem(found, "classes.d");
  expectProblem(found, "classes.e");
  expectProblem(found, "classes.roof");
  expectProblem(found, "colours");
  for (const std::string& problem : found) {
    EXPECT_NE(problem.find("model.yaml: "), std::string::npos) << problem;
    EXPECT_EQ(problem.find('\n'), std::string::npos) << problem;
  }
}

TEST_F(SegmentationModelTest, ReportsChannelsThatAreMissingTwiceOrBeyond) {
  writeNetwork(3, 2);
  const std::vector<std::string> found = problems(
      "file: net.onnx\ninput: {width: 3, height: 2}\nclasses: {a: [0, 4], b: [0]}\n"
      "ignore: [3]\n",
      classSet({"a", "b"}));
  EXPECT_EQ(found.size(), 4u);
  expectProblem(found, "channel 0 occurs more than once");
  expectProblem(found, "channel 1 is missing");
  expectProblem(found, "channel 2 is missing");
  expectProblem(found, "channel 4 does not exist; the network has 0..3");
}

TEST_F(SegmentationModelTest, RefusesFilesThatAreNoNetworkOrNoModelFile) {
  const LabelSet classes = classSet({"a"});
  const std::string rest = "input: {width: 3, height: 2}\nclasses: {a: [0]}\n";
  EXPECT_THROW(SegmentationModel("/nowhere/model.yaml", classes), ConfigError);
  EXPECT_FALSE(problems("- 1\n- 2\n", classes).empty());
  EXPECT_FALSE(problems("{", classes).empty());
  EXPECT_FALSE(problems("", classes).empty());
  expectProblem(problems(rest, classes), "file");
  std::ofstream(path("net.onnx")) << "not a network at all";
  const std::vector<std::string> found = problems("file: net.onnx\n" + rest, classes);
  ASSERT_EQ(found.size(), 1u);
  expectProblem(found, "is no ONNX file");
}

/// A network that takes 32 x 24 and its file's bytes; 100 mutations here, SLF_MODEL_MUTATIONS by
/// hand. Each is refused with one line, or is a network that runs.
TEST_F(SegmentationModelTest, ADamagedNetworkIsRefusedAndKillsNothing) {
  const LabelSet classes = classSet({"a", "b", "c", "d"});
  writeNetwork(32, 24);
  const std::string text =
      "file: net.onnx\ninput: {width: 32, height: 24}\nclasses: {a: [0], b: [1], "
      "c: [2], d: [3]}\n";
  ASSERT_TRUE(problems(text, classes).empty());
  std::stringstream whole;
  whole << std::ifstream(path("net.onnx"), std::ios::binary).rdbuf();
  const char* const wanted = std::getenv("SLF_MODEL_MUTATIONS");
  std::mt19937 random(15);
  int refused = 0;
  const int mutations = wanted == nullptr ? 100 : std::atoi(wanted);
  for (int i = 0; i < mutations; ++i) {
    std::string bytes = whole.str();
    if (i % 8 == 0) {
      bytes.resize(random() % bytes.size());
    } else {
      for (unsigned flips = 1 + random() % 3; flips > 0; --flips) {
        bytes[random() % bytes.size()] ^= static_cast<char>(1u << random() % 8);
      }
    }
    std::ofstream(path("net.onnx"), std::ios::binary) << bytes;
    const std::vector<std::string> said = problems(text, classes);
    refused += said.empty() ? 0 : 1;
    for (const std::string& problem : said) {
      EXPECT_EQ(problem.find('\n'), std::string::npos) << problem;
    }
  }
  EXPECT_GT(refused, mutations / 4);
}

TEST_F(SegmentationModelTest, ATensorThatIsShorterThanItsShapeIsNamed) {
  ProtoMessage graph;
  graph.message(5, onnxTensor("weights", {4, 3, 1, 1}, {1, 2, 3}));
  std::ofstream(path("net.onnx"), std::ios::binary) << ProtoMessage().message(7, graph).text();
  const auto said = problems("file: net.onnx\ninput: {width: 8, height: 8}\nclasses: {a: [0]}\n",
                             classSet({"a"}));
  ASSERT_EQ(said.size(), 1u);
  EXPECT_NE(said[0].find("tensor 'weights' has the shape of 12 values and data of 12 bytes"),
            std::string::npos)
      << said[0];
}

TEST_F(SegmentationModelTest, RefusesImagesItCannotRead) {
  writeNetwork(3, 2);
  SegmentationModel model(writeModelFile("file: net.onnx\ninput: {width: 3, height: 2}\n"
                                         "classes: {a: [0], b: [1], c: [2], d: [3]}\n"),
                          classSet({"a", "b", "c", "d"}));
  EXPECT_THROW(model.scores(cv::Mat()), DataError);
  EXPECT_THROW(model.scores(cv::Mat(2, 3, CV_16UC1, cv::Scalar(0))), DataError);
  EXPECT_THROW(model.scores(cv::Mat(2, 3, CV_8UC4, cv::Scalar::all(0))), DataError);
  EXPECT_NO_THROW(model.scores(cv::Mat(1, 1, CV_8UC3, cv::Scalar::all(0))));
}

/// The files of a folder below the package whose names begin with `prefix`.
std::vector<std::string> filesIn(const std::string& folder, const std::string& prefix) {
  std::set<std::string> found;
  DIR* directory = opendir((std::string(SLF_SOURCE_DIR) + "/" + folder).c_str());
  if (directory == nullptr) return {};
  while (const dirent* entry = readdir(directory)) {
    const std::string name = entry->d_name;
    if (name.rfind(prefix, 0) == 0 && name[0] != '.') {
      found.insert(std::string(SLF_SOURCE_DIR) + "/" + folder + "/" + name);
    }
  }
  closedir(directory);
  return {found.begin(), found.end()};
}

/// A shipped model file with another network path: the mapping alone is at stake.
std::string withNetwork(const std::string& model_file, const std::string& network) {
  YAML::Node root = YAML::LoadFile(model_file);
  root["file"] = network;
  std::ostringstream text;
  text << root;
  return text.str();
}

TEST_F(SegmentationModelTest, ShippedModelFilesServeTheShippedClassSets) {
  const std::vector<std::string> class_sets = filesIn("config", "classes_");
  const std::vector<std::string> model_files = filesIn("config/models", "");
  ASSERT_GE(class_sets.size(), 3u);
  ASSERT_EQ(model_files.size(), 2u);
  for (const std::string& model_file : model_files) {
    const bool enet = model_file.find("enet_camvid12") != std::string::npos;
    const YAML::Node input = YAML::LoadFile(model_file)["input"];
    // A network of the same input and output channels stands in for the real one.
    const int outputs = enet ? 12 : 20;
    writeConvolution(path("net.onnx"), input["width"].as<int>(), input["height"].as<int>(), 8,
                     std::vector<float>(static_cast<std::size_t>(3 * outputs), 0.0f),
                     std::vector<float>(static_cast<std::size_t>(outputs), 0.0f));
    int served = 0;
    for (const std::string& class_set : class_sets) {
      const std::vector<std::string> found =
          problems(withNetwork(model_file, path("net.onnx")), LabelSet::fromFile(class_set));
      if (found.empty()) {
        ++served;
      } else {
        // A class set without an entry is said to have none; no other problem is allowed.
        ASSERT_EQ(found.size(), 1u) << model_file << " with " << class_set << ": " << found[0];
        expectProblem(found, "no entry fits");
      }
    }
    EXPECT_EQ(served, enet ? 2 : 5);
  }
}

/// Scores in CamVid's classes against the annotation of the street photo below.
void expectRightLabels(const cv::Mat& scores, double least_share) {
  const cv::Mat truth =
      cv::imread(sharedPath("data/camvid/Seq05VD_f01140_annot.png"), cv::IMREAD_GRAYSCALE);
  ASSERT_FALSE(truth.empty());
  const int class_count = scores.channels();
  int right = 0, counted = 0;
  for (int y = 0; y < truth.rows; ++y) {
    for (int x = 0; x < truth.cols; ++x) {
      const int label = truth.at<std::uint8_t>(y, x);
      if (label >= 11) continue;
      const float* cell = scores.ptr<float>(y * scores.rows / truth.rows) +
                          x * scores.cols / truth.cols * class_count;
      ++counted;
      right += std::max_element(cell, cell + class_count) - cell == label ? 1 : 0;
    }
  }
  EXPECT_GT(right, least_share * counted) << right << " of " << counted;
}

/// Runs a network of the optional data and compares with a plain call of OpenCV DNN.
class RealNetworks : public SegmentationModelTest {
 protected:
  void expectEqualToOpenCv(const std::string& network, const std::string& model_file,
                           const std::vector<std::vector<int>>& channels_of_class,
                           const cv::Size& input, const cv::Scalar& mean,
                           const cv::Scalar& std_dev) {
    const std::string config = std::string(SLF_SOURCE_DIR) + "/config/";
    const LabelSet classes = LabelSet::fromFile(config + "classes_camvid12.yaml");
    SegmentationModel model(
        writeModelFile(withNetwork(config + "models/" + model_file, sharedPath(network))), classes);
    const cv::Mat image = cv::imread(sharedPath("data/camvid/Seq05VD_f01140.png"));
    ASSERT_FALSE(image.empty());
    const cv::Mat scores = model.scores(image);

    cv::Mat resized, normalised;
    cv::resize(image, resized, input, 0, 0, cv::INTER_LINEAR);
    cv::cvtColor(resized, normalised, cv::COLOR_BGR2RGB);
    normalised.convertTo(normalised, CV_32FC3, 1.0 / 255.0);
    cv::subtract(normalised, mean, normalised);
    cv::divide(normalised, std_dev, normalised);
    cv::dnn::Net net = cv::dnn::readNetFromONNX(sharedPath(network));
    net.setInput(cv::dnn::blobFromImage(normalised));
    const cv::Mat output = net.forward();
    ASSERT_EQ(scores.rows, output.size[2]);
    ASSERT_EQ(scores.cols, output.size[3]);
    ASSERT_EQ(scores.type(), CV_32FC(12));
    double largest = 0;
    int apart = 0;
    for (int y = 0; y < scores.rows; ++y) {
      for (int x = 0; x < scores.cols; ++x) {
        for (std::size_t c = 0; c < 12; ++c) {
          double sum = 0;
          for (const int channel : channels_of_class[c]) {
            sum +=
                std::exp(static_cast<double>(output.ptr<float>(0, channel)[y * scores.cols + x]));
          }
          const double got = scores.ptr<float>(y)[x * 12 + static_cast<int>(c)];
          const double difference = std::abs(got - std::log(sum));
          largest = std::max(largest, difference);
          apart += difference > 1e-3 ? 1 : 0;
        }
      }
    }
    // Only the float rounding of the inputs separates the two; where two cells of a pooling window
    // are equal but for it, the processor's kernels decide which one ENet's unpooling takes up.
    EXPECT_LT(apart, 0.001 * scores.rows * scores.cols * 12) << "of which the largest " << largest;
    EXPECT_LT(largest, 0.1);
    expectRightLabels(scores, 0.75);
  }
};

TEST_F(RealNetworks, EnetEqualsOpenCvAndSeesTheStreet) {
  SLF_SKIP_WITHOUT("models/enet_camvid12_480x360.onnx");
  SLF_SKIP_WITHOUT("data/camvid/Seq05VD_f01140.png");
  expectEqualToOpenCv("models/enet_camvid12_480x360.onnx", "enet_camvid12.yaml",
                      {{0}, {1}, {2}, {3}, {4}, {5}, {6}, {7}, {8}, {9}, {10}, {11}}, {480, 360},
                      cv::Scalar::all(0), cv::Scalar::all(1));
}

TEST_F(RealNetworks, RefusesAnInputSizeThatTheNetworkDoesNotTake) {
  SLF_SKIP_WITHOUT("models/enet_camvid12_480x360.onnx");
  const std::vector<std::string> found =
      problems("file: " + sharedPath("models/enet_camvid12_480x360.onnx") +
                   "\ninput: {width: 100, height: 99}\nclasses: {a: [0]}\n",
               classSet({"a"}));
  ASSERT_EQ(found.size(), 1u);
  expectProblem(found, "does not take an input of 100x99");
}

TEST_F(RealNetworks, EspnetEqualsOpenCvAndSeesTheStreetInCamVidsClasses) {
  SLF_SKIP_WITHOUT("models/espnetv2_city20_1024x512.onnx");
  SLF_SKIP_WITHOUT("data/camvid/Seq05VD_f01140.png");
  expectEqualToOpenCv("models/espnetv2_city20_1024x512.onnx", "espnetv2_city20.yaml",
                      {{10},
                       {2, 3},
                       {5},
                       {0},
                       {1},
                       {8, 9},
                       {6, 7},
                       {4},
                       {13, 14, 15, 16},
                       {11},
                       {12, 17, 18},
                       {19}},
                      {1024, 512}, cv::Scalar(0.485, 0.456, 0.406),
                      cv::Scalar(0.229, 0.224, 0.225));
}

}  // namespace
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <random>
#include <string>
#include <vector>

#include "map_properties.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/superpixel/uncertainty.h"
#include "superpixel/score_kernels.h"

namespace semantic_lidar_fusion {
namespace {

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
constexpr float kInfinity = std::numeric_limits<float>::infinity();
// A float of a probability is off by half a unit in the last place of 1 at most.
constexpr double kFloatStep = std::numeric_limits<float>::epsilon() / 2;
// Double arithmetic of some tens of terms against long double.
constexpr double kDoubleTolerance = 64 * std::numeric_limits<double>::epsilon();

/// Equations 3 and 4 as they are written, in long double.
std::vector<long double> softmaxByEquation(const std::vector<float>& scores, long double share,
                                           const UncertaintyConfig& config) {
  const long double tau =
      config.temperature / std::pow(share, static_cast<long double>(config.exponent));
  long double sum = 0.0L;
  std::vector<long double> result;
  for (const float score : scores) {
    result.push_back(std::exp(score / tau));
    sum += result.back();
  }
  for (long double& p : result) p /= sum;
  return result;
}

std::vector<double> softmax(const std::vector<float>& scores, double share,
                            const UncertaintyConfig& config = {}, bool expect_valid = true) {
  std::vector<double> result(scores.size(), -1.0);
  EXPECT_EQ(
      temperedSoftmax(scores.data(), static_cast<int>(scores.size()), share, config, result.data()),
      expect_valid);
  return result;
}

/// A map from ids given in row-major order.
SuperpixelMap makeMap(int width, int height, const std::vector<int>& ids) {
  SuperpixelMap map;
  map.ids = cv::Mat(height, width, CV_32SC1);
  for (int i = 0; i < width * height; ++i) map.ids.at<int>(i / width, i % width) = ids[i];
  map.count = *std::max_element(ids.begin(), ids.end()) + 1;
  map.sizes.assign(map.count, 0);
  for (const int id : ids) ++map.sizes[id];
  return map;
}

/// Ids in blocks: dense, though not of every shape that clustering makes.
SuperpixelMap blockMap(int width, int height, int side) {
  std::vector<int> ids;
  const int columns = (width + side - 1) / side;
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) ids.push_back(y / side * columns + x / side);
  }
  return makeMap(width, height, ids);
}

cv::Mat randomScores(int width, int height, int class_count, unsigned seed, float scale = 3.0F) {
  std::mt19937 random(seed);
  std::normal_distribution<float> normal(0.0F, scale);
  cv::Mat scores(height, width, CV_32FC(class_count));
  for (int y = 0; y < height; ++y) {
    float* row = scores.ptr<float>(y);
    for (int i = 0; i < width * class_count; ++i) row[i] = normal(random);
  }
  return scores;
}

/// Shares by brute force from the definition: per superpixel, count the labels of its pixels.
std::vector<double> shareByDefinition(const SuperpixelMap& map, const cv::Mat& scores) {
  const int n = scores.channels();
  std::vector<double> result;
  for (int k = 0; k < map.count; ++k) {
    std::map<int, int> votes;
    int voters = 0;
    for (int y = 0; y < map.ids.rows; ++y) {
      for (int x = 0; x < map.ids.cols; ++x) {
        if (map.ids.at<int>(y, x) != k) continue;
        const int column = static_cast<int>(std::floor((x + 0.5) * scores.cols / map.ids.cols));
        const int row = static_cast<int>(std::floor((y + 0.5) * scores.rows / map.ids.rows));
        const float* cell = scores.ptr<float>(row) + column * n;
        int label = 0;
        bool finite = true;
        for (int c = 0; c < n; ++c) {
          finite = finite && std::isfinite(cell[c]);
          if (cell[c] > cell[label]) label = c;
        }
        if (!finite) continue;
        ++votes[label];
        ++voters;
      }
    }
    int most = 0;
    for (const auto& [label, count] : votes) most = std::max(most, count);
    result.push_back(voters == 0 ? 1.0 : static_cast<double>(most) / voters);
  }
  return result;
}

TEST(TemperedSoftmax, FollowsTheEquations) {
  std::mt19937 random(1);
  std::uniform_real_distribution<float> score(-30.0F, 30.0F);
  std::uniform_real_distribution<double> unit(0.02, 1.0);
  for (int trial = 0; trial < 2000; ++trial) {
    std::vector<float> scores(1 + trial % 23);
    for (float& s : scores) s = score(random);
    const double share = trial % 7 == 0 ? 1.0 : unit(random);
    UncertaintyConfig config;
    if (trial % 2 == 1) config = {0.5 + 3.0 * unit(random), 4.0 * unit(random)};
    if (trial % 5 == 0) config.exponent = 0.0;
    const auto expected = softmaxByEquation(scores, share, config);
    const std::vector<double> p = softmax(scores, share, config);
    double sum = 0.0;
    for (std::size_t c = 0; c < p.size(); ++c) {
      // Rounding of 1 / tau scales with the exponent of e: 60 units of score / temperature.
      EXPECT_NEAR(p[c], static_cast<double>(expected[c]), 4 * kDoubleTolerance);
      sum += p[c];
    }
    EXPECT_NEAR(sum, 1.0, kDoubleTolerance);
  }
}

TEST(TemperedSoftmax, PureSuperpixelKeepsTheProbabilitiesOfTheNetwork) {
  const std::vector<float> scores = {2.0F, -1.0F, 0.5F};
  const std::vector<double> p = softmax(scores, 1.0);
  const double sum = std::exp(2.0) + std::exp(-1.0) + std::exp(0.5);
  EXPECT_NEAR(p[0], std::exp(2.0) / sum, kDoubleTolerance);
  EXPECT_NEAR(p[1], std::exp(-1.0) / sum, kDoubleTolerance);
  EXPECT_NEAR(p[2], std::exp(0.5) / sum, kDoubleTolerance);
}

TEST(TemperedSoftmax, SmallerSharesFlattenTheDistribution) {
  const std::vector<float> scores = {4.0F, 1.0F, -2.0F, 0.0F};
  double previous = 1.0;
  for (const double share : {1.0, 0.8, 0.5, 0.2, 0.05}) {
    const double highest = softmax(scores, share)[0];
    EXPECT_LT(highest, previous) << "share " << share;
    previous = highest;
  }
  for (const double share : {1e-4, 1e-30, 1e-200, std::numeric_limits<double>::denorm_min()}) {
    for (const double p : softmax(scores, share)) EXPECT_NEAR(p, 0.25, 1e-6) << "share " << share;
  }
}

TEST(TemperedSoftmax, IsStableForScoresOfAnySize) {
  for (const float size : {1e4F, -1e4F, 1e30F, 3e38F, std::numeric_limits<float>::max()}) {
    for (const double share : {1.0, 0.5, 1e-3}) {
      for (const double temperature : {1.0, 1e-300, 1e-310, 1e300}) {
        SCOPED_TRACE(std::to_string(size) + ", share " + std::to_string(share));
        const std::vector<double> p = softmax({size, -size, 0.0F, size}, share, {temperature, 2.0});
        double sum = 0.0;
        for (const double value : p) {
          EXPECT_GE(value, 0.0);
          sum += value;
        }
        EXPECT_NEAR(sum, 1.0, kDoubleTolerance);
        EXPECT_EQ(p[0], p[3]);
      }
    }
    const std::vector<double> p = softmax({size, -size, 0.0F, size}, 1.0);
    EXPECT_EQ(p[0], size > 0 ? 0.5 : 0.0);
    EXPECT_EQ(p[1], size > 0 ? 0.0 : 1.0);
  }
  // A common offset changes nothing.
  EXPECT_EQ(softmax({10003.0F, 10001.0F, 10000.0F}, 0.7), softmax({3.0F, 1.0F, 0.0F}, 0.7));
}

TEST(TemperedSoftmax, IsUniformWhereScoresOrShareMeanNothing) {
  const std::vector<double> uniform(4, 0.25);
  for (const float bad : {kNan, kInfinity, -kInfinity}) {
    EXPECT_EQ(softmax({1.0F, bad, 2.0F, 3.0F}, 0.5, {}, false), uniform);
  }
  for (const double share : {0.0, -0.5, 1.0001, std::numeric_limits<double>::quiet_NaN(),
                             std::numeric_limits<double>::infinity()}) {
    EXPECT_EQ(softmax({1.0F, 5.0F, 2.0F, 3.0F}, share, {}, false), uniform);
  }
  EXPECT_EQ(softmax({7.0F}, 0.3), std::vector<double>{1.0});
  EXPECT_EQ(softmax({5.0F, 5.0F, 5.0F, 5.0F}, 0.3), uniform);
}

// Three segments, worked by hand: superpixel 0 is pure, 1 is 3 of 4, 2 is split 2 : 2.
TEST(Share, ThreeSegmentsByHand) {
  const SuperpixelMap map = makeMap(6, 2,
                                    {0, 0, 1, 1, 2, 2,  //
                                     0, 0, 1, 1, 2, 2});
  cv::Mat scores(2, 6, CV_32FC2);
  const int labels[2][6] = {{0, 0, 1, 1, 0, 1}, {0, 0, 1, 0, 0, 1}};
  for (int y = 0; y < 2; ++y) {
    for (int x = 0; x < 6; ++x) {
      const float winner = 2.0F;  // scores (2, 0) or (0, 2)
      scores.at<cv::Vec2f>(y, x) =
          labels[y][x] == 0 ? cv::Vec2f(winner, 0.0F) : cv::Vec2f(0.0F, winner);
    }
  }
  const ScoreMap score_map(scores, 2, {});
  const ShareMap share = computeShare(map, score_map);
  EXPECT_EQ(share.superpixel, (std::vector<float>{1.0F, 0.75F, 0.5F}));
  EXPECT_EQ(share.nonfinite_cells, 0U);

  // P of the winner = 1 / (1 + exp(-2 spp^2)): exponents 2, 1.125 and 0.5.
  const cv::Mat p = denseProbabilities(score_map, share.share, {});
  const double pure = 0.88079707797788;   // 1 / (1 + e^-2)
  const double mixed = 0.75491498686763;  // 1 / (1 + e^-1.125)
  const double split = 0.62245933120185;  // 1 / (1 + e^-0.5)
  EXPECT_NEAR(p.at<cv::Vec2f>(0, 0)[0], pure, kFloatStep);
  EXPECT_NEAR(p.at<cv::Vec2f>(0, 2)[1], mixed, kFloatStep);
  EXPECT_NEAR(p.at<cv::Vec2f>(1, 3)[0], mixed, kFloatStep);
  EXPECT_NEAR(p.at<cv::Vec2f>(0, 4)[0], split, kFloatStep);
  EXPECT_NEAR(p.at<cv::Vec2f>(1, 5)[0], 1.0 - split, kFloatStep);
}

TEST(Share, EqualsTheDefinitionForScoreMapsOfAnySize) {
  for (const auto& [width, height] :
       {std::pair<int, int>{1, 1}, {1, 40}, {53, 1}, {37, 29}, {64, 48}}) {
    const SuperpixelMap map = blockMap(width, height, 7);
    for (const auto& [columns, rows] :
         {std::pair<int, int>{1, 1}, {width, height}, {13, 11}, {97, 3}, {128, 96}}) {
      for (const int class_count : {1, 2, 12}) {
        SCOPED_TRACE(std::to_string(width) + "x" + std::to_string(height) + " map, " +
                     std::to_string(columns) + "x" + std::to_string(rows) + " scores, " +
                     std::to_string(class_count) + " classes");
        cv::Mat scores = randomScores(columns, rows, class_count, 11);
        // Small integers, so that ties occur.
        for (int y = 0; y < rows; ++y) {
          float* row = scores.ptr<float>(y);
          for (int i = 0; i < columns * class_count; ++i) row[i] = std::round(row[i] / 2.0F);
        }
        scores.ptr<float>(rows / 2)[0] = kNan;
        const ShareMap share = computeShare(map, ScoreMap(scores, class_count, {}));
        const std::vector<double> expected = shareByDefinition(map, scores);
        ASSERT_EQ(share.superpixel.size(), expected.size());
        for (std::size_t k = 0; k < expected.size(); ++k) {
          EXPECT_EQ(share.superpixel[k], static_cast<float>(expected[k])) << "superpixel " << k;
        }
        ASSERT_EQ(share.share.size(), map.ids.size());
        ASSERT_EQ(share.share.type(), CV_32FC1);
        for (int y = 0; y < height; ++y) {
          for (int x = 0; x < width; ++x) {
            ASSERT_EQ(share.share.at<float>(y, x), share.superpixel[map.ids.at<int>(y, x)]);
          }
        }
      }
    }
  }
}

/// What runs on this machine, plain kernels included.
std::vector<const ScoreKernels*> allScoreKernels() {
  return {&kPlainScoreKernels, &scoreKernels()};
}

/// Every cell of a row, but for each fifth, in disorder: the kernels take any list.
std::vector<int> someCells(int cell_count) {
  std::vector<int> cells;
  for (int i = cell_count - 1; i >= 0; --i) {
    if (i % 5 != 2) cells.push_back(i);
  }
  return cells;
}

TEST(LabelCells, AreTheFirstHighestOfFiniteScores) {
  std::mt19937 random(21);
  const float specials[] = {kNan, kInfinity, -kInfinity, -0.0F, 3e38F, -3e38F};
  for (int class_count = 1; class_count <= 40; ++class_count) {
    const int cell_count = 300;
    std::vector<float> scores(static_cast<std::size_t>(cell_count) * class_count);
    // Few levels, so that ties occur in every lane.
    for (float& score : scores) score = static_cast<float>(static_cast<int>(random() % 5) - 3);
    for (int i = 0; i < 60; ++i) scores[random() % scores.size()] = specials[random() % 6];
    const std::vector<int> cells = someCells(cell_count);
    for (const ScoreKernels* kernels : allScoreKernels()) {
      std::vector<int> labels(cells.size());
      kernels->labelFloats(scores.data(), cells.data(), static_cast<int>(cells.size()), class_count,
                           labels.data());
      for (std::size_t i = 0; i < cells.size(); ++i) {
        const float* cell = &scores[static_cast<std::size_t>(cells[i]) * class_count];
        int expected = static_cast<int>(std::max_element(cell, cell + class_count) - cell);
        for (int c = 0; c < class_count; ++c) {
          if (!std::isfinite(cell[c])) expected = kNoVote;
        }
        ASSERT_EQ(labels[i], expected)
            << kernels->name << ", cell " << cells[i] << ", classes " << class_count;
      }
    }
  }
}

template <typename Score, typename Label>
void checkIntegerLabels(Score levels, const Label& label) {
  std::mt19937 random(22);
  for (int class_count = 1; class_count <= 70; ++class_count) {
    const int cell_count = 120;
    std::vector<Score> scores(static_cast<std::size_t>(cell_count) * class_count);
    const Score base = static_cast<Score>(random());
    for (Score& score : scores) score = static_cast<Score>(base + random() % levels);
    const std::vector<int> cells = someCells(cell_count);
    for (const ScoreKernels* kernels : allScoreKernels()) {
      for (const bool lowest : {false, true}) {
        std::vector<int> labels(cells.size());
        label(*kernels, scores.data(), cells, class_count,
              static_cast<Score>(lowest ? ~Score{0} : Score{0}), labels.data());
        for (std::size_t i = 0; i < cells.size(); ++i) {
          const Score* cell = &scores[static_cast<std::size_t>(cells[i]) * class_count];
          const Score* end = cell + class_count;
          ASSERT_EQ(labels[i],
                    (lowest ? std::min_element(cell, end) : std::max_element(cell, end)) - cell)
              << kernels->name << ", cell " << cells[i] << ", classes " << class_count;
        }
      }
    }
  }
}

TEST(LabelCells, OfIntegersAreTheFirstHighestOrLowest) {
  const auto bytes = [](const ScoreKernels& kernels, const std::uint8_t* scores,
                        const std::vector<int>& cells, int class_count, std::uint8_t flip,
                        int* labels) {
    kernels.labelBytes(scores, cells.data(), static_cast<int>(cells.size()), class_count, flip,
                       labels);
  };
  const auto words = [](const ScoreKernels& kernels, const std::uint16_t* scores,
                        const std::vector<int>& cells, int class_count, std::uint16_t flip,
                        int* labels) {
    kernels.labelWords(scores, cells.data(), static_cast<int>(cells.size()), class_count, flip,
                       labels);
  };
  // Few levels give ties, many give the whole range.
  checkIntegerLabels<std::uint8_t>(3, bytes);
  checkIntegerLabels<std::uint8_t>(255, bytes);
  checkIntegerLabels<std::uint16_t>(3, words);
  checkIntegerLabels<std::uint16_t>(65535, words);
}

TEST(SegmentStarts, AreWhereAnIdOrALabelChanges) {
  std::mt19937 random(23);
  for (int count = 1; count < 70; ++count) {
    std::vector<int> ids(count), labels(count), expected;
    for (int x = 0; x < count; ++x) {
      ids[x] = x > 0 && random() % 6 != 0 ? ids[x - 1] : static_cast<int>(random() % 1000);
      labels[x] = x > 0 && random() % 9 != 0 ? labels[x - 1] : static_cast<int>(random() % 4) - 1;
      if (x == 0 || ids[x] != ids[x - 1] || labels[x] != labels[x - 1]) expected.push_back(x);
    }
    for (const ScoreKernels* kernels : allScoreKernels()) {
      std::vector<int> starts(count + 8);
      starts.resize(kernels->segmentStarts(ids.data(), labels.data(), count, starts.data()));
      ASSERT_EQ(starts, expected) << kernels->name << ", " << count;
    }
  }
}

/// The scores as the format makes them, in single precision.
cv::Mat convertedScores(const cv::Mat& values, const ScoreFormat& format) {
  cv::Mat wide, scores(values.size(), CV_32FC(values.channels()));
  values.convertTo(wide, CV_64F);
  for (int y = 0; y < values.rows; ++y) {
    for (int i = 0; i < values.cols * values.channels(); ++i) {
      scores.ptr<float>(y)[i] =
          static_cast<float>(format.scale * wide.ptr<double>(y)[i] + format.offset);
    }
  }
  return scores;
}

TEST(Share, OfIntegersIsThatOfTheScoresTheyStandFor) {
  const SuperpixelMap map = blockMap(50, 30, 7);
  // The last two lose differences to single precision, or all range of it.
  const ScoreFormat formats[] = {{0.1, -3.0}, {-0.25, 2.0}, {0.0, 1.0}, {1e-3, 1e6}, {1e34, 0.0}};
  for (const int depth : {CV_8U, CV_16U}) {
    for (const int class_count : {3, 12, 19}) {
      cv::Mat values(40, 90, CV_MAKETYPE(depth, class_count));
      cv::RNG(class_count)
          .fill(values.reshape(1), cv::RNG::UNIFORM, 0, depth == CV_8U ? 256 : 65536);
      for (const ScoreFormat& format : formats) {
        const ShareMap share = computeShare(map, ScoreMap(values, class_count, format));
        const ShareMap expected =
            computeShare(map, ScoreMap(convertedScores(values, format), class_count, {}));
        EXPECT_EQ(share.superpixel, expected.superpixel) << format.scale << " " << class_count;
        EXPECT_EQ(share.nonfinite_cells, expected.nonfinite_cells);
      }
    }
  }
}

TEST(Share, NonFiniteCellsHaveNoVoteAndAreCountedPerMapPixel) {
  const SuperpixelMap map = makeMap(4, 2,
                                    {0, 0, 1, 1,  //
                                     0, 0, 1, 1});
  cv::Mat scores(1, 4, CV_32FC3, cv::Scalar(0.0, 1.0, 0.0));
  scores.at<cv::Vec3f>(0, 0) = {kNan, 0.0F, 0.0F};
  scores.at<cv::Vec3f>(0, 2) = {0.0F, kInfinity, 0.0F};
  scores.at<cv::Vec3f>(0, 3) = {0.0F, 0.0F, -kInfinity};
  const ScoreMap score_map(scores, 3, {});
  const ShareMap share = computeShare(map, score_map);
  EXPECT_EQ(share.nonfinite_cells, 6U);  // three cells, each under two pixels of the map
  EXPECT_EQ(share.superpixel, (std::vector<float>{1.0F, 1.0F}));
  const cv::Mat p = denseProbabilities(score_map, share.share, {});
  for (const int x : {0, 2, 3}) {
    for (int c = 0; c < 3; ++c) EXPECT_EQ(p.at<cv::Vec3f>(1, x)[c], 1.0F / 3.0F);
  }
  EXPECT_GT(p.at<cv::Vec3f>(1, 1)[1], 0.5F);
}

TEST(Share, OfABandCountsItsRowsAndGoesOnBeyond) {
  const cv::Mat scores = randomScores(30, 20, 5, 31);
  SuperpixelMap map = blockMap(30, 20, 5);
  for (int y = 0; y < 20; ++y) {
    const int nearest = std::min(std::max(y, 5), 14);
    if (nearest != y) map.ids.row(nearest).copyTo(map.ids.row(y));
  }
  map.rows = {5, 15};
  const ShareMap share = computeShare(map, ScoreMap(scores, 5, {}));
  SuperpixelMap cut;
  cut.ids = map.ids.rowRange(5, 15).clone();
  cut.count = map.count;
  const ShareMap expected = computeShare(cut, ScoreMap(scores.rowRange(5, 15).clone(), 5, {}));
  EXPECT_EQ(share.superpixel, expected.superpixel);
  for (int y = 0; y < 20; ++y) {
    const int row = std::min(std::max(y - 5, 0), 9);
    EXPECT_EQ(cv::norm(share.share.row(y), expected.share.row(row), cv::NORM_INF), 0.0) << y;
  }
}

TEST(Share, TiesGoToTheLowestClass) {
  const SuperpixelMap map = makeMap(3, 1, {0, 0, 0});
  cv::Mat scores(1, 3, CV_32FC2, cv::Scalar::all(4.0));  // ties: class 0
  scores.at<cv::Vec2f>(0, 2) = {0.0F, 1.0F};
  EXPECT_EQ(computeShare(map, ScoreMap(scores, 2, {})).superpixel[0],
            static_cast<float>(2.0 / 3.0));
}

TEST(DenseProbabilities, AreTheSameNumbersAsTheLazySoftmax) {
  const int class_count = 12;
  const SuperpixelMap map = blockMap(61, 43, 9);
  cv::Mat scores = randomScores(31, 50, class_count, 5);
  scores.ptr<float>(7)[40] = kNan;
  const ScoreMap score_map(scores, class_count, {});
  const ShareMap share = computeShare(map, score_map);
  for (const UncertaintyConfig& config : {UncertaintyConfig{}, UncertaintyConfig{1.7, 1.3}}) {
    const cv::Mat dense = denseProbabilities(score_map, share.share, config);
    ASSERT_EQ(dense.type(), CV_32FC(class_count));
    std::vector<float> cell(class_count);
    std::vector<double> p(class_count);
    for (int y = 0; y < 43; ++y) {
      for (int x = 0; x < 61; ++x) {
        score_map.read(cellUnderCentre(x, 61, 31), cellUnderCentre(y, 43, 50), cell.data());
        temperedSoftmax(cell.data(), class_count, share.share.at<float>(y, x), config, p.data());
        for (int c = 0; c < class_count; ++c) {
          ASSERT_EQ(dense.ptr<float>(y)[x * class_count + c], static_cast<float>(p[c]))
              << x << ", " << y << ", class " << c;
        }
      }
    }
  }
}

TEST(ScoreMap, ConvertsIntegerScoresByScaleAndOffset) {
  cv::Mat bytes(2, 3, CV_8UC2);
  cv::Mat words(2, 3, CV_16UC2);
  for (int i = 0; i < 12; ++i) {
    bytes.ptr(i / 6)[i % 6] = static_cast<uchar>(20 * i);
    words.ptr<ushort>(i / 6)[i % 6] = static_cast<ushort>(5000 * i);
  }
  const ScoreMap from_bytes(bytes, 2, {0.5, -20.0});
  const ScoreMap from_words(words, 2, {0.001, 1.0});
  EXPECT_EQ(from_bytes.size(), (ImageSize{3, 2}));
  EXPECT_EQ(from_bytes.classCount(), 2);
  std::array<float, 2> cell;
  ASSERT_TRUE(from_bytes.read(2, 1, cell.data()));
  EXPECT_EQ(cell, (std::array<float, 2>{0.5F * 200 - 20, 0.5F * 220 - 20}));
  ASSERT_TRUE(from_words.read(1, 1, cell.data()));
  EXPECT_EQ(cell, (std::array<float, 2>{static_cast<float>(0.001 * 40000 + 1.0),
                                        static_cast<float>(0.001 * 45000 + 1.0)}));
  // A negative scale turns the order of the classes round.
  const SuperpixelMap map = makeMap(3, 2, {0, 0, 0, 0, 0, 0});
  EXPECT_EQ(computeShare(map, ScoreMap(bytes, 2, {-1.0, 0.0})).superpixel[0], 1.0F);
  EXPECT_FALSE(ScoreMap(bytes, 2, {1e40, 0.0}).read(2, 1, cell.data()));
}

TEST(ScoreMap, FloatScoresIgnoreTheFormatAndTheImageMayBePartOfAnother) {
  cv::Mat whole = randomScores(9, 9, 3, 2);
  const cv::Mat part = whole(cv::Rect(2, 3, 4, 5));
  const ScoreMap map(part, 3, {7.0, 7.0});
  std::array<float, 3> cell;
  ASSERT_TRUE(map.read(1, 2, cell.data()));
  for (int c = 0; c < 3; ++c) EXPECT_EQ(cell[c], whole.at<cv::Vec3f>(5, 3)[c]);
}

TEST(ScoreMap, RefusesWhatIsNoScoreImage) {
  EXPECT_THROW(ScoreMap(cv::Mat(), 3, {}), DataError);
  EXPECT_THROW(ScoreMap(cv::Mat(4, 4, CV_64FC3), 3, {}), DataError);
  EXPECT_THROW(ScoreMap(cv::Mat(4, 4, CV_32SC3), 3, {}), DataError);
  try {
    ScoreMap(cv::Mat(4, 4, CV_32FC3), 12, {});
    FAIL() << "accepted";
  } catch (const DataError& error) {
    EXPECT_NE(std::string(error.what()).find("3 channels"), std::string::npos) << error.what();
    EXPECT_NE(std::string(error.what()).find("12"), std::string::npos) << error.what();
  }
  EXPECT_TRUE(ScoreMap().empty());
  EXPECT_THROW(computeShare(makeMap(1, 1, {0}), ScoreMap()), DataError);
}

TEST(HistogramProbabilities, AreTheLabelSharesOfTheSuperpixel) {
  const SuperpixelMap map = makeMap(4, 2,
                                    {0, 0, 1, 2,  //
                                     0, 0, 1, 2});
  cv::Mat labels(2, 4, CV_8UC1);
  const uchar values[2][4] = {{0, 2, 1, 255}, {2, 2, 7, 255}};
  for (int i = 0; i < 8; ++i) labels.at<uchar>(i / 4, i % 4) = values[i / 4][i % 4];
  const cv::Mat p = histogramProbabilities(map, labels, 3);
  ASSERT_EQ(p.type(), CV_32FC3);
  ASSERT_EQ(p.size(), map.ids.size());
  EXPECT_EQ(p.at<cv::Vec3f>(1, 1), cv::Vec3f(0.25F, 0.0F, 0.75F));
  EXPECT_EQ(p.at<cv::Vec3f>(0, 2), cv::Vec3f(0.0F, 1.0F, 0.0F));  // label 7 is no class
  EXPECT_EQ(p.at<cv::Vec3f>(0, 3), cv::Vec3f::all(static_cast<float>(1.0 / 3.0)));
}

TEST(HistogramProbabilities, TakesLabelImagesOfAnySize) {
  const int class_count = 5;
  const SuperpixelMap map = blockMap(23, 17, 5);
  for (const auto& [columns, rows] : {std::pair<int, int>{1, 1}, {7, 30}, {46, 34}}) {
    const cv::Mat labels = noiseImage(columns, rows, CV_8UC1, 3) & 7;
    const cv::Mat p = histogramProbabilities(map, labels, class_count);
    for (int k = 0; k < map.count; ++k) {
      std::vector<int> votes(class_count, 0);
      int voters = 0;
      cv::Point any;
      for (int y = 0; y < 17; ++y) {
        for (int x = 0; x < 23; ++x) {
          if (map.ids.at<int>(y, x) != k) continue;
          any = {x, y};
          const int label = labels.at<uchar>((2 * y + 1) * rows / 34, (2 * x + 1) * columns / 46);
          if (label < class_count) ++votes[label], ++voters;
        }
      }
      for (int c = 0; c < class_count; ++c) {
        const double expected =
            voters == 0 ? 1.0 / class_count : static_cast<double>(votes[c]) / voters;
        EXPECT_EQ(p.ptr<float>(any.y)[any.x * class_count + c], static_cast<float>(expected));
      }
    }
  }
}

TEST(HistogramProbabilities, RefusesWhatIsNoLabelImage) {
  const SuperpixelMap map = makeMap(1, 1, {0});
  EXPECT_THROW(histogramProbabilities(map, cv::Mat(), 3), DataError);
  EXPECT_THROW(histogramProbabilities(map, cv::Mat(1, 1, CV_8UC3, cv::Scalar(0)), 3), DataError);
  EXPECT_THROW(histogramProbabilities(map, cv::Mat(1, 1, CV_8UC1, cv::Scalar(0)), 0), DataError);
  EXPECT_THROW(histogramProbabilities(map, cv::Mat(1, 1, CV_8UC1, cv::Scalar(0)), 513), DataError);
}

TEST(BlendScores, AveragesEachPixelWithItsSuperpixel) {
  const int class_count = 5;
  const SuperpixelMap map = blockMap(37, 29, 6);
  cv::Mat scores = randomScores(20, 33, class_count, 8);
  scores.ptr<float>(7)[4 * class_count + 1] = kInfinity;
  const ScoreMap score_map(scores, class_count, {});
  const auto cellAt = [&](int x, int y, float* cell) {
    return score_map.read(cellUnderCentre(x, 37, 20), cellUnderCentre(y, 29, 33), cell);
  };
  std::vector<std::vector<long double>> sums(map.count, std::vector<long double>(class_count));
  std::vector<int> voters(map.count);
  std::vector<float> cell(class_count);
  for (int y = 0; y < 29; ++y) {
    for (int x = 0; x < 37; ++x) {
      if (!cellAt(x, y, cell.data())) continue;
      const int id = map.ids.at<int>(y, x);
      ++voters[id];
      for (int c = 0; c < class_count; ++c) sums[id][c] += cell[c];
    }
  }
  for (const double blend : {0.0, 0.27, 1.0}) {
    const cv::Mat blended = blendScores(map, score_map, blend);
    ASSERT_EQ(blended.type(), CV_32FC(class_count));
    for (int y = 0; y < 29; ++y) {
      for (int x = 0; x < 37; ++x) {
        const bool finite = cellAt(x, y, cell.data());
        const int id = map.ids.at<int>(y, x);
        for (int c = 0; c < class_count; ++c) {
          const float ours = blended.ptr<float>(y)[x * class_count + c];
          if (!finite) {
            ASSERT_EQ(ours, cell[c]);
            continue;
          }
          const auto mean = static_cast<double>(sums[id][c] / voters[id]);
          ASSERT_NEAR(ours, (1.0 - blend) * cell[c] + blend * mean,
                      2 * kFloatStep * (std::abs(cell[c]) + std::abs(mean)));
        }
      }
    }
  }
  EXPECT_THROW(blendScores(map, ScoreMap(), 0.5), DataError);
}

TEST(DenseProbabilities, RefuseAnotherTypeOfShare) {
  const ScoreMap scores(randomScores(2, 2, 3, 1), 3, {});
  EXPECT_THROW(denseProbabilities(scores, cv::Mat(), {}), DataError);
  EXPECT_THROW(denseProbabilities(scores, cv::Mat(2, 2, CV_64FC1, cv::Scalar(1)), {}), DataError);
}

}  // namespace
}  // namespace semantic_lidar_fusion

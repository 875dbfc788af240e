// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <random>
#include <string>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/fusion/camera_merger.h"

namespace semantic_lidar_fusion {
namespace {

SemanticCloud cloudOf(std::size_t points, int class_count) {
  SemanticCloud cloud;
  cloud.class_count = class_count;
  cloud.points.x.assign(points, 1.0f);
  cloud.points.y.assign(points, 0.0f);
  cloud.points.z.assign(points, 0.0f);
  cloud.points.intensity.assign(points, 0.0f);
  cloud.points.ring.assign(points, 0);
  cloud.points.dt.assign(points, 0.0f);
  cloud.points.status.assign(points, 2);
  return cloud;
}

void addVote(CameraVotes* camera, std::uint32_t index, const std::vector<double>& distribution,
             std::int64_t time_difference_ns = 0, float theta = 0) {
  camera->index.push_back(index);
  camera->probabilities.insert(camera->probabilities.end(), distribution.begin(),
                               distribution.end());
  camera->time_difference_ns.push_back(time_difference_ns);
  camera->theta.push_back(theta);
}

std::vector<double> randomDistribution(int class_count, std::mt19937* random) {
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  std::vector<double> p(static_cast<std::size_t>(class_count));
  double sum = 0;
  for (double& value : p) sum += value = uniform(*random) < 0.2 ? 0.0 : uniform(*random);
  if (sum == 0) sum = p[0] = 1;
  for (double& value : p) value /= sum;
  return p;
}

/// The merging rules, point by point, from their definitions.
std::vector<double> mergedReference(const std::vector<const CameraVotes*>& cameras,
                                    const std::vector<std::size_t>& rows, OverlapRule rule,
                                    int class_count, unsigned* bits) {
  std::vector<std::size_t> used;
  double least = 1e300;
  for (std::size_t k = 0; k < cameras.size(); ++k) {
    double key = 0;
    if (rule == OverlapRule::kNearestInTime) {
      key = static_cast<double>(cameras[k]->time_difference_ns[rows[k]]);
    }
    if (rule == OverlapRule::kMostCentral) key = cameras[k]->theta[rows[k]];
    if (key < least) used.clear();
    if (key <= least) used.push_back(k);
    least = std::min(least, key);
  }
  const auto p = [&](std::size_t k, int c) {
    return cameras[k]->probabilities[rows[k] * static_cast<std::size_t>(class_count) +
                                     static_cast<std::size_t>(c)];
  };
  std::vector<double> mean(static_cast<std::size_t>(class_count), 0.0);
  std::vector<double> product(static_cast<std::size_t>(class_count), 1.0);
  double product_sum = 0;
  for (int c = 0; c < class_count; ++c) {
    for (const std::size_t k : used) {
      mean[c] += p(k, c) / static_cast<double>(used.size());
      product[c] *= rule == OverlapRule::kGeometricMean
                        ? std::pow(p(k, c), 1.0 / static_cast<double>(used.size()))
                        : p(k, c);
    }
    product_sum += product[c];
  }
  *bits = 0;
  for (const std::size_t k : used) *bits |= 1u << cameras[k]->rig_index;
  const bool multiplies = rule == OverlapRule::kProduct || rule == OverlapRule::kGeometricMean;
  if (!multiplies || product_sum == 0) return mean;
  for (double& value : product) value /= product_sum;
  return product;
}

class AllRules : public ::testing::TestWithParam<OverlapRule> {};

TEST_P(AllRules, EqualTheReferenceOnRandomVotes) {
  constexpr int kClasses = 5;
  constexpr std::size_t kPoints = 400;
  std::mt19937 random(7);
  std::bernoulli_distribution sees(0.5);
  std::uniform_int_distribution<int> few(0, 3);  // few values, hence ties
  std::vector<CameraVotes> votes(4);
  for (int k = 0; k < 4; ++k) {
    votes[k].rig_index = std::array<int, 4>{9, 0, 15, 4}[k];
    for (std::uint32_t i = 0; i < kPoints; ++i) {
      if (!sees(random)) continue;
      addVote(&votes[k], i, randomDistribution(kClasses, &random), 1000 * few(random),
              0.25f * static_cast<float>(few(random)));
    }
  }
  SemanticCloud cloud = cloudOf(kPoints, kClasses);
  cloud.points.status[3] = 1;
  mergeVotes(votes, GetParam(), &cloud);

  std::map<std::size_t, int> points_by_votes;
  for (std::uint32_t i = 0; i < kPoints; ++i) {
    std::vector<const CameraVotes*> cameras;
    std::vector<std::size_t> rows;
    for (const CameraVotes& camera : votes) {
      const auto found = std::find(camera.index.begin(), camera.index.end(), i);
      if (found == camera.index.end()) continue;
      cameras.push_back(&camera);
      rows.push_back(static_cast<std::size_t>(found - camera.index.begin()));
    }
    ++points_by_votes[cameras.size()];
    const float* p = &cloud.probabilities[i * kClasses];
    if (cameras.empty()) {
      EXPECT_EQ(cloud.points.status[i], i == 3 ? 1 : 2);
      EXPECT_EQ(cloud.label[i], kNoLabel);
      EXPECT_EQ(cloud.confidence[i], 0.0f);
      EXPECT_EQ(cloud.entropy[i], 1.0f);
      EXPECT_EQ(cloud.cameras[i], 0);
      for (int c = 0; c < kClasses; ++c) EXPECT_EQ(p[c], 0.0f);
      continue;
    }
    unsigned bits = 0;
    const std::vector<double> want = mergedReference(cameras, rows, GetParam(), kClasses, &bits);
    double entropy = 0;
    for (int c = 0; c < kClasses; ++c) {
      EXPECT_NEAR(p[c], want[c], 1e-7) << "point " << i << " class " << c;
      if (want[c] > 0) entropy -= want[c] * std::log(want[c]) / std::log(kClasses);
    }
    EXPECT_EQ(cloud.points.status[i], 0);
    EXPECT_EQ(cloud.cameras[i], bits);
    EXPECT_EQ(cloud.label[i], std::max_element(p, p + kClasses) - p);
    EXPECT_EQ(cloud.confidence[i], *std::max_element(p, p + kClasses));
    EXPECT_NEAR(cloud.entropy[i], entropy, 1e-6);
  }
  for (std::size_t count = 0; count <= 4; ++count) EXPECT_GT(points_by_votes[count], 0);
}

INSTANTIATE_TEST_SUITE_P(CameraMerger, AllRules,
                         ::testing::Values(OverlapRule::kMean, OverlapRule::kProduct,
                                           OverlapRule::kNearestInTime, OverlapRule::kMostCentral,
                                           OverlapRule::kGeometricMean));

/// Two cameras (rig 1 and 3) that both see point 0.
SemanticCloud mergeTwo(const std::vector<double>& a, const std::vector<double>& b, OverlapRule rule,
                       std::int64_t time_a = 0, std::int64_t time_b = 0, float theta_a = 0,
                       float theta_b = 0) {
  std::vector<CameraVotes> votes(2);
  votes[0].rig_index = 1;
  votes[1].rig_index = 3;
  addVote(&votes[0], 0, a, time_a, theta_a);
  addVote(&votes[1], 0, b, time_b, theta_b);
  SemanticCloud cloud = cloudOf(1, static_cast<int>(a.size()));
  mergeVotes(votes, rule, &cloud);
  return cloud;
}

TEST(CameraMerger, AveragesByHand) {
  const SemanticCloud cloud =
      mergeTwo({0.5, 0.25, 0.25}, {0.25, 0.5, 0.25}, OverlapRule::kMean, 5, 9, 0.1f, 0.2f);
  EXPECT_EQ(cloud.probabilities, (std::vector<float>{0.375f, 0.375f, 0.25f}));
  EXPECT_EQ(cloud.label[0], 0) << "the lowest id wins a tie";
  EXPECT_EQ(cloud.confidence[0], 0.375f);
  EXPECT_EQ(cloud.cameras[0], (1 << 1) | (1 << 3));
}

TEST(CameraMerger, MultipliesByHand) {
  // 0.5 * 0.25 : 0.25 * 0.5 : 0.25 * 0.25 = 2 : 2 : 1.
  const SemanticCloud cloud = mergeTwo({0.5, 0.25, 0.25}, {0.25, 0.5, 0.25}, OverlapRule::kProduct);
  EXPECT_NEAR(cloud.probabilities[0], 0.4, 1e-7);
  EXPECT_NEAR(cloud.probabilities[1], 0.4, 1e-7);
  EXPECT_NEAR(cloud.probabilities[2], 0.2, 1e-7);
}

TEST(CameraMerger, TakesTheGeometricMeanByHand) {
  // sqrt(0.5 * 0.125) : sqrt(0.25 * 0.25) : sqrt(0.25 * 0.625), and twice the same is the same.
  const SemanticCloud cloud =
      mergeTwo({0.5, 0.25, 0.25}, {0.125, 0.25, 0.625}, OverlapRule::kGeometricMean);
  const double sum = 0.25 + 0.25 + std::sqrt(0.15625);
  EXPECT_NEAR(cloud.probabilities[0], 0.25 / sum, 1e-7);
  EXPECT_NEAR(cloud.probabilities[1], 0.25 / sum, 1e-7);
  EXPECT_NEAR(cloud.probabilities[2], std::sqrt(0.15625) / sum, 1e-7);
  const std::vector<double> p{0.7, 0.2, 0.1};
  EXPECT_NEAR(mergeTwo(p, p, OverlapRule::kGeometricMean).probabilities[0], 0.7, 1e-7);
}

TEST(CameraMerger, TakesTheNearestInTimeOrTheMostCentralOnly) {
  const std::vector<double> a{1.0, 0.0}, b{0.25, 0.75};
  SemanticCloud cloud = mergeTwo(a, b, OverlapRule::kNearestInTime, 5, 9, 0.2f, 0.1f);
  EXPECT_EQ(cloud.probabilities, (std::vector<float>{1.0f, 0.0f}));
  EXPECT_EQ(cloud.cameras[0], 1 << 1);
  EXPECT_EQ(cloud.entropy[0], 0.0f);
  cloud = mergeTwo(a, b, OverlapRule::kMostCentral, 5, 9, 0.2f, 0.1f);
  EXPECT_EQ(cloud.probabilities, (std::vector<float>{0.25f, 0.75f}));
  EXPECT_EQ(cloud.cameras[0], 1 << 3);
  EXPECT_EQ(cloud.label[0], 1);
  cloud = mergeTwo(a, b, OverlapRule::kNearestInTime, 5, 5, 0.2f, 0.1f);
  EXPECT_EQ(cloud.probabilities, (std::vector<float>{0.625f, 0.375f}));
  EXPECT_EQ(cloud.cameras[0], (1 << 1) | (1 << 3));
}

TEST(CameraMerger, ProductSurvivesUnderflowAndZeros) {
  // The products themselves are below the least double.
  SemanticCloud cloud =
      mergeTwo({1e-200, 2e-200, 1.0}, {1e-200, 1e-200, 0.0}, OverlapRule::kProduct);
  EXPECT_NEAR(cloud.probabilities[0], 1.0 / 3, 1e-6);
  EXPECT_NEAR(cloud.probabilities[1], 2.0 / 3, 1e-6);
  EXPECT_EQ(cloud.probabilities[2], 0.0f);
  // Full contradiction: the mean.
  cloud = mergeTwo({1.0, 0.0, 0.0}, {0.0, 0.25, 0.75}, OverlapRule::kProduct);
  EXPECT_EQ(cloud.probabilities, (std::vector<float>{0.5f, 0.125f, 0.375f}));
  EXPECT_EQ(cloud.label[0], 0);
}

TEST(CameraMerger, EntropyIsBetweenZeroAndOne) {
  const std::vector<double> uniform(7, 1.0 / 7);
  EXPECT_EQ(mergeTwo(uniform, uniform, OverlapRule::kMean).entropy[0], 1.0f);
  EXPECT_EQ(mergeTwo({0.0, 1.0}, {0.0, 1.0}, OverlapRule::kMean).entropy[0], 0.0f);
  const SemanticCloud one_class = mergeTwo({1.0}, {1.0}, OverlapRule::kProduct);
  EXPECT_EQ(one_class.entropy[0], 0.0f);
  EXPECT_EQ(one_class.confidence[0], 1.0f);
  EXPECT_EQ(one_class.label[0], 0);
}

TEST(CameraMerger, AcceptsNoVotesAndNoPoints) {
  SemanticCloud cloud = cloudOf(2, 3);
  mergeVotes({}, OverlapRule::kMean, &cloud);
  EXPECT_EQ(cloud.label, (std::vector<std::uint8_t>{kNoLabel, kNoLabel}));
  EXPECT_EQ(cloud.probabilities, std::vector<float>(6, 0.0f));
  SemanticCloud empty = cloudOf(0, 3);
  mergeVotes({CameraVotes{}}, OverlapRule::kProduct, &empty);
  EXPECT_TRUE(empty.label.empty());
}

TEST(CameraMerger, RefusesVotesThatDoNotFit) {
  SemanticCloud cloud = cloudOf(3, 2);
  CameraVotes good;
  addVote(&good, 0, {0.5, 0.5});
  addVote(&good, 2, {0.5, 0.5});
  EXPECT_NO_THROW(mergeVotes({good}, OverlapRule::kMean, &cloud));

  CameraVotes bad = good;
  bad.index[1] = 3;
  EXPECT_THROW(mergeVotes({bad}, OverlapRule::kMean, &cloud), DataError);
  bad = good;
  bad.index[1] = 0;
  EXPECT_THROW(mergeVotes({bad}, OverlapRule::kMean, &cloud), DataError);
  bad = good;
  bad.probabilities.pop_back();
  EXPECT_THROW(mergeVotes({bad}, OverlapRule::kMean, &cloud), DataError);
  bad = good;
  bad.theta.clear();
  EXPECT_THROW(mergeVotes({bad}, OverlapRule::kMean, &cloud), DataError);
  bad = good;
  bad.time_difference_ns.pop_back();
  EXPECT_THROW(mergeVotes({bad}, OverlapRule::kMean, &cloud), DataError);
  bad.time_difference_ns.clear();
  EXPECT_NO_THROW(mergeVotes({bad}, OverlapRule::kMean, &cloud));
  EXPECT_THROW(mergeVotes({bad}, OverlapRule::kNearestInTime, &cloud), DataError);
  bad = good;
  bad.rig_index = kMaxCameras;
  EXPECT_THROW(mergeVotes({bad}, OverlapRule::kMean, &cloud), DataError);
  EXPECT_THROW(mergeVotes(std::vector<CameraVotes>(17), OverlapRule::kMean, &cloud), DataError);
}

}  // namespace
}  // namespace semantic_lidar_fusion

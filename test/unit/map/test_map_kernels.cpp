// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <limits>
#include <random>
#include <vector>

#include "map/map_kernels.h"
#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/map/evidence.h"

namespace semantic_lidar_fusion {
namespace {

/// Probabilities of all magnitudes, and what is none.
std::vector<float> samples(std::size_t count) {
  std::mt19937 random(11);
  std::uniform_real_distribution<float> exponent(-23.0f, 0.1f);
  std::vector<float> result = {0.0f,
                               1.0f,
                               1.0000001f,
                               -0.5f,
                               0.5f,
                               std::sqrt(0.5f),
                               std::nextafter(std::sqrt(0.5f), 0.0f),
                               std::numeric_limits<float>::quiet_NaN(),
                               std::numeric_limits<float>::infinity(),
                               -std::numeric_limits<float>::infinity(),
                               std::numeric_limits<float>::denorm_min()};
  while (result.size() < count) result.push_back(std::exp2(exponent(random)));
  return result;
}

EvidenceConfig uniform(int classes, double weight, double floor) {
  EvidenceConfig config;
  config.weight = weight;
  config.floor = floor;
  config.prior.assign(static_cast<std::size_t>(classes), 1.0 / classes);
  return config;
}

TEST(Evidence, IsTheRoundedLogarithm) {
  const std::vector<float> p = samples(40000);
  for (double weight : {1.0, 0.37, 0.01}) {
    for (double floor : {1e-6, 1e-3, 0.2}) {
      const EvidenceModel model(uniform(4, weight, floor));
      std::int32_t evidence[4 * EvidenceModel::kMaxRows];
      double worst = 0.0;
      for (std::size_t i = 0; i + 4 <= p.size(); i += 4) {
        model.compute(p.data() + i, 1, evidence);
        for (int c = 0; c < 4; ++c) {
          const double value = std::isnan(p[i + c]) ? 0.0 : p[i + c];
          const double believed = std::min(std::max(value, floor), 1.0);
          const double exact = std::ldexp(weight * std::log(believed * 4.0), kEvidenceBits);
          worst = std::max(worst, std::abs(evidence[c] - exact));
        }
      }
      // Half a unit of rounding; the logarithm and the floor as floats, relative error 2^-24 each.
      EXPECT_LE(worst, 0.7 + 0.5 * weight) << "weight " << weight << ", floor " << floor;
    }
  }
}

TEST(Evidence, CountsAreRoundedProbabilities) {
  EvidenceConfig config = uniform(2, 0.5, 1e-3);
  config.kind = EvidenceKind::kDirichlet;
  const EvidenceModel model(config);
  const float p[4] = {0.25f, 0.75f, std::numeric_limits<float>::quiet_NaN(), 2.0f};
  std::int32_t evidence[4];
  model.compute(p, 2, evidence);
  EXPECT_EQ(evidence[0], 1 << 17);
  EXPECT_EQ(evidence[1], 3 << 17);
  EXPECT_EQ(evidence[2], 0);
  EXPECT_EQ(evidence[3], 1 << 19);
}

TEST(Evidence, BadConfigurationsAreToldWhole) {
  EvidenceConfig config = uniform(2, 1.5, 0.0);
  config.prior = {0.9, 0.3};
  try {
    EvidenceModel model(config);
    FAIL() << "accepted";
  } catch (const ConfigError& error) {
    EXPECT_EQ(error.problems().size(), 3u) << error.what();
  }
}

#ifdef __x86_64__
TEST(MapKernels, WideOnesGiveTheSameIntegers) {
  if (!__builtin_cpu_supports("avx2")) GTEST_SKIP() << "this processor has no AVX2";
  const std::vector<float> p = samples(10007);
  std::vector<std::int32_t> prior(p.size()), plain(p.size()), wide(p.size());
  std::mt19937 random(5);
  for (std::int32_t& value : prior) value = -static_cast<std::int32_t>(random() % 900000000);
  for (double weight : {1.0, 0.013}) {
    EvidenceConstants constants;
    constants.floor = 1e-6f;
    constants.scale = static_cast<float>(std::ldexp(weight, kEvidenceBits + kGuardBits));
    constants.octave = static_cast<std::int32_t>(std::lround(constants.scale * std::log(2.0)));
    logEvidencePlain(p.data(), p.size(), constants, prior.data(), plain.data());
    logEvidenceAvx2(p.data(), p.size(), constants, prior.data(), wide.data());
    EXPECT_EQ(plain, wide);
    std::vector<std::int32_t> counts(p.size()), wide_counts(p.size());
    constants.scale = static_cast<float>(std::ldexp(weight, kEvidenceBits));
    countEvidencePlain(p.data(), p.size(), constants, nullptr, counts.data());
    countEvidenceAvx2(p.data(), p.size(), constants, nullptr, wide_counts.data());
    EXPECT_EQ(counts, wide_counts);
  }
  std::vector<std::int64_t> sums(p.size(), std::int64_t{1} << 40), wide_sums = sums;
  addEvidencePlain(plain.data(), static_cast<int>(plain.size()), sums.data());
  addEvidenceAvx2(plain.data(), static_cast<int>(plain.size()), wide_sums.data());
  EXPECT_EQ(sums, wide_sums);
}

TEST(MapKernels, WidePlacementIsThePlainOne) {
  if (!__builtin_cpu_supports("avx2")) GTEST_SKIP() << "this processor has no AVX2";
  std::mt19937 random(6);
  std::normal_distribution<float> coordinate(0.0f, 40.0f);
  for (int round = 0; round < 200; ++round) {
    PlacementConstants constants{};
    const double angle = 0.05 * round;
    const double rows[3][4] = {{std::cos(angle), -std::sin(angle), 0.0, 331275.383734},
                               {std::sin(angle), std::cos(angle), 0.0, 6250099.29659},
                               {0.0, 0.0, 1.0, round % 2 ? 1e12 : -3.0}};
    std::memcpy(constants.rows, rows, sizeof rows);
    constants.voxel_size_m = 0.2;
    PlacedPoints plain{};
    for (int i = 0; i < PlacedPoints::kMaxPoints; ++i) {
      plain.x[i] = coordinate(random);
      plain.y[i] = coordinate(random);
      plain.z[i] = coordinate(random);
    }
    PlacedPoints wide = plain;
    placePointsPlain(constants, &plain);
    placePointsAvx2(constants, &wide);
    EXPECT_EQ(std::memcmp(&plain, &wide, sizeof plain), 0) << "round " << round;
    EXPECT_EQ(plain.inside[0], round % 2 ? 0 : 1);
  }
}
#endif

}  // namespace
}  // namespace semantic_lidar_fusion

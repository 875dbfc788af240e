// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <random>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/common/softmax_kernels.h"

namespace semantic_lidar_fusion {
namespace {

std::vector<const SoftmaxKernels*> usable() {
  std::vector<const SoftmaxKernels*> kernels = {&kPlainSoftmaxKernels};
  if (&softmaxKernels() != &kPlainSoftmaxKernels) kernels.push_back(&softmaxKernels());
  return kernels;
}

class Kernels : public testing::TestWithParam<const SoftmaxKernels*> {};

/// Exactly as long as the scores, so that a sanitizer sees each access beyond them.
struct Case {
  Case(int count, std::mt19937* random, float size)
      : scores(new float[static_cast<std::size_t>(count)]),
        p(new double[static_cast<std::size_t>(count)]) {
    std::normal_distribution<float> normal(0.0f, size);
    for (int c = 0; c < count; ++c) scores[c] = normal(*random);
  }
  std::unique_ptr<float[]> scores;
  std::unique_ptr<double[]> p;
};

TEST_P(Kernels, SoftmaxFollowsTheDefinitionForAnyNumberOfClasses) {
  std::mt19937 random(1);
  for (int count = 1; count <= 40; ++count) {
    for (const float size : {0.1f, 3.0f, 50.0f, 1e4f}) {
      for (const double inverse_tau : {0.0, 1e-3, 0.25, 1.0, 7.0}) {
        Case made(count, &random, size);
        ASSERT_TRUE(GetParam()->softmax(made.scores.get(), count, inverse_tau, made.p.get()));
        long double sum = 0.0L;
        std::vector<long double> expected;
        float highest = made.scores[0];
        for (int c = 0; c < count; ++c) highest = std::max(highest, made.scores[c]);
        for (int c = 0; c < count; ++c) {
          // The product is rounded to double, as in the kernel: it is the argument that counts.
          const double exponent =
              (static_cast<double>(made.scores[c]) - static_cast<double>(highest)) * inverse_tau;
          expected.push_back(std::exp(static_cast<long double>(exponent)));
          sum += expected.back();
        }
        for (int c = 0; c < count; ++c) {
          const auto wanted = static_cast<double>(expected[static_cast<std::size_t>(c)] / sum);
          // Relative to each, down to where the numbers of a double end.
          EXPECT_NEAR(made.p[c], wanted, 2e-15 * wanted + 1e-305) << count << " classes";
        }
      }
    }
  }
}

TEST_P(Kernels, GiveTheBytesOfThePlainOnes) {
  std::mt19937 random(2);
  for (int trial = 0; trial < 3000; ++trial) {
    const int count = 1 + trial % 33;
    const double inverse_tau =
        trial % 7 == 0 ? std::numeric_limits<double>::infinity() : std::pow(10.0, trial % 9 - 5);
    Case made(count, &random, trial % 2 == 0 ? 5.0f : 1e30f);
    if (trial % 5 == 0) made.scores[random() % count] = made.scores[0];
    std::vector<double> plain(static_cast<std::size_t>(count));
    ASSERT_TRUE(kPlainSoftmaxKernels.softmax(made.scores.get(), count, inverse_tau, plain.data()));
    ASSERT_TRUE(GetParam()->softmax(made.scores.get(), count, inverse_tau, made.p.get()));
    for (int c = 0; c < count; ++c) ASSERT_EQ(made.p[c], plain[static_cast<std::size_t>(c)]);
    ASSERT_EQ(GetParam()->entropy(made.p.get(), count),
              kPlainSoftmaxKernels.entropy(plain.data(), count));
  }
}

TEST_P(Kernels, RefuseEveryScoreThatIsNotFinite) {
  std::mt19937 random(3);
  for (int count = 1; count <= 13; ++count) {
    for (int bad = 0; bad < count; ++bad) {
      for (const float value :
           {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity(),
            -std::numeric_limits<float>::infinity()}) {
        Case made(count, &random, 1.0f);
        made.scores[bad] = value;
        EXPECT_FALSE(GetParam()->softmax(made.scores.get(), count, 1.0, made.p.get()))
            << value << " at " << bad << " of " << count;
      }
    }
  }
}

TEST_P(Kernels, EntropyFollowsTheDefinition) {
  std::mt19937 random(4);
  std::uniform_real_distribution<double> power(-320.0, 0.0), unit(0.0, 1.0);
  for (int count = 1; count <= 40; ++count) {
    for (int trial = 0; trial < 50; ++trial) {
      const std::unique_ptr<double[]> p(new double[static_cast<std::size_t>(count)]);
      long double expected = 0.0L;
      for (int c = 0; c < count; ++c) {
        p[c] = trial % 3 == 0 ? std::pow(10.0, power(random)) : unit(random);
        if (random() % 6 == 0) p[c] = random() % 2 == 0 ? 0.0 : 1.0;
        if (p[c] > 0.0) expected -= p[c] * std::log(static_cast<long double>(p[c]));
      }
      EXPECT_NEAR(GetParam()->entropy(p.get(), count), static_cast<double>(expected),
                  1e-12 * count);
    }
  }
}

TEST_P(Kernels, NarrowGivesTheFirstOfTheLargest) {
  std::mt19937 random(5);
  for (int count = 1; count <= 40; ++count) {
    for (int trial = 0; trial < 50; ++trial) {
      const auto n = static_cast<std::size_t>(count);
      const std::unique_ptr<double[]> p(new double[n]);
      const std::unique_ptr<float[]> out(new float[n]);
      // Few different values, some of which only doubles tell apart.
      for (int c = 0; c < count; ++c) p[c] = 0.1 * (random() % 4) + 1e-12 * (random() % 3);
      const int label = GetParam()->narrow(p.get(), count, out.get());
      for (int c = 0; c < count; ++c) EXPECT_EQ(out[c], static_cast<float>(p[c]));
      EXPECT_EQ(label, std::max_element(out.get(), out.get() + count) - out.get());
    }
  }
}

INSTANTIATE_TEST_SUITE_P(All, Kernels, testing::ValuesIn(usable()),
                         [](const auto& info) { return std::string(info.param->name); });

}  // namespace
}  // namespace semantic_lidar_fusion

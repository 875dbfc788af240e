// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <limits>
#include <memory>
#include <random>
#include <vector>

#include "not_finite.h"
#include "projection/projection_kernels.h"

namespace semantic_lidar_fusion {
namespace {

/// Points in arrays of exactly their length, so that a sanitizer sees each read beyond them.
struct Points {
  explicit Points(int count)
      : x(new float[count]),
        y(new float[count]),
        z(new float[count]),
        status(new std::uint8_t[count]) {}
  std::unique_ptr<float[]> x, y, z;
  std::unique_ptr<std::uint8_t[]> status;
};

/// Everything that may happen: points anywhere, on the axis, in the centre, far beyond, not finite.
Points hardPoints(int count, std::uint32_t seed) {
  std::mt19937 random(seed);
  std::normal_distribution<float> coordinate(0.0f, 10.0f);
  const float odd[] = {0.0f,   -0.0f, 1e-20f,    -1e-8f,     1e12f,
                       -1e25f, 3e38f, kInfinity, -kInfinity, kNan};
  Points points(count);
  for (int i = 0; i < count; ++i) {
    points.x[i] = coordinate(random);
    points.y[i] = coordinate(random);
    points.z[i] = coordinate(random);
    if (random() % 8 == 0) points.x[i] = odd[random() % 10];
    if (random() % 8 == 0) points.y[i] = odd[random() % 10];
    if (random() % 8 == 0) points.z[i] = odd[random() % 10];
    points.status[i] = random() % 5 == 0 ? 4 : 0;
  }
  return points;
}

SightCone cone(float cosine, float shift_m) {
  return {{0.1f, -0.99f, 0.0f, shift_m, 0.0f, 0.05f, -1.0f, 0.2f, 0.98f, 0.1f, 0.02f, -shift_m},
          cosine,
          1e-5f};
}

EquidistantLens lens(double shift_m, float theta_limit) {
  return {{0.1, -0.99, 0.0, shift_m, 0.0, 0.05, -1.0, 2.0 * shift_m, 0.98, 0.1, 0.02, shift_m},
          400.0f,
          410.0f,
          0.01f,
          300.0f,
          200.0f,
          {-0.0557f, 0.0173f, -0.0019f, 0.00007f},
          theta_limit - 2e-6f,
          theta_limit + 2e-6f,
          -20.5f,
          659.5f,
          -0.5f,
          399.5f};
}

/// Of a shutter that rolls along u or v, at 15 m/s and a fast turn.
RollingRows rolling(const EquidistantLens& lens, bool down) {
  RollingRows rows{};
  for (int i = 0; i < 12; ++i) rows.matrix[i] = static_cast<float>(lens.matrix[i]);
  rows.k[0] = 1.0f;
  for (int i = 0; i < 4; ++i) rows.k[i + 1] = lens.k[i];
  rows.per_right = down ? 0.0f : lens.focal_x;
  rows.per_down = down ? lens.focal_y : lens.focal_x * lens.skew;
  rows.at_centre = down ? lens.centre_y : lens.centre_x;
  rows.begin = -400.0f, rows.end = 800.0f;
  rows.at_zero_s = -0.015f, rows.per_px_s = 0.03f / 400.0f;
  rows.theta_sure = lens.theta_sure - 1e-3f, rows.theta_never = lens.theta_never + 1e-3f;
  rows.least_squared_m2 = 1e-6f;
  rows.in_image = {{15.0f, 0.3f, -0.2f}, {0.02f, 1.5f, -0.01f}};
  rows.in_lidar = {{-0.2f, -15.0f, 0.3f}, {-0.01f, 0.02f, -1.5f}};
  return rows;
}

template <typename T>
void expectSameBytes(const T* a, const T* b, int count, const char* what) {
  EXPECT_EQ(std::memcmp(a, b, sizeof(T) * static_cast<std::size_t>(count)), 0) << what;
}

class WideKernels : public testing::TestWithParam<const ProjectionKernels*> {};

std::vector<const ProjectionKernels*> usable() {
  const ProjectionKernelList list = usableProjectionKernels();
  return {list.kernels, list.kernels + list.count};
}

TEST_P(WideKernels, GiveTheBytesOfThePlainOnes) {
  const ProjectionKernels& plain = kPlainProjectionKernels;
  int selected_in_all = 0, kept_in_all = 0, doubtful_in_all = 0;
  for (const int count : {0, 1, 7, 8, 9, 15, 16, 17, 100, 511, 512}) {
    for (std::uint32_t seed = 0; seed < 20; ++seed) {
      SCOPED_TRACE(std::to_string(count) + " points, seed " + std::to_string(seed));
      const float shift = seed % 3 == 0 ? 0.0f : 0.3f;
      const float cosine = seed % 4 == 0 ? -1.1f : 0.3f;
      // Unaligned as well.
      const int skip = count > 0 ? static_cast<int>(seed % 3) % count : 0;
      const Points points = hardPoints(count, seed);
      const auto select = [&](const ProjectionKernels& kernels, SelectedPoints* out) {
        return kernels.select(cone(cosine, shift), points.x.get() + skip, points.y.get() + skip,
                              points.z.get() + skip, points.status.get() + skip, 4, count - skip,
                              out);
      };
      SelectedPoints expected, selected;
      const int n = select(plain, &expected);
      ASSERT_EQ(select(*GetParam(), &selected), n);
      expectSameBytes(selected.x, expected.x, n, "x");
      expectSameBytes(selected.y, expected.y, n, "y");
      expectSameBytes(selected.z, expected.z, n, "z");
      expectSameBytes(selected.place, expected.place, n, "place");

      const EquidistantLens of = lens(shift, seed % 2 == 0 ? 3.14159265f : 1.3f);
      PixelBlock pixels, wanted;
      const int kept = plain.equidistant(of, expected, n, &wanted);
      ASSERT_EQ(GetParam()->equidistant(of, expected, n, &pixels), kept);
      ASSERT_EQ(pixels.doubtful_count, wanted.doubtful_count);
      expectSameBytes(pixels.doubtful, wanted.doubtful, wanted.doubtful_count, "doubtful");
      expectSameBytes(pixels.place, wanted.place, kept, "place");
      int next = 0;
      for (int k = 0; k < kept; ++k) {
        if (next < wanted.doubtful_count && wanted.doubtful[next] == static_cast<unsigned>(k)) {
          ++next;  // numbers that mean nothing
          continue;
        }
        EXPECT_EQ(pixels.u[k], wanted.u[k]);
        EXPECT_EQ(pixels.v[k], wanted.v[k]);
        EXPECT_EQ(pixels.distance[k], wanted.distance[k]);
        EXPECT_EQ(pixels.theta[k], wanted.theta[k]);
      }
      selected_in_all += n;
      kept_in_all += kept;
      doubtful_in_all += wanted.doubtful_count;
    }
  }
  EXPECT_GT(selected_in_all, 5000);
  EXPECT_GT(kept_in_all, 1000);
  EXPECT_GT(doubtful_in_all, 100);
}

TEST_P(WideKernels, RollAsThePlainOnes) {
  int points_in_all = 0, rolled_in_all = 0, doubtful_in_all = 0;
  for (const int count : {0, 1, 7, 8, 9, 100, 511, 512}) {
    for (std::uint32_t seed = 0; seed < 20; ++seed) {
      SCOPED_TRACE(std::to_string(count) + " points, seed " + std::to_string(seed));
      const Points points = hardPoints(count, seed);
      SelectedPoints all, expected, rolled;
      for (int i = 0; i < count; ++i) {
        all.x[i] = points.x[i], all.y[i] = points.y[i], all.z[i] = points.z[i];
        all.place[i] = static_cast<std::uint32_t>(3 * i);
      }
      const RollingRows rows =
          rolling(lens(0.3f, seed % 2 == 0 ? 3.14159265f : 1.3f), seed % 4 < 2);
      const int kept = kPlainProjectionKernels.roll(rows, all, count, &expected);
      ASSERT_EQ(GetParam()->roll(rows, all, count, &rolled), kept);
      expectSameBytes(rolled.place, expected.place, kept, "place");
      for (int k = 0; k < kept; ++k) {
        ASSERT_EQ(std::isnan(rolled.x[k]), std::isnan(expected.x[k]));
        if (std::isnan(expected.x[k])) {
          ++doubtful_in_all;
          continue;  // y and z mean nothing
        }
        EXPECT_EQ(rolled.x[k], expected.x[k]);
        EXPECT_EQ(rolled.y[k], expected.y[k]);
        EXPECT_EQ(rolled.z[k], expected.z[k]);
      }
      points_in_all += count;
      rolled_in_all += kept;
    }
  }
  EXPECT_GT(points_in_all - rolled_in_all, 1000);
  EXPECT_GT(doubtful_in_all, 100);
  EXPECT_GT(rolled_in_all - doubtful_in_all, 5000);
}

TEST_P(WideKernels, SelectNeverLosesAPointOfTheCone) {
  std::mt19937 random(3);
  std::normal_distribution<double> normal;
  constexpr int kCount = 512;
  Points points(kCount);
  for (int trial = 0; trial < 200; ++trial) {
    // A cone seen from afar or near, points on its surface just inside.
    const double half_angle = 0.05 + 3.05 * (trial / 200.0);
    const double size = std::pow(10.0, trial % 7 - 2);
    const double shift[3] = {normal(random), normal(random), normal(random)};
    SightCone wide{{1, 0, 0, static_cast<float>(shift[0]), 0, 1, 0, static_cast<float>(shift[1]), 0,
                    0, 1, static_cast<float>(shift[2])},
                   static_cast<float>(std::cos(half_angle) - 1e-5),
                   static_cast<float>(2e-5 * std::sqrt(shift[0] * shift[0] + shift[1] * shift[1] +
                                                       shift[2] * shift[2]))};
    for (int i = 0; i < kCount; ++i) {
      const double turn = 0.01 * i, theta = half_angle * (1.0 - 1e-7);
      const double range = size * (1.0 + std::abs(normal(random)));
      points.x[i] = static_cast<float>(range * std::sin(theta) * std::cos(turn) - shift[0]);
      points.y[i] = static_cast<float>(range * std::sin(theta) * std::sin(turn) - shift[1]);
      points.z[i] = static_cast<float>(range * std::cos(theta) - shift[2]);
      points.status[i] = 0;
    }
    SelectedPoints selected;
    EXPECT_EQ(GetParam()->select(wide, points.x.get(), points.y.get(), points.z.get(),
                                 points.status.get(), 4, kCount, &selected),
              kCount)
        << "half angle " << half_angle << ", size " << size;
  }
}

INSTANTIATE_TEST_SUITE_P(All, WideKernels, testing::ValuesIn(usable()),
                         [](const auto& info) { return std::string(info.param->name); });

}  // namespace
}  // namespace semantic_lidar_fusion

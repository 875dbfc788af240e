// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <map>
#include <random>
#include <set>
#include <tuple>
#include <vector>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/map/voxel_map.h"

namespace semantic_lidar_fusion {
namespace {

constexpr int kClasses = 3;

struct Point {
  float x = 0, y = 0, z = 0, intensity = 0;
  std::uint8_t status = 0;
  float p[kClasses] = {};
};

SemanticPoints view(const std::vector<Point>& points) {
  SemanticPoints result;
  result.count = points.size();
  if (points.empty()) return result;
  const auto column = [](const void* first) {
    return Column{static_cast<const std::uint8_t*>(first), sizeof(Point)};
  };
  const Point& first = points.front();
  result.x = column(&first.x);
  result.y = column(&first.y);
  result.z = column(&first.z);
  result.intensity = column(&first.intensity);
  result.status = column(&first.status);
  result.probabilities = column(first.p);
  return result;
}

VoxelMapConfig config() {
  VoxelMapConfig result;
  result.voxel_size_m = 0.25;
  result.evidence.prior = {0.5, 0.25, 0.25};
  return result;
}

std::vector<Point> cloud(int seed, int count) {
  std::mt19937 random(static_cast<unsigned>(seed));
  std::normal_distribution<float> coordinate(0.0f, 10.0f);
  std::uniform_real_distribution<float> share(0.0f, 1.0f);
  std::vector<Point> points(static_cast<std::size_t>(count));
  for (Point& point : points) {
    point.x = coordinate(random);
    point.y = coordinate(random);
    point.z = coordinate(random);
    point.intensity = 100.0f * share(random);
    point.status = static_cast<std::uint8_t>(random() % 5);
    float sum = 0.0f;
    for (float& p : point.p) sum += p = share(random);
    for (float& p : point.p) p /= sum;
  }
  return points;
}

Transform pose(double x) {
  Transform result = Transform::Identity();
  result.linear() = Eigen::AngleAxisd(0.3 * x, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  result.translation() = Eigen::Vector3d(331000.0 + x, 6250000.0, 30.0);
  return result;
}

TEST(VoxelMap, HoldsEveryPointWhereItIs) {
  VoxelMap map(config());
  const std::vector<Point> points = cloud(1, 20000);
  const IntegrationCounts counts = map.integrate(view(points), pose(2.0), 77);
  std::map<std::tuple<int, int, int>, std::pair<int, bool>> expected;
  for (const Point& point : points) {
    if (point.status > 3) continue;
    const Eigen::Vector3d at = pose(2.0) * Eigen::Vector3d(point.x, point.y, point.z);
    auto& entry = expected[{static_cast<int>(std::floor(at.x() / 0.25)),
                            static_cast<int>(std::floor(at.y() / 0.25)),
                            static_cast<int>(std::floor(at.z() / 0.25))}];
    ++entry.first;
    entry.second |= point.status == 0;
  }
  ASSERT_EQ(map.size(), expected.size());
  EXPECT_EQ(counts.labelled + counts.occupied + counts.no_odometry, points.size());
  const std::vector<std::uint8_t> records = map.records();
  for (std::size_t i = 0; i < map.size(); ++i) {
    VoxelHeader voxel;
    std::memcpy(&voxel, records.data() + i * map.recordSize(), sizeof voxel);
    const auto found = expected.find({voxel.x, voxel.y, voxel.z});
    ASSERT_NE(found, expected.end());
    EXPECT_EQ(voxel.observations, static_cast<unsigned>(found->second.first));
    EXPECT_EQ(voxel.looks, 1u);
    EXPECT_EQ(voxel.labelled, found->second.second ? 1u : 0u);
    EXPECT_EQ(voxel.first_ns, 77);
  }
}

TEST(VoxelMap, OrderAndMergingChangeNoBit) {
  VoxelMap whole(config()), backwards(config()), sum(config());
  for (int i = 0; i < 8; ++i) {
    whole.integrate(view(cloud(i, 5000)), pose(i), i);
    backwards.integrate(view(cloud(7 - i, 5000)), pose(7 - i), 7 - i);
    VoxelMap part(config());
    part.integrate(view(cloud(i, 5000)), pose(i), i);
    const std::vector<std::uint8_t> records = part.records(i % 2 == 0);
    sum.add(records.data(), records.size());
  }
  EXPECT_EQ(whole.records(), backwards.records());
  EXPECT_EQ(whole.records(), sum.records());
}

TEST(VoxelMap, ForgetsWhatIsOutside) {
  VoxelMap map(config());
  map.integrate(view(cloud(3, 20000)), pose(0.0), 0);
  const std::size_t before = map.size(), bytes = map.memoryBytes();
  const int x = static_cast<int>(331000 / 0.25);
  map.keepInside({x - 8, -(1 << 30), -(1 << 30)}, {x + 8, 1 << 30, 1 << 30});
  EXPECT_LT(map.size(), before / 2);
  EXPECT_LT(map.memoryBytes(), bytes);
  // It is still one map: the same points again make no voxel twice.
  map.integrate(view(cloud(3, 20000)), pose(0.0), 0);
  EXPECT_EQ(map.size(), before);
}

TEST(VoxelMap, StaysWholeWhenItsMemoryShrinksAndGrows) {
  // Enough voxels for several huge pages of records and a table of more than one.
  VoxelMap map(config()), part(config());
  const std::vector<Point> points = cloud(5, 150000);
  map.integrate(view(points), pose(0.0), 0);
  ASSERT_GT(map.size() * map.recordSize(), 3 * kHugePage);
  EXPECT_GE(map.memoryBytes(), map.size() * map.recordSize());
  const std::vector<std::uint8_t> all = map.records();
  const int x = static_cast<int>(331000 / 0.25), far = 1 << 30;
  for (const int half_width : {1000, 20, 2, 0}) {
    map.keepInside({x - half_width, -far, -far}, {x + half_width, far, far});
    part.add(all.data(), all.size());
    part.keepInside({x - half_width, -far, -far}, {x + half_width, far, far});
    EXPECT_EQ(map.records(), part.records());
    part.clear();
  }
  map.clear();
  map.integrate(view(points), pose(0.0), 0);
  EXPECT_EQ(map.records(), all);
}

TEST(VoxelMap, RefusesBrokenRecordsAndConfigurations) {
  VoxelMap map(config());
  const std::vector<std::uint8_t> bytes(map.recordSize() + 1);
  EXPECT_THROW(map.add(bytes.data(), bytes.size()), DataError);
  VoxelMapConfig wrong = config();
  wrong.voxel_size_m = 0.0;
  wrong.max_range_m = -1.0;
  EXPECT_THROW(VoxelMap{wrong}, ConfigError);
}

struct Crossed {
  std::set<VoxelKey> surely, perhaps;
};

/// Voxels that a point moving along the ray in small steps lies in for 0.8 of an edge or more; to
/// two steps, in which its way into and out of a voxel is uncertain.
Crossed crossed(const Eigen::Vector3d& from, const Eigen::Vector3d& to, double reach) {
  constexpr double kStep = 1e-3;
  std::map<VoxelKey, double> way;
  const double length = (to - from).norm();
  for (double t = kStep / 2; t < std::min(length, reach); t += kStep) {
    const Eigen::Vector3d at = from + (to - from) * (t / length);
    way[{static_cast<int>(std::floor(at.x())), static_cast<int>(std::floor(at.y())),
         static_cast<int>(std::floor(at.z()))}] += kStep;
  }
  Crossed result;
  for (const auto& entry : way) {
    if (entry.second > 0.8 + 2 * kStep) result.surely.insert(entry.first);
    if (entry.second > 0.8 - 2 * kStep) result.perhaps.insert(entry.first);
  }
  return result;
}

std::set<VoxelKey> freeVoxels(const VoxelMap& map) {
  const std::vector<std::uint8_t> bytes = map.bricks();
  std::set<VoxelKey> result;
  for (std::size_t at = 0; at < bytes.size(); at += sizeof(FreeBrick)) {
    FreeBrick brick;
    std::memcpy(&brick, bytes.data() + at, sizeof brick);
    for (int z = 0; z < 8; ++z) {
      for (int bit = 0; bit < 64; ++bit) {
        if ((brick.planes[0][z] >> bit & 1) != 0)
          result.insert({brick.x * 8 + bit % 8, brick.y * 8 + bit / 8, brick.z * 8 + z});
      }
    }
  }
  return result;
}

TEST(VoxelMap, RaysFreeWhatTheyCross) {
  VoxelMapConfig rays = config();
  rays.voxel_size_m = 1.0;
  rays.ray_range_m = 20.0;
  std::mt19937 random(4);
  std::uniform_real_distribution<float> coordinate(-25.0f, 25.0f);
  std::size_t total = 0;
  for (int i = 0; i < 30; ++i) {
    VoxelMap map(rays);
    Point point;
    point.status = 1;
    point.x = coordinate(random);
    point.y = coordinate(random);
    point.z = coordinate(random);
    const double from[3] = {0.31, -0.22, 0.43};
    const std::vector<Point> one = {point};
    SemanticPoints points = view(one);
    points.origins = from;
    map.integrate(points, Transform::Identity(), 0);
    const Eigen::Vector3d end(point.x, point.y, point.z);
    const Crossed expected = crossed(Eigen::Vector3d(from[0], from[1], from[2]), end, 20.0);
    const std::set<VoxelKey> found = freeVoxels(map);
    total += found.size();
    for (const VoxelKey& key : found) EXPECT_EQ(expected.perhaps.count(key), 1u);
    for (const VoxelKey& key : expected.surely) {
      bool own = true;
      for (int axis = 0; axis < 3; ++axis)
        own &= std::abs(key[axis] - static_cast<int>(std::floor(end[axis]))) <= 1;
      EXPECT_EQ(found.count(key), own ? 0u : 1u);
    }
  }
  EXPECT_GT(total, 150u);  // 20 voxels of way each, of which most are crossed by less than 0.8
}

TEST(VoxelMap, PassesStayAtTheirGreatestNumber) {
  VoxelMapConfig rays = config();
  rays.ray_range_m = 20.0;
  VoxelMap map(rays);
  std::vector<Point> near(1), far(1);
  near[0].status = far[0].status = 1;
  near[0].x = 5.1f;
  far[0].x = 9.1f;
  near[0].y = far[0].y = near[0].z = far[0].z = 0.1f;
  map.integrate(view(near), Transform::Identity(), 0);
  for (int i = 0; i < 10; ++i) map.integrate(view(far), Transform::Identity(), 1 + i);
  const auto passes = [](const VoxelMap& of) {
    VoxelHeader voxel;
    const std::vector<std::uint8_t> records = of.records();
    std::memcpy(&voxel, records.data(), sizeof voxel);
    return voxel.passes_after;
  };
  EXPECT_EQ(passes(map), 10u);
  VoxelMap later(rays);
  for (int i = 0; i < 10; ++i) later.integrate(view(far), Transform::Identity(), 11 + i);
  const std::vector<std::uint8_t> records = later.records(), bricks = later.bricks();
  map.add(records.data(), records.size(), bricks.data(), bricks.size());
  EXPECT_EQ(passes(map), kMaxPasses);
  EXPECT_THROW(map.add(nullptr, 0, bricks.data(), bricks.size() - 1), DataError);
}

TEST(VoxelMap, AnEmptyCloudChangesNothing) {
  VoxelMap map(config());
  map.integrate(view({}), pose(0.0), 0);
  EXPECT_EQ(map.size(), 0u);
  EXPECT_TRUE(map.records().empty());
}

}  // namespace
}  // namespace semantic_lidar_fusion

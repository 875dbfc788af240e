// SPDX-License-Identifier: MIT
/// The voxel map beside octomap with a node of twelve floats, one thread, the same drive of 24 000
/// points a scan through a made-up street. Compare rows of one run with each other: absolute times
/// depend on the machine and on its other work.
#include <benchmark/benchmark.h>

#include <cmath>
#include <cstring>
#include <random>
#include <vector>

#include "semantic_lidar_fusion/map/voxel_map.h"
#ifdef SLF_BENCHMARK_OCTOMAP
#include <octomap/OcTreeNode.h>
#include <octomap/OccupancyOcTreeBase.h>
#endif

namespace semantic_lidar_fusion {
namespace {

constexpr int kClasses = 12;
constexpr int kScans = 20;
constexpr int kColumns = 1500;
constexpr int kRings = 16;
constexpr double kVoxel = 0.2;

/// As the points lie in a points_semantic message.
struct Point {
  float x, y, z, intensity;
  std::uint8_t status, label;
  float probabilities[kClasses];
};

struct Scan {
  std::vector<Point> points;
  Transform pose;
};

/// A vehicle at 10 m/s in a street 12 m wide with houses 15 m high.
std::vector<Scan> drive() {
  std::mt19937 random(3);
  std::normal_distribution<float> noise(0.0f, 0.02f), score(0.0f, 1.5f);
  std::vector<Scan> scans(kScans);
  for (int s = 0; s < kScans; ++s) {
    Scan& scan = scans[s];
    scan.pose = Transform::Identity();
    scan.pose.translation() = Eigen::Vector3d(331275.3 + s, 6250099.2, 1.8);
    for (int column = 0; column < kColumns; ++column) {
      for (int ring = 0; ring < kRings; ++ring) {
        const double azimuth = 2 * M_PI * column / kColumns;
        const double elevation = (-15.0 + 2.0 * ring) * M_PI / 180.0;
        const double across = std::abs(std::sin(azimuth)) * std::cos(elevation);
        double range = std::min(100.0, 6.0 / std::max(across, 1e-6));
        int label = 2;
        if (elevation < 0 && 1.8 / std::sin(-elevation) < range) {
          range = 1.8 / std::sin(-elevation);
          label = 4;
        }
        range += noise(random);
        Point point{};
        point.x = static_cast<float>(range * std::cos(elevation) * std::cos(azimuth));
        point.y = static_cast<float>(range * std::cos(elevation) * std::sin(azimuth));
        point.z = static_cast<float>(range * std::sin(elevation));
        point.intensity = 20.0f;
        float sum = 0.0f;
        for (int c = 0; c < kClasses; ++c) {
          point.probabilities[c] = std::exp(score(random) + (c == label ? 4.0f : 0.0f));
          sum += point.probabilities[c];
        }
        for (float& p : point.probabilities) p /= sum;
        point.label = static_cast<std::uint8_t>(label);
        scan.points.push_back(point);
      }
    }
  }
  return scans;
}

const std::vector<Scan>& scans() {
  static const std::vector<Scan> made = drive();
  return made;
}

SemanticPoints view(const Scan& scan) {
  const auto column = [&](const void* first) {
    return Column{static_cast<const std::uint8_t*>(first), sizeof(Point)};
  };
  const Point& p = scan.points.front();
  SemanticPoints points;
  points.count = scan.points.size();
  points.x = column(&p.x);
  points.y = column(&p.y);
  points.z = column(&p.z);
  points.intensity = column(&p.intensity);
  points.status = column(&p.status);
  points.probabilities = column(p.probabilities);
  return points;
}

void count(benchmark::State& state, std::size_t voxels, std::size_t bytes) {
  std::size_t points = 0;
  for (const Scan& scan : scans()) points += scan.points.size();
  state.SetItemsProcessed(static_cast<std::int64_t>(state.iterations() * points));
  state.counters["voxels"] = static_cast<double>(voxels);
  state.counters["bytes_per_voxel"] =
      static_cast<double>(bytes) / static_cast<double>(std::max<std::size_t>(voxels, 1));
}

void voxelMap(benchmark::State& state) {
  scans();
  VoxelMapConfig config;
  config.voxel_size_m = kVoxel;
  config.evidence.kind = state.range(0) ? EvidenceKind::kDirichlet : EvidenceKind::kLog;
  config.evidence.prior.assign(kClasses, 1.0 / kClasses);
  std::size_t voxels = 0, bytes = 0;
  for (auto _ : state) {
    VoxelMap map(config);
    for (const Scan& scan : scans()) map.integrate(view(scan), scan.pose, 0);
    voxels = map.size();
    bytes = map.memoryBytes();
  }
  count(state, voxels, bytes);
}
BENCHMARK(voxelMap)->ArgName("dirichlet")->Arg(0)->Arg(1)->Unit(benchmark::kMillisecond);

#ifdef SLF_BENCHMARK_OCTOMAP
/// octomap's node with evidence of twelve classes beside the occupancy.
class SemanticNode : public octomap::OcTreeNode {
 public:
  SemanticNode() { std::memset(evidence, 0, sizeof evidence); }
  SemanticNode(const SemanticNode& other) : octomap::OcTreeNode(other) {
    std::memcpy(evidence, other.evidence, sizeof evidence);
  }
  void copyData(const SemanticNode& from) {
    octomap::OcTreeNode::copyData(from);
    std::memcpy(evidence, from.evidence, sizeof evidence);
  }
  float evidence[kClasses];
};

class SemanticTree : public octomap::OccupancyOcTreeBase<SemanticNode> {
 public:
  explicit SemanticTree(double size) : octomap::OccupancyOcTreeBase<SemanticNode>(size) {}
  SemanticTree* create() const { return new SemanticTree(resolution); }
  std::string getTreeType() const { return "SemanticTree"; }
};

/// Lazily updated, without rays: the least that octomap can do for the same content.
void octomapTree(benchmark::State& state) {
  scans();
  const bool with_logarithms = state.range(0) != 0;
  const float prior = std::log(1.0f / kClasses);
  std::size_t voxels = 0, bytes = 0;
  for (auto _ : state) {
    SemanticTree tree(kVoxel);
    for (const Scan& scan : scans()) {
      // Its keys have 16 bits: it cannot hold UTM coordinates.
      const Eigen::Vector3d origin(331275.3, 6250099.2, 0.0);
      const Eigen::Affine3d pose(Eigen::Translation3d(-origin) * scan.pose);
      for (const Point& p : scan.points) {
        const Eigen::Vector3d at = pose * Eigen::Vector3d(p.x, p.y, p.z);
        SemanticNode* node = tree.updateNode(at.x(), at.y(), at.z(), true, true);
        if (!node) continue;
        for (int c = 0; c < kClasses; ++c) {
          node->evidence[c] += with_logarithms
                                   ? 0.1f * (std::log(std::max(p.probabilities[c], 0.01f)) - prior)
                                   : p.probabilities[c];
        }
      }
    }
    voxels = tree.getNumLeafNodes();
    bytes = tree.memoryUsage();
  }
  count(state, voxels, bytes);
}
BENCHMARK(octomapTree)->ArgName("logarithms")->Arg(1)->Arg(0)->Unit(benchmark::kMillisecond);
#endif

}  // namespace
}  // namespace semantic_lidar_fusion

BENCHMARK_MAIN();

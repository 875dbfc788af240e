// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/check/class_geometry.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

namespace semantic_lidar_fusion {
namespace {

constexpr double kGroundRange_m = 20.0, kBin_m = 0.1, kLowest_m = -8.0, kHighest_m = 8.0;
constexpr std::size_t kFewestNear = 200;
constexpr double kGroundBand_m = 0.15, kHigh_m = 3.0, kNear_m = 15.0;
constexpr std::uint64_t kFewest = 300;
constexpr double kLeastGround = 0.35, kMostHigh = 0.25, kMostSky = 0.1;
/// By how much shifted ids must fit better, and how well then; or by how much however well.
constexpr double kShiftGain = 0.15, kShiftFit = 0.5, kShiftFarGain = 0.5;
/// Labels of one thing and its surroundings say nothing of the ground: so many classes must have
/// this share of the points.
constexpr int kFewestClasses = 3;
constexpr double kClassShare = 0.01;

const char* const kGroundWords[] = {
    "road",    "pavement", "sidewalk", "terrain", "grass",  "ground", "dirt",  "mud",       "lane",
    "parking", "asphalt",  "concrete", "gravel",  "puddle", "water",  "floor", "undrivable"};

using Histogram = ClassGeometry::Histogram;

std::vector<bool> classesNamed(const LabelSet& classes, const std::vector<std::string>& words) {
  std::vector<bool> result;
  for (const ClassInfo& info : classes.classes()) {
    result.push_back(std::any_of(words.begin(), words.end(), [&](const std::string& word) {
      return info.name.find(word) != std::string::npos;
    }));
  }
  return result;
}

std::uint64_t total(const Histogram& histogram) {
  std::uint64_t sum = 0;
  for (const std::uint64_t count : histogram) sum += count;
  return sum;
}

/// Share of the labels that are of `classes` once `by` is taken off their ids.
double shareOf(const Histogram& histogram, const std::vector<bool>& classes, int by = 0) {
  const std::uint64_t all = total(histogram);
  if (all == 0) return 0.0;
  std::uint64_t sum = 0;
  for (int id = 0; id < static_cast<int>(classes.size()); ++id) {
    const int label = id + by;
    if (classes[static_cast<std::size_t>(id)] && label >= 0 && label < 256) {
      sum += histogram[static_cast<std::size_t>(label)];
    }
  }
  return static_cast<double>(sum) / static_cast<double>(all);
}

int classesUsed(const Histogram& histogram) {
  const double least = kClassShare * static_cast<double>(total(histogram));
  return static_cast<int>(std::count_if(
      histogram.begin(), histogram.end(),
      [least](std::uint64_t count) { return count > 0 && static_cast<double>(count) >= least; }));
}

int commonest(const Histogram& histogram) {
  return static_cast<int>(std::max_element(histogram.begin(), histogram.end()) - histogram.begin());
}

bool contains(const std::vector<bool>& classes, int label) {
  return label < static_cast<int>(classes.size()) && classes[static_cast<std::size_t>(label)];
}

std::string nameOf(int label, const LabelSet& classes) {
  return label < classes.size() ? classes[label].name : std::to_string(label);
}

std::string percent(double share) {
  char text[16];
  std::snprintf(text, sizeof(text), "%.0f %%", 100.0 * share);
  return text;
}

}  // namespace

std::optional<GroundPlane> groundPlane(const Cloud& cloud, const Transform& T_vehicle_lidar) {
  constexpr auto kBins = static_cast<std::size_t>((kHighest_m - kLowest_m) / kBin_m);
  std::vector<double> counts(kBins + 2, 0.0);  // with a margin on both sides
  const Eigen::Matrix4d T = T_vehicle_lidar.matrix();
  std::size_t near = 0;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    const Eigen::Vector4d p = T * Eigen::Vector4d(cloud.x[i], cloud.y[i], cloud.z[i], 1.0);
    if (p.head<2>().norm() >= kGroundRange_m) continue;
    ++near;
    const double bin = (p.z() - kLowest_m) / kBin_m;
    if (bin >= 0.0 && bin < static_cast<double>(kBins)) {
      counts[static_cast<std::size_t>(bin) + 1] += 1.0;
    }
  }
  if (near < kFewestNear) return std::nullopt;
  const auto smooth = [&](std::size_t k) {
    return 0.5 * counts[k - 1] + counts[k] + 0.5 * counts[k + 1];
  };
  const auto height = [](std::size_t k) {
    return kLowest_m + (static_cast<double>(k) - 0.5) * kBin_m;
  };
  std::size_t best = 1;
  for (std::size_t k = 2; k <= kBins; ++k) {
    if (smooth(k) > smooth(best)) best = k;
  }
  GroundPlane ground;
  ground.height_m = height(best);
  ground.share = (counts[best - 1] + counts[best] + counts[best + 1]) / static_cast<double>(near);
  const double lidar_m = T_vehicle_lidar.translation().z();
  ground.above_lidar_m = ground.height_m - lidar_m;
  for (std::size_t k = 1; k <= kBins; ++k) {
    const bool other = (height(k) > lidar_m) != (ground.above_lidar_m > 0.0);
    ground.has_other_side = ground.has_other_side || (other && smooth(k) > 0.5 * smooth(best));
  }
  return ground;
}

void ClassGeometry::add(const SemanticCloud& cloud, int camera, const Transform& T_vehicle_lidar,
                        const GroundPlane& ground) {
  const auto bit = static_cast<std::uint16_t>(1u << camera);
  const auto fused = static_cast<std::uint8_t>(PointStatus::kFused);
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    if (cloud.points.status[i] != fused || cloud.cameras[i] != bit) continue;
    const Eigen::Vector3d p =
        T_vehicle_lidar * Eigen::Vector3d(cloud.points.x[i], cloud.points.y[i], cloud.points.z[i]);
    const std::size_t label = cloud.label[i];
    const double height = p.z() - ground.height_m;
    ++all_[label];
    if (height > kHigh_m) ++high_[label];
    if (std::abs(height) < kGroundBand_m && p.head<2>().norm() < kNear_m) ++on_ground_[label];
  }
}

ClassGeometry::Answer ClassGeometry::judge(const LabelSet& classes) const {
  const std::vector<bool> grounds =
      classesNamed(classes, {std::begin(kGroundWords), std::end(kGroundWords)});
  const std::vector<bool> skies = classesNamed(classes, {"sky"});
  const bool knows_ground = std::find(grounds.begin(), grounds.end(), true) != grounds.end();
  if (!knows_ground || total(on_ground_) < kFewest || classesUsed(all_) < kFewestClasses) return {};
  const bool has_high = total(high_) >= kFewest;
  const double share = shareOf(on_ground_, grounds);
  const auto fit = [&](int by) {
    return shareOf(on_ground_, grounds, by) - (has_high ? shareOf(high_, grounds, by) : 0.0) -
           shareOf(all_, skies, by);
  };
  const std::string called = percent(share) + " of its points on the ground have a class of ground";
  const int by = fit(1) >= fit(-1) ? 1 : -1;
  const double gain = fit(by) - fit(0);
  if (gain > kShiftFarGain || (gain > kShiftGain && fit(by) > kShiftFit)) {
    return {by > 0 ? Verdict::kIdsTooHigh : Verdict::kIdsTooLow,
            called + ", most are " + nameOf(commonest(on_ground_), classes) +
                ": class ids are one too " + (by > 0 ? "high" : "low")};
  }
  if (share < kLeastGround && !contains(grounds, commonest(on_ground_))) {
    return {Verdict::kGroundIsOther,
            called + ", most are " + nameOf(commonest(on_ground_), classes) +
                ": another order of classes than the network's, or points beside their pixels"};
  }
  const double high = has_high ? shareOf(high_, grounds) : 0.0;
  if (high > kMostHigh) {
    return {Verdict::kGroundIsHigh,
            percent(high) +
                " of its points high above the ground have a class of ground: points "
                "lie beside their pixels"};
  }
  const double sky = shareOf(all_, skies);
  if (sky > kMostSky) {
    return {Verdict::kSky, percent(sky) +
                               " of its points are sky, which no lidar sees: points lie "
                               "beside their pixels"};
  }
  return {Verdict::kFine, {}};
}

}  // namespace semantic_lidar_fusion

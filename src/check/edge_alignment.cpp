// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/check/edge_alignment.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <opencv2/imgproc.hpp>
#include <optional>
#include <utility>

namespace semantic_lidar_fusion {
namespace {

constexpr double kLeastStep_m = 0.5, kLeastStepRatio = 0.1, kFarthestEdge_m = 40.0;
constexpr double kFullWeightStep_m = 5.0;
constexpr double kNearest_m = 0.5;  // of what is not the vehicle
constexpr std::size_t kFewestOfARing = 10;
constexpr int kWidth = 640;
constexpr double kFallOff_px = 3.0;
constexpr int kChanceWindow_px = 61;

struct Beam {
  std::uint16_t ring = 0;
  float azimuth = 0.0f;
  std::uint32_t index = 0;
};

double rangeOf(const Cloud& cloud, std::uint32_t i) {
  return Eigen::Vector3d(cloud.x[i], cloud.y[i], cloud.z[i]).norm();
}

std::vector<Beam> sortedBeams(const Cloud& cloud) {
  std::vector<Beam> beams;
  beams.reserve(cloud.size());
  const auto covered = static_cast<std::uint8_t>(PointStatus::kFused);
  for (std::uint32_t i = 0; i < cloud.size(); ++i) {
    if (cloud.ring[i] == kNoRing || cloud.status[i] != covered) continue;
    if (rangeOf(cloud, i) <= kNearest_m) continue;
    beams.push_back({cloud.ring[i], std::atan2(cloud.y[i], cloud.x[i]), i});
  }
  std::sort(beams.begin(), beams.end(), [](const Beam& a, const Beam& b) {
    if (a.ring != b.ring) return a.ring < b.ring;
    return a.azimuth != b.azimuth ? a.azimuth < b.azimuth : a.index < b.index;
  });
  return beams;
}

/// Of two neighbours `gap` apart, where the median gap of the ring is `step`, rad.
std::optional<LidarEdge> edgeBetween(const Cloud& cloud, const Beam& a, const Beam& b, double gap,
                                     double step) {
  if (gap <= 0.0 || gap >= 3.0 * step) return std::nullopt;
  const double range_a = rangeOf(cloud, a.index), range_b = rangeOf(cloud, b.index);
  const double near = std::min(range_a, range_b), jump = std::abs(range_a - range_b);
  if (near >= kFarthestEdge_m || jump <= std::max(kLeastStep_m, kLeastStepRatio * near)) {
    return std::nullopt;
  }
  const std::uint32_t i = range_a < range_b ? a.index : b.index;
  const double turn = (range_a < range_b ? 0.5 : -0.5) * std::min(gap, 1.5 * step);
  const double c = std::cos(turn), s = std::sin(turn);
  const Eigen::Vector3d p(c * cloud.x[i] - s * cloud.y[i], s * cloud.x[i] + c * cloud.y[i],
                          cloud.z[i]);
  return LidarEdge{p, std::sqrt(std::min(jump, kFullWeightStep_m))};
}

void addRing(const Cloud& cloud, const Beam* begin, const Beam* end,
             std::vector<LidarEdge>* edges) {
  if (static_cast<std::size_t>(end - begin) < kFewestOfARing) return;
  std::vector<double> gaps;
  for (const Beam* beam = begin; beam + 1 != end; ++beam) {
    gaps.push_back(static_cast<double>(beam[1].azimuth) - static_cast<double>(beam[0].azimuth));
  }
  std::vector<double> sorted = gaps;
  const auto middle = sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2);
  std::nth_element(sorted.begin(), middle, sorted.end());
  for (const Beam* beam = begin; beam + 1 != end; ++beam) {
    const auto edge =
        edgeBetween(cloud, beam[0], beam[1], gaps[static_cast<std::size_t>(beam - begin)], *middle);
    if (edge) edges->push_back(*edge);
  }
}

/// The values exp(-d / 3 px) of an image at 640 px width, and their means around each pixel.
std::pair<cv::Mat, cv::Mat> edgeValues(const cv::Mat& image) {
  cv::Mat grey = image;
  if (image.channels() == 3) cv::cvtColor(image, grey, cv::COLOR_BGR2GRAY);
  if (grey.cols > kWidth) {
    const int height =
        std::max(1, static_cast<int>(std::lround(1.0 * grey.rows * kWidth / grey.cols)));
    cv::Mat small;
    cv::resize(grey, small, cv::Size(kWidth, height), 0, 0, cv::INTER_AREA);
    grey = small;
  }
  cv::Mat blurred, edges, distance, value, chance;
  cv::GaussianBlur(grey, blurred, cv::Size(0, 0), 1.0);
  cv::Canny(blurred, edges, 30, 90);
  if (cv::countNonZero(edges) == 0) {
    value = cv::Mat::zeros(grey.size(), CV_32F);
  } else {
    cv::distanceTransform(255 - edges, distance, cv::DIST_L2, 5);
    cv::exp(distance * (-1.0 / kFallOff_px), value);
  }
  cv::blur(value, chance, cv::Size(kChanceWindow_px, kChanceWindow_px));
  return {value, chance};
}

}  // namespace

std::vector<LidarEdge> lidarEdges(const Cloud& cloud) {
  const std::vector<Beam> beams = sortedBeams(cloud);
  std::vector<LidarEdge> edges;
  for (std::size_t begin = 0; begin < beams.size();) {
    std::size_t end = begin;
    while (end < beams.size() && beams[end].ring == beams[begin].ring) ++end;
    addRing(cloud, beams.data() + begin, beams.data() + end, &edges);
    begin = end;
  }
  return edges;
}

void EdgeScore::add(const EdgeScore& other) {
  edges += other.edges;
  weight += other.weight;
  hit += other.hit;
  chance += other.chance;
}

double EdgeScore::lift() const {
  return weight - chance > 1e-9 * weight ? (hit - chance) / (weight - chance) : 0.0;
}

EdgeScore scoreEdges(const std::vector<LidarEdge>& edges, const CameraModel& model,
                     const Transform& T_camera_lidar, const cv::Mat& image) {
  EdgeScore score;
  const auto [value, chance] = edgeValues(image);
  const double scale = static_cast<double>(value.cols) / image.cols;
  for (const LidarEdge& edge : edges) {
    const std::optional<Eigen::Vector2d> pixel = model.project(T_camera_lidar * edge.p);
    if (!pixel || !inImage(pixel->x(), pixel->y(), model.imageSize())) continue;
    const int column = std::clamp(static_cast<int>((pixel->x() + 0.5) * scale), 0, value.cols - 1);
    const int row = std::clamp(static_cast<int>((pixel->y() + 0.5) * scale), 0, value.rows - 1);
    ++score.edges;
    score.weight += edge.weight;
    score.hit += edge.weight * static_cast<double>(value.at<float>(row, column));
    score.chance += edge.weight * static_cast<double>(chance.at<float>(row, column));
  }
  return score;
}

}  // namespace semantic_lidar_fusion

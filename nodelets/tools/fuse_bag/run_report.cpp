// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/run_report.h"

#include <algorithm>
#include <cstdio>

namespace semantic_lidar_fusion {
namespace {

std::string percent(std::uint64_t part, std::uint64_t whole) {
  char text[16];
  std::snprintf(text, sizeof(text), "%.1f %%",
                whole ? 100.0 * static_cast<double>(part) / static_cast<double>(whole) : 0.0);
  return text;
}

std::string count(std::uint64_t n, const std::string& thing) {
  return std::to_string(n) + " " + thing + (n == 1 ? "" : "s");
}

/// What a camera gave, and whether the lidar's edges lie on those of its images.
std::string figuresText(const RigWatch::CameraFigures& figures) {
  std::string text = count(figures.points, "point") + ", " +
                     percent(figures.points, figures.fused_points) + " of the fused points";
  if (figures.edges.edges > 0) {
    char lift[32];
    std::snprintf(lift, sizeof(lift), "; edges meet with %.2f", figures.edges.lift());
    text += lift;
  }
  return text;
}

}  // namespace

void RunReport::countScan(const Cloud& semantic) {
  ++scans_;
  points_ += semantic.size();
  const auto by_status = countByStatus(semantic);
  for (std::size_t s = 0; s < by_status.size(); ++s) by_status_[s] += by_status[s];
}

std::string RunReport::commonestStatus() const {
  if (points_ == 0) return "no point of its scans came out";
  const auto most = std::max_element(by_status_.begin(), by_status_.end());
  return percent(*most, points_) + " of " + count(points_, "point") + ": " +
         kPointStatusNames[static_cast<std::size_t>(most - by_status_.begin())];
}

std::string RunReport::text(const Input& input,
                            const std::map<std::string, std::uint64_t>& drops) const {
  std::string text = input.output + ": " + count(scans_, "scan") + " of " +
                     std::to_string(input.scans) + ", " + count(points_, "point") + " (";
  for (std::size_t s = 0; s < by_status_.size(); ++s) {
    text +=
        (s ? ", " : "") + std::string(kPointStatusNames[s]) + " " + percent(by_status_[s], points_);
  }
  text += ")\n";
  for (std::size_t c = 0; c < cameras_.size(); ++c) {
    const auto scans = [&](Contribution contribution) {
      return cameras_[c][static_cast<std::size_t>(contribution)];
    };
    text += "  camera " + input.cameras[c].name + ": in " +
            count(scans(Contribution::kUsed), "scan") + "; no image in time in " +
            std::to_string(scans(Contribution::kNone)) + ", image not usable in " +
            std::to_string(scans(Contribution::kLost)) + "; " +
            count(input.cameras[c].images, "image") + " and " +
            std::to_string(input.cameras[c].scores) + " of scores in the bag; " +
            figuresText(input.cameras[c].figures) + "\n";
  }
  if (!input.time_decision.empty()) text += "  " + input.time_decision + "\n";
  if (drops.empty()) text += "  nothing was dropped\n";
  for (const auto& drop : drops) {
    text += "  counted: " + drop.first + ": " + std::to_string(drop.second) + "\n";
  }
  for (const std::string& doubt : input.doubts) text += "  check: " + doubt + "\n";
  if (!input.doubts.empty()) text += "  " + input.check_command + " tells more\n";
  const double seconds =
      std::chrono::duration<double>(std::chrono::steady_clock::now() - started_).count();
  char time[80];
  std::snprintf(time, sizeof(time), "  %.1f s (%.1f scans/s)\n", seconds,
                static_cast<double>(input.scans) / std::max(seconds, 1e-9));
  return text + time;
}

}  // namespace semantic_lidar_fusion

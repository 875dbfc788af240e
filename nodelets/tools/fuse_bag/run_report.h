// SPDX-License-Identifier: MIT
/// What came in, what came out, and what was dropped and why.
#pragma once

#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include "semantic_lidar_fusion/check/rig_watch.h"
#include "semantic_lidar_fusion/common/point_cloud.h"

namespace semantic_lidar_fusion {

class RunReport {
 public:
  enum class Contribution : std::uint8_t {
    kUsed,
    kNone,  ///< no image in time
    kLost,  ///< the chosen image is not usable
  };
  /// What the bag holds of one camera.
  struct CameraContents {
    std::string name;
    std::size_t images = 0;
    std::size_t scores = 0;
    RigWatch::CameraFigures figures;
  };
  /// What the run was given.
  struct Input {
    std::string output;  ///< name of the output
    std::size_t scans = 0;
    std::vector<CameraContents> cameras;
    std::string time_decision;        ///< how the times of points are understood
    std::vector<std::string> doubts;  ///< what looks wrong in the rig
    std::string check_command;        ///< that tells more of it
  };

  explicit RunReport(std::size_t cameras) : cameras_(cameras) {}

  void countCamera(std::size_t camera, Contribution contribution) {
    ++cameras_[camera][static_cast<std::size_t>(contribution)];
  }
  void countScan(const Cloud& semantic);
  std::uint64_t scansWritten() const { return scans_; }
  std::uint64_t fusedPoints() const {
    return by_status_[static_cast<std::size_t>(PointStatus::kFused)];
  }
  /// "100.0 % of 8000 points: no odometry": what stands in the way of most points.
  std::string commonestStatus() const;

  std::string text(const Input& input, const std::map<std::string, std::uint64_t>& drops) const;

 private:
  std::chrono::steady_clock::time_point started_ = std::chrono::steady_clock::now();
  std::vector<std::array<std::uint64_t, 3>> cameras_;  ///< scans, by Contribution
  std::uint64_t scans_ = 0;
  std::uint64_t points_ = 0;
  std::array<std::uint64_t, kPointStatusNames.size()> by_status_{};
};

}  // namespace semantic_lidar_fusion

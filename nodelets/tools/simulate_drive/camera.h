// SPDX-License-Identifier: MIT
/// Pictures of the world through a lens, with what each pixel shows.
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <memory>
#include <opencv2/core.hpp>
#include <vector>

#include "semantic_lidar_fusion/camera/camera_model.h"
#include "tools/simulate_drive/drive_path.h"
#include "tools/simulate_drive/exposure.h"
#include "tools/simulate_drive/world.h"

namespace semantic_lidar_fusion {
namespace simulator {

/// What a pixel's centre shows.
struct Sight {
  int object = -1;  ///< none: the sky
  Eigen::Vector3f
      place;  ///< on the object, in its coordinates, m; of the sky far away in the world
  float m_per_rad = 1.0F;  ///< how far apart on the object two rays meet it, by their angle
};

struct Picture {
  cv::Mat image;              ///< CV_8UC3, BGR
  cv::Mat labels;             ///< CV_8UC1: the class at each pixel's centre
  std::vector<Sight> sights;  ///< by row
};

class Camera {
 public:
  /// `lens`: in place of what the camera_info says; null = none.
  Camera(const CameraInfo& info, const std::shared_ptr<const LensCalibration>& lens,
         const Transform& T_base_camera);

  /// Each line at its own time. Moves the world's instant. The same bytes for every number of
  /// threads.
  Picture render(const DrivePath& path, const Exposure& exposure, std::uint64_t key, int threads,
                 World* world) const;

  /// Unit vector through a pixel's middle, in the camera's frame; zero where the lens has no ray.
  const Eigen::Vector3f& ray(int row, int column) const {
    return rays_[static_cast<std::size_t>(row) * static_cast<std::size_t>(info_.size.width) +
                 static_cast<std::size_t>(column)];
  }
  const CameraInfo& info() const { return info_; }
  const CameraModel& model() const { return *model_; }
  std::shared_ptr<const CameraModel> sharedModel() const { return model_; }
  const Transform& T_base_camera() const { return T_base_camera_; }

 private:
  CameraInfo info_;
  std::shared_ptr<const CameraModel> model_;
  Transform T_base_camera_;
  std::vector<Eigen::Vector3f> rays_;  ///< by row
};

/// 1-px precision is enough nowhere: distance in px from each pixel's centre to the border of the
/// nearest pixel of another class. CV_32FC1; at most the image's diagonal.
cv::Mat distanceToClassEdge(const cv::Mat& labels);

}  // namespace simulator
}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
/// Shared value types and the conventions of the whole package.
///
/// Time: `StampNs` is integer nanoseconds since the epoch (ROS time). "True" time is a message's
/// header stamp plus the `time_offset` of its sensor; "raw" stamps only match messages.
/// Frames: `T_target_source` maps coordinates given in `source` to `target`; products cancel
/// visibly (T_a_c = T_a_b * T_b_c). Bodies are x forward, y left, z up; cameras are optical frames,
/// x right, y down, z forward (REP 103). Lengths are metres, angles radians unless the name says
/// so. Pixels: integer coordinates are pixel centres.
#pragma once

#include <Eigen/Geometry>
#include <array>
#include <cmath>
#include <cstdint>
#include <string>

namespace semantic_lidar_fusion {

using StampNs = std::int64_t;
using Transform = Eigen::Isometry3d;

constexpr StampNs kNsPerSecond = 1000000000;
constexpr double kPi = 3.14159265358979323846;
constexpr double kRadPerDeg = kPi / 180.0;

inline double toSeconds(StampNs duration_ns) { return static_cast<double>(duration_ns) * 1e-9; }
/// Nearest nanosecond.
inline StampNs toNs(double duration_s) {
  return static_cast<StampNs>(std::llround(duration_s * 1e9));
}

/// Motion of a body relative to the fixed world, in the body's own axes.
struct Twist {
  Eigen::Vector3d velocity = Eigen::Vector3d::Zero();  ///< of the body's origin, m/s
  Eigen::Vector3d turn = Eigen::Vector3d::Zero();      ///< rad/s
};

/// Where a point `p` that stands still in the world is in the body's axes `t_s` later, to the
/// second order of the body's motion.
inline Eigen::Vector3d seenLater(const Eigen::Vector3d& p, const Twist& twist, double t_s) {
  const Eigen::Vector3d flow = twist.velocity + twist.turn.cross(p);
  return p - t_s * flow + 0.5 * t_s * t_s * twist.turn.cross(flow);
}

/// The twist of a body that is fixed to another one.
inline Twist twistOf(const Transform& T_body_other, const Twist& other) {
  const Eigen::Vector3d turn = T_body_other.linear() * other.turn;
  return {T_body_other.linear() * other.velocity + T_body_other.translation().cross(turn), turn};
}

/// Largest width and height, px.
constexpr int kMaxImageSide = 32767;

struct ImageSize {
  int width = 0;
  int height = 0;
  bool operator==(const ImageSize& other) const {
    return width == other.width && height == other.height;
  }
  bool operator!=(const ImageSize& other) const { return !(*this == other); }
};

/// "1920x1208".
inline std::string sizeText(const ImageSize& size) {
  return std::to_string(size.width) + "x" + std::to_string(size.height);
}

/// Index of the pixel that holds the real coordinate `u`: floor(u + 0.5), also left of the image.
inline int pixelIndex(double u) {
  // Without std::floor, which is a function call on processors of old.
  const double shifted = u + 0.5;
  const int whole = static_cast<int>(shifted);
  return whole - (shifted < whole ? 1 : 0);
}

/// Whether (u, v) falls on a pixel of the image: -0.5 <= u < width - 0.5, likewise v.
inline bool inImage(double u, double v, const ImageSize& size) {
  return u >= -0.5 && u < size.width - 0.5 && v >= -0.5 && v < size.height - 0.5;
}

/// Cell of a grid of `target_count` cells under the centre of cell `index` of `source_count` cells:
/// floor((index + 0.5) * target_count / source_count), in exact integer arithmetic.
inline int cellUnderCentre(int index, int source_count, int target_count) {
  return static_cast<int>((2 * static_cast<std::int64_t>(index) + 1) * target_count /
                          (2 * static_cast<std::int64_t>(source_count)));
}

/// Why a point has a class distribution, or has none. The values are the `status` field of the
/// published clouds.
enum class PointStatus : std::uint8_t {
  kFused = 0,
  kOccluded = 1,
  kOutsideImages = 2,
  kNoImage = 3,
  kNoOdometry = 4,
};
/// By the value of PointStatus, for people.
constexpr std::array<const char*, 5> kPointStatusNames = {"fused", "occluded", "outside",
                                                          "no image", "no odometry"};

/// The `label` of a point without a distribution.
constexpr std::uint8_t kNoLabel = 255;
/// The `ring` of a point whose sensor gives none.
constexpr std::uint16_t kNoRing = 65535;
/// Cameras of one rig: the `cameras` field of a point has 16 bits.
constexpr int kMaxCameras = 16;

}  // namespace semantic_lidar_fusion

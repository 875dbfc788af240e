// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/camera.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <opencv2/imgproc.hpp>
#include <thread>

#include "tools/simulate_drive/materials.h"
#include "tools/simulate_drive/noise.h"

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

using Eigen::Vector3f;

const Vector3f kSunDirection = Vector3f(0.35F, -0.62F, 0.70F).normalized();
const Vector3f kSunLight(1.75F, 1.62F, 1.40F);
const Vector3f kSkyLight(0.46F, 0.54F, 0.66F);
const Vector3f kGroundLight(0.22F, 0.20F, 0.18F);
constexpr float kHazeM = 320.0F;
constexpr float kSkyM = 100.0F;  // where the sky's places are taken to be

Vector3f skyColor(const Vector3f& way) {
  const float up = std::max(way.z(), 0.0F);
  const Vector3f zenith(0.16F, 0.33F, 0.68F), horizon(0.72F, 0.80F, 0.90F);
  Vector3f sky = horizon + (zenith - horizon) * std::pow(up, 0.45F);
  if (way.z() > 0.02F) {
    const float x = 1.6F * way.x() / (way.z() + 0.25F), y = 1.6F * way.y() / (way.z() + 0.25F);
    const float clouds = 0.5F * smoothNoise(x, y, 1) + 0.3F * smoothNoise(2.1F * x, 2.1F * y, 2) +
                         0.2F * smoothNoise(4.7F * x, 4.7F * y, 3);
    sky += (Vector3f(0.95F, 0.95F, 0.96F) - sky) * 0.85F * smoothStep(0.5F, 0.72F, clouds) *
           smoothStep(0.02F, 0.15F, way.z());
  }
  const float glare = std::max(way.dot(kSunDirection), 0.0F);
  sky += Vector3f(1.0F, 0.93F, 0.8F) *
         (0.35F * std::pow(glare, 24.0F) + 6.0F * std::pow(glare, 1800.0F));
  return sky;
}

struct Sample {
  Vector3f light;
  Class kind = Class::kSky;
  Sight sight;
};

Sample look(const World& world, const Vector3f& origin, const Vector3f& way) {
  Sample sample;
  const Hit hit = world.see(origin, way);
  if (hit.range <= 0.0F) {
    sample.light = skyColor(way);
    sample.sight = {-1, kSkyM * way, kSkyM};
    return sample;
  }
  sample.kind = world.classOf(hit);
  const Vector3f p = origin + hit.range * way;
  const Vector3f place = world.toObjectNow(hit.object, p);
  // On a slope as the root of the area is, but no more than five times as on a face.
  const float facing_eye = std::max(std::abs(way.dot(hit.normal)), 0.04F);
  sample.sight = {hit.object, place, hit.range / std::sqrt(facing_eye)};
  const Surface surface =
      surfaceOf(world.materialOf(hit),
                {world.tintOf(hit), place, world.normalToObjectNow(hit.object, hit.normal),
                 world.textureOf(hit), hit.range});
  const Vector3f& n = hit.normal;
  float facing = n.dot(kSunDirection);
  if (surface.thin) facing = facing > 0.0F ? 0.35F + 0.65F * facing : -0.55F * facing + 0.2F;
  float sun = 0.0F;
  if (facing > 0.0F) {
    const Vector3f start = p + n * (1e-3F + 2e-5F * hit.range);
    sun = world.blocked(start, kSunDirection, 1e-3F, 120.0F) ? 0.0F : facing;
  }
  const float up = 0.5F + 0.5F * n.z();
  // What stands near the ground sees less of the sky.
  const float open = 0.72F + 0.28F * smoothStep(0.0F, 2.5F, p.z());
  const Vector3f ambient =
      (kGroundLight + (kSkyLight - kGroundLight) * up) * (n.z() > 0.9F ? 1.0F : open);
  Vector3f light = surface.albedo.cwiseProduct(ambient + kSunLight * sun);
  const Vector3f mirrored = way - 2.0F * way.dot(n) * n;
  if (surface.gloss > 0.0F) {
    const float grazing = std::pow(1.0F - std::abs(way.dot(n)), 4.0F);
    const float share = surface.gloss + (1.0F - surface.gloss) * 0.6F * grazing;
    const Vector3f around =
        mirrored.z() > 0.05F ? Vector3f(0.75F * skyColor(mirrored)) : Vector3f(0.2F, 0.19F, 0.18F);
    light = light * (1.0F - share) + around * share;
  }
  if (surface.shine > 0.0F && sun > 0.0F) {
    const float highlight = std::max(mirrored.dot(kSunDirection), 0.0F);
    light += kSunLight * (surface.shine * std::pow(highlight, 60.0F));
  }
  light += surface.glow * surface.albedo;
  const float haze = 1.0F - std::exp(-hit.range / kHazeM);
  sample.light = light + (Vector3f(0.70F, 0.77F, 0.86F) - light) * haze;
  return sample;
}

float toneMapped(float light) {
  const float x = 0.80F * light;
  const float film = x * (2.51F * x + 0.03F) / (x * (2.43F * x + 0.59F) + 0.14F);
  return std::pow(std::min(std::max(film, 0.0F), 1.0F), 1.0F / 2.2F);
}

/// Calls work(i) for 0 <= i < count.
template <typename Work>
void inParallel(int count, int threads, const Work& work) {
  std::atomic<int> next{0};
  const auto loop = [&] {
    constexpr int kAtOnce = 8;
    for (int first = next.fetch_add(kAtOnce); first < count; first = next.fetch_add(kAtOnce)) {
      for (int i = first; i < std::min(count, first + kAtOnce); ++i) work(i);
    }
  };
  std::vector<std::thread> pool;
  for (int i = 1; i < threads; ++i) pool.emplace_back(loop);
  loop();
  for (std::thread& thread : pool) thread.join();
}

/// Calls work(row, column, T_world_camera) for every pixel, while the world stands at the time of
/// its line.
template <typename Work>
void forEachPixel(const DrivePath& path, const Exposure& exposure, const Camera& camera,
                  int threads, World* world, const Work& work) {
  const ImageSize& size = camera.info().size;
  for (int line = 0; line < exposure.lines(); ++line) {
    const double time = exposure.timeOf(line);
    world->setInstant(time);
    const Eigen::Isometry3f eye = (path.pose(time) * camera.T_base_camera()).cast<float>();
    if (!exposure.rolling()) {
      inParallel(size.height, threads, [&](int row) {
        for (int column = 0; column < size.width; ++column) work(row, column, eye);
      });
    } else if (exposure.linesAreRows()) {
      inParallel(size.width, threads, [&](int column) { work(line, column, eye); });
    } else {
      inParallel(size.height, threads, [&](int row) { work(row, line, eye); });
    }
  }
}

/// A picture in the making: first one ray for each pixel, then more where they differ.
class Rendering {
 public:
  Rendering(const World& world, const Camera& camera, std::uint64_t key)
      : world_(world),
        camera_(camera),
        key_(key),
        width_(camera.info().size.width),
        height_(camera.info().size.height),
        samples_(static_cast<std::size_t>(width_) * static_cast<std::size_t>(height_)),
        picture_{cv::Mat(height_, width_, CV_8UC3), cv::Mat(height_, width_, CV_8UC1), {}} {}

  void lookOnce(int row, int column, const Eigen::Isometry3f& eye) {
    const Vector3f& ray = camera_.ray(row, column);
    // Beyond the lens's valid domain the sensor is dark.
    samples_[at(row, column)] = ray.isZero(0.0F)
                                    ? Sample{Vector3f::Zero(), Class::kUnlabeled, Sight()}
                                    : look(world_, eye.translation(), eye.linear() * ray);
  }

  /// After all of lookOnce().
  void paint(int row, int column, const Eigen::Isometry3f& eye) {
    const Sample& sample = samples_[at(row, column)];
    Vector3f light = sample.light;
    // Edges take three more samples inside of the pixel; its label stays that of the centre.
    if (isEdge(row, column) && lensCoversAround(row, column)) {
      addAround(row, column, eye, &light);
      light *= 0.25F;
    }
    const float cx = static_cast<float>(camera_.model().cx());
    const float cy = static_cast<float>(camera_.model().cy());
    const float x = (static_cast<float>(column) - cx) / static_cast<float>(width_);
    const float y = (static_cast<float>(row) - cy) / static_cast<float>(width_);
    light *= 1.0F - 0.55F * (x * x + y * y);
    Random random(
        mixKeys(key_, static_cast<std::uint64_t>(row), static_cast<std::uint64_t>(column)));
    const float grain = static_cast<float>(random.uniform() + random.uniform() - 1.0) * 4.0F;
    auto& pixel = picture_.image.at<cv::Vec3b>(row, column);
    for (int channel = 0; channel < 3; ++channel) {
      const float value = 255.0F * toneMapped(light[2 - channel]) + grain +
                          static_cast<float>(random.uniform() - 0.5) * 2.0F;
      pixel[channel] = static_cast<std::uint8_t>(std::min(std::max(value + 0.5F, 0.0F), 255.0F));
    }
    picture_.labels.at<std::uint8_t>(row, column) = static_cast<std::uint8_t>(sample.kind);
  }

  Picture finished() {
    picture_.sights.reserve(samples_.size());
    for (const Sample& sample : samples_) picture_.sights.push_back(sample.sight);
    return picture_;
  }

 private:
  std::size_t at(int row, int column) const {
    return static_cast<std::size_t>(row) * static_cast<std::size_t>(width_) +
           static_cast<std::size_t>(column);
  }

  bool isEdge(int row, int column) const {
    const Sample& sample = samples_[at(row, column)];
    const auto differs = [&](const Sample& other) {
      return other.sight.object != sample.sight.object || other.kind != sample.kind ||
             (other.light - sample.light).squaredNorm() > 0.02F;
    };
    return (column + 1 < width_ && differs(samples_[at(row, column + 1)])) ||
           (row + 1 < height_ && differs(samples_[at(row + 1, column)]));
  }

  bool lensCoversAround(int row, int column) const {
    const int left = std::min(column + 1, width_ - 1) - 1;
    const int top = std::min(row + 1, height_ - 1) - 1;
    const auto covers = [&](int y, int x) { return !camera_.ray(y, x).isZero(0.0F); };
    return covers(row, column) && covers(row, left) && covers(row, left + 1) &&
           covers(top, column) && covers(top + 1, column);
  }

  /// Adds three more rays through a pixel.
  void addAround(int row, int column, const Eigen::Isometry3f& eye, Vector3f* light) const {
    const int left = std::min(column + 1, width_ - 1) - 1;
    const int top = std::min(row + 1, height_ - 1) - 1;
    const Vector3f right = camera_.ray(row, left + 1) - camera_.ray(row, left);
    const Vector3f down = camera_.ray(top + 1, column) - camera_.ray(top, column);
    const float offsets[3][2] = {{0.33F, -0.17F}, {-0.33F, 0.17F}, {0.17F, 0.40F}};
    for (const auto& offset : offsets) {
      const Vector3f way =
          (camera_.ray(row, column) + offset[0] * right + offset[1] * down).normalized();
      *light += look(world_, eye.translation(), eye.linear() * way).light;
    }
  }

  const World& world_;
  const Camera& camera_;
  std::uint64_t key_;
  int width_, height_;
  std::vector<Sample> samples_;
  Picture picture_;
};

}  // namespace

Camera::Camera(const CameraInfo& info, const std::shared_ptr<const LensCalibration>& lens,
               const Transform& T_base_camera)
    : info_(info), T_base_camera_(T_base_camera) {
  CameraModelOptions options;
  options.lens = lens;
  model_ = std::make_shared<const CameraModel>(info, options);
  rays_.reserve(static_cast<std::size_t>(info.size.width) *
                static_cast<std::size_t>(info.size.height));
  for (int row = 0; row < info.size.height; ++row) {
    for (int column = 0; column < info.size.width; ++column) {
      const std::optional<Eigen::Vector3d> ray = model_->ray({column, row});
      rays_.push_back(ray ? Eigen::Vector3f(ray->cast<float>()) : Eigen::Vector3f::Zero());
    }
  }
}

Picture Camera::render(const DrivePath& path, const Exposure& exposure, std::uint64_t key,
                       int threads, World* world) const {
  Rendering rendering(*world, *this, key);
  forEachPixel(path, exposure, *this, threads, world,
               [&](int row, int column, const Eigen::Isometry3f& eye) {
                 rendering.lookOnce(row, column, eye);
               });
  forEachPixel(path, exposure, *this, threads, world,
               [&](int row, int column, const Eigen::Isometry3f& eye) {
                 rendering.paint(row, column, eye);
               });
  return rendering.finished();
}

cv::Mat distanceToClassEdge(const cv::Mat& labels) {
  // Class by class: how far is the nearest pixel of another class?
  cv::Mat result(labels.size(), CV_32FC1, cv::Scalar(std::hypot(labels.cols, labels.rows)));
  for (int kind = 0; kind < kClassCount; ++kind) {
    const cv::Mat inside = labels == kind;
    const int count = cv::countNonZero(inside);
    if (count == 0 || count == labels.rows * labels.cols) continue;
    cv::Mat distance;
    cv::distanceTransform(inside, distance, cv::DIST_L2, cv::DIST_MASK_PRECISE, CV_32F);
    distance -= 0.5F;
    distance.copyTo(result, inside);
  }
  return result;
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

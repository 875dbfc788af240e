// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/camera.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <opencv2/imgproc.hpp>
#include <thread>

#include "semantic_lidar_fusion/common/error.h"
#include "tools/simulate_drive/noise.h"

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

using Eigen::Vector2f;
using Eigen::Vector3f;

const Vector3f kSunDirection = Vector3f(0.35F, -0.62F, 0.70F).normalized();
const Vector3f kSunLight(1.75F, 1.62F, 1.40F);
const Vector3f kSkyLight(0.46F, 0.54F, 0.66F);
const Vector3f kGroundLight(0.22F, 0.20F, 0.18F);
constexpr float kHazeM = 320.0F;

float smoothStep(float from, float to, float x) {
  const float t = std::min(std::max((x - from) / (to - from), 0.0F), 1.0F);
  return t * t * (3.0F - 2.0F * t);
}

float fraction(float x) { return x - std::floor(x); }

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

/// Joints of stones of a running bond: 1 on the stone, 0 in the joint.
float bond(float along, float up, float length, float height, float joint, float* id_x,
           float* id_y) {
  const float row = std::floor(up / height);
  const float shifted = along / length + (std::fmod(std::abs(row), 2.0F) < 0.5F ? 0.0F : 0.5F);
  *id_x = std::floor(shifted);
  *id_y = row;
  const float x = (shifted - *id_x) * length, y = up - row * height;
  const float edge = std::min(std::min(x, length - x), std::min(y, height - y));
  return smoothStep(0.2F * joint, joint, edge);
}

struct Surface {
  Vector3f albedo;
  float gloss = 0.0F;  ///< of a mirror for the sky
  float shine = 0.0F;  ///< of the sun's highlight
  float glow = 0.0F;   ///< own light
  bool thin = false;   ///< lets light through from behind
};

/// `p`: object coordinates, `n`: normal in object coordinates, `uv`: texture.
Surface surfaceOf(Material material, const Vector3f& tint, const Vector3f& p, const Vector3f& n,
                  const Vector2f& uv, float distance) {
  Surface s;
  const float fine = distance < 25.0F ? 1.0F : 25.0F / distance;
  switch (material) {
    case Material::kAsphalt: {
      const float along = uv.x(), across = uv.y();
      const float grain = smoothNoise(40.0F * along, 40.0F * across, 5) - 0.5F;
      const float patch = smoothNoise(0.35F * along, 0.8F * across, 6) - 0.5F;
      const float worn = std::exp(-12.0F * std::pow(std::abs(std::abs(across) - 0.75F), 2.0F));
      const float repair = smoothNoise(0.12F * along, 0.3F * across, 9) > 0.72F ? -0.045F : 0.0F;
      const float base = 0.185F + 0.06F * fine * grain + 0.05F * patch + 0.02F * worn + repair;
      s.albedo = Vector3f(base, base, 1.03F * base);
      const float wear = smoothNoise(9.0F * along, 9.0F * across, 8);
      const bool dash = fraction(along / 9.0F) < 0.4F && std::abs(across + 1.75F) < 0.06F;
      const bool edge = std::abs(across - 1.72F) < 0.05F || std::abs(across + 5.22F) < 0.05F;
      if ((dash || edge) && wear > 0.22F) s.albedo = Vector3f(0.72F, 0.72F, 0.69F);
      // The gutter.
      if (across > 3.5F || across < -7.0F) {
        s.albedo = Vector3f::Constant(0.34F + 0.05F * fine * grain + 0.03F * patch);
      }
      s.shine = 0.06F;
      break;
    }
    case Material::kMarking:
      s.albedo = Vector3f(0.75F, 0.75F, 0.72F);
      break;
    case Material::kPaving: {
      float ix, iy;
      const float slab = bond(uv.x(), uv.y(), 0.6F, 0.6F, 0.012F + 0.001F * distance, &ix, &iy);
      const float shade = latticeNoise(static_cast<int>(ix), static_cast<int>(iy), 11) - 0.5F;
      const float dirt = smoothNoise(0.9F * uv.x(), 0.9F * uv.y(), 12) - 0.5F;
      const float grain = smoothNoise(30.0F * uv.x(), 30.0F * uv.y(), 13) - 0.5F;
      const float base = 0.46F + 0.09F * shade + 0.10F * dirt + 0.05F * fine * grain;
      s.albedo = Vector3f(1.04F, 1.0F, 0.93F) * base * (1.0F - (1.0F - slab) * 0.55F * fine);
      break;
    }
    case Material::kKerb: {
      const float joint = fraction(uv.x()) < 0.02F ? 0.6F : 1.0F;
      s.albedo = Vector3f::Constant(
          joint * (0.55F + 0.12F * (smoothNoise(7.0F * uv.x(), 7.0F * uv.y(), 14) - 0.5F)));
      break;
    }
    case Material::kGrass: {
      const float tuft = smoothNoise(14.0F * uv.x(), 14.0F * uv.y(), 15);
      const float blade = smoothNoise(60.0F * uv.x(), 60.0F * uv.y(), 16);
      const float dry = smoothNoise(0.4F * uv.x(), 0.4F * uv.y(), 17);
      const float base = 0.55F + 0.5F * fine * (tuft - 0.5F) + 0.5F * fine * (blade - 0.5F);
      s.albedo = base * (Vector3f(0.20F, 0.34F, 0.09F) + dry * Vector3f(0.20F, 0.10F, 0.05F));
      break;
    }
    case Material::kBrick:
    case Material::kPlaster: {
      const float along = std::abs(n.x()) > 0.7F ? p.y() : p.x(), up = p.z();
      const float stain = smoothNoise(0.7F * along, 0.35F * up, 18) - 0.5F;
      if (material == Material::kBrick) {
        float ix, iy;
        const float brick = bond(along, up, 0.24F, 0.082F, 0.01F + 0.0012F * distance, &ix, &iy);
        const float shade = latticeNoise(static_cast<int>(ix), static_cast<int>(iy), 19) - 0.5F;
        s.albedo = 0.8F * tint * (1.0F + 0.45F * fine * shade + 0.25F * stain);
        s.albedo += (Vector3f(0.6F, 0.57F, 0.52F) - s.albedo) * (1.0F - brick) * fine;
      } else {
        const float rough = smoothNoise(18.0F * along, 18.0F * up, 20) - 0.5F;
        const float drip = smoothNoise(4.0F * along, 0.5F * up, 21) - 0.5F;
        s.albedo = 0.85F * tint * (1.0F + 0.22F * stain + 0.10F * fine * rough + 0.08F * drip);
        if (up < 0.6F) s.albedo *= 0.72F;
      }
      break;
    }
    case Material::kGlass: {
      const float x = std::abs(uv.x() - 0.5F), y = std::abs(uv.y() - 0.5F);
      const bool frame = x > 0.445F || y > 0.455F || x < 0.03F || std::abs(uv.y() - 0.68F) < 0.02F;
      if (frame) {
        s.albedo = Vector3f(0.82F, 0.82F, 0.8F);
      } else {
        const bool curtain = uv.y() > 0.2F && x > 0.3F + 0.1F * fraction(13.7F * std::floor(p.x()));
        s.albedo = curtain ? Vector3f(0.42F, 0.40F, 0.36F) : Vector3f(0.05F, 0.06F, 0.07F);
        s.gloss = 0.30F;
        s.shine = 0.8F;
      }
      break;
    }
    case Material::kFrame:
      s.albedo = Vector3f(0.80F, 0.79F, 0.76F);
      break;
    case Material::kRoof: {
      float ix, iy;
      const float tile = bond(p.x(), p.y(), 0.3F, 0.33F, 0.03F, &ix, &iy);
      const float shade = latticeNoise(static_cast<int>(ix), static_cast<int>(iy), 22) - 0.5F;
      s.albedo = Vector3f(0.42F, 0.22F, 0.16F) * (0.75F + 0.25F * tile + 0.3F * fine * shade);
      break;
    }
    case Material::kDoor: {
      const bool panel = std::abs(std::abs(uv.x() - 0.5F) - 0.22F) < 0.15F &&
                         std::abs(fraction(2.0F * uv.y()) - 0.5F) < 0.36F;
      s.albedo = Vector3f(0.14F, 0.20F, 0.26F) * (panel ? 1.35F : 1.0F);
      s.shine = 0.1F;
      break;
    }
    case Material::kWood: {
      const float grain = smoothNoise(25.0F * p.x(), 2.0F * p.z() + 25.0F * p.y(), 24) - 0.5F;
      s.albedo = tint * (1.0F + 0.3F * grain);
      break;
    }
    case Material::kMetal:
      s.albedo = tint;
      s.gloss = 0.05F;
      s.shine = 0.3F;
      break;
    case Material::kConcrete:
      s.albedo = Vector3f::Constant(
          0.6F + 0.15F * (smoothNoise(5.0F * p.x(), 5.0F * (p.y() + p.z()), 25) - 0.5F));
      break;
    case Material::kBark: {
      const float ridge = smoothNoise(30.0F * (p.x() + p.y()), 5.0F * p.z(), 26);
      s.albedo = Vector3f(0.27F, 0.20F, 0.15F) * (0.55F + 0.8F * ridge);
      break;
    }
    case Material::kLeaf: {
      const float kind =
          latticeNoise(static_cast<int>(std::floor(7.0F * p.x())),
                       static_cast<int>(std::floor(7.0F * (p.y() + 2.0F * p.z()))), 27);
      s.albedo = tint * (0.7F + 0.7F * kind);
      s.thin = true;
      s.shine = 0.08F;
      break;
    }
    case Material::kPaint: {
      // Door seams.
      const bool seam = p.z() > 0.35F && p.z() < 1.0F &&
                        (std::abs(p.x() + 0.25F) < 0.008F || std::abs(p.x() - 0.85F) < 0.008F);
      s.albedo = seam ? Vector3f(0.3F * tint) : tint;
      s.gloss = 0.10F;
      s.shine = 1.1F;
      break;
    }
    case Material::kCarGlass:
      s.albedo = Vector3f(0.03F, 0.035F, 0.04F);
      s.gloss = 0.28F;
      s.shine = 1.0F;
      break;
    case Material::kRubber:
      s.albedo = Vector3f(0.045F, 0.045F, 0.05F);
      break;
    case Material::kHeadlight:
      s.albedo = Vector3f(0.75F, 0.76F, 0.78F);
      s.gloss = 0.2F;
      break;
    case Material::kTaillight:
      s.albedo = Vector3f(0.55F, 0.04F, 0.03F);
      s.glow = 0.15F;
      break;
    case Material::kSkin:
      s.albedo = Vector3f(0.62F, 0.43F, 0.34F);
      break;
    case Material::kCloth: {
      const float fold = smoothNoise(9.0F * p.x() + 9.0F * p.y(), 7.0F * p.z(), 28) - 0.5F;
      s.albedo = tint * (1.0F + 0.4F * fold);
      break;
    }
    case Material::kTrousers:
      s.albedo = 0.25F * tint + Vector3f(0.05F, 0.055F, 0.08F);
      break;
    case Material::kHair:
      s.albedo = Vector3f(0.10F, 0.07F, 0.05F);
      break;
    case Material::kSignFace: {
      const float radius = std::max(uv.norm(), std::max(std::abs(uv.x()), std::abs(uv.y())));
      const bool bar = std::abs(uv.y()) < 0.14F && std::abs(uv.x()) < 0.45F;
      s.albedo = radius > 0.74F || uv.isZero(0.0F) ? Vector3f(0.66F, 0.06F, 0.05F)
                 : bar                             ? Vector3f(0.06F, 0.06F, 0.07F)
                                                   : Vector3f(0.85F, 0.85F, 0.84F);
      s.glow = 0.1F;
      break;
    }
    case Material::kBin:
      s.albedo = tint;
      s.shine = 0.1F;
      break;
  }
  s.albedo = s.albedo.cwiseMax(0.01F).cwiseMin(0.95F);
  return s;
}

struct Sample {
  Vector3f light;
  int object = -1;
  int triangle = -1;
  Class kind = Class::kSky;
  float range = 0.0F;
};

Sample look(const World& world, const Vector3f& origin, const Vector3f& way) {
  Sample sample;
  const Hit hit = world.see(origin, way);
  if (hit.range <= 0.0F) {
    sample.light = skyColor(way);
    return sample;
  }
  sample.object = hit.object;
  sample.triangle = hit.triangle;
  sample.kind = world.classOf(hit);
  sample.range = hit.range;
  const Vector3f p = origin + hit.range * way;
  const Surface surface =
      surfaceOf(world.materialOf(hit), world.tintOf(hit), world.toObjectNow(hit.object, p),
                world.normalToObjectNow(hit.object, hit.normal), world.textureOf(hit), hit.range);
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

/// Calls work(row) for every row.
template <typename Work>
void forEachRow(int rows, int threads, const Work& work) {
  std::atomic<int> next{0};
  const auto loop = [&] {
    constexpr int kRowsAtOnce = 8;
    for (int first = next.fetch_add(kRowsAtOnce); first < rows;
         first = next.fetch_add(kRowsAtOnce)) {
      for (int row = first; row < std::min(rows, first + kRowsAtOnce); ++row) work(row);
    }
  };
  std::vector<std::thread> pool;
  for (int i = 1; i < threads; ++i) pool.emplace_back(loop);
  loop();
  for (std::thread& thread : pool) thread.join();
}

}  // namespace

Camera::Camera(const CameraInfo& info, const Transform& T_base_camera)
    : info_(info), model_(info, {}), T_base_camera_(T_base_camera) {
  rays_.reserve(static_cast<std::size_t>(info.size.width) *
                static_cast<std::size_t>(info.size.height));
  for (int row = 0; row < info.size.height; ++row) {
    for (int column = 0; column < info.size.width; ++column) {
      const std::optional<Eigen::Vector3d> ray = model_.ray({column, row});
      if (!ray) throw Error("a pixel of the simulated lens has no ray");
      rays_.push_back(ray->cast<float>());
    }
  }
}

Picture Camera::render(const World& world, const Transform& T_world_base, std::uint64_t key,
                       int threads) const {
  const Eigen::Isometry3f T_world_camera = (T_world_base * T_base_camera_).cast<float>();
  const Vector3f origin = T_world_camera.translation();
  const Eigen::Matrix3f R = T_world_camera.linear();
  const int width = info_.size.width, height = info_.size.height;
  const auto rayOf = [&](int row, int column) {
    return rays_[static_cast<std::size_t>(row) * static_cast<std::size_t>(width) +
                 static_cast<std::size_t>(column)];
  };
  std::vector<Sample> samples(rays_.size());
  forEachRow(height, threads, [&](int row) {
    for (int column = 0; column < width; ++column) {
      samples[static_cast<std::size_t>(row) * width + column] =
          look(world, origin, R * rayOf(row, column));
    }
  });
  Picture picture{cv::Mat(height, width, CV_8UC3), cv::Mat(height, width, CV_8UC1)};
  const float cx = static_cast<float>(model_.cx()), cy = static_cast<float>(model_.cy());
  forEachRow(height, threads, [&](int row) {
    auto* pixel = picture.image.ptr<std::uint8_t>(row);
    auto* label = picture.labels.ptr<std::uint8_t>(row);
    for (int column = 0; column < width; ++column, pixel += 3, ++label) {
      const Sample& sample = samples[static_cast<std::size_t>(row) * width + column];
      Vector3f light = sample.light;
      // Edges take three more samples inside of the pixel; its label stays that of the centre.
      bool edge = false;
      for (const int step : {1, width}) {
        const std::size_t at = static_cast<std::size_t>(row) * width + column;
        const bool inside = step == 1 ? column + 1 < width : row + 1 < height;
        if (!inside) continue;
        const Sample& other = samples[at + static_cast<std::size_t>(step)];
        edge = edge || other.object != sample.object || other.kind != sample.kind ||
               (other.light - light).squaredNorm() > 0.02F;
      }
      if (edge) {
        const Vector3f right = rayOf(row, std::min(column + 1, width - 1)) -
                               rayOf(row, std::min(column + 1, width - 1) - 1);
        const Vector3f down = rayOf(std::min(row + 1, height - 1), column) -
                              rayOf(std::min(row + 1, height - 1) - 1, column);
        const float offsets[3][2] = {{0.33F, -0.17F}, {-0.33F, 0.17F}, {0.17F, 0.40F}};
        for (const auto& offset : offsets) {
          const Vector3f way =
              (rayOf(row, column) + offset[0] * right + offset[1] * down).normalized();
          light += look(world, origin, R * way).light;
        }
        light *= 0.25F;
      }
      const float x = (static_cast<float>(column) - cx) / static_cast<float>(width);
      const float y = (static_cast<float>(row) - cy) / static_cast<float>(width);
      light *= 1.0F - 0.55F * (x * x + y * y);
      Random random(
          mixKeys(key, static_cast<std::uint64_t>(row), static_cast<std::uint64_t>(column)));
      const float grain = static_cast<float>(random.uniform() + random.uniform() - 1.0) * 4.0F;
      for (int channel = 0; channel < 3; ++channel) {
        const float value = 255.0F * toneMapped(light[2 - channel]) + grain +
                            static_cast<float>(random.uniform() - 0.5) * 2.0F;
        pixel[channel] = static_cast<std::uint8_t>(std::min(std::max(value + 0.5F, 0.0F), 255.0F));
      }
      *label = static_cast<std::uint8_t>(sample.kind);
    }
  });
  return picture;
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

LidarResponse lidarResponse(Material material, const Eigen::Vector3f& tint) {
  switch (material) {
    case Material::kAsphalt:
      return {0.17F, 0.0F};
    case Material::kMarking:
      return {0.6F, 0.0F};
    case Material::kPaving:
    case Material::kKerb:
    case Material::kConcrete:
      return {0.4F, 0.0F};
    case Material::kGrass:
    case Material::kLeaf:
      return {0.45F, 0.03F};
    case Material::kBark:
    case Material::kWood:
      return {0.4F, 0.0F};
    case Material::kGlass:
      return {0.25F, 0.55F};
    case Material::kCarGlass:
      return {0.2F, 0.7F};
    case Material::kPaint:
      return {0.12F + 0.5F * tint.mean(), 0.04F};
    case Material::kRubber:
    case Material::kHair:
      return {0.08F, 0.02F};
    case Material::kMetal:
      return {0.35F, 0.01F};
    case Material::kHeadlight:
    case Material::kTaillight:
    case Material::kSignFace:
      return {1.0F, 0.0F};
    default:
      return {0.15F + 0.4F * tint.mean(), 0.0F};
  }
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

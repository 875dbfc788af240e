// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/materials.h"

#include <algorithm>
#include <cmath>

#include "tools/simulate_drive/noise.h"

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

using Eigen::Vector3f;

float fraction(float x) { return x - std::floor(x); }

/// Of details smaller than a pixel's view, the less the farther away.
float fineness(const Place& at) { return at.distance < 25.0F ? 1.0F : 25.0F / at.distance; }

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

/// Stains of a wall, and where the place is on it, m.
float wallStain(const Place& at, float* along, float* up) {
  *along = std::abs(at.n.x()) > 0.7F ? at.p.y() : at.p.x();
  *up = at.p.z();
  return smoothNoise(0.7F * *along, 0.35F * *up, 18) - 0.5F;
}

Surface asphalt(const Place& at) {
  Surface s;
  const float along = at.uv.x(), across = at.uv.y();
  const float grain = smoothNoise(40.0F * along, 40.0F * across, 5) - 0.5F;
  const float patch = smoothNoise(0.35F * along, 0.8F * across, 6) - 0.5F;
  const float worn = std::exp(-12.0F * std::pow(std::abs(std::abs(across) - 0.75F), 2.0F));
  const float repair = smoothNoise(0.12F * along, 0.3F * across, 9) > 0.72F ? -0.045F : 0.0F;
  const float base = 0.185F + 0.06F * fineness(at) * grain + 0.05F * patch + 0.02F * worn + repair;
  s.albedo = Vector3f(base, base, 1.03F * base);
  const float wear = smoothNoise(9.0F * along, 9.0F * across, 8);
  const bool dash = fraction(along / 9.0F) < 0.4F && std::abs(across + 1.75F) < 0.06F;
  const bool edge = std::abs(across - 1.72F) < 0.05F || std::abs(across + 5.22F) < 0.05F;
  if ((dash || edge) && wear > 0.22F) s.albedo = Vector3f(0.72F, 0.72F, 0.69F);
  // The gutter.
  if (across > 3.5F || across < -7.0F) {
    s.albedo = Vector3f::Constant(0.34F + 0.05F * fineness(at) * grain + 0.03F * patch);
  }
  s.shine = 0.06F;
  return s;
}

Surface paving(const Place& at) {
  Surface s;
  float ix, iy;
  const float slab =
      bond(at.uv.x(), at.uv.y(), 0.6F, 0.6F, 0.012F + 0.001F * at.distance, &ix, &iy);
  const float shade = latticeNoise(static_cast<int>(ix), static_cast<int>(iy), 11) - 0.5F;
  const float dirt = smoothNoise(0.9F * at.uv.x(), 0.9F * at.uv.y(), 12) - 0.5F;
  const float grain = smoothNoise(30.0F * at.uv.x(), 30.0F * at.uv.y(), 13) - 0.5F;
  const float base = 0.46F + 0.09F * shade + 0.10F * dirt + 0.05F * fineness(at) * grain;
  s.albedo = Vector3f(1.04F, 1.0F, 0.93F) * base * (1.0F - (1.0F - slab) * 0.55F * fineness(at));
  return s;
}

Surface kerb(const Place& at) {
  Surface s;
  const float joint = fraction(at.uv.x()) < 0.02F ? 0.6F : 1.0F;
  s.albedo = Vector3f::Constant(
      joint * (0.55F + 0.12F * (smoothNoise(7.0F * at.uv.x(), 7.0F * at.uv.y(), 14) - 0.5F)));
  return s;
}

Surface grass(const Place& at) {
  Surface s;
  const float tuft = smoothNoise(14.0F * at.uv.x(), 14.0F * at.uv.y(), 15);
  const float blade = smoothNoise(60.0F * at.uv.x(), 60.0F * at.uv.y(), 16);
  const float dry = smoothNoise(0.4F * at.uv.x(), 0.4F * at.uv.y(), 17);
  const float base =
      0.55F + 0.5F * fineness(at) * (tuft - 0.5F) + 0.5F * fineness(at) * (blade - 0.5F);
  s.albedo = base * (Vector3f(0.20F, 0.34F, 0.09F) + dry * Vector3f(0.20F, 0.10F, 0.05F));
  return s;
}

Surface glass(const Place& at) {
  Surface s;
  const float x = std::abs(at.uv.x() - 0.5F), y = std::abs(at.uv.y() - 0.5F);
  const bool frame = x > 0.445F || y > 0.455F || x < 0.03F || std::abs(at.uv.y() - 0.68F) < 0.02F;
  if (frame) {
    s.albedo = Vector3f(0.82F, 0.82F, 0.8F);
  } else {
    const bool curtain =
        at.uv.y() > 0.2F && x > 0.3F + 0.1F * fraction(13.7F * std::floor(at.p.x()));
    s.albedo = curtain ? Vector3f(0.42F, 0.40F, 0.36F) : Vector3f(0.05F, 0.06F, 0.07F);
    s.gloss = 0.30F;
    s.shine = 0.8F;
  }
  return s;
}

Surface roof(const Place& at) {
  Surface s;
  float ix, iy;
  const float tile = bond(at.p.x(), at.p.y(), 0.3F, 0.33F, 0.03F, &ix, &iy);
  const float shade = latticeNoise(static_cast<int>(ix), static_cast<int>(iy), 22) - 0.5F;
  s.albedo = Vector3f(0.42F, 0.22F, 0.16F) * (0.75F + 0.25F * tile + 0.3F * fineness(at) * shade);
  return s;
}

Surface door(const Place& at) {
  Surface s;
  const bool panel = std::abs(std::abs(at.uv.x() - 0.5F) - 0.22F) < 0.15F &&
                     std::abs(fraction(2.0F * at.uv.y()) - 0.5F) < 0.36F;
  s.albedo = Vector3f(0.14F, 0.20F, 0.26F) * (panel ? 1.35F : 1.0F);
  s.shine = 0.1F;
  return s;
}

Surface wood(const Place& at) {
  Surface s;
  const float grain = smoothNoise(25.0F * at.p.x(), 2.0F * at.p.z() + 25.0F * at.p.y(), 24) - 0.5F;
  s.albedo = at.tint * (1.0F + 0.3F * grain);
  return s;
}

Surface concrete(const Place& at) {
  Surface s;
  s.albedo = Vector3f::Constant(
      0.6F + 0.15F * (smoothNoise(5.0F * at.p.x(), 5.0F * (at.p.y() + at.p.z()), 25) - 0.5F));
  return s;
}

Surface bark(const Place& at) {
  Surface s;
  const float ridge = smoothNoise(30.0F * (at.p.x() + at.p.y()), 5.0F * at.p.z(), 26);
  s.albedo = Vector3f(0.27F, 0.20F, 0.15F) * (0.55F + 0.8F * ridge);
  return s;
}

Surface leaf(const Place& at) {
  Surface s;
  const float kind =
      latticeNoise(static_cast<int>(std::floor(7.0F * at.p.x())),
                   static_cast<int>(std::floor(7.0F * (at.p.y() + 2.0F * at.p.z()))), 27);
  s.albedo = at.tint * (0.7F + 0.7F * kind);
  s.thin = true;
  s.shine = 0.08F;
  return s;
}

Surface paint(const Place& at) {
  Surface s;
  // Door seams.
  const bool seam = at.p.z() > 0.35F && at.p.z() < 1.0F &&
                    (std::abs(at.p.x() + 0.25F) < 0.008F || std::abs(at.p.x() - 0.85F) < 0.008F);
  s.albedo = seam ? Vector3f(0.3F * at.tint) : at.tint;
  s.gloss = 0.10F;
  s.shine = 1.1F;
  return s;
}

Surface cloth(const Place& at) {
  Surface s;
  const float fold = smoothNoise(9.0F * at.p.x() + 9.0F * at.p.y(), 7.0F * at.p.z(), 28) - 0.5F;
  s.albedo = at.tint * (1.0F + 0.4F * fold);
  return s;
}

Surface signFace(const Place& at) {
  Surface s;
  const float radius = std::max(at.uv.norm(), std::max(std::abs(at.uv.x()), std::abs(at.uv.y())));
  const bool bar = std::abs(at.uv.y()) < 0.14F && std::abs(at.uv.x()) < 0.45F;
  s.albedo = radius > 0.74F || at.uv.isZero(0.0F) ? Vector3f(0.66F, 0.06F, 0.05F)
             : bar                                ? Vector3f(0.06F, 0.06F, 0.07F)
                                                  : Vector3f(0.85F, 0.85F, 0.84F);
  s.glow = 0.1F;
  return s;
}

Surface brick(const Place& at) {
  Surface s;
  float along, up;
  const float stain = wallStain(at, &along, &up);
  float ix, iy;
  const float stone = bond(along, up, 0.24F, 0.082F, 0.01F + 0.0012F * at.distance, &ix, &iy);
  const float shade = latticeNoise(static_cast<int>(ix), static_cast<int>(iy), 19) - 0.5F;
  s.albedo = 0.8F * at.tint * (1.0F + 0.45F * fineness(at) * shade + 0.25F * stain);
  s.albedo += (Vector3f(0.6F, 0.57F, 0.52F) - s.albedo) * (1.0F - stone) * fineness(at);
  return s;
}

Surface plaster(const Place& at) {
  Surface s;
  float along, up;
  const float stain = wallStain(at, &along, &up);
  const float rough = smoothNoise(18.0F * along, 18.0F * up, 20) - 0.5F;
  const float drip = smoothNoise(4.0F * along, 0.5F * up, 21) - 0.5F;
  s.albedo = 0.85F * at.tint * (1.0F + 0.22F * stain + 0.10F * fineness(at) * rough + 0.08F * drip);
  if (up < 0.6F) s.albedo *= 0.72F;
  return s;
}

/// Without the limits that every material keeps.
Surface freeSurface(Material material, const Place& at) {
  switch (material) {
    case Material::kAsphalt:
      return asphalt(at);
    case Material::kMarking:
      return {Vector3f(0.75F, 0.75F, 0.72F)};
    case Material::kPaving:
      return paving(at);
    case Material::kKerb:
      return kerb(at);
    case Material::kGrass:
      return grass(at);
    case Material::kGlass:
      return glass(at);
    case Material::kFrame:
      return {Vector3f(0.80F, 0.79F, 0.76F)};
    case Material::kRoof:
      return roof(at);
    case Material::kDoor:
      return door(at);
    case Material::kWood:
      return wood(at);
    case Material::kMetal:
      return {at.tint, 0.05F, 0.3F};
    case Material::kConcrete:
      return concrete(at);
    case Material::kBark:
      return bark(at);
    case Material::kLeaf:
      return leaf(at);
    case Material::kPaint:
      return paint(at);
    case Material::kCarGlass:
      return {Vector3f(0.03F, 0.035F, 0.04F), 0.28F, 1.0F};
    case Material::kRubber:
      return {Vector3f(0.045F, 0.045F, 0.05F)};
    case Material::kHeadlight:
      return {Vector3f(0.75F, 0.76F, 0.78F), 0.2F};
    case Material::kTaillight:
      return {Vector3f(0.55F, 0.04F, 0.03F), 0.0F, 0.0F, 0.15F};
    case Material::kSkin:
      return {Vector3f(0.62F, 0.43F, 0.34F)};
    case Material::kCloth:
      return cloth(at);
    case Material::kTrousers:
      return {0.25F * at.tint + Vector3f(0.05F, 0.055F, 0.08F)};
    case Material::kHair:
      return {Vector3f(0.10F, 0.07F, 0.05F)};
    case Material::kSignFace:
      return signFace(at);
    case Material::kBin:
      return {at.tint, 0.0F, 0.1F};
    case Material::kBrick:
      return brick(at);
    case Material::kPlaster:
      return plaster(at);
  }
  return {};
}

}  // namespace

float smoothStep(float from, float to, float x) {
  const float t = std::min(std::max((x - from) / (to - from), 0.0F), 1.0F);
  return t * t * (3.0F - 2.0F * t);
}

Surface surfaceOf(Material material, const Place& place) {
  Surface s = freeSurface(material, place);
  s.albedo = s.albedo.cwiseMax(0.01F).cwiseMin(0.95F);
  return s;
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

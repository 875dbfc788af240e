// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/street.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "tools/simulate_drive/noise.h"

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

using Eigen::Vector3f;

// Across the road, m to the left of the lane's middle.
constexpr double kRoadLeft = 3.85, kRoadRight = -7.35;
constexpr double kParkingWidth = 2.1;
constexpr double kKerbHeight = 0.14, kKerbWidth = 0.16;
constexpr double kFootpathWidth = 3.2;
constexpr double kGardenDepth = 10.0;  // beyond the footpath; bends have room for no more
// Along the road, beyond the drive's ends.
constexpr double kBehindM = 70.0, kAheadM = 110.0;

Vector3f color(double r, double g, double b) {
  return {static_cast<float>(r), static_cast<float>(g), static_cast<float>(b)};
}

Transform placed(double x, double y, double z, double heading) {
  Transform T = Transform::Identity();
  T.translation() = Eigen::Vector3d(x, y, z);
  T.linear() = Eigen::AngleAxisd(heading, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  return T;
}

Transform pitched(double angle) {
  Transform T = Transform::Identity();
  T.linear() = Eigen::AngleAxisd(angle, Eigen::Vector3d::UnitY()).toRotationMatrix();
  return T;
}

Transform shifted(double x, double y, double z) { return placed(x, y, z, 0.0); }

/// On the road's coordinates: `across` to the left of the lane, turned by `turn`.
Transform onRoad(const DrivePath& path, double along, double across, double z, double turn) {
  const PathPoint p = path.roadAt(along);
  return placed(p.x - across * std::sin(p.heading), p.y + across * std::cos(p.heading), z,
                p.heading + turn);
}

// ------------------------------------------------------------------------------------- meshes

/// One cross section of a car at `x`: heights of sill, belt line and roof, half widths.
struct Station {
  float x, sill, belt, roof, belt_half, roof_half;
};

Mesh makeCar(const std::vector<Station>& stations, float wheel_x_front, float wheel_x_rear) {
  Mesh mesh;
  const auto corners = [](const Station& s) {
    return std::array<Vector3f, 8>{
        Vector3f(s.x, s.belt_half - 0.08F, s.sill),  Vector3f(s.x, s.belt_half, s.sill + 0.25F),
        Vector3f(s.x, s.belt_half - 0.02F, s.belt),  Vector3f(s.x, s.roof_half, s.roof),
        Vector3f(s.x, -s.roof_half, s.roof),         Vector3f(s.x, -s.belt_half + 0.02F, s.belt),
        Vector3f(s.x, -s.belt_half, s.sill + 0.25F), Vector3f(s.x, -s.belt_half + 0.08F, s.sill)};
  };
  const auto tall = [](const Station& s) { return s.roof > s.belt + 0.25F; };
  for (std::size_t i = 0; i + 1 < stations.size(); ++i) {
    const Station& a = stations[i];
    const Station& b = stations[i + 1];
    const auto ca = corners(a), cb = corners(b);
    for (int k = 0; k < 8; ++k) {
      const int next = (k + 1) % 8;
      // Glass: the sides of the cabin, and the wind screens between bonnet and roof.
      const bool side = k == 2 || k == 4;
      const bool screen = k == 3 && tall(a) != tall(b);
      const Material material = (side && tall(a) && tall(b)) || screen ? Material::kCarGlass
                                : k == 7                               ? Material::kRubber
                                                                       : Material::kPaint;
      mesh.quad(ca[k], ca[next], cb[next], cb[k], Class::kVehicle, material);
    }
    // Pillars before the glass.
    if (tall(a) && tall(b)) {
      for (const int sign : {1, -1}) {
        const float s = static_cast<float>(sign);
        const Vector3f low(b.x, s * b.belt_half, b.belt),
            high(b.x, s * (b.roof_half + 0.02F), b.roof);
        const Vector3f wide(0.05F, 0.0F, 0.0F);
        mesh.quad(low - wide, low + wide, high + wide, high - wide, Class::kVehicle,
                  Material::kPaint);
      }
    }
  }
  for (const std::size_t end : {std::size_t{0}, stations.size() - 1}) {
    const auto c = corners(stations[end]);
    for (int k = 1; k + 1 < 8; ++k) {
      mesh.triangle(c[0], c[k], c[k + 1], Class::kVehicle, Material::kPaint);
    }
    // Lights and number plate just outside of the body.
    const bool front = end != 0;
    const float out = front ? 0.03F : -0.03F, x = stations[end].x;
    const float z = stations[end].sill + 0.32F, half = stations[end].belt_half;
    for (const float s : {1.0F, -1.0F}) {
      const float y = s * (half - 0.28F);
      mesh.box(Vector3f(std::min(x, x + out), y - 0.2F, z),
               Vector3f(std::max(x, x + out), y + 0.2F, z + 0.16F), Class::kVehicle,
               front ? Material::kHeadlight : Material::kTaillight);
    }
    mesh.box(Vector3f(std::min(x, x + out), -0.22F, z - 0.2F),
             Vector3f(std::max(x, x + out), 0.22F, z - 0.08F), Class::kVehicle, Material::kFrame);
  }
  for (const float x : {wheel_x_front, wheel_x_rear}) {
    for (const float s : {1.0F, -1.0F}) {
      const float y = s * (stations[stations.size() / 2].belt_half - 0.2F);
      mesh.tube(Vector3f(x, y, 0.32F), Vector3f(x, y + s * 0.23F, 0.32F), 0.32F, 0.32F, 14,
                Class::kVehicle, Material::kRubber);
      mesh.tube(Vector3f(x, y + s * 0.2F, 0.32F), Vector3f(x, y + s * 0.245F, 0.32F), 0.19F, 0.17F,
                10, Class::kVehicle, Material::kMetal);
    }
  }
  return mesh;
}

Mesh makeSedan() {
  return makeCar({{-2.2F, 0.32F, 0.86F, 0.88F, 0.76F, 0.60F},
                  {-1.95F, 0.22F, 0.92F, 0.97F, 0.88F, 0.70F},
                  {-1.55F, 0.20F, 0.93F, 1.00F, 0.90F, 0.72F},
                  {-0.95F, 0.20F, 0.92F, 1.40F, 0.90F, 0.62F},
                  {-0.2F, 0.20F, 0.91F, 1.45F, 0.90F, 0.64F},
                  {0.35F, 0.20F, 0.90F, 1.40F, 0.90F, 0.62F},
                  {1.05F, 0.20F, 0.86F, 0.92F, 0.90F, 0.76F},
                  {1.85F, 0.22F, 0.74F, 0.78F, 0.87F, 0.72F},
                  {2.2F, 0.30F, 0.62F, 0.66F, 0.74F, 0.62F}},
                 1.38F, -1.32F);
}

Mesh makeHatchback() {
  return makeCar({{-1.95F, 0.30F, 0.92F, 0.98F, 0.78F, 0.70F},
                  {-1.75F, 0.22F, 0.96F, 1.04F, 0.87F, 0.72F},
                  {-1.45F, 0.20F, 0.97F, 1.46F, 0.88F, 0.64F},
                  {-0.5F, 0.20F, 0.95F, 1.54F, 0.89F, 0.66F},
                  {0.25F, 0.20F, 0.94F, 1.50F, 0.89F, 0.64F},
                  {1.05F, 0.20F, 0.90F, 0.97F, 0.88F, 0.74F},
                  {1.7F, 0.22F, 0.78F, 0.82F, 0.86F, 0.72F},
                  {1.95F, 0.30F, 0.66F, 0.70F, 0.76F, 0.62F}},
                 1.25F, -1.22F);
}

Mesh makeVan() {
  return makeCar({{-2.5F, 0.35F, 1.15F, 2.10F, 0.95F, 0.86F},
                  {-1.0F, 0.30F, 1.15F, 2.15F, 0.96F, 0.87F},
                  {0.3F, 0.30F, 1.15F, 2.15F, 0.96F, 0.87F},
                  {1.35F, 0.30F, 1.12F, 2.02F, 0.96F, 0.80F},
                  {2.05F, 0.30F, 1.08F, 1.16F, 0.95F, 0.80F},
                  {2.5F, 0.34F, 0.85F, 0.92F, 0.88F, 0.74F}},
                 1.7F, -1.55F);
}

/// A trunk with branches, and a crown of small leaves in lumps, through which rays find ways.
Mesh makeTree(Random random, double height, double crown, int leaves) {
  Mesh mesh;
  const double trunk = 0.42 * height;
  const float thick = static_cast<float>(0.028 * height);
  const Vector3f fork(static_cast<float>(random.uniform(-0.15, 0.15)),
                      static_cast<float>(random.uniform(-0.15, 0.15)), static_cast<float>(trunk));
  mesh.tube(Vector3f(0, 0, -0.1F), fork, thick, 0.75F * thick, 9, Class::kVegetation,
            Material::kBark);
  std::vector<Vector3f> lumps;
  std::vector<float> sizes;
  const int lump_count = 9;
  for (int i = 0; i < lump_count; ++i) {
    const double azimuth = 2.0 * kPi * (i + random.uniform()) / lump_count;
    const double out = crown * random.uniform(0.15, 0.68);
    const Vector3f lump(static_cast<float>(out * std::cos(azimuth)),
                        static_cast<float>(out * std::sin(azimuth)),
                        static_cast<float>(height * random.uniform(0.55, 0.92)));
    lumps.push_back(lump);
    sizes.push_back(static_cast<float>(crown * random.uniform(0.38, 0.58)));
    mesh.tube(fork, lump, 0.45F * thick, 0.12F * thick, 5, Class::kVegetation, Material::kBark);
  }
  for (int i = 0; i < leaves; ++i) {
    const std::size_t lump = static_cast<std::size_t>(random.uniform() * lump_count);
    Vector3f way;
    do {
      way = Vector3f(static_cast<float>(random.uniform(-1, 1)),
                     static_cast<float>(random.uniform(-1, 1)),
                     static_cast<float>(random.uniform(-1, 1)));
    } while (way.norm() > 1.0F || way.norm() < 0.45F);
    const Vector3f at = lumps[lump] + sizes[lump] * way;
    const Vector3f normal =
        (way + Vector3f(static_cast<float>(random.normal()), static_cast<float>(random.normal()),
                        static_cast<float>(random.normal() + 0.6)) *
                   0.6F)
            .normalized();
    const Vector3f p = normal.unitOrthogonal(), q = normal.cross(p);
    const float size = static_cast<float>(random.uniform(0.07, 0.15));
    const Vector3f along =
        size * (std::cos(static_cast<float>(i)) * p + std::sin(static_cast<float>(i)) * q);
    const Vector3f aside =
        0.55F * size * (std::cos(static_cast<float>(i)) * q - std::sin(static_cast<float>(i)) * p);
    mesh.quad(at - along, at + aside, at + along, at - aside, Class::kVegetation, Material::kLeaf);
  }
  return mesh;
}

Mesh makeHedge(Random random, float length) {
  Mesh mesh;
  mesh.box(Vector3f(0.05F, -0.22F, 0.0F), Vector3f(length - 0.05F, 0.22F, 0.95F),
           Class::kVegetation, Material::kLeaf);
  const int leaves = static_cast<int>(260.0F * length);
  for (int i = 0; i < leaves; ++i) {
    const float x = static_cast<float>(random.uniform(0.0, length));
    const int side = static_cast<int>(random.uniform() * 3.0);
    const float y =
        side == 2 ? static_cast<float>(random.uniform(-0.28, 0.28)) : (side == 0 ? -0.25F : 0.25F);
    const float z = side == 2 ? 0.98F : static_cast<float>(random.uniform(0.05, 1.0));
    const Vector3f at(x, y + static_cast<float>(0.03 * random.normal()),
                      z + static_cast<float>(0.02 * random.normal()));
    const Vector3f normal =
        Vector3f(static_cast<float>(random.normal()), static_cast<float>(random.normal()),
                 static_cast<float>(random.normal()))
            .normalized();
    const Vector3f p = 0.07F * normal.unitOrthogonal(), q = 0.6F * normal.cross(p);
    mesh.quad(at - p, at + q, at + p, at - q, Class::kVegetation, Material::kLeaf);
  }
  return mesh;
}

/// A house front from x = 0 to `width`, looking to -y, with windows set back into the wall.
Mesh makeHouse(Random random, float width, int storeys, Material wall, bool pitched_roof) {
  Mesh mesh;
  const float storey = 3.1F, depth = 8.0F, reveal = 0.16F;
  const float height = storey * static_cast<float>(storeys) + 0.5F;
  const Class kind = Class::kBuilding;
  const int columns = std::max(2, static_cast<int>(width / 2.7F));
  const float cell = width / static_cast<float>(columns);
  const int door = static_cast<int>(random.uniform() * columns);
  const auto wallPiece = [&](float x0, float x1, float z0, float z1) {
    mesh.quad({x0, 0, z0}, {x1, 0, z0}, {x1, 0, z1}, {x0, 0, z1}, kind, wall);
  };
  for (int row = 0; row < storeys; ++row) {
    for (int column = 0; column < columns; ++column) {
      const float x0 = cell * static_cast<float>(column), x1 = x0 + cell;
      const float z0 = storey * static_cast<float>(row), z1 = z0 + storey;
      const bool is_door = row == 0 && column == door;
      const float half = is_door ? 0.5F : 0.65F, middle = 0.5F * (x0 + x1);
      const float a = middle - half, b = middle + half;
      const float c = is_door ? 0.0F : z0 + 0.9F, d = is_door ? 2.15F : z0 + 2.45F;
      wallPiece(x0, a, z0, z1);
      wallPiece(b, x1, z0, z1);
      if (c > z0) wallPiece(a, b, z0, c);
      wallPiece(a, b, d, z1);
      const Vector3f corner[4] = {{a, 0, c}, {b, 0, c}, {b, 0, d}, {a, 0, d}};
      const Vector3f in(0, reveal, 0);
      for (int i = 0; i < 4; ++i) {
        const Vector3f &p = corner[i], &q = corner[(i + 1) % 4];
        mesh.quad(p, q, q + in, p + in, kind, Material::kFrame);
      }
      const Eigen::Vector2f unit[4] = {{0, 0}, {1, 0}, {1, 1}, {0, 1}};
      const Vector3f pane[4] = {corner[0] + in, corner[1] + in, corner[2] + in, corner[3] + in};
      mesh.texturedQuad(pane, unit, kind, is_door ? Material::kDoor : Material::kGlass);
      if (!is_door) {
        mesh.box({a - 0.08F, -0.07F, c - 0.09F}, {b + 0.08F, 0.02F, c}, kind, Material::kConcrete);
      }
    }
  }
  wallPiece(0, width, storey * static_cast<float>(storeys), height);
  mesh.quad({0, 0, 0}, {0, depth, 0}, {0, depth, height}, {0, 0, height}, kind, wall);
  mesh.quad({width, 0, 0}, {width, depth, 0}, {width, depth, height}, {width, 0, height}, kind,
            wall);
  mesh.quad({0, depth, 0}, {width, depth, 0}, {width, depth, height}, {0, depth, height}, kind,
            wall);
  if (pitched_roof) {
    const float ridge = height + 2.4F;
    const float over = 0.35F;
    mesh.quad({-over, -over, height}, {width + over, -over, height},
              {width + over, 0.5F * depth, ridge}, {-over, 0.5F * depth, ridge}, kind,
              Material::kRoof);
    mesh.quad({-over, depth + over, height}, {width + over, depth + over, height},
              {width + over, 0.5F * depth, ridge}, {-over, 0.5F * depth, ridge}, kind,
              Material::kRoof);
    mesh.triangle({0, 0, height}, {0, depth, height}, {0, 0.5F * depth, ridge}, kind, wall);
    mesh.triangle({width, 0, height}, {width, depth, height}, {width, 0.5F * depth, ridge}, kind,
                  wall);
  } else {
    mesh.quad({0, 0, height}, {width, 0, height}, {width, depth, height}, {0, depth, height}, kind,
              Material::kConcrete);
    mesh.box({-0.1F, -0.18F, height - 0.25F}, {width + 0.1F, 0.05F, height + 0.1F}, kind,
             Material::kFrame);
  }
  return mesh;
}

/// Along x, one of iron bars, or of boards.
Mesh makeFence(float length, bool bars) {
  Mesh mesh;
  const float height = bars ? 1.25F : 1.15F, step = bars ? 0.13F : 0.14F;
  const Material material = bars ? Material::kMetal : Material::kWood;
  const float half = bars ? 0.011F : 0.05F, thick = bars ? 0.011F : 0.012F;
  const int count = static_cast<int>(length / step);
  for (int i = 0; i <= count; ++i) {
    const float x = step * static_cast<float>(i) + half;
    mesh.box({x - half, -thick, 0.06F}, {x + half, thick, height}, Class::kFence, material);
  }
  for (const float z : {0.2F, height - 0.15F}) {
    mesh.box({0, -0.025F, z - 0.03F}, {length, 0.025F, z + 0.03F}, Class::kFence, material);
  }
  for (float x = 0.0F; x <= length; x += 2.0F) {
    mesh.box({x - 0.05F, -0.05F, 0.0F}, {x + 0.05F, 0.05F, height + 0.1F}, Class::kFence, material);
  }
  return mesh;
}

Mesh makeLamp() {
  Mesh mesh;
  mesh.tube({0, 0, 0}, {0, 0, 1.2F}, 0.09F, 0.085F, 10, Class::kPole, Material::kMetal);
  mesh.tube({0, 0, 1.2F}, {0, 0, 7.2F}, 0.07F, 0.05F, 10, Class::kPole, Material::kMetal);
  mesh.tube({0, 0, 7.1F}, {0, -1.6F, 7.5F}, 0.045F, 0.035F, 7, Class::kPole, Material::kMetal);
  mesh.box({-0.12F, -2.1F, 7.42F}, {0.12F, -1.5F, 7.56F}, Class::kPole, Material::kConcrete);
  return mesh;
}

/// Faces -x.
Mesh makeSign(int kind) {
  Mesh mesh;
  mesh.tube({0, 0, 0}, {0, 0, 2.75F}, 0.03F, 0.03F, 8, Class::kPole, Material::kMetal);
  const float x = -0.04F, z = 2.4F;
  if (kind == 0) {
    const float radius = 0.33F;
    for (int i = 0; i < 20; ++i) {
      const float a = static_cast<float>(2.0 * kPi * i / 20),
                  b = static_cast<float>(2.0 * kPi * (i + 1) / 20);
      const Vector3f p(x, radius * std::cos(a), z + radius * std::sin(a));
      const Vector3f q(x, radius * std::cos(b), z + radius * std::sin(b));
      const Vector3f m(x, 0, z);
      const Vector3f none(x, 0, z);
      mesh.triangle(m, p, q, Class::kSign, Material::kSignFace);
      mesh.texture[mesh.texture.size() - 3] = {0.0F, 0.0F};
      mesh.texture[mesh.texture.size() - 2] = {(p.y()) / radius, (p.z() - z) / radius};
      mesh.texture[mesh.texture.size() - 1] = {(q.y()) / radius, (q.z() - z) / radius};
    }
  } else {
    const float half = kind == 1 ? 0.3F : 0.45F, tall = kind == 1 ? 0.4F : 0.16F;
    const Vector3f corners[4] = {
        {x, -half, z - tall}, {x, half, z - tall}, {x, half, z + tall}, {x, -half, z + tall}};
    const Eigen::Vector2f unit[4] = {{-0.7F, -0.7F}, {0.7F, -0.7F}, {0.7F, 0.7F}, {-0.7F, 0.7F}};
    mesh.texturedQuad(corners, unit, Class::kSign, Material::kSignFace);
  }
  return mesh;
}

Mesh makeBin() {
  Mesh mesh;
  mesh.box({-0.28F, -0.3F, 0.08F}, {0.28F, 0.3F, 1.0F}, Class::kUnlabeled, Material::kBin);
  mesh.box({-0.31F, -0.34F, 1.0F}, {0.31F, 0.33F, 1.08F}, Class::kUnlabeled, Material::kRubber);
  for (const float x : {-0.2F, 0.2F}) {
    mesh.tube({x, 0.28F, 0.1F}, {x + 0.06F, 0.28F, 0.1F}, 0.1F, 0.1F, 10, Class::kUnlabeled,
              Material::kRubber);
  }
  return mesh;
}

Mesh makeBench() {
  Mesh mesh;
  for (int i = 0; i < 4; ++i) {
    const float y = 0.11F * static_cast<float>(i);
    mesh.box({-0.8F, y, 0.42F}, {0.8F, y + 0.08F, 0.46F}, Class::kUnlabeled, Material::kWood);
    mesh.box({-0.8F, 0.44F, 0.5F + y}, {0.8F, 0.48F, 0.58F + y}, Class::kUnlabeled,
             Material::kWood);
  }
  for (const float x : {-0.7F, 0.65F}) {
    mesh.box({x, 0.02F, 0.0F}, {x + 0.05F, 0.08F, 0.42F}, Class::kUnlabeled, Material::kMetal);
    mesh.box({x, 0.4F, 0.0F}, {x + 0.05F, 0.46F, 0.9F}, Class::kUnlabeled, Material::kMetal);
  }
  return mesh;
}

void addTorso(Mesh* mesh, Class kind, float hip, float lean) {
  const Vector3f top(lean, 0.0F, hip + 0.52F);
  mesh->tube({0, 0, hip - 0.06F}, {0.5F * lean, 0, hip + 0.25F}, 0.16F, 0.15F, 10, kind,
             Material::kCloth);
  mesh->tube({0.5F * lean, 0, hip + 0.25F}, top, 0.15F, 0.2F, 10, kind, Material::kCloth);
  mesh->ellipsoid(top, {0.15F, 0.23F, 0.1F}, 8, kind, Material::kCloth);
  mesh->tube(top, top + Vector3f(0.02F, 0, 0.12F), 0.06F, 0.055F, 7, kind, Material::kSkin);
  mesh->ellipsoid(top + Vector3f(0.04F, 0, 0.23F), {0.105F, 0.085F, 0.13F}, 9, kind,
                  Material::kSkin);
  mesh->ellipsoid(top + Vector3f(0.02F, 0, 0.27F), {0.11F, 0.095F, 0.11F}, 8, kind,
                  Material::kHair);
}

Mesh makeThigh() {
  Mesh mesh;
  mesh.tube({0, 0, 0}, {0, 0, -0.44F}, 0.095F, 0.065F, 9, Class::kPedestrian, Material::kTrousers);
  mesh.ellipsoid({0, 0, -0.44F}, {0.066F, 0.066F, 0.066F}, 7, Class::kPedestrian,
                 Material::kTrousers);
  return mesh;
}

Mesh makeShin() {
  Mesh mesh;
  mesh.tube({0, 0, 0}, {0, 0, -0.4F}, 0.06F, 0.045F, 8, Class::kPedestrian, Material::kTrousers);
  mesh.box({-0.06F, -0.045F, -0.46F}, {0.18F, 0.045F, -0.38F}, Class::kPedestrian,
           Material::kRubber);
  return mesh;
}

Mesh makeArm() {
  Mesh mesh;
  mesh.tube({0, 0, 0}, {0, 0, -0.3F}, 0.055F, 0.045F, 8, Class::kPedestrian, Material::kCloth);
  mesh.tube({0, 0, -0.3F}, {0.1F, 0, -0.56F}, 0.042F, 0.035F, 7, Class::kPedestrian,
            Material::kCloth);
  mesh.ellipsoid({0.12F, 0, -0.6F}, {0.045F, 0.03F, 0.06F}, 6, Class::kPedestrian, Material::kSkin);
  return mesh;
}

/// A bicycle and who rides it, along x.
Mesh makeRider() {
  Mesh mesh;
  const Class kind = Class::kRider;
  for (const float x : {-0.52F, 0.52F}) {
    const int parts = 20;
    for (int i = 0; i < parts; ++i) {
      const float a = static_cast<float>(2.0 * kPi * i / parts),
                  b = static_cast<float>(2.0 * kPi * (i + 1) / parts);
      mesh.tube({x + 0.34F * std::cos(a), 0, 0.34F + 0.34F * std::sin(a)},
                {x + 0.34F * std::cos(b), 0, 0.34F + 0.34F * std::sin(b)}, 0.02F, 0.02F, 5, kind,
                Material::kRubber);
      if (i % 2 == 0) {
        mesh.tube({x, 0, 0.34F}, {x + 0.33F * std::cos(a), 0, 0.34F + 0.33F * std::sin(a)}, 0.003F,
                  0.003F, 3, kind, Material::kMetal);
      }
    }
  }
  const Vector3f rear(-0.52F, 0, 0.34F), front(0.52F, 0, 0.34F), crank(-0.06F, 0, 0.3F);
  const Vector3f saddle(-0.24F, 0, 0.92F), head(0.38F, 0, 0.86F), bar(0.42F, 0, 1.02F);
  const std::vector<std::pair<Vector3f, Vector3f>> frame = {
      {rear, crank}, {rear, saddle}, {crank, saddle}, {crank, head}, {saddle, head}, {front, bar}};
  for (const auto& [from, to] : frame) mesh.tube(from, to, 0.02F, 0.02F, 6, kind, Material::kPaint);
  mesh.tube(bar + Vector3f(0, -0.26F, 0), bar + Vector3f(0, 0.26F, 0), 0.016F, 0.016F, 6, kind,
            Material::kRubber);
  mesh.box({-0.36F, -0.07F, 0.92F}, {-0.12F, 0.07F, 0.98F}, kind, Material::kRubber);
  const Vector3f hip(-0.22F, 0, 1.02F), chest(0.14F, 0, 1.45F);
  mesh.tube(hip, chest, 0.14F, 0.18F, 10, kind, Material::kCloth);
  mesh.ellipsoid(chest, {0.15F, 0.21F, 0.12F}, 8, kind, Material::kCloth);
  mesh.tube(chest, chest + Vector3f(0.1F, 0, 0.15F), 0.06F, 0.055F, 7, kind, Material::kSkin);
  mesh.ellipsoid(chest + Vector3f(0.14F, 0, 0.25F), {0.105F, 0.085F, 0.13F}, 9, kind,
                 Material::kSkin);
  mesh.ellipsoid(chest + Vector3f(0.12F, 0, 0.3F), {0.14F, 0.1F, 0.1F}, 8, kind,
                 Material::kSignFace);
  for (const float s : {1.0F, -1.0F}) {
    const Vector3f knee(0.16F, 0.1F * s, s > 0 ? 0.86F : 0.66F);
    const Vector3f foot(-0.06F + (s > 0 ? 0.12F : -0.02F), 0.11F * s, s > 0 ? 0.46F : 0.2F);
    mesh.tube(hip + Vector3f(0, 0.09F * s, 0), knee, 0.09F, 0.065F, 8, kind, Material::kTrousers);
    mesh.tube(knee, foot, 0.06F, 0.045F, 8, kind, Material::kTrousers);
    mesh.box(foot - Vector3f(0.06F, 0.04F, 0.05F), foot + Vector3f(0.18F, 0.04F, 0.02F), kind,
             Material::kRubber);
    const Vector3f elbow(0.26F, 0.26F * s, 1.2F);
    mesh.tube(chest + Vector3f(0, 0.2F * s, 0), elbow, 0.055F, 0.045F, 7, kind, Material::kCloth);
    mesh.tube(elbow, bar + Vector3f(0, 0.22F * s, 0.03F), 0.042F, 0.035F, 7, kind, Material::kSkin);
  }
  return mesh;
}

// ------------------------------------------------------------------------------------- builder

class Builder {
 public:
  Builder(const DrivePath& path, const StreetOptions& options, World* world)
      : path_(path), options_(options), world_(world), random_(mixKeys(options.seed, 0x57EE7)) {}

  void build() {
    from_ = path_.firstDistance() - kBehindM;
    to_ = path_.lastDistance() + kAheadM;
    addGround();
    addHouses(1);
    addHouses(-1);
    addFurniture();
    addParkedCars();
    addTraffic();
    addPeople();
    world_->finish();
  }

 private:
  std::uint32_t nextSurface() { return ++surface_; }

  void add(int mesh, const Transform& T, std::uint32_t surface, const Vector3f& tint) {
    world_->addStatic(mesh, T, surface, tint);
  }

  /// A strip along the road between two lines (across, z), with texture (along, across).
  void addStrip(Mesh* mesh, double from_across, double from_z, double to_across, double to_z,
                Class kind, Material material) const {
    const double step = 1.0;
    for (double s = from_; s < to_; s += step) {
      Vector3f corners[4];
      Eigen::Vector2f texture[4];
      const double along[4] = {s, s + step, s + step, s};
      for (int i = 0; i < 4; ++i) {
        const double across = i < 2 ? from_across : to_across;
        const double z = i < 2 ? from_z : to_z;
        corners[i] = onRoad(path_, along[i], across, z, 0.0).translation().cast<float>();
        // Upright strips are textured by their height.
        texture[i] = {static_cast<float>(along[i]), static_cast<float>(across + z)};
      }
      mesh->texturedQuad(corners, texture, kind, material);
    }
  }

  void addGround() {
    const Transform here = Transform::Identity();
    const Vector3f white = color(1, 1, 1);
    Mesh road;
    addStrip(&road, kRoadRight, 0.0, kRoadLeft, 0.0, Class::kRoad, Material::kAsphalt);
    add(world_->addMesh(std::move(road)), here, nextSurface(), white);
    for (const int side : {1, -1}) {
      const double kerb = side > 0 ? kRoadLeft : kRoadRight;
      const double path_begin = kerb + side * kKerbWidth;
      const double path_end = kerb + side * kFootpathWidth;
      Mesh kerbs, footpath, garden;
      addStrip(&kerbs, kerb, 0.0, kerb, kKerbHeight, Class::kUndrivableRoad, Material::kKerb);
      addStrip(&kerbs, kerb, kKerbHeight, path_begin, kKerbHeight, Class::kUndrivableRoad,
               Material::kKerb);
      addStrip(&footpath, path_begin, kKerbHeight, path_end, kKerbHeight + 0.03,
               Class::kUndrivableRoad, Material::kPaving);
      addStrip(&garden, path_end, kKerbHeight + 0.03, path_end + side * kGardenDepth,
               kKerbHeight + 0.1, Class::kVegetation, Material::kGrass);
      add(world_->addMesh(std::move(kerbs)), here, nextSurface(), white);
      add(world_->addMesh(std::move(footpath)), here, nextSurface(), white);
      add(world_->addMesh(std::move(garden)), here, nextSurface(), white);
    }
    Mesh plain;
    const float far = 600.0F, z = -0.15F;
    const Vector3f corners[4] = {{-far, -far, z}, {far, -far, z}, {far, far, z}, {-far, far, z}};
    const Eigen::Vector2f texture[4] = {{-far, -far}, {far, -far}, {far, far}, {-far, far}};
    plain.texturedQuad(corners, texture, Class::kVegetation, Material::kGrass);
    add(world_->addMesh(std::move(plain)), here, nextSurface(), white);
  }

  void addHouses(int side) {
    static const Vector3f kWalls[] = {color(0.62, 0.33, 0.25), color(0.72, 0.5, 0.38),
                                      color(0.85, 0.8, 0.68),  color(0.78, 0.78, 0.76),
                                      color(0.66, 0.7, 0.74),  color(0.88, 0.74, 0.55)};
    const double boundary = (side > 0 ? kRoadLeft : kRoadRight) + side * kFootpathWidth;
    double s = from_;
    while (s < to_) {
      const double width = random_.uniform(8.0, 13.0);
      const bool garden = random_.uniform() < 0.5;
      const int storeys = random_.uniform() < 0.45 ? 1 + static_cast<int>(random_.uniform() * 2.0)
                                                   : 2 + static_cast<int>(random_.uniform() * 2.0);
      const bool brick = random_.uniform() < 0.55;
      const Vector3f tint = kWalls[static_cast<int>(random_.uniform() * 2.999) + (brick ? 0 : 3)];
      const double setback = garden ? random_.uniform(3.0, 4.5) : 0.15;
      const int mesh = world_->addMesh(
          makeHouse(Random(mixKeys(options_.seed, 17, surface_)), static_cast<float>(width),
                    storeys, brick ? Material::kBrick : Material::kPlaster, garden || storeys < 3));
      // The front looks to -y of the house, which is to the road on both sides.
      const double middle = s + 0.5 * width;
      const Transform T = onRoad(path_, middle, boundary + side * setback, kKerbHeight + 0.03,
                                 side > 0 ? 0.0 : kPi) *
                          shifted(-0.5 * width, 0.0, 0.0);
      add(mesh, T, nextSurface(), tint);
      if (garden) addGarden(side, middle, width, boundary, setback);
      s += width + (garden ? random_.uniform(0.6, 2.5) : random_.uniform(0.0, 0.8));
    }
  }

  void addGarden(int side, double middle, double width, double boundary, double setback) {
    const double kind = random_.uniform();
    const float length = static_cast<float>(0.5 * width - 0.7);
    const std::uint32_t surface = nextSurface();
    for (const double half : {-0.5 * width, 0.7}) {
      const Transform T =
          onRoad(path_, middle, boundary + side * 0.3, kKerbHeight + 0.03, side > 0 ? 0.0 : kPi) *
          shifted(half, 0.0, 0.0);
      if (kind < 0.45) {
        add(world_->addMesh(makeFence(length, true)), T, surface, color(0.10, 0.12, 0.11));
      } else if (kind < 0.8) {
        add(world_->addMesh(makeFence(length, false)), T, surface, color(0.75, 0.70, 0.62));
      } else {
        add(world_->addMesh(makeHedge(Random(mixKeys(options_.seed, 23, surface_)), length)), T,
            surface, color(0.24, 0.36, 0.14));
      }
    }
    if (random_.uniform() < 0.6) {
      addTree(middle + random_.uniform(-0.35, 0.35) * width, boundary + side * (0.55 * setback),
              0.5);
    }
  }

  void addTree(double along, double across, double size) {
    if (trees_.empty()) {
      for (int i = 0; i < 4; ++i) {
        trees_.push_back(world_->addMesh(makeTree(
            Random(mixKeys(options_.seed, 31, static_cast<std::uint64_t>(i))), 7.5, 2.6, 5200)));
      }
    }
    Transform T = onRoad(path_, along, across, kKerbHeight, random_.uniform(0.0, 2.0 * kPi));
    T.matrix().topLeftCorner<3, 3>() *= size * random_.uniform(0.85, 1.2);
    const double hue = random_.uniform();
    add(trees_[static_cast<std::size_t>(random_.uniform() * 3.999)], T, nextSurface(),
        color(0.20 + 0.12 * hue, 0.34 + 0.06 * hue, 0.11));
  }

  void addFurniture() {
    const int lamp = world_->addMesh(makeLamp()), bin = world_->addMesh(makeBin());
    const int bench = world_->addMesh(makeBench());
    const int signs[3] = {world_->addMesh(makeSign(0)), world_->addMesh(makeSign(1)),
                          world_->addMesh(makeSign(2))};
    for (const int side : {1, -1}) {
      const double kerb = side > 0 ? kRoadLeft : kRoadRight;
      const double facing = side > 0 ? 0.0 : kPi;
      for (double s = from_ + (side > 0 ? 4.0 : 15.0); s < to_; s += random_.uniform(22.0, 27.0)) {
        add(lamp, onRoad(path_, s, kerb + side * 0.5, kKerbHeight, facing), nextSurface(),
            color(0.42, 0.45, 0.45));
      }
      for (double s = from_ + random_.uniform(5.0, 12.0); s < to_;
           s += random_.uniform(11.0, 19.0)) {
        add(signs[static_cast<int>(random_.uniform() * 2.999)],
            onRoad(path_, s, kerb + side * 0.45, kKerbHeight,
                   facing + random_.uniform(-0.15, 0.15)),
            nextSurface(), color(0.5, 0.52, 0.52));
      }
      for (double s = from_ + random_.uniform(2.0, 9.0); s < to_; s += random_.uniform(9.0, 17.0)) {
        addTree(s, kerb + side * random_.uniform(0.75, 0.95), 1.0);
      }
      for (double s = from_ + random_.uniform(2.0, 9.0); s < to_;
           s += random_.uniform(10.0, 24.0)) {
        const bool sit = random_.uniform() < 0.3;
        const double across =
            kerb + side * (sit ? kFootpathWidth - 0.7 : random_.uniform(0.6, 0.8));
        add(sit ? bench : bin, onRoad(path_, s, across, kKerbHeight + 0.02, facing), nextSurface(),
            random_.uniform() < 0.5 ? color(0.12, 0.3, 0.14) : color(0.4, 0.28, 0.2));
      }
    }
  }

  void makeVehicles() {
    vehicles_ = {world_->addMesh(makeSedan()), world_->addMesh(makeHatchback()),
                 world_->addMesh(makeVan())};
  }

  int anyVehicle() {
    const double choice = random_.uniform();
    return vehicles_[choice < 0.45 ? 0 : choice < 0.82 ? 1 : 2];
  }

  Vector3f anyPaint() {
    static const Vector3f kPaints[] = {color(0.8, 0.8, 0.8),    color(0.72, 0.73, 0.75),
                                       color(0.05, 0.05, 0.06), color(0.28, 0.3, 0.32),
                                       color(0.45, 0.04, 0.04), color(0.06, 0.12, 0.34),
                                       color(0.5, 0.47, 0.4),   color(0.08, 0.25, 0.2)};
    return kPaints[static_cast<int>(random_.uniform() * 7.999)];
  }

  void addParkedCars() {
    makeVehicles();
    for (const int side : {1, -1}) {
      const double across =
          (side > 0 ? kRoadLeft : kRoadRight) - side * (0.5 * kParkingWidth + 0.05);
      for (double s = from_ + random_.uniform(0.0, 5.0); s < to_; s += random_.uniform(5.8, 7.0)) {
        if (random_.uniform() > 0.55) continue;
        add(anyVehicle(),
            onRoad(path_, s, across + random_.uniform(-0.1, 0.1), 0.0,
                   (side > 0 ? 0.0 : kPi) + random_.uniform(-0.02, 0.02)),
            nextSurface(), anyPaint());
      }
    }
  }

  /// Along the road at constant speed (negative: towards the vehicle), or standing.
  Motion alongRoad(double start, double across, double z, double speed) const {
    const double used = options_.moving ? speed : 0.0;
    const double turn = speed < 0.0 ? kPi : 0.0;
    const DrivePath& path = path_;
    return [=, &path](double t) { return onRoad(path, start + used * t, across, z, turn); };
  }

  void addTraffic() {
    // Before the vehicle; in a standing world it would be run over.
    const double mean = path_.distance(0.5) / 0.5;
    if (options_.moving) {
      world_->addMoving(vehicles_[1], alongRoad(17.0, 0.1, 0.0, mean), nextSurface(), anyPaint());
      world_->addMoving(vehicles_[2], alongRoad(-16.0, 0.0, 0.0, 0.6 * mean), nextSurface(),
                        anyPaint());
    }
    for (double s = random_.uniform(12.0, 18.0) + from_; s < to_ + 60.0;
         s += random_.uniform(20.0, 34.0)) {
      world_->addMoving(anyVehicle(), alongRoad(s, -3.5, 0.0, -random_.uniform(8.0, 9.0)),
                        nextSurface(), anyPaint());
    }
    const int rider = world_->addMesh(makeRider());
    for (double s = random_.uniform(6.0, 9.0); s < to_; s += random_.uniform(18.0, 30.0)) {
      world_->addMoving(rider, alongRoad(s, 1.55, 0.0, random_.uniform(4.0, 5.5)), nextSurface(),
                        anyCloth());
    }
    for (double s = random_.uniform(10.0, 16.0); s < to_ + 30.0; s += random_.uniform(22.0, 36.0)) {
      world_->addMoving(rider, alongRoad(s, -5.05, 0.0, -random_.uniform(4.0, 5.5)), nextSurface(),
                        anyCloth());
    }
  }

  Vector3f anyCloth() {
    static const Vector3f kCloths[] = {color(0.55, 0.1, 0.1),   color(0.1, 0.2, 0.5),
                                       color(0.75, 0.7, 0.2),   color(0.12, 0.12, 0.13),
                                       color(0.75, 0.75, 0.75), color(0.15, 0.38, 0.3),
                                       color(0.6, 0.35, 0.15)};
    return kCloths[static_cast<int>(random_.uniform() * 6.999)];
  }

  void addPeople() {
    Mesh body;
    addTorso(&body, Class::kPedestrian, 0.92F, 0.03F);
    const int torso = world_->addMesh(std::move(body));
    const int thigh = world_->addMesh(makeThigh()), shin = world_->addMesh(makeShin());
    const int arm = world_->addMesh(makeArm());
    for (const int side : {1, -1}) {
      for (double s = from_ + random_.uniform(2.0, 8.0); s < to_; s += random_.uniform(4.0, 11.0)) {
        const double across =
            (side > 0 ? kRoadLeft : kRoadRight) + side * random_.uniform(1.5, kFootpathWidth - 0.5);
        const double speed = (random_.uniform() < 0.5 ? 1.0 : -1.0) * random_.uniform(1.1, 1.6);
        addPedestrian({torso, thigh, shin, arm}, s, across, speed);
      }
    }
  }

  struct BodyMeshes {
    int torso, thigh, shin, arm;
  };

  void addPedestrian(const BodyMeshes& meshes, double start, double across, double speed) {
    const std::uint32_t surface = nextSurface();
    const Vector3f tint = anyCloth();
    const double phase = random_.uniform(0.0, 2.0 * kPi);
    const double rate = options_.moving ? 2.0 * kPi * std::abs(speed) / 1.45 : 0.0;
    const double size = random_.uniform(0.93, 1.08);
    const Motion walk = alongRoad(start, across, kKerbHeight + 0.03, speed);
    const auto body = [=](double t) {
      Transform T = walk(t) * shifted(0.0, 0.0, 0.02 * std::cos(2.0 * (rate * t + phase)) - 0.02);
      T.matrix().topLeftCorner<3, 3>() *= size;
      return T;
    };
    world_->addMoving(meshes.torso, body, surface, tint);
    for (const double s : {1.0, -1.0}) {
      const auto leg = [=](double t) {
        const double swing = -0.42 * s * std::sin(rate * t + phase);
        return Transform(body(t) * shifted(0.0, 0.09 * s, 0.9) * pitched(swing));
      };
      world_->addMoving(meshes.thigh, leg, surface, tint);
      world_->addMoving(
          meshes.shin,
          [=](double t) {
            const double bend =
                0.3 + 0.3 * std::cos(rate * t + phase + (s > 0.0 ? 0.0 : kPi) + 0.4);
            return Transform(leg(t) * shifted(0.0, 0.0, -0.44) * pitched(bend));
          },
          surface, tint);
      world_->addMoving(
          meshes.arm,
          [=](double t) {
            const double swing = 0.35 * s * std::sin(rate * t + phase);
            return Transform(body(t) * shifted(0.03, 0.25 * s, 1.45) * pitched(swing));
          },
          surface, tint);
    }
  }

  const DrivePath& path_;
  const StreetOptions& options_;
  World* world_;
  Random random_;
  double from_ = 0.0, to_ = 0.0;
  std::uint32_t surface_ = 0;
  std::vector<int> trees_;
  std::vector<int> vehicles_;
};

}  // namespace

void buildStreet(const DrivePath& path, const StreetOptions& options, World* world) {
  Builder(path, options, world).build();
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

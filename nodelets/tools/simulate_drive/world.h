// SPDX-License-Identifier: MIT
/// A world of meshes, some of which move, and rays through it at any time.
#pragma once

#include <Eigen/Geometry>
#include <cstdint>
#include <functional>
#include <memory>
#include <vector>

#include "semantic_lidar_fusion/common/types.h"
#include "tools/simulate_drive/embree.h"

namespace semantic_lidar_fusion {
namespace simulator {

constexpr float kPiF = static_cast<float>(kPi);

/// Ids of config/classes_usyd12.yaml.
enum class Class : std::uint8_t {
  kUnlabeled,
  kSky,
  kBuilding,
  kPole,
  kRoad,
  kUndrivableRoad,
  kVegetation,
  kSign,
  kFence,
  kVehicle,
  kPedestrian,
  kRider,
};
constexpr int kClassCount = 12;

enum class Material : std::uint8_t {
  kAsphalt,
  kMarking,
  kPaving,
  kKerb,
  kGrass,
  kBrick,
  kPlaster,
  kGlass,
  kFrame,
  kRoof,
  kDoor,
  kWood,
  kMetal,
  kConcrete,
  kBark,
  kLeaf,
  kPaint,  ///< of a car, tinted
  kCarGlass,
  kRubber,
  kHeadlight,
  kTaillight,
  kSkin,
  kCloth,     ///< tinted
  kTrousers,  ///< tinted, darker
  kHair,
  kSignFace,  ///< red rim, white inside, dark bar
  kBin,
};

struct Mesh {
  std::vector<Eigen::Vector3f> vertices;
  std::vector<Eigen::Vector2f> texture;  ///< per vertex; m along and across where it matters
  std::vector<Eigen::Vector3i> triangles;
  std::vector<Class> classes;       ///< per triangle
  std::vector<Material> materials;  ///< per triangle

  void triangle(const Eigen::Vector3f& a, const Eigen::Vector3f& b, const Eigen::Vector3f& c,
                Class kind, Material material);
  /// Corners in turn.
  void quad(const Eigen::Vector3f& a, const Eigen::Vector3f& b, const Eigen::Vector3f& c,
            const Eigen::Vector3f& d, Class kind, Material material);
  void texturedQuad(const Eigen::Vector3f corners[4], const Eigen::Vector2f texture[4], Class kind,
                    Material material);
  void box(const Eigen::Vector3f& least, const Eigen::Vector3f& most, Class kind,
           Material material);
  /// A tapered tube with closed ends.
  void tube(const Eigen::Vector3f& from, const Eigen::Vector3f& to, float from_radius,
            float to_radius, int sides, Class kind, Material material);
  void ellipsoid(const Eigen::Vector3f& centre, const Eigen::Vector3f& radii, int sides, Class kind,
                 Material material);
};

/// T_world_object at a time in s.
using Motion = std::function<Transform(double)>;

struct Hit {
  float range = 0.0F;  ///< m; the other fields hold only if it is positive
  int object = -1;
  int triangle = -1;
  float u = 0.0F, v = 0.0F;
  Eigen::Vector3f normal = Eigen::Vector3f::UnitZ();  ///< in the world, towards the ray's origin
};

class World {
 public:
  World();
  ~World();
  World(const World&) = delete;
  World& operator=(const World&) = delete;

  /// Index of a mesh that objects can share.
  int addMesh(Mesh mesh);
  void addStatic(int mesh, const Transform& T_world_object, std::uint32_t surface,
                 const Eigen::Vector3f& tint);
  void addMoving(int mesh, Motion motion, std::uint32_t surface, const Eigen::Vector3f& tint);
  /// No objects are added after this.
  void finish();

  /// The times that cast() may ask for. Between steps of at most 4 ms, motions are linear.
  void setSweep(double first_s, double last_s);
  /// The time of see() and blocked().
  void setInstant(double time_s);

  Hit cast(const Eigen::Vector3d& origin, const Eigen::Vector3d& direction, double time_s) const;
  Hit see(const Eigen::Vector3f& origin, const Eigen::Vector3f& direction) const;
  bool blocked(const Eigen::Vector3f& origin, const Eigen::Vector3f& direction, float nearest,
               float farthest) const;

  Class classOf(const Hit& hit) const;
  Material materialOf(const Hit& hit) const;
  std::uint32_t surfaceOf(const Hit& hit) const { return objects_[hit.object].surface; }
  const Eigen::Vector3f& tintOf(const Hit& hit) const { return objects_[hit.object].tint; }
  Eigen::Vector2f textureOf(const Hit& hit) const;
  /// A point of an object between its own coordinates and the world's.
  Eigen::Vector3d toObject(int object, const Eigen::Vector3d& p_world, double time_s) const;
  Eigen::Vector3d toWorld(int object, const Eigen::Vector3d& p_object, double time_s) const;
  /// At the instant.
  Eigen::Vector3f toObjectNow(int object, const Eigen::Vector3f& p_world) const;
  Eigen::Vector3f normalToObjectNow(int object, const Eigen::Vector3f& normal) const;

 private:
  struct Object {
    int mesh = 0;
    Motion motion;
    bool moves = false;
    std::uint32_t surface = 0;
    Eigen::Vector3f tint;
    Transform T_world_object;          ///< at the instant
    Eigen::Isometry3f T_object_world;  ///< at the instant
    RTCGeometry in_sweep = nullptr;
    RTCGeometry in_instant = nullptr;
  };

  RTCGeometry addInstance(RTCScene scene, const Object& object, unsigned id);

  RTCDevice device_ = nullptr;
  RTCScene sweep_ = nullptr;
  RTCScene instant_ = nullptr;
  std::vector<Mesh> meshes_;
  std::vector<RTCScene> mesh_scenes_;
  std::vector<Object> objects_;
  double sweep_first_s_ = 0.0;
  double sweep_last_s_ = 0.0;
};

}  // namespace simulator
}  // namespace semantic_lidar_fusion

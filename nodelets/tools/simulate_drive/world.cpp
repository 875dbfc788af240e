// SPDX-License-Identifier: MIT
#include "tools/simulate_drive/world.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace simulator {
namespace {

constexpr double kLongestStepS = 0.004;

void setTransform(RTCGeometry geometry, unsigned step, const Transform& T) {
  float columns[12];
  for (int column = 0; column < 4; ++column) {
    for (int row = 0; row < 3; ++row) {
      columns[3 * column + row] = static_cast<float>(T.matrix()(row, column));
    }
  }
  rtcSetGeometryTransform(geometry, step, RTC_FORMAT_FLOAT3X4_COLUMN_MAJOR, columns);
}

RTCRayHit makeRay(const Eigen::Vector3f& origin, const Eigen::Vector3f& direction, float time) {
  RTCRayHit ray;
  ray.ray.org_x = origin.x();
  ray.ray.org_y = origin.y();
  ray.ray.org_z = origin.z();
  ray.ray.dir_x = direction.x();
  ray.ray.dir_y = direction.y();
  ray.ray.dir_z = direction.z();
  ray.ray.tnear = 0.0F;
  ray.ray.tfar = std::numeric_limits<float>::infinity();
  ray.ray.time = time;
  ray.ray.mask = 0xFFFFFFFFU;
  ray.ray.id = 0;
  ray.ray.flags = 0;
  ray.hit.geomID = RTC_INVALID_GEOMETRY_ID;
  ray.hit.primID = RTC_INVALID_GEOMETRY_ID;
  ray.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
  return ray;
}

}  // namespace

void Mesh::triangle(const Eigen::Vector3f& a, const Eigen::Vector3f& b, const Eigen::Vector3f& c,
                    Class kind, Material material) {
  const int first = static_cast<int>(vertices.size());
  for (const Eigen::Vector3f* vertex : {&a, &b, &c}) {
    vertices.push_back(*vertex);
    texture.emplace_back(0.0F, 0.0F);
  }
  triangles.emplace_back(first, first + 1, first + 2);
  classes.push_back(kind);
  materials.push_back(material);
}

void Mesh::quad(const Eigen::Vector3f& a, const Eigen::Vector3f& b, const Eigen::Vector3f& c,
                const Eigen::Vector3f& d, Class kind, Material material) {
  const Eigen::Vector3f corners[4] = {a, b, c, d};
  const Eigen::Vector2f flat[4] = {{0, 0}, {1, 0}, {1, 1}, {0, 1}};
  texturedQuad(corners, flat, kind, material);
}

void Mesh::texturedQuad(const Eigen::Vector3f corners[4], const Eigen::Vector2f coordinates[4],
                        Class kind, Material material) {
  const int first = static_cast<int>(vertices.size());
  for (int i = 0; i < 4; ++i) {
    vertices.push_back(corners[i]);
    texture.push_back(coordinates[i]);
  }
  triangles.emplace_back(first, first + 1, first + 2);
  triangles.emplace_back(first, first + 2, first + 3);
  classes.insert(classes.end(), 2, kind);
  materials.insert(materials.end(), 2, material);
}

void Mesh::box(const Eigen::Vector3f& least, const Eigen::Vector3f& most, Class kind,
               Material material) {
  const auto corner = [&](int i) {
    return Eigen::Vector3f((i & 1) != 0 ? most.x() : least.x(), (i & 2) != 0 ? most.y() : least.y(),
                           (i & 4) != 0 ? most.z() : least.z());
  };
  const int sides[6][4] = {{0, 1, 3, 2}, {4, 5, 7, 6}, {0, 1, 5, 4},
                           {2, 3, 7, 6}, {0, 2, 6, 4}, {1, 3, 7, 5}};
  for (const auto& side : sides) {
    quad(corner(side[0]), corner(side[1]), corner(side[2]), corner(side[3]), kind, material);
  }
}

void Mesh::tube(const Eigen::Vector3f& from, const Eigen::Vector3f& to, float from_radius,
                float to_radius, int sides, Class kind, Material material) {
  const Eigen::Vector3f axis = (to - from).normalized();
  const Eigen::Vector3f p = axis.unitOrthogonal();
  const Eigen::Vector3f q = axis.cross(p);
  for (int i = 0; i < sides; ++i) {
    const float a = 2.0F * kPiF * static_cast<float>(i) / static_cast<float>(sides);
    const float b = 2.0F * kPiF * static_cast<float>(i + 1) / static_cast<float>(sides);
    const Eigen::Vector3f first = std::cos(a) * p + std::sin(a) * q;
    const Eigen::Vector3f second = std::cos(b) * p + std::sin(b) * q;
    quad(from + from_radius * first, from + from_radius * second, to + to_radius * second,
         to + to_radius * first, kind, material);
    triangle(from, from + from_radius * first, from + from_radius * second, kind, material);
    triangle(to, to + to_radius * first, to + to_radius * second, kind, material);
  }
}

void Mesh::ellipsoid(const Eigen::Vector3f& centre, const Eigen::Vector3f& radii, int sides,
                     Class kind, Material material) {
  const auto point = [&](int i, int j) {
    const float polar = kPiF * static_cast<float>(j) / static_cast<float>(sides);
    const float azimuth = 2.0F * kPiF * static_cast<float>(i) / static_cast<float>(sides);
    const Eigen::Vector3f unit(std::sin(polar) * std::cos(azimuth),
                               std::sin(polar) * std::sin(azimuth), std::cos(polar));
    return Eigen::Vector3f(centre + radii.cwiseProduct(unit));
  };
  for (int j = 0; j < sides; ++j) {
    for (int i = 0; i < sides; ++i) {
      quad(point(i, j), point(i + 1, j), point(i + 1, j + 1), point(i, j + 1), kind, material);
    }
  }
}

World::World() {
  // One thread builds: the same tree every time.
  device_ = rtcNewDevice("threads=1");
  if (device_ == nullptr) throw Error("Embree cannot start");
  sweep_ = rtcNewScene(device_);
  instant_ = rtcNewScene(device_);
  for (RTCScene scene : {sweep_, instant_}) rtcSetSceneFlags(scene, RTC_SCENE_FLAG_ROBUST);
}

World::~World() {
  for (const Object& object : objects_) {
    if (object.in_sweep != nullptr) rtcReleaseGeometry(object.in_sweep);
    if (object.in_instant != nullptr) rtcReleaseGeometry(object.in_instant);
  }
  for (RTCScene scene : mesh_scenes_) rtcReleaseScene(scene);
  rtcReleaseScene(sweep_);
  rtcReleaseScene(instant_);
  rtcReleaseDevice(device_);
}

int World::addMesh(Mesh mesh) {
  RTCScene scene = rtcNewScene(device_);
  rtcSetSceneFlags(scene, RTC_SCENE_FLAG_ROBUST);
  rtcSetSceneBuildQuality(scene, RTC_BUILD_QUALITY_HIGH);
  RTCGeometry geometry = rtcNewGeometry(device_, RTC_GEOMETRY_TYPE_TRIANGLE);
  auto* vertices = static_cast<float*>(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0,
                                                               RTC_FORMAT_FLOAT3, 3 * sizeof(float),
                                                               mesh.vertices.size()));
  for (const Eigen::Vector3f& vertex : mesh.vertices) {
    for (int i = 0; i < 3; ++i) *vertices++ = vertex[i];
  }
  auto* indices = static_cast<unsigned*>(
      rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                              3 * sizeof(unsigned), mesh.triangles.size()));
  for (const Eigen::Vector3i& triangle : mesh.triangles) {
    for (int i = 0; i < 3; ++i) *indices++ = static_cast<unsigned>(triangle[i]);
  }
  rtcCommitGeometry(geometry);
  rtcAttachGeometryByID(scene, geometry, 0);
  rtcReleaseGeometry(geometry);
  rtcCommitScene(scene);
  meshes_.push_back(std::move(mesh));
  mesh_scenes_.push_back(scene);
  return static_cast<int>(meshes_.size()) - 1;
}

void World::addStatic(int mesh, const Transform& T_world_object, std::uint32_t surface,
                      const Eigen::Vector3f& tint) {
  addMoving(
      mesh, [T_world_object](double) { return T_world_object; }, surface, tint);
  objects_.back().moves = false;
}

void World::addMoving(int mesh, Motion motion, std::uint32_t surface, const Eigen::Vector3f& tint) {
  Object object;
  object.mesh = mesh;
  object.motion = std::move(motion);
  object.moves = true;
  object.surface = surface;
  object.tint = tint;
  objects_.push_back(std::move(object));
}

RTCGeometry World::addInstance(RTCScene scene, const Object& object, unsigned id) {
  RTCGeometry geometry = rtcNewGeometry(device_, RTC_GEOMETRY_TYPE_INSTANCE);
  rtcSetGeometryInstancedScene(geometry, mesh_scenes_[static_cast<std::size_t>(object.mesh)]);
  setTransform(geometry, 0, object.motion(0.0));
  rtcCommitGeometry(geometry);
  rtcAttachGeometryByID(scene, geometry, id);
  return geometry;
}

void World::finish() {
  for (std::size_t i = 0; i < objects_.size(); ++i) {
    Object& object = objects_[i];
    object.T_world_object = object.motion(0.0);
    object.T_object_world = object.T_world_object.inverse(Eigen::Affine).cast<float>();
    object.in_sweep = addInstance(sweep_, object, static_cast<unsigned>(i));
    object.in_instant = addInstance(instant_, object, static_cast<unsigned>(i));
  }
  rtcCommitScene(sweep_);
  rtcCommitScene(instant_);
}

void World::setSweep(double first_s, double last_s) {
  sweep_first_s_ = first_s;
  sweep_last_s_ = std::max(last_s, first_s + 1e-6);
  const unsigned steps =
      1 + static_cast<unsigned>(std::ceil((sweep_last_s_ - sweep_first_s_) / kLongestStepS));
  for (Object& object : objects_) {
    if (!object.moves) continue;
    rtcSetGeometryTimeStepCount(object.in_sweep, steps);
    for (unsigned step = 0; step < steps; ++step) {
      const double w = static_cast<double>(step) / (steps - 1);
      setTransform(object.in_sweep, step,
                   object.motion(sweep_first_s_ + w * (sweep_last_s_ - sweep_first_s_)));
    }
    rtcCommitGeometry(object.in_sweep);
  }
  rtcCommitScene(sweep_);
}

void World::setInstant(double time_s) {
  for (Object& object : objects_) {
    if (!object.moves) continue;
    object.T_world_object = object.motion(time_s);
    object.T_object_world = object.T_world_object.inverse(Eigen::Affine).cast<float>();
    setTransform(object.in_instant, 0, object.T_world_object);
    rtcCommitGeometry(object.in_instant);
  }
  rtcCommitScene(instant_);
}

namespace {

Hit hitOf(const RTCRayHit& ray, const Eigen::Matrix3f& R_world_object,
          const Eigen::Vector3f& direction) {
  Hit hit;
  hit.range = ray.ray.tfar;
  hit.object = static_cast<int>(ray.hit.instID[0]);
  hit.triangle = static_cast<int>(ray.hit.primID);
  hit.u = ray.hit.u;
  hit.v = ray.hit.v;
  // Embree gives the normal in the object's coordinates.
  hit.normal =
      (R_world_object * Eigen::Vector3f(ray.hit.Ng_x, ray.hit.Ng_y, ray.hit.Ng_z)).normalized();
  if (hit.normal.dot(direction) > 0.0F) hit.normal = -hit.normal;
  return hit;
}

}  // namespace

Hit World::cast(const Eigen::Vector3d& origin, const Eigen::Vector3d& direction,
                double time_s) const {
  const Eigen::Vector3f way = direction.cast<float>();
  const double fraction = (time_s - sweep_first_s_) / (sweep_last_s_ - sweep_first_s_);
  RTCRayHit ray = makeRay(origin.cast<float>(), way,
                          static_cast<float>(std::min(std::max(fraction, 0.0), 1.0)));
  intersectRay(sweep_, false, &ray);
  if (ray.hit.geomID == RTC_INVALID_GEOMETRY_ID) return {};
  const Object& object = objects_[ray.hit.instID[0]];
  return hitOf(ray, object.motion(time_s).linear().cast<float>(), way);
}

Hit World::see(const Eigen::Vector3f& origin, const Eigen::Vector3f& direction) const {
  RTCRayHit ray = makeRay(origin, direction, 0.0F);
  intersectRay(instant_, true, &ray);
  if (ray.hit.geomID == RTC_INVALID_GEOMETRY_ID) return {};
  return hitOf(ray, objects_[ray.hit.instID[0]].T_object_world.linear().transpose(), direction);
}

bool World::blocked(const Eigen::Vector3f& origin, const Eigen::Vector3f& direction, float nearest,
                    float farthest) const {
  RTCRay ray = makeRay(origin, direction, 0.0F).ray;
  ray.tnear = nearest;
  ray.tfar = farthest;
  return occludedRay(instant_, &ray);
}

Class World::classOf(const Hit& hit) const {
  return meshes_[objects_[hit.object].mesh].classes[hit.triangle];
}

Material World::materialOf(const Hit& hit) const {
  return meshes_[objects_[hit.object].mesh].materials[hit.triangle];
}

Eigen::Vector2f World::textureOf(const Hit& hit) const {
  const Mesh& mesh = meshes_[objects_[hit.object].mesh];
  const Eigen::Vector3i& t = mesh.triangles[hit.triangle];
  return (1.0F - hit.u - hit.v) * mesh.texture[t[0]] + hit.u * mesh.texture[t[1]] +
         hit.v * mesh.texture[t[2]];
}

Eigen::Vector3d World::toObject(int object, const Eigen::Vector3d& p_world, double time_s) const {
  return objects_[object].motion(time_s).inverse(Eigen::Affine) * p_world;
}

Eigen::Vector3d World::toWorld(int object, const Eigen::Vector3d& p_object, double time_s) const {
  return objects_[object].motion(time_s) * p_object;
}

Eigen::Vector3f World::toObjectNow(int object, const Eigen::Vector3f& p_world) const {
  return objects_[object].T_object_world * p_world;
}

Eigen::Vector3f World::normalToObjectNow(int object, const Eigen::Vector3f& normal) const {
  return objects_[object].T_object_world.linear() * normal;
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

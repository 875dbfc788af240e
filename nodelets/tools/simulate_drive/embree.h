// SPDX-License-Identifier: MIT
/// Embree 3 or 4, whichever CMake has found (SLF_EMBREE_MAJOR): one way to ask both for a ray.
#pragma once

#if SLF_EMBREE_MAJOR >= 4
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

namespace semantic_lidar_fusion {
namespace simulator {

/// The nearest hit. `coherent`: the rays before and after this one go nearly the same way.
inline void intersectRay(RTCScene scene, bool coherent, RTCRayHit* ray) {
#if SLF_EMBREE_MAJOR >= 4
  RTCIntersectArguments arguments;
  rtcInitIntersectArguments(&arguments);
  if (coherent) arguments.flags = RTC_RAY_QUERY_FLAG_COHERENT;
  rtcIntersect1(scene, ray, &arguments);
#else
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  if (coherent) context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
  rtcIntersect1(scene, &context, ray);
#endif
}

/// Whether anything is met between the ray's `tnear` and `tfar`.
inline bool occludedRay(RTCScene scene, RTCRay* ray) {
#if SLF_EMBREE_MAJOR >= 4
  rtcOccluded1(scene, ray, nullptr);
#else
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  rtcOccluded1(scene, &context, ray);
#endif
  return ray->tfar < 0.0F;
}

}  // namespace simulator
}  // namespace semantic_lidar_fusion

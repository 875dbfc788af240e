// SPDX-License-Identifier: MIT
#pragma once

#include "semantic_lidar_fusion/common/cloud_bytes.h"
#include "semantic_lidar_fusion/fusion/semantic_projector.h"

namespace semantic_lidar_fusion {

/// Where the points of one camera went, for pixelCloudBytes; valid as long as `report`.
inline CloudPixels pixelsOf(const CameraFusionReport& report) {
  const PixelCovariances& covariances = report.covariances;
  return {report.index,   report.u,       report.v,     covariances.uu,
          covariances.uv, covariances.vv, report.status};
}

}  // namespace semantic_lidar_fusion

// SPDX-License-Identifier: MIT
#include "lens_parts.h"

namespace semantic_lidar_fusion {

const std::vector<LensKind>& lensKinds() {
  static const std::vector<LensKind> kinds = {
      // name, names in camera_info, skewed, maker
      {"pinhole", {""}, false, makePinhole},
      {"plumb_bob", {"plumb_bob"}, false, makePlumbBob},
      {"rational_polynomial", {"rational_polynomial"}, false, makeRationalPolynomial},
      {"equidistant", {"equidistant", "fisheye"}, true, makeEquidistant},
  };
  return kinds;
}

}  // namespace semantic_lidar_fusion

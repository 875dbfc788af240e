// SPDX-License-Identifier: MIT
#include "lens_parts.h"

namespace semantic_lidar_fusion {

// Each is defined in the file of its lens.
std::unique_ptr<const Lens> makePinhole(const LensParameters&, double, std::vector<std::string>*);
std::unique_ptr<const Lens> makePlumbBob(const LensParameters&, double, std::vector<std::string>*);
std::unique_ptr<const Lens> makeRationalPolynomial(const LensParameters&, double,
                                                   std::vector<std::string>*);
std::unique_ptr<const Lens> makeEquidistant(const LensParameters&, double,
                                            std::vector<std::string>*);
std::unique_ptr<const Lens> makeOmni(const LensParameters&, double, std::vector<std::string>*);
std::unique_ptr<const Lens> makeDoubleSphere(const LensParameters&, double,
                                             std::vector<std::string>*);
std::unique_ptr<const Lens> makeEucm(const LensParameters&, double, std::vector<std::string>*);
std::unique_ptr<const Lens> makeUcm(const LensParameters&, double, std::vector<std::string>*);
std::unique_ptr<const Lens> makeOcam(const LensParameters&, double, std::vector<std::string>*);
std::unique_ptr<const Lens> makeFtheta(const LensParameters&, double, std::vector<std::string>*);

const std::vector<LensKind>& lensKinds() {
  static const std::vector<LensKind> kinds = {
      // name, names in camera_info, skewed, maker
      {"pinhole", {""}, false, makePinhole},
      {"plumb_bob", {"plumb_bob"}, false, makePlumbBob},
      {"rational_polynomial", {"rational_polynomial"}, false, makeRationalPolynomial},
      {"equidistant", {"equidistant", "fisheye"}, true, makeEquidistant},
      {"omni", {}, true, makeOmni},
      {"double_sphere", {}, true, makeDoubleSphere},
      {"eucm", {}, true, makeEucm},
      {"ucm", {}, true, makeUcm},
      {"ocam", {}, false, makeOcam},
      {"ftheta", {}, false, makeFtheta},
  };
  return kinds;
}

}  // namespace semantic_lidar_fusion

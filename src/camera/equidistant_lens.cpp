// SPDX-License-Identifier: MIT
// Kannala-Brandt: equations 6-11 of "Semantic sensor fusion: from camera to sparse lidar
// information".
#include <cmath>

#include "lens_parts.h"
#include "polynomial.h"

namespace semantic_lidar_fusion {
namespace {

class EquidistantLens : public RadialLens {
 public:
  EquidistantLens(const std::array<double, 4>& k, double max_theta_rad)
      : RadialLens(0.0, std::min(foldOver(k), max_theta_rad)), k_(k) {}

  const std::array<double, 4>* kannalaBrandt() const override { return &k_; }

 protected:
  /// theta_d of eq. 9
  double radius(double theta) const override {
    const double s = theta * theta;
    return theta * (1.0 + s * (k_[0] + s * (k_[1] + s * (k_[2] + s * k_[3]))));
  }
  double slope(double theta) const override { return evaluate(slopeOf(k_), theta * theta); }

 private:
  /// d theta_d / d theta as a polynomial in theta^2
  static Polynomial slopeOf(const std::array<double, 4>& k) {
    return {1.0, 3.0 * k[0], 5.0 * k[1], 7.0 * k[2], 9.0 * k[3]};
  }
  static double foldOver(const std::array<double, 4>& k) {
    return std::sqrt(firstRoot(slopeOf(k), 0.0, kPi * kPi));
  }

  std::array<double, 4> k_;
};

}  // namespace

std::unique_ptr<const Lens> makeEquidistant(const LensParameters& parameters, double max_theta_rad,
                                            std::vector<std::string>* notes) {
  const std::vector<double> d =
      checkedCoefficients(parameters, {4}, "must be 4 for equidistant (k1..k4)", notes);
  return std::make_unique<EquidistantLens>(std::array<double, 4>{d[0], d[1], d[2], d[3]},
                                           max_theta_rad);
}

}  // namespace semantic_lidar_fusion

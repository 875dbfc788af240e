// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/check/own_motion.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

namespace semantic_lidar_fusion {
namespace {

constexpr std::size_t kRings = 16, kColumns = 360;
constexpr float kNearestReturn_m = 2.0f, kFarthestReturn_m = 40.0f;
constexpr double kLeastChange_m = 0.1, kMostChange_m = 1.5;
constexpr std::size_t kFewestChanged = 100;
constexpr double kLeastChangedShare = 0.05, kLeastQuarter = 0.05;
constexpr double kLeastMotion_m = 0.25, kLeastAgreeing = 0.58;
constexpr double kStill_m = 0.02, kMoved_m = 0.15, kSame = 0.7;
constexpr StampNs kLongestPairNs = 400000000;
constexpr int kFewestVotes = 3;

}  // namespace

RangeGrid::RangeGrid(const TimedCloud& scan) {
  std::uint16_t rings = 0;
  for (const std::uint16_t ring : scan.ring) {
    if (ring != kNoRing) rings = std::max<std::uint16_t>(rings, ring);
  }
  const std::size_t every = rings / kRings + 1u;
  range_m_.assign(kRings * kColumns, std::numeric_limits<float>::quiet_NaN());
  std::vector<float> off(range_m_.size(), 1.0f);  // from the middle of a column, in columns
  for (std::size_t i = 0; i < scan.size(); ++i) {
    if (scan.ring[i] == kNoRing || scan.ring[i] % every != 0) continue;
    const float range = std::hypot(scan.x[i], scan.y[i], scan.z[i]);
    if (!(range > kNearestReturn_m && range < kFarthestReturn_m)) continue;
    const double column = (std::atan2(scan.y[i], scan.x[i]) / kPi + 1.0) * (kColumns / 2.0);
    const std::size_t whole = std::min(static_cast<std::size_t>(column), kColumns - 1);
    const std::size_t cell = scan.ring[i] / every * kColumns + whole;
    const auto away = static_cast<float>(std::abs(column - static_cast<double>(whole) - 0.5));
    if (away < off[cell]) {
      off[cell] = away;
      range_m_[cell] = range;
    }
  }
}

RangeGrid::Change RangeGrid::to(const RangeGrid& later) const {
  Change change;
  struct Cell {
    Eigen::Vector2d beam;
    double change_m;
  };
  std::vector<Cell> cells;
  Eigen::Matrix2d normal = Eigen::Matrix2d::Zero();
  Eigen::Vector2d sum = Eigen::Vector2d::Zero();
  for (std::size_t k = 0; k < range_m_.size(); ++k) {
    const double by = static_cast<double>(later.range_m_[k]) - static_cast<double>(range_m_[k]);
    if (std::isnan(by)) continue;
    ++change.cells;
    if (std::abs(by) < kLeastChange_m || std::abs(by) > kMostChange_m) continue;
    const double azimuth = (static_cast<double>(k % kColumns) + 0.5) * (2.0 * kPi / kColumns) - kPi;
    const Eigen::Vector2d beam(std::cos(azimuth), std::sin(azimuth));
    cells.push_back({beam, by});
    normal += beam * beam.transpose();
    sum -= by * beam;
  }
  change.changed = cells.size();
  if (cells.size() < 2 || std::abs(normal.determinant()) < 1e-9) return change;
  change.motion = normal.inverse() * sum;
  std::size_t agreeing = 0;
  std::array<std::size_t, 4> quarters{};
  for (const Cell& cell : cells) {
    agreeing += -cell.change_m * cell.beam.dot(change.motion) > 0.0 ? 1 : 0;
    ++quarters[(cell.beam.x() > cell.beam.y() ? 2u : 0u) +
               (cell.beam.x() > -cell.beam.y() ? 1u : 0u)];
  }
  const auto all = static_cast<double>(cells.size());
  change.agreeing = static_cast<double>(agreeing) / all;
  change.least_quarter =
      static_cast<double>(*std::min_element(quarters.begin(), quarters.end())) / all;
  return change;
}

bool RangeGrid::Change::isClear() const {
  return changed >= kFewestChanged && motion.norm() >= kLeastMotion_m &&
         agreeing >= kLeastAgreeing && least_quarter >= kLeastQuarter &&
         static_cast<double>(changed) > kLeastChangedShare * static_cast<double>(cells);
}

void OwnMotion::add(const TimedCloud& scan, const PoseBuffer& odometry,
                    const Transform& T_vehicle_lidar) {
  const std::uint64_t turn = scans_++ % kEvery;
  if (turn > 1 || scan.empty()) return;
  const StampNs at_ns = scanInterval(scan).middleNs();
  const std::optional<Transform> T_fixed_vehicle = odometry.lookup(at_ns);
  RangeGrid grid(scan);
  if (turn == 0) {
    first_ = std::move(grid);
    first_ns_ = at_ns;
    T_fixed_lidar_first_.reset();
    if (T_fixed_vehicle) T_fixed_lidar_first_ = *T_fixed_vehicle * T_vehicle_lidar;
    return;
  }
  const bool joined = first_ && T_fixed_lidar_first_ && T_fixed_vehicle && at_ns > first_ns_ &&
                      at_ns - first_ns_ < kLongestPairNs;
  if (!joined) return;
  const RangeGrid::Change seen = first_->to(grid);
  const Transform step = T_fixed_lidar_first_->inverse() * (*T_fixed_vehicle * T_vehicle_lidar);
  const Eigen::Vector2d told = step.translation().head<2>();
  if (!seen.isClear()) return;
  if (told.norm() < kStill_m) {
    ++frozen_;
  } else if (told.norm() > kMoved_m) {
    const double same = told.normalized().dot(seen.motion.normalized());
    if (same < -kSame) ++backwards_;
    if (same > kSame) ++agreed_;
  }
}

std::string OwnMotion::doubt() const {
  const int votes = frozen_ + backwards_ + agreed_;
  if (frozen_ >= kFewestVotes && 5 * frozen_ >= 4 * votes) {
    return "the lidar moves and odometry stands still: it is frozen";
  }
  if (backwards_ >= kFewestVotes && 5 * backwards_ >= 4 * votes) {
    return "the lidar moves against odometry: odometry is inverted, or the lidar's frame is turned "
           "about";
  }
  return {};
}

}  // namespace semantic_lidar_fusion

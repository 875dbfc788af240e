// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/motion/compensation.h"

#include <algorithm>
#include <cmath>
#include <deque>
#include <limits>
#include <unordered_map>
#include <utility>
#include <vector>

#include "motion_kernels.h"
#include "semantic_lidar_fusion/common/cross_matrix.h"

namespace semantic_lidar_fusion {
namespace {

/// Longest rotation that one Segment spans. Inside it transforms are linear in time, so a point is
/// off by at most (its distance from the vehicle's origin) * angle^2 / 8: 0.013 mm at 100 m.
constexpr double kSegmentAngle = 1e-3;
/// Longest duration of a Segment: times within it are 32-bit nanoseconds.
constexpr StampNs kSegmentNs = kNsPerSecond;
/// Points that are worked on together.
constexpr int kBlock = 256;

const MotionKernels& motionKernels() {
  static const MotionKernelList list = usableMotionKernels();
  return *list.kernels[list.count - 1];
}

/// T_a_b of two poses in one frame. The difference of the positions comes first, so that nothing is
/// lost to large coordinates.
Transform relative(const Transform& T_fixed_a, const Transform& T_fixed_b) {
  Transform T_a_b = Transform::Identity();
  const Eigen::Matrix3d inverse_rotation = T_fixed_a.linear().transpose();
  T_a_b.linear() = inverse_rotation * T_fixed_b.linear();
  T_a_b.translation() = inverse_rotation * (T_fixed_b.translation() - T_fixed_a.translation());
  return T_a_b;
}

/// Motion `step` (T_first_second) continued at constant twist to `fraction` times its duration: the
/// screw motion exp(fraction * log(step)).
Transform screw(const Transform& step, double fraction) {
  const Eigen::AngleAxisd rotation(step.linear());
  const double angle = rotation.angle();
  // V(phi) = I + b [axis]x + c [axis]x^2 maps the twist's linear part to the translation.
  const Eigen::Matrix3d axis = crossMatrix(rotation.axis());
  const auto integral = [&](double phi) -> Eigen::Matrix3d {
    const double b = std::abs(phi) < 1e-9 ? phi / 2.0 : (1.0 - std::cos(phi)) / phi;
    const double c = std::abs(phi) < 1e-9 ? phi * phi / 6.0 : 1.0 - std::sin(phi) / phi;
    return Eigen::Matrix3d::Identity() + b * axis + c * axis * axis;
  };
  const Eigen::Vector3d velocity = integral(angle).inverse() * step.translation();
  Transform result = Transform::Identity();
  result.linear() = Eigen::AngleAxisd(fraction * angle, rotation.axis()).toRotationMatrix();
  result.translation() = integral(fraction * angle) * (fraction * velocity);
  return result;
}

/// A span of time in which T_lidar(t_ref)_lidar(t) is linear in t. Relative to t_ref the numbers
/// are small, so that float holds them; rows of 3x4 matrices.
struct Segment {
  StampNs begin_ns = 0;
  StampNs end_ns = 0;        ///< inclusive
  LinearMotion motion = {};  ///< from begin_ns on

  bool contains(StampNs t) const { return begin_ns <= t && t <= end_ns; }
};

/// T_lidar(t_ref)_lidar(t) as a sequence of segments.
class Track {
 public:
  Track(const Transform& T_fixed_vehicle_ref, const Transform& T_vehicle_lidar)
      : T_fixed_vehicle_ref_(T_fixed_vehicle_ref),
        T_vehicle_lidar_(T_vehicle_lidar),
        T_lidar_vehicle_(T_vehicle_lidar.inverse(Eigen::Isometry)) {}

  /// The pose stands still from `begin_ns` to `end_ns`.
  void addStill(const Transform& T_fixed_vehicle, StampNs begin_ns, StampNs end_ns) {
    const Matrix34 pose = toReference(T_fixed_vehicle);
    addLinear(pose, pose, begin_ns, end_ns);
  }

  /// The vehicle moves as `pose_at(t)` says, by rotations up to `angle` in all.
  template <typename PoseAt>
  void addMoving(const PoseAt& pose_at, double angle, StampNs begin_ns, StampNs end_ns) {
    const StampNs duration = end_ns - begin_ns;
    const StampNs count = std::max({static_cast<StampNs>(std::ceil(angle / kSegmentAngle)),
                                    (duration + kSegmentNs - 1) / kSegmentNs, StampNs{1}});
    Matrix34 from = toReference(pose_at(begin_ns));
    StampNs from_ns = begin_ns;
    for (StampNs i = 1; i <= count; ++i) {
      // The remainder apart: duration * i may exceed 64 bits.
      const StampNs to_ns = begin_ns + duration / count * i + duration % count * i / count;
      const Matrix34 to = toReference(pose_at(to_ns));
      addLinear(from, to, from_ns, to_ns);
      from = to;
      from_ns = to_ns;
    }
  }

  /// The segment of a time (the first one's for earlier times, the last one's for later); fast
  /// where times ascend slowly.
  const Segment& find(StampNs t) {
    if (segments_[last_].contains(t)) return segments_[last_];
    if (last_ + 1 < segments_.size() && segments_[last_ + 1].contains(t)) {
      return segments_[++last_];
    }
    const auto after = std::upper_bound(
        segments_.begin(), segments_.end(), t,
        [](StampNs time, const Segment& segment) { return time < segment.begin_ns; });
    last_ = after == segments_.begin()
                ? 0
                : static_cast<std::size_t>(std::distance(segments_.begin(), after)) - 1;
    return segments_[last_];
  }

 private:
  using Matrix34 = Eigen::Matrix<double, 3, 4, Eigen::RowMajor>;

  /// Equation 5.
  Matrix34 toReference(const Transform& T_fixed_vehicle) const {
    const Transform T_ref_t =
        T_lidar_vehicle_ * relative(T_fixed_vehicle_ref_, T_fixed_vehicle) * T_vehicle_lidar_;
    return T_ref_t.matrix().topRows<3>();
  }

  void addLinear(const Matrix34& from, const Matrix34& to, StampNs begin_ns, StampNs end_ns) {
    Segment segment;
    segment.begin_ns = begin_ns;
    segment.end_ns = end_ns;
    const double per_ns = end_ns > begin_ns ? 1.0 / static_cast<double>(end_ns - begin_ns) : 0.0;
    for (int i = 0; i < 12; ++i) {
      segment.motion.start[i] = static_cast<float>(from.data()[i]);
      segment.motion.rate_per_ns[i] = static_cast<float>((to.data()[i] - from.data()[i]) * per_ns);
    }
    segments_.push_back(segment);
  }

  Transform T_fixed_vehicle_ref_;
  Transform T_vehicle_lidar_;
  Transform T_lidar_vehicle_;
  std::vector<Segment> segments_;
  std::size_t last_ = 0;
};

double angleBetween(const Transform& a, const Transform& b) {
  return Eigen::Quaterniond(a.linear()).angularDistance(Eigen::Quaterniond(b.linear()));
}

/// The readings that belong together with the pose at t_ref.
class Readings {
 public:
  Readings(const PoseBuffer& odometry, StampNs around_ns)
      : all_(odometry.readings()), stretch_(odometry.stretchAround(around_ns)) {}

  std::size_t size() const { return stretch_.end - stretch_.begin; }
  bool empty() const { return size() == 0; }
  const StampedPose& operator[](std::size_t i) const { return all_[stretch_.begin + i]; }
  const StampedPose& front() const { return (*this)[0]; }
  const StampedPose& back() const { return (*this)[size() - 1]; }
  /// The first one at or after `t`; size() if there is none.
  std::size_t atOrAfter(StampNs t) const {
    const auto first = all_.begin() + static_cast<std::ptrdiff_t>(stretch_.begin);
    const auto end = all_.begin() + static_cast<std::ptrdiff_t>(stretch_.end);
    const auto found = std::lower_bound(
        first, end, t,
        [](const StampedPose& reading, StampNs time) { return reading.stamp < time; });
    return static_cast<std::size_t>(found - first);
  }

 private:
  const std::deque<StampedPose>& all_;
  PoseBuffer::Stretch stretch_;
};

/// What becomes of a firing's points.
enum class Fate : std::uint8_t { kMove, kMark, kDrop };

struct Plan {
  std::vector<StampNs> packet_times;  ///< of each firing; empty: each point's own time counts
  std::vector<Fate> fates;            ///< of each firing
  std::vector<bool> uncovered;        ///< for each firing, whether odometry leaves it out
  std::size_t uncovered_count = 0;
  StampNs first_ns = std::numeric_limits<StampNs>::max();  ///< times of the poses that are needed,
  StampNs last_ns = std::numeric_limits<StampNs>::min();   ///< none if first > last
};

/// For each firing the time of its packet's first firing.
std::vector<StampNs> packetTimes(const std::vector<Firing>& firings,
                                 const std::vector<StampNs>& packet_begin_ns) {
  if (!packet_begin_ns.empty()) {
    std::vector<StampNs> times;
    times.reserve(firings.size());
    for (const Firing& firing : firings) times.push_back(packet_begin_ns.at(firing.packet));
    return times;
  }
  std::unordered_map<std::uint32_t, StampNs> first_of_packet;
  for (const Firing& firing : firings) {
    const auto entry = first_of_packet.emplace(firing.packet, firing.begin_ns).first;
    entry->second = std::min(entry->second, firing.begin_ns);
  }
  std::vector<StampNs> times;
  times.reserve(firings.size());
  for (const Firing& firing : firings) times.push_back(first_of_packet.at(firing.packet));
  return times;
}

Fate fateOfUncovered(StampNs begin_ns, StampNs end_ns, const Readings& readings,
                     const CompensationConfig& config) {
  switch (config.on_missing) {
    case OnMissingOdometry::kDrop:
      return Fate::kDrop;
    case OnMissingOdometry::kHold:
      return readings.empty() ? Fate::kMark : Fate::kMove;
    case OnMissingOdometry::kExtrapolate:
      return readings.size() >= 2 &&
                     begin_ns >= readings.front().stamp - config.max_extrapolation_ns &&
                     end_ns <= readings.back().stamp + config.max_extrapolation_ns
                 ? Fate::kMove
                 : Fate::kMark;
    case OnMissingOdometry::kMark:
      break;
  }
  return Fate::kMark;
}

Plan makePlan(const TimedCloud& scan, const Readings& readings, bool reference_covered,
              const CompensationConfig& config) {
  const std::vector<Firing>& firings = scan.firings;
  Plan plan;
  const bool by_packet = config.granularity == MotionGranularity::kPacket;
  if (by_packet) plan.packet_times = packetTimes(firings, scan.packet_begin_ns);
  plan.fates.assign(firings.size(), Fate::kMove);
  plan.uncovered.assign(firings.size(), false);
  const StampNs covered_from = readings.empty() ? 1 : readings.front().stamp;
  const StampNs covered_to = readings.empty() ? 0 : readings.back().stamp;
  for (std::size_t k = 0; k < firings.size(); ++k) {
    const StampNs begin = by_packet ? plan.packet_times[k] : firings[k].begin_ns;
    const StampNs end = by_packet ? begin : firings[k].end_ns;
    if (begin < covered_from || end > covered_to) {
      plan.uncovered[k] = true;
      ++plan.uncovered_count;
      plan.fates[k] = fateOfUncovered(begin, end, readings, config);
    }
    // Without the pose at t_ref no firing has one relative to it, whatever becomes of single ones.
    if (!reference_covered) plan.fates[k] = Fate::kMark;
    if (plan.fates[k] != Fate::kMove) continue;
    plan.first_ns = std::min(plan.first_ns, begin);
    plan.last_ns = std::max(plan.last_ns, end);
  }
  return plan;
}

/// The pose at a time outside of the readings: that of the nearest one, or, with two readings and
/// kExtrapolate, at the constant twist of the nearest two.
class Outside {
 public:
  Outside(const Readings& readings, bool before, const CompensationConfig& config)
      : edge_(before ? readings.front() : readings.back()),
        twist_(config.on_missing == OnMissingOdometry::kExtrapolate && readings.size() >= 2) {
    if (!twist_) return;
    const StampedPose& inner = before ? readings[1] : readings[readings.size() - 2];
    step_ = relative(inner.T_fixed_vehicle, edge_.T_fixed_vehicle);
    step_ns_ = static_cast<double>(edge_.stamp - inner.stamp);  // negative before
    angle_ = angleBetween(inner.T_fixed_vehicle, edge_.T_fixed_vehicle);
  }

  Transform at(StampNs t) const {
    if (!twist_) return edge_.T_fixed_vehicle;
    return edge_.T_fixed_vehicle * screw(step_, static_cast<double>(t - edge_.stamp) / step_ns_);
  }

  void addTo(Track* track, StampNs begin, StampNs end) const {
    if (!twist_) {
      track->addStill(edge_.T_fixed_vehicle, begin, end);
      return;
    }
    const double angle = angle_ * static_cast<double>(end - begin) / std::abs(step_ns_);
    track->addMoving([this](StampNs t) -> Transform { return at(t); }, angle, begin, end);
  }

 private:
  const StampedPose& edge_;
  bool twist_;
  Transform step_ = Transform::Identity();
  double step_ns_ = 1.0;
  double angle_ = 0.0;
};

Track makeTrack(const Readings& readings, const Transform& T_fixed_vehicle_ref,
                const Transform& T_vehicle_lidar, const CompensationConfig& config,
                const Plan& plan) {
  const StampNs first = plan.first_ns;
  const StampNs last = plan.last_ns;
  Track track(T_fixed_vehicle_ref, T_vehicle_lidar);
  const StampedPose& front = readings.front();
  const StampedPose& back = readings.back();
  if (first < front.stamp) {
    Outside(readings, true, config).addTo(&track, first, std::min(last, front.stamp));
  }
  // From the last reading before the first time on.
  const std::size_t from = readings.atOrAfter(first);
  const std::size_t start = from == 0 ? 0 : from - 1;
  if (config.lookup == OdometryLookup::kClosest) {
    for (std::size_t i = start; i < readings.size(); ++i) {
      // Half-way belongs to the earlier reading.
      const StampNs begin =
          i == 0 ? front.stamp
                 : readings[i - 1].stamp + (readings[i].stamp - readings[i - 1].stamp) / 2 + 1;
      const StampNs end = i + 1 == readings.size()
                              ? back.stamp
                              : readings[i].stamp + (readings[i + 1].stamp - readings[i].stamp) / 2;
      if (end < first) continue;
      if (begin > last) break;
      track.addStill(readings[i].T_fixed_vehicle, begin, end);
    }
  } else {
    for (std::size_t i = start; i < readings.size() && readings[i].stamp <= last; ++i) {
      const StampedPose& a = readings[i];
      const StampedPose& b = readings[std::min(i + 1, readings.size() - 1)];
      const StampNs begin = std::max(a.stamp, first);
      const StampNs end = std::min(b.stamp, last);
      if (begin > end) continue;
      if (a.stamp == b.stamp) {
        track.addStill(a.T_fixed_vehicle, begin, end);
        continue;
      }
      const double duration = static_cast<double>(b.stamp - a.stamp);
      const double angle = angleBetween(a.T_fixed_vehicle, b.T_fixed_vehicle) *
                           static_cast<double>(end - begin) / duration;
      track.addMoving(
          [&](StampNs t) {
            return interpolate(a.T_fixed_vehicle, b.T_fixed_vehicle,
                               static_cast<double>(t - a.stamp) / duration);
          },
          angle, begin, end);
    }
  }
  if (last > back.stamp) {
    Outside(readings, false, config).addTo(&track, std::max(first, back.stamp), last);
  }
  return track;
}

/// Moves the points from `begin` on, each at its own time, as far as the segment of the first one
/// reaches; returns where it ends.
std::size_t moveByTime(const std::vector<StampNs>& times, std::size_t begin, std::size_t end,
                       const Segment& segment, Cloud* cloud) {
  // A segment longer than kSegmentNs stands still: any of its times will do.
  const auto length = static_cast<std::uint32_t>(
      std::min<StampNs>(segment.end_ns - segment.begin_ns, std::numeric_limits<int>::max()));
  float ns[kBlock];
  int wanted = 0, within = 0;
  std::size_t at = begin;
  do {
    wanted = static_cast<int>(std::min<std::size_t>(kBlock, end - at));
    within = motionKernels().timesWithin(&times[at], wanted, segment.begin_ns, length, ns);
    // A point out of its firing's time takes the segment that is nearest.
    if (at == begin) within = std::max(within, 1);
    motionKernels().move(segment.motion, ns, within, &cloud->x[at], &cloud->y[at], &cloud->z[at]);
    at += static_cast<std::size_t>(within);
  } while (within == wanted && at < end);
  return at;
}

/// Moves points [begin, end) at one time, in `segment`.
void moveAt(StampNs time, std::size_t begin, std::size_t end, const Segment& segment,
            Cloud* cloud) {
  LinearMotion still = segment.motion;
  const float ns = static_cast<float>(time - segment.begin_ns);
  for (int k = 0; k < 12; ++k) {
    still.start[k] += ns * still.rate_per_ns[k];
    still.rate_per_ns[k] = 0.0f;
  }
  const float zeros[kBlock] = {};
  for (std::size_t at = begin; at < end; at += kBlock) {
    motionKernels().move(still, zeros, static_cast<int>(std::min<std::size_t>(kBlock, end - at)),
                         &cloud->x[at], &cloud->y[at], &cloud->z[at]);
  }
}

void moveAll(const std::vector<StampNs>& times, const std::vector<std::uint32_t>& firing,
             const Plan& plan, Track* track, Cloud* cloud) {
  const bool by_packet = !plan.packet_times.empty();
  const bool all_move = std::all_of(plan.fates.begin(), plan.fates.end(),
                                    [](Fate fate) { return fate == Fate::kMove; });
  const auto moves = [&](std::size_t i) {
    return all_move || plan.fates[firing[i]] == Fate::kMove;
  };
  const std::size_t count = times.size();
  for (std::size_t i = 0; i < count;) {
    if (!moves(i)) {
      ++i;
      continue;
    }
    std::size_t end = i + 1;
    if (by_packet) {
      const StampNs time = plan.packet_times[firing[i]];
      while (end < count && plan.packet_times[firing[end]] == time && moves(end)) ++end;
      moveAt(time, i, end, track->find(time), cloud);
      i = end;
    } else {
      if (all_move) end = count;
      while (end < count && moves(end)) ++end;
      while (i < end) i = moveByTime(times, i, end, track->find(times[i]), cloud);
    }
  }
}

/// Sets the status of points that do not move, and counts.
void markAndCount(const std::vector<std::uint32_t>& firings, const Plan& plan,
                  const CompensationConfig& config, CompensationResult* result) {
  CompensationCounters& counters = result->counters;
  for (std::size_t i = 0; i < firings.size(); ++i) {
    const std::uint32_t firing = firings[i];
    if (plan.fates[firing] == Fate::kMark) {
      result->cloud.status[i] = static_cast<std::uint8_t>(PointStatus::kNoOdometry);
      ++counters.marked_points;
    } else if (plan.fates[firing] == Fate::kDrop) {
      ++counters.dropped_points;
    } else if (plan.uncovered[firing]) {
      ++(config.on_missing == OnMissingOdometry::kHold ? counters.held_points
                                                       : counters.extrapolated_points);
    }
  }
}

void removeDropped(const std::vector<std::uint32_t>& firings, const std::vector<Fate>& fates,
                   Cloud* cloud) {
  std::size_t kept = 0;
  for (std::size_t i = 0; i < firings.size(); ++i) {
    if (fates[firings[i]] == Fate::kDrop) continue;
    cloud->x[kept] = cloud->x[i];
    cloud->y[kept] = cloud->y[i];
    cloud->z[kept] = cloud->z[i];
    cloud->intensity[kept] = cloud->intensity[i];
    cloud->ring[kept] = cloud->ring[i];
    cloud->dt[kept] = cloud->dt[i];
    cloud->status[kept] = cloud->status[i];
    ++kept;
  }
  cloud->resize(kept);
}

/// time - reference in s.
std::vector<float> secondsSince(StampNs reference_ns, const std::vector<StampNs>& times,
                                const ScanInterval& span) {
  std::vector<float> seconds(times.size());
  constexpr StampNs kNear = std::numeric_limits<std::int32_t>::max();
  if (span.first_ns >= reference_ns - kNear && span.last_ns <= reference_ns + kNear) {
    motionKernels().secondsSince(reference_ns, times.data(), static_cast<int>(times.size()),
                                 seconds.data());
  } else {
    for (std::size_t i = 0; i < times.size(); ++i) {
      seconds[i] = static_cast<float>(toSeconds(times[i] - reference_ns));
    }
  }
  return seconds;
}

/// The scan as a rigid cloud whose points do not move; takes over its arrays.
Cloud asMeasured(TimedCloud* scan, StampNs reference_ns) {
  const ScanInterval span = scanInterval(*scan);
  Cloud cloud;
  cloud.frame_id = scan->frame_id;
  cloud.stamp = scan->empty() ? scan->header_stamp : reference_ns;
  cloud.first_point_ns = span.first_ns;
  cloud.dt = secondsSince(reference_ns, scan->time_ns, span);
  cloud.status.assign(scan->size(), static_cast<std::uint8_t>(PointStatus::kFused));
  cloud.x = std::move(scan->x);
  cloud.y = std::move(scan->y);
  cloud.z = std::move(scan->z);
  cloud.intensity = std::move(scan->intensity);
  cloud.ring = std::move(scan->ring);
  return cloud;
}

/// The pose at `t`, which need not be the time of a point: interpolated, or as `on_missing` has it.
std::optional<Transform> poseAt(const PoseBuffer& odometry, StampNs t,
                                const CompensationConfig& config) {
  if (const std::optional<Transform> pose = odometry.lookup(t)) return pose;
  const Readings readings(odometry, t);
  if (readings.empty() || fateOfUncovered(t, t, readings, config) != Fate::kMove) {
    return std::nullopt;
  }
  return Outside(readings, t < readings.front().stamp, config).at(t);
}

}  // namespace

CompensationResult compensate(TimedCloud scan, StampNs reference_ns, const PoseBuffer& odometry,
                              const Transform& T_vehicle_lidar, const CompensationConfig& config) {
  CompensationResult result;
  result.cloud = asMeasured(&scan, reference_ns);
  if (!config.enabled || result.cloud.empty()) return result;

  const std::optional<Transform> T_fixed_vehicle_ref = poseAt(odometry, reference_ns, config);
  result.counters.reference_covered = T_fixed_vehicle_ref.has_value();

  const Readings readings(odometry, reference_ns);
  const Plan plan = makePlan(scan, readings, result.counters.reference_covered, config);
  result.counters.uncovered_firings = plan.uncovered_count;
  if (plan.first_ns <= plan.last_ns) {
    Track track = makeTrack(readings, *T_fixed_vehicle_ref, T_vehicle_lidar, config, plan);
    moveAll(scan.time_ns, scan.firing, plan, &track, &result.cloud);
  }
  if (plan.uncovered_count > 0 || !result.counters.reference_covered) {
    markAndCount(scan.firing, plan, config, &result);
    if (result.counters.dropped_points > 0) removeDropped(scan.firing, plan.fates, &result.cloud);
  }
  return result;
}

std::optional<Transform> vehicleMotion(const PoseBuffer& odometry, StampNs from_ns, StampNs to_ns,
                                       const CompensationConfig& config) {
  if (!(odometry.stretchAround(from_ns) == odometry.stretchAround(to_ns))) return std::nullopt;
  const std::optional<Transform> T_fixed_from = poseAt(odometry, from_ns, config);
  const std::optional<Transform> T_fixed_to = poseAt(odometry, to_ns, config);
  if (!T_fixed_from || !T_fixed_to) return std::nullopt;
  return relative(*T_fixed_to, *T_fixed_from);
}

}  // namespace semantic_lidar_fusion

# SPDX-License-Identifier: MIT
"""The chain once more, slowly and point by point, from the equations and the interface's rules.

Nothing here is shared with the package. Points are (n, 3) in m, times integer ns (true unless named
raw), angles rad, transforms 4x4 named T_target_source. `config` arguments are parts of the rig
file's tree.
"""
import dataclasses
import math
import struct
from typing import Any, Dict, List, Optional, Tuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

FUSED, OCCLUDED, OUTSIDE, NO_IMAGE, NO_ODOMETRY = range(5)
PRECEDENCE = {FUSED: 0, OCCLUDED: 1, NO_IMAGE: 2, OUTSIDE: 3}

# Velodyne's manuals: elevation of each laser in the order of the data; VLP-32C: azimuth offset too.
VLP16_DEG = [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]
HI_RES_DEG = [(-10 if i % 2 == 0 else 2 / 3) + i // 2 * 4 / 3 for i in range(16)]
HDL32E_DEG = [-30.67, -9.33, -29.33, -8, -28, -6.67, -26.67, -5.33, -25.33, -4, -24, -2.67]
HDL32E_DEG += [-22.67, -1.33, -21.33, 0, -20, 1.33, -18.67, 2.67, -17.33, 4, -16, 5.33, -14.67]
HDL32E_DEG += [6.67, -13.33, 8, -12, 9.33, -10.67, 10.67]
VLP32C_DEG = [-25, -1, -1.667, -15.639, -11.31, 0, -0.667, -8.843, -7.254, 0.333, -0.333, -6.148]
VLP32C_DEG += [-5.333, 1.333, 0.667, -4, -4.667, 1.667, 1, -3.667, -3.333, 3.333, 2.333, -2.667]
VLP32C_DEG += [-3, 7, 4.667, -2.333, -2, 15, 10.333, -1.333]
VLP32C_AZIMUTH_DEG = [1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4]
VLP32C_AZIMUTH_DEG += [4.2, -1.4, 1.4, -4.2, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4, 1.4, -1.4, 1.4, -4.2]
VLP32C_AZIMUTH_DEG += [4.2, -1.4, 1.4, -1.4]


@dataclasses.dataclass
class Lidar:
    """`lasers_at_once` fire together, one group every `laser_ns`."""

    factory: int
    elevation_deg: List[float]
    unit_m: float
    firing_ns: int
    laser_ns: int
    lasers_at_once: int = 1
    azimuth_deg: Optional[List[float]] = None

    @property
    def firings_per_block(self) -> int:
        return 32 // len(self.elevation_deg)


LIDARS = {
    "VLP16": Lidar(0x22, VLP16_DEG, 0.002, 55296, 2304),
    "PuckHiRes": Lidar(0x24, HI_RES_DEG, 0.002, 55296, 2304),
    "VLP32C": Lidar(0x28, VLP32C_DEG, 0.004, 55296, 2304, 2, VLP32C_AZIMUTH_DEG),
    "HDL32E": Lidar(0x21, HDL32E_DEG, 0.002, 46080, 1152),
}


@dataclasses.dataclass
class Scan:
    """Points as measured. `firing`, `packet`: what shares a pose at each granularity."""

    xyz: np.ndarray
    intensity: np.ndarray
    ring: np.ndarray
    time_ns: np.ndarray
    firing: np.ndarray
    packet: np.ndarray
    packet_begin_ns: Dict[int, int]  # of its first firing, whether it returned anything or not

    @property
    def first_ns(self) -> int:
        return int(self.time_ns.min())

    @property
    def last_ns(self) -> int:
        return int(self.time_ns.max())


def within_limits(range_m: float, config: Dict[str, Any]) -> bool:
    most = config.get("max_range_m", 0)
    return range_m >= config.get("min_range_m", 0) and (not most or range_m <= most)


def decode_packets(packets: List[Tuple[int, bytes]], name: str, config: Dict[str, Any]) -> Scan:
    """(raw stamp, bytes) of one scan's packets in any order, perhaps repeated."""
    lidar, offset_ns = LIDARS[name], round(config.get("time_offset", 0) * 1e9)
    lasers, firings = len(lidar.elevation_deg), lidar.firings_per_block
    ring_of = np.argsort(np.argsort(lidar.elevation_deg))
    heights = config.get("vertical_offsets_m") or [0.0] * lasers
    rows, begins = [], {}
    for number, (stamp, data) in enumerate(sorted(set(packets))):
        blocks = 2 if data[1204] == 0x39 else 1  # that tell the same firings
        slots, slot_ns = 12 // blocks, firings * lidar.firing_ns
        early = {"start": 0, "middle": slots * slot_ns // 2, "end": slots * slot_ns}
        start = stamp + offset_ns - early[config.get("packet_stamp", "start")]
        begins[number] = start
        azimuths = [struct.unpack_from("<H", data, 100 * s * blocks + 2)[0] for s in range(slots)]
        for s in range(slots):
            if s + 1 < slots:  # the last one keeps the difference before
                turn = (azimuths[s + 1] - azimuths[s] + 18000) % 36000 - 18000
            for b in range(blocks):
                for k in range(32):
                    at = 100 * (s * blocks + b) + 4 + 3 * k
                    raw, intensity = struct.unpack_from("<HB", data, at)
                    if raw == 0 or (b == 1 and data[at : at + 3] == data[at - 100 : at - 97]):
                        continue
                    f, laser = divmod(k, lasers)
                    in_slot = f * lidar.firing_ns + laser // lidar.lasers_at_once * lidar.laser_ns
                    azimuth_deg = (azimuths[s] + turn * in_slot / slot_ns) / 100
                    if lidar.azimuth_deg:
                        azimuth_deg += lidar.azimuth_deg[laser]
                    az, el = math.radians(azimuth_deg), math.radians(lidar.elevation_deg[laser])
                    d = raw * lidar.unit_m
                    if not within_limits(d, config):
                        continue
                    xyz = (
                        d * math.cos(el) * math.cos(az),
                        -d * math.cos(el) * math.sin(az),
                        d * math.sin(el) + heights[ring_of[laser]],
                    )
                    time = start + s * slot_ns + in_slot
                    firing = (number * slots + s) * firings + f
                    rows.append((xyz, intensity, ring_of[laser], time, firing, number))
    xyz, intensity, ring, time, firing, packet = zip(*rows)
    return Scan(*map(np.array, (xyz, intensity, ring, time, firing, packet)), begins)


class Odometry:
    """Readings T_fixed_vehicle at true times."""

    def __init__(self, times_ns: List[int], poses: List[np.ndarray]):
        self.times, self.poses = np.array(times_ns, np.int64), poses

    def covers(self, t: int) -> bool:
        return bool(self.times[0] <= t <= self.times[-1])

    def at(self, t: int) -> np.ndarray:
        """Linear and slerp between the readings around t."""
        i = int(np.searchsorted(self.times, t))
        if self.times[i] == t:
            return self.poses[i]
        a, b = self.poses[i - 1], self.poses[i]
        part = (t - int(self.times[i - 1])) / (int(self.times[i]) - int(self.times[i - 1]))
        result = np.eye(4)
        rotations = Rotation.from_matrix(np.stack([a[:3, :3], b[:3, :3]]))
        result[:3, :3] = Slerp([0.0, 1.0], rotations)([part]).as_matrix()[0]
        result[:3, 3] = a[:3, 3] + part * (b[:3, 3] - a[:3, 3])
        return result

    def nearest(self, t: int) -> np.ndarray:
        """Of two the earlier."""
        return self.poses[int(np.argmin(np.abs(self.times - t)))]

    def pose(self, t: int, on_missing: str) -> Optional[np.ndarray]:
        """Of t_ref and of an image."""
        if self.covers(t):
            return self.at(t)
        return self.nearest(t) if on_missing == "hold" else None


def between(T_fixed_a: np.ndarray, T_fixed_b: np.ndarray) -> np.ndarray:
    """T_a_b, without losing digits to large coordinates."""
    result = np.eye(4)
    result[:3, :3] = T_fixed_a[:3, :3].T @ T_fixed_b[:3, :3]
    result[:3, 3] = T_fixed_a[:3, :3].T @ (T_fixed_b[:3, 3] - T_fixed_a[:3, 3])
    return result


def moved(T: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    return xyz @ T[:3, :3].T + T[:3, 3]


def compensate(
    scan: Scan, t_ref: int, odometry: Odometry, T_vehicle_lidar: np.ndarray, rig: Dict[str, Any]
) -> Tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Equation 5: points, status, and which points come out (not those that on_missing drops)."""
    xyz, n = scan.xyz.copy(), len(scan.xyz)
    status, comes_out = np.zeros(n, int), np.ones(n, bool)
    if not rig["motion"]["enabled"]:
        return xyz, status, comes_out
    pose_ref = odometry.pose(t_ref, rig["odometry"]["on_missing"])
    if pose_ref is None:
        return xyz, np.full(n, NO_ODOMETRY), comes_out
    T_lidar_vehicle, config = np.linalg.inv(T_vehicle_lidar), rig["odometry"]
    by_packet = rig["motion"]["granularity"] == "packet"
    for firing in np.unique(scan.firing):
        members = np.flatnonzero(scan.firing == firing)
        ends = (int(scan.time_ns[members].min()), int(scan.time_ns[members].max()))
        if by_packet:
            ends = (scan.packet_begin_ns[scan.packet[members[0]]],)
        covered = all(odometry.covers(t) for t in ends)
        if not covered and config["on_missing"] == "mark":
            status[members] = NO_ODOMETRY
            continue
        if not covered and config["on_missing"] == "drop":
            comes_out[members] = False
            continue
        for i in members:
            t = scan.packet_begin_ns[scan.packet[i]] if by_packet else int(scan.time_ns[i])
            if config["lookup"] == "closest" or not odometry.covers(t):
                pose = odometry.nearest(t)
            else:
                pose = odometry.at(t)
            T = T_lidar_vehicle @ between(pose_ref, pose) @ T_vehicle_lidar
            xyz[i] = moved(T, scan.xyz[i])
    return xyz, status, comes_out


@dataclasses.dataclass
class Projection:
    """`valid`: the model has a pixel for the point, in the image or not."""

    uv: np.ndarray
    valid: np.ndarray
    theta: np.ndarray
    distance: np.ndarray
    size: Tuple[int, int]
    focal: Tuple[float, float]

    def inside(self) -> np.ndarray:
        width, height = self.size
        u, v = self.uv.T
        return self.valid & (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)

    def pixels(self) -> np.ndarray:
        """Columns and rows, 0 outside."""
        inside = self.inside()[:, None]
        return np.where(inside, np.floor(np.where(inside, self.uv, 0) + 0.5), 0).astype(int)


def first_positive_root(coefficients: List[float]) -> float:
    roots = np.roots(coefficients)
    positive = [r.real for r in roots if abs(r.imag) < 1e-9 and r.real > 0]
    return min(positive) if positive else math.inf


def project(info: Any, config: Dict[str, Any], xyz: np.ndarray) -> Projection:
    """Points in the camera's frame through a sensor_msgs/CameraInfo (R = 1); equations 6 to 11."""
    x, y, z = xyz.T
    widest = math.radians(config.get("max_theta_deg", 0)) or math.pi
    with np.errstate(all="ignore"):
        if config.get("rectified"):
            p = np.array(info.P).reshape(3, 4)
            u, v, w = p @ np.vstack([xyz.T, np.ones(len(xyz))])
            u, v = u / w, v / w
            ray = xyz + [p[0, 3] / p[0, 0], p[1, 3] / p[1, 1], 0.0]
            theta = np.arctan2(np.hypot(ray[:, 0], ray[:, 1]), ray[:, 2])
            valid, distance, focal = z > 0, np.linalg.norm(ray, axis=1), (p[0, 0], p[1, 1])
        else:
            k, d = np.array(info.K).reshape(3, 3), list(info.D) + [0.0] * (8 - len(info.D))
            r, distance, focal, skew = (
                np.hypot(x, y),
                np.linalg.norm(xyz, axis=1),
                k[[0, 1], [0, 1]],
                0,
            )
            theta = np.arctan2(r, z)
            if info.distortion_model in ("equidistant", "fisheye"):
                skew, t = k[0, 1] / k[0, 0], theta
                bent = t * (1 + d[0] * t**2 + d[1] * t**4 + d[2] * t**6 + d[3] * t**8)
                fold = [9 * d[3], 0, 7 * d[2], 0, 5 * d[1], 0, 3 * d[0], 0, 1]
                valid = (theta <= first_positive_root(fold)) & ((r > 0) | (z > 0))
                a, b = np.where(r > 0, x / r, 0) * bent, np.where(r > 0, y / r, 0) * bent
            else:
                k1, k2, p1, p2, k3, k4, k5, k6 = d
                a, b = x / z, y / z
                top, bottom = np.poly1d([k3, 0, k2, 0, k1, 0, 1]), np.poly1d(
                    [k6, 0, k5, 0, k4, 0, 1]
                )
                along = np.poly1d([1, 0]) * top
                slope = along.deriv() * bottom - along * bottom.deriv()
                limit = min(first_positive_root(slope.coeffs), first_positive_root(bottom.coeffs))
                s = a**2 + b**2
                valid = (z > 0) & (np.sqrt(s) <= limit)
                radial = top(np.sqrt(s)) / bottom(np.sqrt(s))
                a, b = (
                    a * radial + 2 * p1 * a * b + p2 * (s + 2 * a**2),
                    b * radial + p1 * (s + 2 * b**2) + 2 * p2 * a * b,
                )
            u, v = k[0, 0] * (a + skew * b) + k[0, 2], k[1, 1] * b + k[1, 2]
    bin_x, bin_y = max(1, info.binning_x), max(1, info.binning_y)
    whole = not (info.roi.width or info.roi.height)
    size = (
        (info.width if whole else info.roi.width) // bin_x,
        (info.height if whole else info.roi.height) // bin_y,
    )
    uv = np.stack([(u - info.roi.x_offset) / bin_x, (v - info.roi.y_offset) / bin_y], axis=1)
    valid = valid & (theta <= widest)
    return Projection(uv, valid, theta, distance, size, (focal[0] / bin_x, focal[1] / bin_y))


def cells(count: int, target: int) -> np.ndarray:
    """Cell of `target` under the centre of each of `count`."""
    return (2 * np.arange(count) + 1) * target // (2 * count)


def resampled(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """The cell of `image` under each pixel of another size."""
    return image[cells(height, image.shape[0])][:, cells(width, image.shape[1])]


def odd_mask(focal: float, step_deg: float) -> int:
    """Equation 14 in odd pixels."""
    gap = focal * math.tan(math.radians(step_deg))
    up = math.ceil(gap)
    return max(1, min(up + (up + 1) % 2, 2 * math.floor(gap) - 1))


def visible_paper(
    seen: Projection, config: Dict[str, Any], shift: Tuple[float, float]
) -> np.ndarray:
    """Nearest first; a visible point hides what lies on its mask. `shift` moves the pixels."""
    width, height = seen.size
    half_u = (odd_mask(seen.focal[0], config["horizontal_step_deg"]) - 1) // 2
    half_v = (odd_mask(seen.focal[1], config["vertical_step_deg"]) - 1) // 2
    moved_by = dataclasses.replace(seen, uv=seen.uv + shift)
    pixels, distance = moved_by.pixels(), seen.distance.astype(np.float32)
    masked, visible = np.zeros((height, width), bool), np.zeros(len(pixels), bool)
    for i in sorted(np.flatnonzero(moved_by.inside()), key=lambda k: (distance[k], k)):
        u, v = pixels[i]
        if not masked[v, u]:
            visible[i] = True
            masked[max(0, v - half_v) : v + half_v + 1, max(0, u - half_u) : u + half_u + 1] = True
    return visible


def histogram(ids: np.ndarray, labels: np.ndarray, classes: int) -> np.ndarray:
    """Votes (superpixels, classes); labels outside the classes have none."""
    votes = np.zeros((ids.max() + 1, classes))
    known = (labels >= 0) & (labels < classes)
    np.add.at(votes, (ids[known], labels[known]), 1)
    return votes


def shares(ids: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """spp_k of each pixel of a superpixel map, from the scores (f64) under its pixels."""
    finite = np.isfinite(scores).all(axis=-1)
    labels = np.where(finite, np.argmax(np.where(finite[..., None], scores, 0), axis=-1), -1)
    votes = histogram(ids, labels, scores.shape[-1])
    total = votes.sum(axis=1)
    return np.where(total > 0, votes.max(axis=1) / np.maximum(total, 1), 1.0)[ids]


def tempered(scores: np.ndarray, share: np.ndarray, config: Dict[str, Any]) -> np.ndarray:
    """Equations 3 and 4; uniform where a score is not finite."""
    finite = np.isfinite(scores).all(axis=-1, keepdims=True)
    tau = config.get("temperature", 1.0) / share[..., None] ** config.get("exponent", 2.0)
    s = np.where(finite, scores, 0.0) / tau
    p = np.exp(s - s.max(axis=-1, keepdims=True))
    return np.where(finite, p / p.sum(axis=-1, keepdims=True), 1.0 / scores.shape[-1])


def label_distribution(ids: np.ndarray, labels: np.ndarray, classes: int) -> np.ndarray:
    """P of label-only input: the histogram of the pixel's superpixel, uniform without votes."""
    votes = histogram(ids, labels, classes)
    total = votes.sum(axis=1, keepdims=True)
    return np.where(total > 0, votes / np.maximum(total, 1), 1.0 / classes)[ids]


@dataclasses.dataclass
class Vote:
    """What one camera says of one point."""

    bit: int
    p: np.ndarray
    time_difference_ns: int
    theta: float


def merged(votes: List[Vote], rule: str) -> Tuple[np.ndarray, int]:
    """Distribution and bits of the contributors."""
    if rule == "nearest_in_time":
        least = min(v.time_difference_ns for v in votes)
        votes = [v for v in votes if v.time_difference_ns == least]
    if rule == "most_central":
        votes = [min(votes, key=lambda v: v.theta)]
    bits = sum(1 << v.bit for v in votes)
    if rule in ("product", "geometric_mean") and len(votes) > 1:
        with np.errstate(divide="ignore"):
            logs = sum(np.log(v.p) for v in votes)
        if rule == "geometric_mean":
            logs = logs / len(votes)
        if np.isfinite(logs.max()):  # else they contradict each other fully: the mean
            p = np.exp(logs - logs.max())
            return p / p.sum(), bits
    return sum(v.p for v in votes) / len(votes), bits

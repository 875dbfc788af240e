# SPDX-License-Identifier: MIT
"""The sampled scans as geometry: points in the vehicle's frame, the ground, the edges for a camera."""

import dataclasses
from typing import Dict, List, Optional, Tuple

import numpy as np

from semantic_lidar_fusion.bags.poses import PoseSeries, invert, transform_points
from semantic_lidar_fusion.rigcheck import alignment
from semantic_lidar_fusion.rigcheck.alignment import View
from semantic_lidar_fusion.rigcheck.sample import CameraSample, Sample, Scan, vehicle_twist

GROUND_RANGE_M = 20.0
GROUND_BIN_M = 0.1


def xyz(points: np.ndarray) -> np.ndarray:
    """(N, 3) float64."""
    return np.stack([points["x"], points["y"], points["z"]], axis=1).astype(float)


def compensated(
    points: np.ndarray,
    times_ns: np.ndarray,
    T_vehicle_lidar: np.ndarray,
    odometry: PoseSeries,
    at_ns: int,
) -> Tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) in the vehicle's frame at `at_ns`, and which of them odometry covers (N,) bool.
    Without any odometry the vehicle is taken to stand still."""
    in_vehicle = transform_points(T_vehicle_lidar, points)
    if not len(odometry):
        return in_vehicle, np.ones(len(points), dtype=bool)
    # One pose a millisecond: the vehicle moves less than 2 cm between them.
    ticks, which = np.unique(times_ns // 1_000_000, return_inverse=True)
    poses, covered = odometry.lookup(ticks * 1_000_000 + 500_000)
    here, known = odometry.lookup(np.array([at_ns]))
    if not known[0]:
        return in_vehicle, np.zeros(len(points), dtype=bool)
    relative = invert(here[0]) @ poses
    relative[~covered] = np.eye(4)
    r, t = relative[which, :3, :3], relative[which, :3, 3]
    return np.einsum("nij,nj->ni", r, in_vehicle) + t, covered[which]


@dataclasses.dataclass(frozen=True)
class Ground:
    """The fullest horizontal plane near the vehicle. height_m: in the vehicle's frame; share: of the
    points within GROUND_RANGE_M that lie on it."""

    height_m: float
    share: float


def ground_of(points_vehicle: np.ndarray) -> Optional[Ground]:
    """None if there are too few points near by."""
    near = np.hypot(points_vehicle[:, 0], points_vehicle[:, 1]) < GROUND_RANGE_M
    z = points_vehicle[near & np.isfinite(points_vehicle).all(axis=1), 2]
    if len(z) < 200:
        return None
    edges = np.arange(-8.0, 8.0 + GROUND_BIN_M, GROUND_BIN_M)
    counts = np.histogram(z, edges)[0].astype(float)
    smooth = np.convolve(counts, [0.5, 1.0, 0.5], mode="same")
    k = int(np.argmax(smooth))
    inside = (z > edges[k] - GROUND_BIN_M) & (z < edges[k + 1] + GROUND_BIN_M)
    if not inside.any():
        return None
    return Ground(float(np.median(z[inside])), float(inside.mean()))


@dataclasses.dataclass
class Edges:
    """The edges of one scan, computed once for all cameras. points (E, 3) in the lidar's frame at
    each one's own time (times_ns), m."""

    scan: Scan
    points: np.ndarray
    weights: np.ndarray
    times_ns: np.ndarray


def edges_of(sample: Sample) -> List[Edges]:
    """Of one scan of each pair, or of all if there are no pairs."""
    chosen = [a for a, _ in sample.pairs] or list(range(len(sample.scans)))
    result = []
    for k in chosen:
        scan = sample.scans[k]
        points, index, weights = alignment.lidar_edges(scan.points)
        result.append(Edges(scan, points, weights, scan.times_ns[index]))
    return result


def views_of(
    sample: Sample,
    camera: CameraSample,
    edges: List[Edges],
    T_vehicle_lidar: np.ndarray,
    cache: Dict[Tuple[str, int], alignment.ImageEdges],
) -> List[View]:
    """The edges of each scan for the camera's image nearest to the scan's middle."""
    views: List[View] = []
    for one in edges:
        stamp = camera.image_at(one.scan.middle_ns)
        if stamp is None or not len(one.points):
            continue
        key = (camera.name, stamp)
        if key not in cache:
            cache[key] = alignment.image_edges(camera.images[stamp])
        at_ns = stamp + camera.offset_ns
        points, covered = compensated(
            one.points, one.times_ns, T_vehicle_lidar, sample.odometry, at_ns
        )
        if not covered.any():
            continue
        velocity, rate = vehicle_twist(sample.odometry, at_ns)
        views.append(View(points[covered], one.weights[covered], velocity, rate, cache[key]))
    return views


def motion_of(views: List[View]) -> float:
    """The mean speed of the views, m/s."""
    return float(np.mean([np.linalg.norm(view.velocity) for view in views])) if views else 0.0

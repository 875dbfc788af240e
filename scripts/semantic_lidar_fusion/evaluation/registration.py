# SPDX-License-Identifier: MIT
"""How good the resulting cloud is as a cloud: how thick flat surfaces come out when scans are laid over
each other, and how well a registration that knows nothing of odometry follows the vehicle with it.

Poses are those of /truth/poses where the bag has it, else those of tf."""

from typing import Any, Callable, Dict, Iterator, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.bags.bag_io import BagReader, to_ns
from semantic_lidar_fusion.bags.cloud_io import SemanticCloud
from semantic_lidar_fusion.bags.poses import (
    PoseSeries,
    TransformTree,
    from_message,
    invert,
    transform_points,
)
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.evaluation import tables
from semantic_lidar_fusion.evaluation.scoring import CLOUD_TOPIC, Configuration
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.rig import Rig

POSE_TOPIC = "/truth/poses"
CELL_M = 0.5
SCANS_TOGETHER = 10
LEAST_POINTS = 20  # of a cell
LEAST_SPREAD_M = 0.08  # of a cell's points in the second direction, or they are a line
FARTHEST_M = 60.0

CONFIGURATIONS = (
    Configuration("raw", ("motion.enabled=false",)),
    Configuration("packet", ("motion.enabled=true", "motion.granularity=packet")),
    Configuration("firing", ("motion.enabled=true", "motion.granularity=firing")),
)

Cloud = Tuple[np.ndarray, np.ndarray]  # points (N, 3) in the lidar's frame, T_world_lidar (4, 4)


class Result(NamedTuple):
    """Of one configuration: median thickness (m) of the cells that are surfaces, their number, and
    the registration's error of a step (m, root mean square) and at the end (share of the way)."""

    name: str
    thickness_m: float
    cells: int
    step_m: float
    drift: float


def thickness(clouds: Sequence[Cloud]) -> np.ndarray:
    """For each cell of CELL_M with points of a surface, the standard deviation (m) of all clouds'
    points across the plane that fits them best."""
    points = [transform_points(pose, xyz) for xyz, pose in clouds if len(xyz)]
    if not points:
        return np.zeros(0)
    world = np.concatenate(points)
    cells = np.floor(world / CELL_M).astype(np.int64)
    around = (cells + (1 << 20)) & ((1 << 21) - 1)  # one number for a cell, 500 km around
    keys = (around[:, 0] << 42) | (around[:, 1] << 21) | around[:, 2]
    _, number, counts = np.unique(keys, return_inverse=True, return_counts=True)

    def mean_of(values: np.ndarray) -> np.ndarray:
        return np.bincount(number, values, len(counts)) / counts

    # About the cell's corner, so that sums of squares keep their digits.
    local = world - cells * CELL_M
    mean = np.stack([mean_of(local[:, i]) for i in range(3)], axis=1)
    square = np.empty((len(counts), 3, 3))
    for i in range(3):
        for j in range(3):
            square[:, i, j] = mean_of(local[:, i] * local[:, j]) - mean[:, i] * mean[:, j]
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(square), 0.0))
    result: np.ndarray = spread[(counts >= LEAST_POINTS) & (spread[:, 1] >= LEAST_SPREAD_M), 0]
    return result


def follow(clouds: Sequence[Cloud], registration: Any) -> np.ndarray:
    """Poses (K, 4, 4) of the clouds in the first one's frame, by small_gicp (`registration`) against
    a voxel map of those before, begun with the last step again."""
    target = registration.GaussianVoxelMap(1.0)
    pose, step, result = np.eye(4), np.eye(4), []
    for number, (xyz, _) in enumerate(clouds):
        cloud, _ = registration.preprocess_points(xyz.astype(np.float64), 0.25)
        if number:
            found = registration.align(target, cloud, init_T_target_source=pose @ step)
            moved = np.asarray(found.T_target_source)
            step, pose = invert(pose) @ moved, moved
        target.insert(cloud, pose)
        result.append(pose)
    return np.array(result)


def trajectory_error(found: np.ndarray, true: np.ndarray) -> Tuple[float, float]:
    """Error of a step (m, root mean square) and of the end (share of the way); poses (K, 4, 4)."""
    if len(found) < 2:
        return np.nan, np.nan
    steps = [invert(poses[:-1]) @ poses[1:] for poses in (found, true)]
    wrong = np.linalg.norm(steps[0][:, :3, 3] - steps[1][:, :3, 3], axis=1)
    way = np.linalg.norm(steps[1][:, :3, 3], axis=1).sum()
    ends = [(invert(poses[0]) @ poses[-1])[:3, 3] for poses in (found, true)]
    drift = np.linalg.norm(ends[0] - ends[1]) / way if way > 0 else np.nan
    return float(np.sqrt(np.mean(wrong**2))), float(drift)


def true_poses(bag: str, rig: Rig) -> Callable[[int, str], Optional[np.ndarray]]:
    """(stamp ns, lidar frame) -> T_world_lidar, or None where nothing covers it."""
    vehicle, fixed = rig.text("vehicle_frame"), rig.text("fixed_frame")
    with BagReader(bag) as reader:
        tree = TransformTree.from_bag(reader)
        readings = [
            (to_ns(item.message.header.stamp), from_message(_transform(item.message.pose.pose)))
            for item in reader.read([POSE_TOPIC])
        ]
    series = PoseSeries(*map(np.array, zip(*readings))) if readings else None

    def pose(stamp_ns: int, frame: str) -> Optional[np.ndarray]:
        stamps = np.array([stamp_ns])
        if series is None:
            found, covered = tree.lookup(fixed, frame, stamps)
        else:
            found, covered = series.lookup(stamps)
            found = found @ tree.static(vehicle, frame)
        return found[0] if covered[0] else None

    return pose


def _transform(pose: Any) -> Any:
    from geometry_msgs.msg import Transform

    return Transform(translation=pose.position, rotation=pose.orientation)


def _clouds(
    fused: str, labels: LabelSet, pose_of: Callable[[int, str], Optional[np.ndarray]]
) -> Iterator[Tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(points, whether they are of a class that moves, T_world_lidar) of each scan with a pose."""
    moves = np.zeros(256, dtype=bool)
    moves[labels.dynamic_ids] = True
    with BagReader(fused) as reader:
        for item in reader.read([CLOUD_TOPIC]):
            cloud = SemanticCloud.from_message(item.message)
            pose = pose_of(cloud.stamp_ns, cloud.frame_id)
            xyz = cloud.xyz
            near = np.linalg.norm(xyz, axis=1) < FARTHEST_M
            if pose is not None and near.any():
                yield xyz[near], moves[cloud.label[near]], pose


def evaluate(
    fused: Dict[str, str], labels: LabelSet, bag: str, rig: Rig, registration: Optional[Any]
) -> List[Result]:
    """`fused`: configuration -> bag of fuse_bag. The last one is judged without moving classes,
    too. `registration`: the module small_gicp, or None: then no error of a trajectory."""
    pose_of = true_poses(bag, rig)
    results = []
    for name, path in fused.items():
        scans = list(_clouds(path, labels, pose_of))
        if not scans:
            raise DataError("%s: no scan has a pose (%s or tf)" % (bag, POSE_TOPIC))
        results.append(_judge(name, [(xyz, pose) for xyz, _, pose in scans], registration))
    still = [(xyz[~moves], pose) for xyz, moves, pose in scans]
    return results + [_judge(name + ", moving classes left out", still, registration)]


def _judge(name: str, clouds: Sequence[Cloud], registration: Optional[Any]) -> Result:
    cells = [
        thickness(clouds[begin : begin + SCANS_TOGETHER])
        for begin in range(0, len(clouds), SCANS_TOGETHER)
    ]
    every = np.concatenate(cells)
    step_m = drift = np.nan
    if registration is not None:
        true = np.array([pose for _, pose in clouds])
        step_m, drift = trajectory_error(follow(clouds, registration), true)
    middle = float(np.median(every)) if len(every) else np.nan
    return Result(name, middle, len(every), step_m, drift)


def section(results: Sequence[Result]) -> str:
    """The table as Markdown."""
    header = ["cloud", "thickness, mm", "cells", "step error, mm", "drift, %"]
    rows = [
        [
            result.name,
            tables.number(1e3 * result.thickness_m, 1),
            result.cells,
            tables.number(1e3 * result.step_m, 1),
            tables.number(100 * result.drift, 2),
        ]
        for result in results
    ]
    return tables.markdown(header, rows)


def csv(results: Sequence[Result]) -> str:
    header = ["cloud", "thickness_m", "cells", "step_error_m", "drift"]
    return tables.csv_text(header, [list(result) for result in results])

# SPDX-License-Identifier: MIT
"""Rigid transforms as 4x4 matrices named T_target_source, pose series in time, and the tf of a bag.

Quaternions are (x, y, z, w), as in ROS. Everything is double precision; a position in UTM
coordinates keeps its millimetres.
"""

from typing import Any, Dict, List, Optional, Set, Tuple

import numpy as np

from semantic_lidar_fusion.errors import DataError


def make_transform(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """T (4, 4) of R (3, 3) and t (3,)."""
    result = np.eye(4)
    result[:3, :3] = rotation
    result[:3, 3] = np.asarray(translation).reshape(3)
    return result


def invert(transform: np.ndarray) -> np.ndarray:
    """The inverse of rigid transforms (..., 4, 4)."""
    result = np.zeros_like(transform)
    rotation = np.swapaxes(transform[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, transform[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def transform_points(transform: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 3) points of the source frame in the target frame."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def to_quaternion(rotation: np.ndarray) -> np.ndarray:
    """(4,) unit quaternion, w >= 0, of the rotation (3, 3); the nearest one to a matrix that is
    rounded (as calibration files are)."""
    m = np.asarray(rotation, dtype=float)
    # It is the eigenvector of the largest eigenvalue of this symmetric matrix (Bar-Itzhack 2000);
    # eigh reads the lower half.
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
            [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], 0],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m.trace()],
        ]
    )
    vectors = np.linalg.eigh(k)[1]
    quaternion = vectors[:, -1]
    return quaternion if quaternion[3] >= 0 else -quaternion


def to_rotation(quaternion: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotations of quaternions (..., 4), which need not be normalised."""
    q = np.asarray(quaternion, dtype=float)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


class PoseSeries:
    """Poses at increasing times; between two readings linear in position and slerp in rotation."""

    def __init__(self, stamps_ns: np.ndarray, poses: np.ndarray):
        """`stamps_ns` (M,) int64, `poses` (M, 4, 4); sorted here, of equal times the last holds."""
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        order = np.argsort(stamps, kind="stable")
        stamps = stamps[order]
        keep = np.append(stamps[1:] != stamps[:-1], True) if len(stamps) else np.zeros(0, bool)
        self.stamps_ns = stamps[keep]
        chosen = np.asarray(poses, dtype=float).reshape(-1, 4, 4)[order][keep]
        self.positions = chosen[:, :3, 3]
        self.quaternions = np.array([to_quaternion(p[:3, :3]) for p in chosen]).reshape(-1, 4)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def lookup(self, stamps_ns: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
        """Poses (K, 4, 4) at times (K,) and whether the readings cover them (K,) bool; a pose that
        is not covered is NaN."""
        times = np.atleast_1d(np.asarray(stamps_ns, dtype=np.int64))
        result = np.full((len(times), 4, 4), np.nan)
        if not len(self):
            return result, np.zeros(len(times), dtype=bool)
        covered = (times >= self.stamps_ns[0]) & (times <= self.stamps_ns[-1])
        t = times[covered]
        after = np.minimum(np.searchsorted(self.stamps_ns, t, side="left"), len(self) - 1)
        before = np.where(self.stamps_ns[after] == t, after, after - 1)
        span = self.stamps_ns[after] - self.stamps_ns[before]
        ratio = np.where(span > 0, (t - self.stamps_ns[before]) / np.maximum(span, 1), 0.0)
        result[covered] = np.eye(4)
        start, end = self.positions[before], self.positions[after]
        result[covered, :3, 3] = start + ratio[:, None] * (end - start)
        quaternions = _slerp(self.quaternions[before], self.quaternions[after], ratio)
        result[covered, :3, :3] = to_rotation(quaternions)
        return result, covered


def _slerp(a: np.ndarray, b: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    dot = np.sum(a * b, axis=-1)
    b = np.where(dot[:, None] < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    small = angle < 1e-9
    sine = np.where(small, 1.0, np.sin(angle))
    weight_a = np.where(small, 1.0 - ratio, np.sin((1.0 - ratio) * angle) / sine)
    weight_b = np.where(small, ratio, np.sin(ratio * angle) / sine)
    return weight_a[:, None] * a + weight_b[:, None] * b


def from_message(transform: Any) -> np.ndarray:
    """T (4, 4) of a geometry_msgs/Transform."""
    r, t = transform.rotation, transform.translation
    return make_transform(to_rotation(np.array([r.x, r.y, r.z, r.w])), np.array([t.x, t.y, t.z]))


class TransformTree:
    """The tf of a bag: static and moving edges, looked up along the tree."""

    def __init__(self) -> None:
        self._parents: Dict[str, str] = {}
        self._static: Dict[str, np.ndarray] = {}
        self._readings: Dict[str, Tuple[List[int], List[np.ndarray]]] = {}
        self._series: Dict[str, PoseSeries] = {}

    @staticmethod
    def from_bag(reader: Any) -> "TransformTree":
        """Reads /tf_static, then /tf, of a bag_io.BagReader."""
        tree = TransformTree()
        for topic in ("/tf_static", "/tf"):
            for entry in reader.read([topic]):
                for transform in entry.message.transforms:
                    tree.add(transform, topic == "/tf_static")
        return tree

    def add(self, stamped: Any, static: bool) -> None:
        """Adds a geometry_msgs/TransformStamped; a frame that was ever static stays so."""
        from semantic_lidar_fusion.bags.bag_io import to_ns

        child = stamped.child_frame_id.lstrip("/")
        if not static and child in self._static:
            return
        self._parents[child] = stamped.header.frame_id.lstrip("/")
        if static:
            self._static[child] = from_message(stamped.transform)
        else:
            stamps, poses = self._readings.setdefault(child, ([], []))
            stamps.append(to_ns(stamped.header.stamp))
            poses.append(from_message(stamped.transform))
            self._series.pop(child, None)

    def _chain(self, frame: str) -> List[str]:
        chain, seen = [frame], {frame}  # type: Tuple[List[str], Set[str]]
        while chain[-1] in self._parents:
            parent = self._parents[chain[-1]]
            if parent in seen:
                raise DataError("tf: the frames %s form a loop" % ", ".join(chain))
            chain.append(parent)
            seen.add(parent)
        return chain

    def _edge(self, child: str, stamps_ns: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
        if child in self._static:
            count = len(stamps_ns)
            return np.repeat(self._static[child][None], count, axis=0), np.ones(count, dtype=bool)
        if child not in self._series:
            stamps, poses = self._readings[child]
            self._series[child] = PoseSeries(np.array(stamps), np.array(poses))
        return self._series[child].lookup(stamps_ns)

    def lookup(
        self, target: str, source: str, stamps_ns: np.ndarray
    ) -> Tuple[np.ndarray, np.ndarray]:
        """T_target_source (K, 4, 4) at times (K,) ns, and whether tf covers them (K,) bool.

        Raises DataError if the two frames are not connected at all.
        """
        times = np.atleast_1d(np.asarray(stamps_ns, dtype=np.int64))
        up_target, up_source = self._chain(target.lstrip("/")), self._chain(source.lstrip("/"))
        common = next((frame for frame in up_source if frame in up_target), None)
        if common is None:
            raise DataError("tf: %s and %s are not connected" % (target, source))
        valid = np.ones(len(times), dtype=bool)

        def to_common(chain: List[str]) -> np.ndarray:
            result = np.repeat(np.eye(4)[None], len(times), axis=0)
            for child in chain[: chain.index(common)]:
                edge, covered = self._edge(child, times)
                valid[~covered] = False
                result = edge @ result
            return result

        result = invert(to_common(up_target)) @ to_common(up_source)
        result[~valid] = np.nan
        return result, valid

    def static(self, target: str, source: str) -> np.ndarray:
        """T_target_source (4, 4) of two frames that are joined by static edges only."""
        for frame in (target, source):
            if frame.lstrip("/") not in self._parents and frame.lstrip("/") not in set(
                self._parents.values()
            ):
                raise DataError("tf: no frame %s" % frame)
        result, valid = self.lookup(target, source, np.zeros(1, dtype=np.int64))
        if not valid[0]:
            raise DataError("tf: %s to %s is not static" % (target, source))
        return result[0]


def to_message(
    parent: str, child: str, transform: np.ndarray, stamp_ns: Optional[int] = None
) -> Any:
    """A geometry_msgs/TransformStamped of T_parent_child."""
    from geometry_msgs.msg import TransformStamped

    from semantic_lidar_fusion.bags.bag_io import to_stamp

    message = TransformStamped()
    message.header.stamp = to_stamp(stamp_ns or 0)
    message.header.frame_id = parent
    message.child_frame_id = child
    t = message.transform.translation
    t.x, t.y, t.z = (float(value) for value in transform[:3, 3])
    r = message.transform.rotation
    r.x, r.y, r.z, r.w = (float(value) for value in to_quaternion(transform[:3, :3]))
    return message

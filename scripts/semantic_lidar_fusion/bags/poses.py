# SPDX-License-Identifier: MIT
"""Rigid transforms as 4x4 matrices named T_target_source, pose series in time, and the tf of a bag.

Quaternions are (x, y, z, w), as in ROS. Everything is double precision; a position in UTM
coordinates keeps its millimetres.
"""

from typing import Any, Dict, List, Optional, Set, Tuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.errors import DataError

_TF_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")


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
    """(4,) unit quaternion, w >= 0, of the rotation (3, 3); a near one to a matrix that is rounded
    (as calibration files are)."""
    quaternion: np.ndarray = Rotation.from_matrix(rotation).as_quat()
    return quaternion if quaternion[3] >= 0 else -quaternion


def to_rotation(quaternion: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotations of quaternions (..., 4), which need not be normalised. DataError for
    one that is zero or not finite."""
    q = np.asarray(quaternion, dtype=float)
    flat = q.reshape(-1, 4)
    if not np.isfinite(flat).all() or not flat.any(axis=1).all():
        raise DataError("a quaternion is zero or not finite")
    if not len(flat):
        return np.zeros(q.shape[:-1] + (3, 3))
    rotations: np.ndarray = Rotation.from_quat(flat).as_matrix()
    return rotations.reshape(q.shape[:-1] + (3, 3))


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
        result[covered, :3, :3] = self._rotations(t)
        return result, covered

    def _rotations(self, times_ns: np.ndarray) -> np.ndarray:
        """(K, 3, 3) at times (K,) that the readings cover."""
        if len(self) == 1 or not len(times_ns):
            return to_rotation(np.repeat(self.quaternions[:1], len(times_ns), axis=0))
        # A double holds 104 days in ns; counted from the first reading, times keep all digits.
        elapsed = (self.stamps_ns - self.stamps_ns[0]).astype(float)
        slerp = Slerp(elapsed, Rotation.from_quat(self.quaternions))
        rotations: np.ndarray = slerp((times_ns - self.stamps_ns[0]).astype(float)).as_matrix()
        return rotations


# As fuse_bag takes them (transformOf in motion/pose_buffer.h): off by rounding, and by a filter that
# does not normalise.
_ROUNDED_NORM, _LOOSE_NORM = 0.01, 0.1
# Numbers of a bag can make any number of reasons.
_MOST_REASONS = 8


def from_message(transform: Any) -> np.ndarray:
    """T (4, 4) of a geometry_msgs/Transform. DataError, with the reason, where a number is not finite
    or the quaternion's norm is not 1."""
    r, t = transform.rotation, transform.translation
    quaternion, translation = np.array([r.x, r.y, r.z, r.w]), np.array([t.x, t.y, t.z])
    if not np.isfinite(quaternion).all() or not np.isfinite(translation).all():
        raise DataError("a number is not finite")
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > _LOOSE_NORM:
        raise DataError("a quaternion of norm %.6g; 1 is wanted" % norm)
    return make_transform(to_rotation(quaternion), translation)


class TransformTree:
    """The tf of a bag: static and moving edges, looked up along the tree.

    dropped: reason -> number of transforms that could not be used.
    loose: number of transforms whose quaternion had to be normalised."""

    def __init__(self) -> None:
        self._parents: Dict[str, str] = {}
        self._static: Dict[str, np.ndarray] = {}
        self._readings: Dict[str, Tuple[List[int], List[np.ndarray]]] = {}
        self._series: Dict[str, PoseSeries] = {}
        self.dropped: Dict[str, int] = {}
        self.loose = 0

    @staticmethod
    def from_bag(reader: Any) -> "TransformTree":
        """Reads /tf_static, then /tf, of a bag_io.BagReader. Warns of what it drops."""
        tree = TransformTree()
        for topic in ("/tf_static", "/tf"):
            for entry in reader.read([topic], _TF_TYPES):
                for transform in entry.message.transforms:
                    tree.add(transform, topic == "/tf_static")
        reasons = sorted(tree.dropped.items())
        for reason, count in reasons[:_MOST_REASONS]:
            cli.warn("%s: %d transforms are dropped: %s" % (reader.path, count, reason))
        if reasons[_MOST_REASONS:]:
            more = sum(count for _, count in reasons[_MOST_REASONS:])
            cli.warn("%s: %d more transforms are dropped for such reasons" % (reader.path, more))
        if tree.loose:
            cli.warn(
                "%s: %d transforms have a quaternion of a norm that is not 1 and are taken as if "
                "normalised" % (reader.path, tree.loose)
            )
        return tree

    def __len__(self) -> int:
        """Number of edges."""
        return len(self._parents)

    def add(self, stamped: Any, static: bool) -> None:
        """Adds a geometry_msgs/TransformStamped; a frame that was ever static stays so. One that
        cannot be used is dropped and counted, by the rule of fuse_bag."""
        from semantic_lidar_fusion.bags.bag_io import to_ns

        child, parent = stamped.child_frame_id.lstrip("/"), stamped.header.frame_id.lstrip("/")
        stamp_ns = to_ns(stamped.header.stamp)
        try:
            if not child or not parent or child == parent:
                raise DataError("its frames are empty or the same")
            if not static and stamp_ns == 0:
                raise DataError("its stamp is 0")
            pose = from_message(stamped.transform)
        except DataError as error:
            self.dropped[str(error)] = self.dropped.get(str(error), 0) + 1
            return
        r = stamped.transform.rotation
        self.loose += abs(float(np.linalg.norm((r.x, r.y, r.z, r.w))) - 1.0) > _ROUNDED_NORM
        if not static and child in self._static:
            return
        self._parents[child] = parent
        if static:
            self._static[child] = pose
        else:
            stamps, poses = self._readings.setdefault(child, ([], []))
            stamps.append(stamp_ns)
            poses.append(pose)
            self._series.pop(child, None)

    def stamps_ns(self, frame: str, ancestor: str) -> np.ndarray:
        """Times (M,) ns, sorted, at which any moving edge between two frames has a reading."""
        chain = self._chain(frame.lstrip("/"))
        if ancestor.lstrip("/") not in chain:
            return np.zeros(0, dtype=np.int64)
        moving = chain[: chain.index(ancestor.lstrip("/"))]
        stamps = [self._readings[child][0] for child in moving if child in self._readings]
        return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *stamps]).astype(np.int64))

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

        def to_common(chain: List[str], common: str) -> np.ndarray:
            result = np.repeat(np.eye(4)[None], len(times), axis=0)
            for child in chain[: chain.index(common)]:
                edge, covered = self._edge(child, times)
                valid[~covered] = False
                result = edge @ result
            return result

        result = invert(to_common(up_target, common)) @ to_common(up_source, common)
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

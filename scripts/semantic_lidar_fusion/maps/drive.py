# SPDX-License-Identifier: MIT
"""Clouds of drives with the poses they were seen from: tf of bags, or a file of corrected poses.

All poses are T_map_frame; times integer ns."""

import dataclasses
import json
from typing import Any, Dict, Iterator, List, NamedTuple, Optional, Tuple

import numpy as np

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags.bag_io import BagReader
from semantic_lidar_fusion.bags.cloud_io import SemanticCloud
from semantic_lidar_fusion.bags.poses import PoseSeries, TransformTree, to_rotation
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.files import open_file
from semantic_lidar_fusion.labels import LabelSet

CLOUD_TOPIC = "/points_semantic"
FRAMES = ("map", "odom")  # of the map, the first that tf connects to the clouds
VEHICLE_FRAME = "base_link"
# A pose further from the frame's origin is none: UTM coordinates end at 1e7 m.
FARTHEST_M = 1e8
# Between so many ns of a scan the lidar moves along a line.
_KNOT_NS = 10**7
_LONGEST_SCAN_S = 1.0


@dataclasses.dataclass(frozen=True)
class Drive:
    """A bag with semantic clouds, and the bags that hold its tf (itself, if they are none).

    odometry: topic of nav_msgs/Odometry to take beside tf. poses: file of poses instead of tf;
    poses_frame: the frame of tf whose poses they are, "" = the clouds'. vehicle_frame: whose path
    is free in 2-D maps, if tf has it."""

    clouds: str
    tf: Tuple[str, ...] = ()
    topic: str = CLOUD_TOPIC
    odometry: str = ""
    poses: str = ""
    poses_frame: str = ""
    vehicle_frame: str = VEHICLE_FRAME


class SeenCloud(NamedTuple):
    """A cloud, T_map_lidar (4, 4) at its stamp, where the lidar was at each point's time ((N, 3), or
    None), and T_map_vehicle (4, 4), the lidar's own without such a frame."""

    cloud: SemanticCloud
    pose: np.ndarray
    origins: Optional[np.ndarray]
    vehicle: np.ndarray


def read_poses(path: str) -> Tuple[Optional[np.ndarray], np.ndarray]:
    """Stamps (N,) ns and poses (N, 4, 4) of a file: TUM (stamp x y z qx qy qz qw, s and m) or KITTI
    (twelve numbers of a 3 x 4 matrix; stamps None: line k is cloud k's). DataError names the line.
    """
    stamps: List[int] = []
    poses: List[np.ndarray] = []
    width = 0
    try:
        with open_file(path) as file:
            lines = file.read().decode("utf-8").splitlines()
    except OSError as error:
        raise DataError("%s: %s" % (path, error.strerror or error)) from error
    except UnicodeDecodeError as error:
        raise DataError("%s: not a text file" % path) from error
    for number, line in enumerate(lines, 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        where = "%s: line %d" % (path, number)
        try:
            values = [float(word) for word in words]
        except ValueError as error:
            raise DataError("%s: %s" % (where, error)) from error
        width = width or len(values)
        if len(values) != width or width not in (8, 12):
            raise DataError(
                "%s: %d numbers; must be 8 (TUM) or 12 (KITTI) in every line" % (where, len(values))
            )
        if not np.isfinite(values).all():
            raise DataError("%s: not finite" % where)
        pose = np.eye(4)
        if width == 8:
            norm = float(np.linalg.norm(values[4:]))
            if not 0.9 < norm < 1.1:
                raise DataError("%s: the quaternion's norm is %g; must be 1" % (where, norm))
            stamps.append(_seconds_to_ns(words[0]))
            pose[:3, :3] = to_rotation(np.array(values[4:]))
            pose[:3, 3] = values[1:4]
        else:
            pose[:3] = np.reshape(values, (3, 4))
        poses.append(pose)
    if not poses:
        raise DataError("%s: no pose" % path)
    return np.array(stamps, dtype=np.int64) if width == 8 else None, np.array(poses)


def _seconds_to_ns(text: str) -> int:
    """Without the rounding of a double, which is 200 ns at today's stamps."""
    whole, point, fraction = text.partition(".")
    if not point or "e" in text.lower():
        return int(round(float(text) * 1e9))
    return int(whole) * 10**9 + int((fraction + "0" * 9)[:9])


def pose_problem(pose: np.ndarray) -> Optional[str]:
    """Why a pose cannot be used; None if it can."""
    if not np.isfinite(pose).all():
        return "the pose is not finite"
    distance = float(np.abs(pose[:3, 3]).max())
    if distance > FARTHEST_M:
        return "the pose lies %.3g m from the frame's origin; at most %.3g m" % (
            distance,
            FARTHEST_M,
        )
    return None


class Poses:
    """Where the frames of a drive are in the map."""

    def __init__(self, drive: Drive):
        self.drive = drive
        self.tree = TransformTree()
        self._parents: Dict[str, str] = {}
        self._series: Optional[PoseSeries] = None
        if not drive.poses or drive.poses_frame or drive.tf:
            self._read_tf()
        if drive.poses:
            stamps, poses = read_poses(drive.poses)
            self._series = PoseSeries(self._stamps_of_clouds(len(poses)) if stamps is None else stamps, poses)  # fmt: skip

    def _read_tf(self) -> None:
        for path in self.drive.tf or (self.drive.clouds,):
            with BagReader(path) as bag:
                for topic in ("/tf_static", "/tf"):
                    for item in bag.read([topic]):
                        for transform in item.message.transforms:
                            self._add(transform, topic == "/tf_static", path)
                if self.drive.odometry:
                    bag.require_topic(self.drive.odometry, "nav_msgs/Odometry")
                    for item in bag.read([self.drive.odometry]):
                        self._add(_as_transform(item.message), False, path)
        for reason, count in sorted(self.tree.dropped.items()):
            cli.warn("%s: %d transforms are dropped: %s" % (self.drive.clouds, count, reason))

    def _add(self, stamped: Any, static: bool, path: str) -> None:
        child, parent = stamped.child_frame_id.lstrip("/"), stamped.header.frame_id.lstrip("/")
        known = self._parents.setdefault(child, parent)
        if known != parent and not self.drive.poses:
            raise DataError(
                "%s: tf gives the frame %s two parents, %s and %s; a map needs one: leave out the "
                "bag or the topic of the other, or give --poses" % (path, child, known, parent)
            )
        self.tree.add(stamped, static)

    def _stamps_of_clouds(self, count: int) -> np.ndarray:
        with BagReader(self.drive.clouds) as bag:
            stamps = [
                int(item.message.header.stamp.to_nsec()) for item in bag.read([self.drive.topic])
            ]
        if len(stamps) != count:
            raise DataError(
                "%s: %d poses without stamps for the %d clouds of %s"
                % (self.drive.poses, count, len(stamps), self.drive.clouds)
            )
        return np.array(stamps, dtype=np.int64)

    def lookup(
        self, frame_id: str, source: str, stamps_ns: np.ndarray
    ) -> Tuple[np.ndarray, np.ndarray]:
        """T_frame_source (K, 4, 4) at times (K,), and whether they are known (K,) bool."""
        if self._series is None:
            return self.tree.lookup(frame_id, source, stamps_ns)
        poses, covered = self._series.lookup(stamps_ns)
        own = self.drive.poses_frame.lstrip("/")
        if own and own != source.lstrip("/"):
            inner, known = self.tree.lookup(own, source, stamps_ns)
            poses, covered = poses @ inner, covered & known
        return poses, covered

    def seen(self, cloud: SemanticCloud, frame_id: str) -> Optional[SeenCloud]:
        """A cloud with its poses; None if they are not known, or absurd."""
        stamp = np.array([cloud.stamp_ns])
        poses, covered = self.lookup(frame_id, cloud.frame_id, stamp)
        if not covered[0] or pose_problem(poses[0]):
            return None
        vehicle = poses[0]
        try:
            found, known = self.lookup(frame_id, self.drive.vehicle_frame, stamp)
            if known[0] and not pose_problem(found[0]):
                vehicle = found[0]
        except DataError:
            pass  # no such frame: the lidar's own path
        return SeenCloud(cloud, poses[0], self._origins(cloud, frame_id), vehicle)

    def _origins(self, cloud: SemanticCloud, frame_id: str) -> Optional[np.ndarray]:
        dt = cloud.optional("dt")
        if dt is None or not len(dt):
            return None
        dt = np.clip(np.nan_to_num(dt.astype(np.float64)), -_LONGEST_SCAN_S, _LONGEST_SCAN_S)
        low, high = int(dt.min() * 1e9), int(dt.max() * 1e9)
        times = np.linspace(low, high, 2 + (high - low) // _KNOT_NS).astype(np.int64)
        poses, covered = self.lookup(frame_id, cloud.frame_id, cloud.stamp_ns + times)
        if not covered.any():
            return None
        knots, at = times[covered], poses[covered][:, :3, 3]
        return np.stack([np.interp(dt * 1e9, knots, at[:, axis]) for axis in range(3)], axis=1)


def _as_transform(odometry: Any) -> Any:
    from geometry_msgs.msg import TransformStamped

    result = TransformStamped()
    result.header = odometry.header
    result.child_frame_id = odometry.child_frame_id
    pose = odometry.pose.pose
    result.transform.translation.x = pose.position.x
    result.transform.translation.y = pose.position.y
    result.transform.translation.z = pose.position.z
    result.transform.rotation = pose.orientation
    return result


_poses: Dict[Drive, Poses] = {}


def poses_of(drive: Drive) -> Poses:
    """The poses of a drive; the last ones read are kept."""
    if drive not in _poses:
        found = Poses(drive)
        _poses.clear()
        _poses[drive] = found
    return _poses[drive]


def first_cloud(drive: Drive) -> SemanticCloud:
    with BagReader(drive.clouds) as bag:
        bag.require_topic(drive.topic, "sensor_msgs/PointCloud2")
        for item in bag.read([drive.topic]):
            return SemanticCloud.from_message(item.message)
    raise DataError("%s: %s is empty" % (drive.clouds, drive.topic))


def class_set(drive: Drive, cloud: SemanticCloud, classes_file: Optional[str]) -> LabelSet:
    """From the file, else the bag's class_info; its names must be the cloud's."""
    if classes_file:
        labels = LabelSet.from_file(classes_file)
    else:
        labels = _class_info(drive)
    if labels.names != cloud.class_names:
        raise DataError(
            "%s: its clouds have the classes %s; the class set has %s"
            % (drive.clouds, ", ".join(cloud.class_names), ", ".join(labels.names))
        )
    return labels


def _class_info(drive: Drive) -> LabelSet:
    with BagReader(drive.clouds) as bag:
        if "/class_info" not in bag.topics:
            raise DataError(
                "%s: no topic /class_info; name the class set with --classes" % drive.clouds
            )
        for item in bag.read(["/class_info"]):
            try:
                tree = json.loads(item.message.data)
                if not isinstance(tree, dict):
                    raise ValueError("not a mapping")
                return LabelSet.from_class_info(tree)
            except (ValueError, AttributeError) as error:
                raise DataError(
                    "%s: class_info is not JSON (%s)" % (drive.clouds, error)
                ) from error
    raise DataError("%s: /class_info is empty" % drive.clouds)


def choose_frame(drive: Drive, cloud: SemanticCloud, wanted: Optional[str]) -> str:
    """The map's frame: as wanted, else the first of FRAMES that tf connects to the clouds; that of a
    file of poses is FRAMES[0]."""
    poses = poses_of(drive)
    stamps = np.array([cloud.stamp_ns])
    if wanted or drive.poses:
        frame = wanted or FRAMES[0]
        poses.lookup(frame, cloud.frame_id, stamps)
        return frame.lstrip("/")
    for frame in FRAMES:
        try:
            poses.lookup(frame, cloud.frame_id, stamps)
            return frame
        except DataError:
            continue
    raise DataError(
        "%s: tf connects %s to neither %s; name the map's frame with --frame, and the bag that has "
        "the tf with --tf" % (drive.clouds, cloud.frame_id, " nor ".join(FRAMES))
    )


def clouds_of(
    drive: Drive, frame_id: str, begin_ns: int, end_ns: int
) -> Iterator[Optional[SeenCloud]]:
    """Clouds recorded from begin_ns to end_ns with their poses; None for one without."""
    poses = poses_of(drive)
    with BagReader(drive.clouds) as bag:
        for item in bag.read([drive.topic], start_ns=begin_ns, end_ns=end_ns):
            yield poses.seen(SemanticCloud.from_message(item.message), frame_id)

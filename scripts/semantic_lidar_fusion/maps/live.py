# SPDX-License-Identifier: MIT
"""Maps a live topic: clouds wait, bounded, for the tf of their stamp, and then enter the map.

A callback only queues. One thread looks poses up and integrates; another publishes. What is dropped
is counted by its reason. `LiveMapper` serves build_semantic_map.py --live and the node.
"""

import collections
import json
import os
import threading
import time
from typing import Any, Callable, Deque, Dict, List, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags.bag_io import to_ns, to_stamp
from semantic_lidar_fusion.bags.cloud_io import SemanticCloud
from semantic_lidar_fusion.errors import ConfigError, DataError
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.bags.poses import from_message
from semantic_lidar_fusion.maps.build import Totals
from semantic_lidar_fusion.maps.drive import VEHICLE_FRAME, pose_problem
from semantic_lidar_fusion.maps.map_file import MapHeader, MapWriter, joined_path, merge_files
from semantic_lidar_fusion.maps.records import BRICK_BITS, pose_of_path
from semantic_lidar_fusion.maps.semantic_map import COUNTS, MapConfig, VoxelMap
from semantic_lidar_fusion.texts import plain_text

MAX_WAITING = 10  # clouds
# A stamp so much older than the last one starts anew: a bag was restarted (ns).
JUMP_BACK_NS = 10**9
DROPS = (
    "tf_late",
    "tf_missing",
    "tf_past",
    "queue_full",
    "no_classes",
    "bad_cloud",
    "bad_pose",
    "jumped_back",
)
# Of a line or a value of /diagnostics; texts of messages may hold anything.
LONGEST_TEXT = 2000
# One warning of a kind in so many seconds.
WARN_EVERY_S = 30.0
_MAX_PATH = 1 << 20  # poses kept in memory


class Store:
    """The map of a drive that goes on: voxels in memory, and files of those that left it.

    Not thread safe; the mapper's lock guards it."""

    def __init__(
        self, header: MapHeader, folder: str, memory_bytes: int, disk_bytes: Optional[int] = None
    ):
        """`folder` takes the files, of `disk_bytes` at most (None = no limit)."""
        self.header, self.folder = header, folder
        self.memory_bytes, self.disk_bytes = memory_bytes, disk_bytes
        self.voxels = VoxelMap(header.config, header.labels)
        self.runs: List[str] = []
        self.forgotten = 0  # voxels that found no place on disk
        self._path: List[np.ndarray] = []
        self._made = 0

    @property
    def spilled_bytes(self) -> int:
        return sum(os.path.getsize(run) for run in self.runs)

    def path(self) -> np.ndarray:
        """Of what is in memory."""
        self._path = [joined_path(self._path)]
        return self._path[0]

    def integrate(
        self,
        cloud: SemanticCloud,
        pose: np.ndarray,
        origins: Optional[np.ndarray],
        vehicle: np.ndarray,
    ) -> Dict[str, int]:
        counts = self.voxels.integrate(cloud, pose, origins)
        self._path.append(pose_of_path(cloud.stamp_ns, vehicle))
        if self.voxels.memory_bytes > self.memory_bytes or len(self._path) > _MAX_PATH:
            self.spill()
        return counts

    def spill(self, inside: Optional[Tuple[Sequence[int], Sequence[int]]] = None) -> None:
        """Moves voxels to a file: all, or those outside the bounds (low, high) in whole bricks."""
        records, bricks = self.voxels.records(), self.voxels.bricks()
        if inside is not None:
            records = records[~_within(records, inside, 0)]
            bricks = bricks[~_within(bricks, inside, BRICK_BITS)]
            if not len(records) and not len(bricks):
                return
        needed = records.nbytes + bricks.nbytes
        if self.disk_bytes is not None and self.spilled_bytes + needed > self.disk_bytes:
            self.forgotten += len(records)
        else:
            target = os.path.join(self.folder, "live%06d.voxels" % self._made)
            self._made += 1
            with MapWriter(target, self.header) as writer:
                writer.write(records, bricks)
                writer.add_path(self.path())
            self.runs.append(target)
            self._path = []
        if inside is None:
            self.voxels.clear()
        else:
            self.voxels.keep_inside(*inside)

    def snapshot(self) -> Tuple[List[str], np.ndarray, np.ndarray, np.ndarray]:
        """Files, and records, bricks and path of what is in memory, for `write_snapshot`."""
        return list(self.runs), self.voxels.records(), self.voxels.bricks(), self.path()

    def clear(self) -> None:
        self.voxels.clear()
        for run in self.runs:
            os.remove(run)
        self.runs, self._path, self.forgotten = [], [], 0


def _within(
    entries: np.ndarray, bounds: Tuple[Sequence[int], Sequence[int]], bits: int
) -> np.ndarray:
    inside = np.ones(len(entries), dtype=bool)
    for axis, low, high in zip("xyz", *bounds):
        inside &= (entries[axis] >= low >> bits) & (entries[axis] <= high >> bits)
    return inside


def write_snapshot(
    snapshot: Tuple[List[str], np.ndarray, np.ndarray, np.ndarray],
    header: MapHeader,
    folder: str,
    target: str,
) -> bool:
    """Writes a store's snapshot as one map file; `folder` takes a file meanwhile. Whether there was
    anything."""
    runs, records, bricks, path = snapshot
    if not runs and not len(records):
        return False
    last = os.path.join(folder, ".last.voxels")
    with MapWriter(last, header) as writer:
        writer.write(records, bricks)
        writer.add_path(path)
    try:
        # In the order in which they were made, not of their paths: the window's is the last.
        merge_files([*runs, last], target, header)
    finally:
        os.remove(last)
    return True


class LiveMapper:
    """Subscribes clouds and class_info, and keeps the map. All members that a thread changes are
    guarded by `lock`; `lock` is never held while tf is looked up."""

    def __init__(
        self,
        topic: str,
        frame_id: str,
        config_of: Callable[[LabelSet], MapConfig],
        store_folder: str,
        labels: Optional[LabelSet] = None,
        tf_timeout_s: float = 0.5,
        tf_cache_s: float = 10.0,
        memory_bytes: int = 1 << 30,
        disk_bytes: Optional[int] = None,
        on_cloud: Optional[Callable[[SemanticCloud, np.ndarray], None]] = None,
    ):
        """`labels`: None takes those of the topic class_info. `store_folder` takes voxels beyond
        `memory_bytes`, up to `disk_bytes`. `on_cloud` is called, with the lock held, after a cloud
        with its pose has entered the map."""
        import rospy
        import tf2_ros
        from sensor_msgs.msg import PointCloud2
        from std_msgs.msg import String

        self._rospy, self._tf2 = rospy, tf2_ros
        self.frame_id = frame_id.lstrip("/")
        self._config_of, self._on_cloud = config_of, on_cloud
        self._tf_timeout_s = tf_timeout_s
        self._store_of = lambda header: Store(header, store_folder, memory_bytes, disk_bytes)
        self._warned: Dict[str, float] = {}
        self.lock = threading.Lock()
        self._arrived = threading.Condition()
        self._waiting: Deque[Tuple[Any, float]] = collections.deque()
        self._stopping = False
        self._last_ns = 0
        self.store: Optional[Store] = None
        self.totals = Totals()
        self.received = 0
        self.drops = dict.fromkeys(DROPS, 0)
        self.last_error = ""
        if labels is not None:
            self._use_classes(labels)
        self._tf = tf2_ros.Buffer(rospy.Duration(tf_cache_s))
        self._listener = tf2_ros.TransformListener(self._tf, tcp_nodelay=True)
        self._worker = threading.Thread(target=self._work, name="mapper", daemon=True)
        self._worker.start()
        self._subscribers = []
        if labels is None:
            self._subscribers.append(rospy.Subscriber("class_info", String, self._on_class_info))
        self._subscribers.append(
            rospy.Subscriber(
                topic, PointCloud2, self._queue, queue_size=4, buff_size=1 << 24, tcp_nodelay=True
            )
        )
        self.topic = self._subscribers[-1].resolved_name

    def header(self) -> Optional[MapHeader]:
        """None before the classes are known."""
        return None if self.store is None else self.store.header

    def write(self, target: str) -> bool:
        """Writes the map so far as a map file; whether there is anything in it."""
        with self.lock:
            if self.store is None:
                return False
            snapshot = self.store.snapshot()
        return write_snapshot(snapshot, self.store.header, os.path.dirname(target), target)

    def close(self) -> None:
        """Stops receiving, and maps what waits and has its tf."""
        for subscriber in self._subscribers:
            subscriber.unregister()
        with self._arrived:
            self._stopping = True
            self._arrived.notify()
        self._worker.join(timeout=5.0)

    def clear(self) -> None:
        with self.lock:
            if self.store is not None:
                self.store.clear()
            self.totals = Totals()

    def _drop(self, reason: str, text: str) -> None:
        self.drops[reason] += 1
        self.last_error = text
        self.warn(reason, "%s (%d so far)" % (text, self.drops[reason]))

    def warn(self, kind: str, text: str) -> None:
        """Logs a warning unless one of its kind was logged in the last WARN_EVERY_S: its text may
        differ each time."""
        now = time.monotonic()
        if now - self._warned.get(kind, -WARN_EVERY_S) >= WARN_EVERY_S:
            self._warned[kind] = now
            self._rospy.logwarn(plain_text(text, LONGEST_TEXT))

    def _use_classes(self, labels: LabelSet) -> None:
        with self.lock:
            if self.store is None:
                self.store = self._store_of(
                    MapHeader(self._config_of(labels), labels, self.frame_id)
                )
            elif self.store.header.labels != labels:
                self.last_error = "class_info changed; the map keeps the classes it began with"
                self.warn("class_info", self.last_error)

    def _on_class_info(self, message: Any) -> None:
        try:
            self._use_classes(LabelSet.from_class_info(json.loads(message.data)))
        except Exception as error:  # whatever a text holds that is no class_info
            self.last_error = "class_info: %s" % error
            self.warn("class_info", self.last_error)

    def _queue(self, message: Any) -> None:
        with self._arrived:
            self.received += 1
            if len(self._waiting) >= MAX_WAITING:
                self._waiting.popleft()
                self._drop("queue_full", "%s: clouds come faster than they are mapped" % self.topic)
            self._waiting.append((message, time.monotonic()))
            self._arrived.notify()

    def _work(self) -> None:
        while True:
            with self._arrived:
                while not self._waiting and not self._stopping:
                    self._arrived.wait(1.0)
                if not self._waiting:
                    return
                message, since = self._waiting[0]
            try:
                finished = self._process(message, since)
            except (DataError, ValueError, OverflowError) as error:
                finished = True
                self._drop("bad_cloud", "%s: %s" % (self.topic, error))
            except Exception as error:  # one bad message must not end the mapping
                finished = True
                self._drop("bad_cloud", "%s: %s: %s" % (self.topic, type(error).__name__, error))
            if finished:
                with self._arrived:
                    if self._waiting and self._waiting[0][0] is message:
                        self._waiting.popleft()
            else:
                time.sleep(0.01)

    def _process(self, message: Any, since: float) -> bool:
        """Whether the message is done with, mapped or dropped."""
        stamp_ns = to_ns(message.header.stamp)
        if stamp_ns < self._last_ns - JUMP_BACK_NS:
            self._rospy.loginfo("time went back by %.1f s", (self._last_ns - stamp_ns) * 1e-9)
            self.drops["jumped_back"] += 1
            self._tf.clear()
            self._last_ns = stamp_ns
        if self.store is None:
            if time.monotonic() - since < self._tf_timeout_s and not self._stopping:
                return False
            self._drop("no_classes", "no message on class_info: the classes are not known")
            return True
        pose = self._pose(message, time.monotonic() - since)
        if pose is None:
            return False
        if not len(pose):
            self.totals.clouds += 1
            self.totals.without_pose += 1
            return True
        problem = pose_problem(pose)
        if problem:
            self._drop("bad_pose", "%s: %s" % (self.topic, problem))
            self.totals.clouds += 1
            self.totals.without_pose += 1
            return True
        cloud = SemanticCloud.from_message(message)
        origins, vehicle = self._origins(cloud), self._vehicle(cloud, pose)
        with self.lock:
            points = self.store.integrate(cloud, pose, origins, vehicle)
            self.totals.clouds += 1
            for name in COUNTS:
                self.totals.points[name] += points[name]
            if self._on_cloud is not None:
                self._on_cloud(cloud, pose)
        self._last_ns = max(self._last_ns, stamp_ns)
        return True

    def _at(self, source: str, stamp_ns: int) -> Optional[np.ndarray]:
        """T_map_source, None if tf does not have it (yet)."""
        try:
            found = self._tf.lookup_transform(self.frame_id, source, to_stamp(stamp_ns))
        except self._tf2.TransformException:
            return None
        pose = from_message(found.transform)
        return None if pose_problem(pose) else pose

    def _origins(self, cloud: SemanticCloud) -> Optional[np.ndarray]:
        """Where the lidar was at each point's time, on a line through what tf knows of the scan."""
        dt = cloud.optional("dt")
        if dt is None or not len(dt):
            return None
        seconds = np.clip(np.nan_to_num(dt.astype(np.float64)), -1.0, 1.0)
        knots, places = [], []
        for offset in sorted({float(seconds.min()), 0.0, float(seconds.max())}):
            found = self._at(cloud.frame_id.lstrip("/"), cloud.stamp_ns + int(offset * 1e9))
            if found is not None:
                knots.append(offset)
                places.append(found[:3, 3])
        if not knots:
            return None
        at = np.array(places)
        return np.stack([np.interp(seconds, knots, at[:, axis]) for axis in range(3)], axis=1)

    def _vehicle(self, cloud: SemanticCloud, pose: np.ndarray) -> np.ndarray:
        found = self._at(VEHICLE_FRAME, cloud.stamp_ns)
        return pose if found is None else found

    def _pose(self, message: Any, age_s: float) -> Optional[np.ndarray]:
        """T_map_lidar at the cloud's stamp; None = not yet; an empty array = never, counted."""
        source = message.header.frame_id.lstrip("/")
        stamp = message.header.stamp
        try:
            found = self._tf.lookup_transform(self.frame_id, source, stamp)
            return from_message(found.transform)
        except self._tf2.TransformException as error:
            what = "no tf from %s to %s at %.3f: %s" % (
                source,
                self.frame_id,
                stamp.to_sec(),
                error,
            )
            reason = "tf_missing"
            if isinstance(error, self._tf2.ExtrapolationException):
                reason = "tf_late"
                try:
                    latest = self._tf.get_latest_common_time(self.frame_id, source)
                    if to_ns(latest) > to_ns(stamp):
                        reason = "tf_past"
                except self._tf2.TransformException:
                    pass
        # The past does not come back; everything else may come yet.
        if reason != "tf_past" and age_s < self._tf_timeout_s and not self._stopping:
            return None
        self._drop(reason, what)
        return np.zeros(0)


def record_live(
    topic: str,
    frame_id: str,
    classes_file: str,
    duration_s: Optional[float],
    config_of: Callable[[LabelSet], MapConfig],
    folder: str,
    memory_bytes: int,
) -> LiveMapper:
    """build_semantic_map.py --live: maps until Ctrl-C, the master's end, or `duration_s`; the mapper,
    which has ended. `folder` takes what outgrows `memory_bytes`."""
    cli.require("rospy", "tf2_ros")
    import rosgraph
    import rospy

    if not rosgraph.is_master_online():
        raise DataError("no ROS master answers; start one, or map a bag")
    labels = LabelSet.from_file(classes_file) if classes_file else None
    rospy.init_node("build_semantic_map", anonymous=True, disable_signals=True)
    mapper = LiveMapper(topic, frame_id, config_of, folder, labels, memory_bytes=memory_bytes)
    end = time.monotonic() + (duration_s if duration_s else float("inf"))
    try:
        while time.monotonic() < end and not rospy.is_shutdown():
            time.sleep(0.1)
    except (KeyboardInterrupt, cli.Ended):
        pass  # the ways to end it
    mapper.close()
    if mapper.header() is None:
        raise DataError("no message on class_info: the classes are not known (--classes)")
    for reason, count in mapper.drops.items():
        if count:
            cli.warn("%d clouds: %s" % (count, reason.replace("_", " ")))
    return mapper


def drop_values(drops: Dict[str, int]) -> Dict[str, str]:
    """Drops for /diagnostics."""
    return {"dropped, " + reason.replace("_", " "): str(count) for reason, count in drops.items()}

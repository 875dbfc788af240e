# SPDX-License-Identifier: MIT
"""Maps a live topic: clouds wait, bounded, for the tf of their stamp, and then enter the map.

A callback only queues. One thread looks poses up and integrates; another publishes. What is dropped
is counted by its reason. `LiveMapper` serves build_semantic_map.py --live and the node.
"""

import collections
import json
import threading
import time
from typing import Any, Callable, Deque, Dict, Optional, Tuple

import numpy as np

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags.bag_io import to_ns
from semantic_lidar_fusion.bags.cloud_io import SemanticCloud
from semantic_lidar_fusion.errors import ConfigError, DataError
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.bags.poses import from_message
from semantic_lidar_fusion.maps.semantic_map import COUNTS, MapConfig, VoxelMap
from semantic_lidar_fusion.maps.build import Totals
from semantic_lidar_fusion.maps.map_file import MapHeader

MAX_WAITING = 10  # clouds
# A stamp so much older than the last one starts anew: a bag was restarted (ns).
JUMP_BACK_NS = 10**9
DROPS = ("tf_late", "tf_missing", "tf_past", "queue_full", "no_classes", "bad_cloud", "jumped_back")


class LiveMapper:
    """Subscribes clouds and class_info, and keeps the map. All members that a thread changes are
    guarded by `lock`; `lock` is never held while tf is looked up."""

    def __init__(
        self,
        topic: str,
        frame_id: str,
        config_of: Callable[[LabelSet], MapConfig],
        labels: Optional[LabelSet] = None,
        tf_timeout_s: float = 0.5,
        tf_cache_s: float = 10.0,
        on_cloud: Optional[Callable[[SemanticCloud, np.ndarray], None]] = None,
    ):
        """`labels`: None takes those of the topic class_info. `on_cloud` is called, with the lock
        held, after a cloud with its pose has entered the map."""
        import rospy
        import tf2_ros
        from sensor_msgs.msg import PointCloud2
        from std_msgs.msg import String

        self._rospy, self._tf2 = rospy, tf2_ros
        self.frame_id = frame_id.lstrip("/")
        self._config_of, self._on_cloud = config_of, on_cloud
        self._tf_timeout_s = tf_timeout_s
        self.lock = threading.Lock()
        self._arrived = threading.Condition()
        self._waiting: Deque[Tuple[Any, float]] = collections.deque()
        self._stopping = False
        self._last_ns = 0
        self.voxels: Optional[VoxelMap] = None
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
        if self.voxels is None:
            return None
        return MapHeader(self.voxels.config, self.voxels.labels, self.frame_id)

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
            if self.voxels is not None:
                self.voxels.clear()
            self.totals = Totals()

    def _drop(self, reason: str, text: str) -> None:
        self.drops[reason] += 1
        self.last_error = text
        self._rospy.logwarn_throttle_identical(30, text)

    def _use_classes(self, labels: LabelSet) -> None:
        with self.lock:
            if self.voxels is None:
                self.voxels = VoxelMap(self._config_of(labels), labels)
            elif self.voxels.labels != labels:
                self.last_error = "class_info changed; the map keeps the classes it began with"
                self._rospy.logwarn(self.last_error)

    def _on_class_info(self, message: Any) -> None:
        try:
            self._use_classes(LabelSet.from_class_info(json.loads(message.data)))
        except (ValueError, ConfigError) as error:
            self.last_error = "class_info: %s" % error
            self._rospy.logerr_throttle(30, self.last_error)

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
            except DataError as error:
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
        if self.voxels is None:
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
        cloud = SemanticCloud.from_message(message)
        with self.lock:
            points = self.voxels.integrate(cloud, pose)
            self.totals.clouds += 1
            for name in COUNTS:
                self.totals.points[name] += points[name]
            if self._on_cloud is not None:
                self._on_cloud(cloud, pose)
        self._last_ns = max(self._last_ns, stamp_ns)
        return True

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
    options: Any, config_of: Callable[[Any, LabelSet], MapConfig]
) -> Tuple[Optional[VoxelMap], MapHeader, Totals]:
    """build_semantic_map.py --live: maps until Ctrl-C, the master's end, or --duration s."""
    cli.require("rospy", "tf2_ros")
    import rosgraph
    import rospy

    if not rosgraph.is_master_online():
        raise DataError("no ROS master answers; start one, or map a bag")
    labels = LabelSet.from_file(options.classes) if options.classes else None
    rospy.init_node("build_semantic_map", anonymous=True, disable_signals=True)
    mapper = LiveMapper(
        options.live,
        options.frame or "odom",
        lambda classes: config_of(options, classes),
        labels,
    )
    end = time.monotonic() + (options.duration if options.duration else float("inf"))
    try:
        while time.monotonic() < end and not rospy.is_shutdown():
            time.sleep(0.1)
    except KeyboardInterrupt:
        pass  # the way to end it
    mapper.close()
    header = mapper.header()
    if header is None:
        raise DataError("no message on class_info: the classes are not known (--classes)")
    for reason, count in mapper.drops.items():
        if count:
            cli.warn("%d clouds: %s" % (count, reason.replace("_", " ")))
    return mapper.voxels, header, mapper.totals


def drop_values(drops: Dict[str, int]) -> Dict[str, str]:
    """Drops for /diagnostics."""
    return {"dropped, " + reason.replace("_", " "): str(count) for reason, count in drops.items()}

# SPDX-License-Identifier: MIT
"""The semantic clouds of a bag as arrays, with ROS or without.

ROS's rosbag reads the bag where it is installed, else PyPI's rosbags does
(``pip install semantic_lidar_fusion[bags]``).
"""

import importlib.util
import json
from types import SimpleNamespace
from typing import Any, Callable, Dict, Iterator, List, Optional, Sequence, Tuple, Union

from semantic_lidar_fusion.bags.cloud_io import SemanticCloud, to_array
from semantic_lidar_fusion.errors import DataError, MissingDependencyError
from semantic_lidar_fusion.labels import LabelSet

TOPIC = "/points_semantic"
_CLOUD_TYPE = "sensor_msgs/PointCloud2"
_Interval = Tuple[Optional[int], Optional[int]]


class _RosbagSource:
    """A bag through ROS's rosbag."""

    def __init__(self, path: str):
        from semantic_lidar_fusion.bags.bag_io import BagReader

        self._reader = BagReader(path)
        self.topics = self._reader.topics

    def close(self) -> None:
        self._reader.close()

    def stamps_ns(self, topic: str) -> List[int]:
        return self._reader.stamps_ns(topic)

    def read(self, topic: str, interval: _Interval = (None, None)) -> Iterator[Any]:
        for item in self._reader.read([topic], start_ns=interval[0], end_ns=interval[1]):
            yield item.message


class _RosbagsSource:
    """A bag through PyPI's rosbags."""

    def __init__(self, path: str):
        from rosbags.rosbag1 import Reader, ReaderError
        from rosbags.typesys import Stores, get_typestore

        self._store = get_typestore(Stores.ROS1_NOETIC)
        self._reader = Reader(path)
        try:
            self._reader.open()
        except (ReaderError, OSError) as error:
            raise DataError("%s: not a readable bag (%s)" % (path, error)) from error
        self.topics = {c.topic: c.msgtype.replace("/msg/", "/") for c in self._reader.connections}

    def close(self) -> None:
        self._reader.close()

    def _messages(self, topic: str, interval: _Interval) -> Iterator[Tuple[Any, int, bytes]]:
        chosen = [c for c in self._reader.connections if c.topic == topic]
        stop = None if interval[1] is None else interval[1] + 1
        return self._reader.messages(chosen, start=interval[0], stop=stop)

    def stamps_ns(self, topic: str) -> List[int]:
        return [stamp for _, stamp, _ in self._messages(topic, (None, None))]

    def read(self, topic: str, interval: _Interval = (None, None)) -> Iterator[Any]:
        for connection, _, data in self._messages(topic, interval):
            message = self._store.deserialize_ros1(data, connection.msgtype)
            if hasattr(message, "header"):
                stamp = message.header.stamp
                message = _with_header(message, int(stamp.sec), int(stamp.nanosec))
            yield message


def _with_header(message: Any, secs: int, nsecs: int) -> Any:
    """The message with the header as ROS 1 names its parts."""
    values = {name: getattr(message, name) for name in message.__dataclass_fields__}
    stamp = SimpleNamespace(secs=secs, nsecs=nsecs)
    values["header"] = SimpleNamespace(stamp=stamp, frame_id=message.header.frame_id)
    return SimpleNamespace(**values)


_Source = Union[_RosbagSource, _RosbagsSource]
_SOURCES: Dict[str, Callable[[str], _Source]] = {
    "rosbag": _RosbagSource,
    "rosbags": _RosbagsSource,
}


def _source(path: str) -> _Source:
    for module, source in _SOURCES.items():
        if importlib.util.find_spec(module) is not None:
            return source(path)
    raise MissingDependencyError(
        "%s: neither ROS's rosbag nor PyPI's rosbags can be imported; "
        "pip install semantic_lidar_fusion[bags]" % path
    )


class Clouds(Sequence[SemanticCloud]):
    """The semantic clouds of a bag, one for each scan, read when they are asked for.

    topic: str; labels: the class set, or None where the bag does not tell its colours.
    """

    def __init__(self, path: str, topic: Optional[str] = None):
        """`topic`: default, /points_semantic, or the only one that ends like this. DataError if the
        bag cannot be read or has no such topic."""
        self.path = path
        self._bag = _source(path)
        self.topic = topic or self._only_topic()
        if self._bag.topics.get(self.topic) != _CLOUD_TYPE:
            self.close()
            raise DataError("%s: no clouds on %s" % (path, self.topic))
        # Two scans may share one t_ref, which is their clouds' record time.
        self.stamps_ns = sorted(self._bag.stamps_ns(self.topic))
        self.labels = self._class_set()

    def _only_topic(self) -> str:
        found = sorted(t for t, k in self._bag.topics.items() if k == _CLOUD_TYPE)
        ours = [t for t in found if t.endswith(TOPIC)]
        if TOPIC in ours or not ours:
            return TOPIC
        if len(ours) > 1:
            raise DataError("%s: name one topic of %s" % (self.path, ", ".join(ours)))
        return ours[0]

    def _class_set(self) -> Optional[LabelSet]:
        name = self.topic[: -len(TOPIC)] + "/class_info"
        if name in self._bag.topics:
            for message in self._bag.read(name):
                return LabelSet.from_class_info(json.loads(message.data))
        return None

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        stamp = self.stamps_ns[index]
        among_equals = range(len(self))[index] - self.stamps_ns.index(stamp)
        for number, message in enumerate(self._bag.read(self.topic, (stamp, stamp))):
            if number == among_equals:
                return _cloud(message)
        raise DataError("%s: the cloud at %d ns is gone" % (self.path, stamp))

    def __iter__(self) -> Iterator[SemanticCloud]:
        for message in self._bag.read(self.topic):
            yield _cloud(message)

    def close(self) -> None:
        self._bag.close()

    def __enter__(self) -> "Clouds":
        return self

    def __exit__(self, *reason: Any) -> None:
        self.close()


def _cloud(message: Any) -> SemanticCloud:
    stamp = message.header.stamp
    stamp_ns = int(stamp.secs) * 1000000000 + int(stamp.nsecs)
    return SemanticCloud(to_array(message), stamp_ns, message.header.frame_id)

# SPDX-License-Identifier: MIT
"""Reading and writing bags.

Times are integer nanoseconds, named `*_ns`. A writer makes its file aside and renames it when all
is well, so that a bag with the wanted name is always a whole one. Messages of velodyne_msgs are
read and written whether or not that package is installed.
"""

import errno
import os
import tempfile
from types import TracebackType
from typing import (
    Any,
    Dict,
    Iterable,
    Iterator,
    List,
    NamedTuple,
    Optional,
    Sequence,
    Tuple,
    Type,
    TypeVar,
)

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.errors import DataError, cannot_write
from semantic_lidar_fusion.files import AtomicFile, open_file, write_text

__all__ = ["AtomicFile", "BagReader", "BagWriter", "write_text"]

T = TypeVar("T")

_RULE = "=" * 80 + "\n"
_HEADER = """Header header
"""
_HEADER_DEFINITION = (
    _RULE
    + """MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
"""
)
_PACKET_DEFINITION = """time stamp
uint8[1206] data
"""
DEFINITIONS = {
    "velodyne_msgs/VelodynePacket": _PACKET_DEFINITION,
    "velodyne_msgs/VelodyneScan": _HEADER
    + "VelodynePacket[] packets\n"
    + _RULE
    + "MSG: velodyne_msgs/VelodynePacket\n"
    + _PACKET_DEFINITION
    + _HEADER_DEFINITION,
}
_MD5 = {
    "velodyne_msgs/VelodynePacket": "ae4f90a23256f44e82baa08dd45c3456",
    "velodyne_msgs/VelodyneScan": "50804fc9533a0e579e6322c04ae70566",
}
_generated: Dict[str, Any] = {}


def to_ns(stamp: Any) -> int:
    """A rospy Time or Duration (ns)."""
    return int(stamp.secs) * 1000000000 + int(stamp.nsecs)


def to_stamp(stamp_ns: int) -> Any:
    """A genpy Time of integer nanoseconds; DataError outside what a ROS time holds."""
    import genpy

    seconds, nanoseconds = divmod(int(stamp_ns), 1000000000)
    if not 0 <= seconds < 2**32:
        raise DataError("%d ns is no ROS time (0 to 2^32 s)" % stamp_ns)
    return genpy.Time(seconds, nanoseconds)


def message_class(type_name: str) -> Any:
    """The class of a message type ("sensor_msgs/Image"), of velodyne_msgs without its package.

    Raises DataError if the type is not known here.
    """
    cli.require("genpy", "roslib.message")
    import genpy.dynamic
    import roslib.message

    try:
        found = roslib.message.get_message_class(type_name)
    except Exception:  # roslib passes on whatever a broken package raises
        found = None
    if found is not None:
        return found
    if type_name not in DEFINITIONS:
        raise DataError("the message type %s is not installed" % type_name)
    if type_name not in _generated:
        generated = genpy.dynamic.generate_dynamic(type_name, DEFINITIONS[type_name])
        _generated.update(generated)
        if _generated[type_name]._md5sum != _MD5[type_name]:
            raise AssertionError("the definition of %s has changed" % type_name)
    return _generated[type_name]


def _told(error: Exception) -> str:
    """An error's text, or its name where it has none."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _unread(what: str, error: Exception) -> DataError:
    """What to raise where `what` cannot be read. genpy writes code for a bag's messages into the
    temporary folder, whose disk may be full, and a disk may fail: neither is the bag's fault."""
    code = error.errno if isinstance(error, OSError) else None
    if code in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
        told = "%s: cannot be read: the temporary folder %s: %s; TMPDIR names another"
        return DataError(told % (what, tempfile.gettempdir(), os.strerror(code or 0)))
    if code in (errno.EIO, errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ESTALE):
        return DataError("%s: cannot be read: %s" % (what, os.strerror(code or 0)))
    return DataError("%s: damaged (%s)" % (what, _told(error)))


def _absolute(topic: str) -> str:
    return topic if topic.startswith("/") else "/" + topic


class BagMessage(NamedTuple):
    """One message of a bag, with its record time (ns)."""

    topic: str
    message: Any
    stamp_ns: int


class RawMessage(NamedTuple):
    """A message as the bag holds it, of whatever type. `connection`: its connection header."""

    topic: str
    content: Tuple[Any, ...]
    stamp_ns: int
    connection: Dict[str, Any]

    @property
    def latched(self) -> bool:
        return str(self.connection.get("latching", "0")) == "1"

    def message(self) -> Any:
        """Decoded by the definition that the bag brings along."""
        try:
            message = self.content[-1]()
            message.deserialize(self.content[1])
        except Exception as error:  # whatever genpy meets in a damaged message
            raise _unread("%s: a message" % self.topic, error) from error
        return message


def _refuse_ros2(path: str) -> None:
    start = b""
    if os.path.isfile(path):
        with open_file(path) as file:
            start = file.read(8)
    in_folder = os.path.exists(os.path.join(path, "metadata.yaml"))
    if in_folder or start == b"SQLite f" or start.startswith(b"\x89MCAP"):
        told = "%s: is a bag of ROS 2; import_dataset.py ros2 makes one of ROS 1 of it"
        raise DataError(told % path)


class BagReader:
    """A bag open for reading, as a context manager.

    topics: topic -> message type, for every topic of the bag. Names begin with a slash, which
    `rosbag record` leaves away where its command line does.
    """

    def __init__(self, path: str):
        cli.require("rosbag")
        import rosbag

        self.path = path
        _refuse_ros2(path)
        self._file = open_file(path)
        try:
            self._bag = rosbag.Bag(self._file, "r")
            information = self._bag.get_type_and_topic_info()[1]
        except rosbag.ROSBagUnindexedException as error:
            self._file.close()
            raise DataError(
                "%s: the bag has no index (recording was cut off); repair it with "
                "`rosbag reindex`" % path
            ) from error
        except Exception as error:  # whatever rosbag meets in a damaged file
            self._file.close()
            raise DataError("%s: not a readable bag (%s)" % (path, _told(error))) from error
        self.topics: Dict[str, str] = {}
        self._counts: Dict[str, int] = {}
        self._recorded_names: Dict[str, List[str]] = {}
        for name, entry in information.items():
            topic = _absolute(name)
            self.topics[topic] = entry[0]
            self._counts[topic] = self._counts.get(topic, 0) + int(entry[1])
            self._recorded_names.setdefault(topic, []).append(name)

    def __enter__(self) -> "BagReader":
        return self

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        trace: Optional[TracebackType],
    ) -> None:
        self.close()

    def close(self) -> None:
        self._bag.close()
        self._file.close()

    def _guarded(self, entries: Iterable[T]) -> Iterator[T]:
        """Passes the entries on; whatever rosbag, genpy or a message definition of a damaged bag
        raises becomes a DataError. What the reader of the entries raises is its own."""
        iterator = iter(entries)
        while True:
            try:
                entry = next(iterator)
            except StopIteration:
                return
            except Exception as error:
                raise _unread(self.path, error) from error
            yield entry

    def topics_of_type(self, type_name: str) -> List[str]:
        """Names of the topics of a message type, sorted."""
        return sorted(name for name, kind in self.topics.items() if kind == type_name)

    def require_topic(self, topic: str, type_name: Optional[str] = None) -> None:
        """DataError unless the bag has this topic (of this type)."""
        if topic not in self.topics:
            known = ", ".join(sorted(self.topics)) or "none"
            raise DataError("%s: no topic %s (it has: %s)" % (self.path, topic, known))
        if type_name is not None and self.topics[topic] != type_name:
            raise DataError(
                "%s: %s is %s, not %s" % (self.path, topic, self.topics[topic], type_name)
            )

    def count(self, topics: Optional[Sequence[str]] = None) -> int:
        """Number of messages of these topics (default: all)."""
        return sum(
            self._counts.get(name, 0) for name in (self.topics if topics is None else topics)
        )

    def stamps_ns(self, topic: str) -> List[int]:
        """Record times (ns) of a topic's messages, in order, from the bag's index alone."""
        connections = self._bag._get_connections([topic])
        return sorted(to_ns(entry.time) for entry in self._bag._get_entries(connections))

    def _check_topic(self, found: str, names: Sequence[str]) -> None:
        if _absolute(found) not in names:
            told = "%s: damaged (its index leads from another topic to a message of %s)"
            raise DataError(told % (self.path, found))

    def read(
        self,
        topics: Optional[Sequence[str]] = None,
        types: Optional[Sequence[str]] = None,
        start_ns: Optional[int] = None,
        end_ns: Optional[int] = None,
        label: Optional[str] = None,
    ) -> Iterator[BagMessage]:
        """Messages in order of record time, of the given topics and types (None = all), recorded
        from start_ns to end_ns inclusive (ns). `label` shows a progress bar under that name."""
        names = sorted(self.topics if topics is None else topics)
        if types is not None:
            names = [name for name in names if self.topics.get(name) in types]
        names = [name for name in names if name in self.topics]
        if not names:
            return
        entries: Iterable[Any] = self._bag.read_messages(
            topics=[recorded for name in names for recorded in self._recorded_names[name]],
            start_time=None if start_ns is None else to_stamp(start_ns),
            end_time=None if end_ns is None else to_stamp(end_ns),
        )
        if label is not None:
            entries = cli.progress(entries, self.count(names), label)
        for topic, message, stamp in self._guarded(entries):
            self._check_topic(topic, names)
            yield BagMessage(_absolute(topic), message, to_ns(stamp))

    def read_raw(
        self,
        topics: Optional[Sequence[str]] = None,
        start_ns: Optional[int] = None,
        end_ns: Optional[int] = None,
        label: Optional[str] = None,
    ) -> Iterator[RawMessage]:
        """Messages in order of record time, not decoded; arguments as in read()."""
        names = None
        if topics is not None:
            names = [recorded for name in topics for recorded in self._recorded_names.get(name, [])]
            if not names:
                return
        entries: Iterable[Any] = self._bag.read_messages(
            topics=names,
            start_time=None if start_ns is None else to_stamp(max(0, start_ns)),
            end_time=None if end_ns is None else to_stamp(end_ns),
            raw=True,
            return_connection_header=True,
        )
        if label is not None:
            entries = cli.progress(entries, self.count(), label)
        for entry in self._guarded(entries):
            if topics is not None:
                self._check_topic(entry.topic, topics)
            header = {key: _text(value) for key, value in entry.connection_header.items()}
            yield RawMessage(_absolute(entry.topic), entry.message, to_ns(entry.timestamp), header)


class BagWriter:
    """A new bag as a context manager: it gets its name only if the block ends without an error."""

    def __init__(self, path: str, compression: Optional[str] = None):
        """`compression`: "none", "bz2", "lz4"; default lz4 where Python can write it."""
        cli.require("rosbag")
        import rosbag

        if compression is None:
            try:
                import roslz4  # noqa: F401

                compression = "lz4"
            except ImportError:
                compression = "none"
        self.path = path
        self._file = AtomicFile(path)
        with self._file.opening():
            self._bag = rosbag.Bag(self._file.temporary, "w", compression=compression)

    def __enter__(self) -> "BagWriter":
        return self

    def write(self, topic: str, message: Any, stamp_ns: int, latched: bool = False) -> None:
        """Appends a message with its record time (ns). `latched`: rosbag play keeps it for late
        subscribers."""
        header = None
        if latched:
            header = {
                "topic": topic,
                "type": message._type,
                "md5sum": message._md5sum,
                "message_definition": message._full_text,
                "callerid": "/semantic_lidar_fusion",
                "latching": "1",
            }
        try:
            self._bag.write(topic, message, to_stamp(stamp_ns), connection_header=header)
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def write_raw(self, item: RawMessage) -> None:
        """Appends a message of another bag as it is."""
        try:
            self._bag.write(
                item.topic,
                item.content,
                to_stamp(item.stamp_ns),
                raw=True,
                connection_header=dict(item.connection, topic=item.topic),
            )
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        trace: Optional[TracebackType],
    ) -> None:
        try:
            self._bag.close()
            if kind is None:
                self._file.commit()
        except OSError as close_error:
            if kind is None:
                raise cannot_write(self.path, close_error) from close_error
        finally:
            self._file.discard()

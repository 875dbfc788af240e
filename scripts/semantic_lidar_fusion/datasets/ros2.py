# SPDX-License-Identifier: MIT
"""Bags of ROS 2 (sqlite3 or MCAP, a folder or a file) as bags of ROS 1, through PyPI's rosbags.

Messages keep their record times, stamps and topics; those whose type has another layout in ROS 1
(camera_info's field names, the header's seq) are translated by rosbags.
"""

import contextlib
import io
import os
import pathlib
import tempfile
from typing import Any, Dict, List, NamedTuple, Sequence

from semantic_lidar_fusion.bags.bag_io import DEFINITIONS
from semantic_lidar_fusion.errors import DataError, MissingDependencyError, cannot_write


class Summary(NamedTuple):
    """`messages`: written; `left_out`: topic -> type that nothing defines."""

    messages: int
    topics: int
    left_out: Dict[str, str]


def _rosbags() -> Any:
    try:
        import rosbags.convert.converter
        import rosbags.highlevel
        import rosbags.typesys
    except ImportError as error:
        raise MissingDependencyError(
            "ROS 2 bags are read by PyPI's rosbags: pip install rosbags (%s)" % error
        ) from error
    return rosbags


def _typestore(store: Any, version: Any) -> Any:
    """The types of a release of ROS, and velodyne_msgs."""
    types = store.get_typestore(version)
    for name in ("velodyne_msgs/VelodynePacket", "velodyne_msgs/VelodyneScan"):
        full = name.replace("/", "/msg/")
        if full not in types.fielddefs:
            text = DEFINITIONS[name].split("=" * 80)[0].replace("time stamp", _time(version))
            types.register(store.get_types_from_msg(text, full))
    return types


def _time(version: Any) -> str:
    return "time stamp" if version.name.startswith("ROS1") else "builtin_interfaces/Time stamp"


def convert(sources: Sequence[str], bag_path: str) -> Summary:
    """Writes the bag, whole or not at all. DataError if a source cannot be read."""
    rosbags = _rosbags()
    stores = rosbags.typesys.Stores
    known = _typestore(rosbags.typesys, stores.LATEST)
    paths = [pathlib.Path(source) for source in sources]
    for path in paths:
        if not path.exists():
            raise DataError("%s: does not exist" % path)
    left_out = _undefined(rosbags, paths, known)
    folder = os.path.dirname(os.path.abspath(bag_path))
    try:
        with tempfile.TemporaryDirectory(prefix=".import_", dir=folder) as part:
            made = pathlib.Path(part) / "part.bag"
            with contextlib.redirect_stdout(io.StringIO()):  # it names each type that it translates
                rosbags.convert.converter.convert(
                    srcs=paths,
                    dst=made,
                    dst_storage="",
                    dst_version=9,
                    compress=None,  # ROS does not read the lz4 frames that rosbags writes
                    compress_mode="file",
                    default_typestore=known,
                    typestore=_typestore(rosbags.typesys, stores.ROS1_NOETIC),
                    exclude_topics=sorted(left_out),
                    include_topics=[],
                    exclude_msgtypes=[],
                    include_msgtypes=[],
                )
            if not made.exists():
                raise DataError("%s: holds no message that can be read" % ", ".join(sources))
            summary = _counted(rosbags, made, left_out)
            os.replace(made, bag_path)
    except rosbags.convert.converter.ConverterError as error:
        raise DataError("%s: %s" % (", ".join(sources), error)) from error
    except OSError as error:
        raise cannot_write(bag_path, error) from error
    return summary


def _undefined(rosbags: Any, paths: List[pathlib.Path], known: Any) -> Dict[str, str]:
    """Topics whose type neither the bags nor ROS define."""
    try:
        with rosbags.highlevel.AnyReader(paths, default_typestore=known) as reader:
            if not reader.is2:
                raise DataError("%s: is a bag of ROS 1" % paths[0])
            return {
                connection.topic: connection.msgtype
                for connection in reader.connections
                if connection.msgtype not in reader.typestore.fielddefs
            }
    except rosbags.highlevel.AnyReaderError as error:
        raise DataError("%s: %s" % (", ".join(map(str, paths)), error)) from error


def _counted(rosbags: Any, made: pathlib.Path, left_out: Dict[str, str]) -> Summary:
    with rosbags.highlevel.AnyReader([made]) as reader:
        return Summary(reader.message_count, len(reader.topics), left_out)

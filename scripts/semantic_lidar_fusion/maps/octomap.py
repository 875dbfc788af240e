# SPDX-License-Identifier: MIT
"""A map as OctoMap files, and as a message of octomap_msgs in a bag, where that is installed."""

import os
import tempfile
from typing import Any, Dict, List

import numpy as np

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags.bag_io import to_stamp
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.maps.reading import GONE, STATIC, labels_of
from semantic_lidar_fusion.maps.records import free_voxels, voxel_indices
from semantic_lidar_fusion.maps.semantic_map import native_module
from semantic_lidar_fusion.maps.source import MapSource, class_colors

# Clouds whose rays crossed a voxel that is exported as free.
_FREE_PASSES = 2
# A tree in memory takes about 150 bytes for each voxel: 2.5 GB.
MAX_VOXELS = 1 << 24
TOPIC = "/octomap"


def write_octomap(source: MapSource, folder: str) -> Dict[str, Any]:
    """map.ot (ColorOcTree, class colours) and map.bt (occupancy only): the static layer is occupied,
    what rays crossed is free, the dynamic layer is neither. Of a map with more than MAX_VOXELS of both
    free space is left out (octomap_free tells), with more that are occupied nothing is written."""
    module = native_module()
    if module is None or not module.has_octomap:
        raise DataError(
            "OctoMap files need the module _core, built with pybind11 and liboctomap; leave "
            "octomap out of --formats"
        )
    remaining = MAX_VOXELS - source.extent.counts[STATIC]
    if remaining < 0:
        raise DataError(
            "OctoMap: %d voxels; a tree of more than %d takes more than 2.5 GB: use a larger --voxel, "
            "or map parts of the drive" % (source.extent.counts[STATIC], MAX_VOXELS)
        )
    size = source.config.voxel_size_m
    offset = np.floor(np.array(source.extent.offset_m) / size).astype(np.int64)
    occupied, colors = [], []
    free: List[np.ndarray] = [np.zeros((0, 3), dtype=np.int64)]
    for tile, records, bricks in source.reader.read_tiles():
        layer = source.layers(tile, records)
        if remaining >= 0:
            voxels, passes = free_voxels(bricks)
            free.append(voxels[passes >= _FREE_PASSES])
            free.append(voxel_indices(records[layer == GONE]))
            remaining -= sum(len(part) for part in free[-2:])
            if remaining < 0:
                free = free[:1]
        if not len(records):
            continue
        chosen = records[layer == STATIC]
        occupied.append(voxel_indices(chosen))
        label = labels_of(chosen, source.config, source.labels)
        colors.append(class_colors(source.labels, label))
    module.write_octomap(
        np.concatenate(occupied) - offset,
        np.concatenate(colors),
        np.concatenate(free) - offset,
        size,
        os.path.join(folder, "map.ot"),
        os.path.join(folder, "map.bt"),
    )
    return {
        "octomap_offset_m": [float(value) for value in offset * size],
        "octomap_free": remaining >= 0,
    }


def to_message(path: str, frame_id: str, stamp_ns: int) -> Any:
    """An octomap_msgs/Octomap of a file .bt or .ot; its data is what follows the file's header."""
    from octomap_msgs.msg import Octomap

    with open(path, "rb") as file:
        header, _, data = file.read().partition(b"\ndata\n")
    fields: Dict[bytes, bytes] = {}
    for line in header.split(b"\n"):
        name, _, value = line.partition(b" ")
        fields[name] = value
    message = Octomap()
    message.header.frame_id = frame_id
    message.header.stamp = to_stamp(stamp_ns)
    message.binary = header.startswith(b"# Octomap OcTree binary file")
    message.id = fields[b"id"].decode("ascii")
    message.resolution = float(fields[b"res"])
    message.data = np.frombuffer(data, dtype=np.int8).tolist()
    return message


def write_octomap_message(source: MapSource, folder: str) -> Dict[str, Any]:
    """octomap.bag: map.bt as one message on TOPIC, in the map's frame, as octomap_server publishes it."""
    cli.require("octomap_msgs.msg", "rosbag")
    import rosbag

    with tempfile.TemporaryDirectory(prefix=".octomap.", dir=folder) as parts:
        offset = write_octomap(source, parts)["octomap_offset_m"]
        if any(offset):
            raise DataError(
                "octomap_msgs: the map lies %s m from its frame's origin, beyond single precision; "
                "octomap has files with an offset" % offset
            )
        path = source.reader.path
        stamp_ns = int(path["stamp_ns"][-1]) if len(path) else 0
        message = to_message(os.path.join(parts, "map.bt"), source.header.frame_id, stamp_ns)
    with rosbag.Bag(os.path.join(folder, "octomap.bag"), "w") as bag:
        bag.write(TOPIC, message, to_stamp(max(stamp_ns, 1)))
    return {}

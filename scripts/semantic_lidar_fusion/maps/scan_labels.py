# SPDX-License-Identifier: MIT
"""The map's class for every point of every scan, as SemanticKITTI's .label files."""

import os
from typing import Dict, Sequence

import numpy as np

from semantic_lidar_fusion.bags.bag_io import BagReader
from semantic_lidar_fusion.bags.cloud_io import SemanticCloud
from semantic_lidar_fusion.bags.poses import transform_points
from semantic_lidar_fusion.datasets import semantickitti
from semantic_lidar_fusion.errors import DataError, cannot_write
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet
from semantic_lidar_fusion.maps.drive import Drive, poses_of
from semantic_lidar_fusion.maps.map_file import MapReader
from semantic_lidar_fusion.maps.query import MapQuery


def kitti_ids(labels: LabelSet) -> np.ndarray:
    """(256,) uint32: SemanticKITTI's id of each class, the least one that names it; 0 = unlabelled."""
    table = np.zeros(256, dtype=np.uint32)
    first: Dict[str, int] = {}
    for names_at in range(max(len(names) for names in semantickitti.CLASSES.values())):
        for number, names in sorted(semantickitti.CLASSES.items()):
            if names_at < len(names):
                first.setdefault(names[names_at], number)
    for index, name in enumerate(labels.names):
        table[index] = first.get(name, 0)
    return table


def write_scan_labels(reader: MapReader, drives: Sequence[Drive], folder: str) -> int:
    """Writes folder/000000.label, ... (uint32 each, one per point in the cloud's order) for the clouds
    of the drives in their order; their number. A point without a voxel keeps its own class. A cloud
    without a pose keeps all of its own."""
    query, table = MapQuery(reader), kitti_ids(reader.header.labels)
    count = 0
    try:
        os.makedirs(folder, exist_ok=True)
        for drive in drives:
            poses = poses_of(drive)
            with BagReader(drive.clouds) as bag:
                for item in bag.read([drive.topic]):
                    cloud = SemanticCloud.from_message(item.message)
                    if cloud.class_names != reader.header.labels.names:
                        raise DataError("%s: its clouds have other classes" % drive.clouds)
                    label = cloud.label.copy()
                    seen = poses.seen(cloud, reader.header.frame_id)
                    if seen is not None:
                        of_map = query.at(transform_points(seen.pose, cloud.xyz)).label
                        label = np.where(of_map == NO_LABEL, label, of_map)
                    path = os.path.join(folder, "%06d.label" % count)
                    table[label].astype("<u4").tofile(path)
                    count += 1
    except OSError as error:
        raise cannot_write(folder, error) from error
    return count

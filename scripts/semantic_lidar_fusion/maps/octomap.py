# SPDX-License-Identifier: MIT
"""A map as OctoMap files."""

import os
from typing import Any, Dict

import numpy as np

from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.maps.reading import GONE, STATIC, labels_of
from semantic_lidar_fusion.maps.records import free_voxels, voxel_indices
from semantic_lidar_fusion.maps.semantic_map import native_module
from semantic_lidar_fusion.maps.source import MapSource, class_colors

# Clouds whose rays crossed a voxel that is exported as free.
_FREE_PASSES = 2


def write_octomap(source: MapSource, folder: str) -> Dict[str, Any]:
    """map.ot (ColorOcTree, class colours) and map.bt (occupancy only): the static layer is occupied,
    what rays crossed is free, the dynamic layer is neither."""
    module = native_module()
    if module is None or not module.has_octomap:
        raise DataError(
            "OctoMap files need the module _core, built with pybind11 and liboctomap; leave "
            "octomap out of --formats"
        )
    size = source.config.voxel_size_m
    offset = np.floor(np.array(source.extent.offset_m) / size).astype(np.int64)
    occupied, colors, free = [], [], [np.zeros((0, 3), dtype=np.int64)]
    for tile, records, bricks in source.reader.read_tiles():
        voxels, passes = free_voxels(bricks)
        free.append(voxels[passes >= _FREE_PASSES])
        if not len(records):
            continue
        layer = source.layers(tile, records)
        free.append(voxel_indices(records[layer == GONE]))
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
    return {"octomap_offset_m": [float(value) for value in offset * size]}

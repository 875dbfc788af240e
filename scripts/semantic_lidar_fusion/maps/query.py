# SPDX-License-Identifier: MIT
"""A map as a function of position: what is at x, y, z."""

from typing import NamedTuple

import numpy as np

from semantic_lidar_fusion.errors import ConfigError
from semantic_lidar_fusion.labels import NO_LABEL
from semantic_lidar_fusion.maps.map_file import MapReader
from semantic_lidar_fusion.maps.numpy_map import merge_records
from semantic_lidar_fusion.maps.reading import labels_and_confidences
from semantic_lidar_fusion.maps.records import voxel_indices


class Found(NamedTuple):
    """label: (N,) uint8, 255 = no voxel or no class; confidence: (N,) float32; voxel: (N,) index into
    the records of the map, -1 = none."""

    label: np.ndarray
    confidence: np.ndarray
    voxel: np.ndarray


class MapQuery:
    """Reads a map file once and answers for many positions (about 0.5 us each). `coarser`: 2^coarser
    voxels to an edge are read as one, their evidence added up; 0 = the map's own voxels."""

    def __init__(self, reader: MapReader, coarser: int = 0):
        if not 0 <= coarser <= 16:
            raise ConfigError("coarser = %s: must be from 0 to 16" % coarser)
        self.header = reader.header
        self.size_m = reader.header.config.voxel_size_m * (1 << coarser)
        records = reader.records()
        if coarser:
            records = merge_records(records, coarser, reader.header.config.voxel_size_m)
        self.records = records
        self.label, self.confidence = labels_and_confidences(
            records, self.header.config, self.header.labels
        )
        indices = voxel_indices(records)
        empty = not len(indices)
        self._low = np.zeros(3, np.int64) if empty else indices.min(axis=0)
        self._high = np.full(3, -1, np.int64) if empty else indices.max(axis=0)
        # Sorted (x, y) columns, and z within: 64 bits hold both parts of the key.
        span = self._high - self._low + 1
        self._columns, of = np.unique(
            (indices[:, 0] - self._low[0]) * span[1] + (indices[:, 1] - self._low[1]),
            return_inverse=True,
        )
        keys = of.reshape(-1) * span[2] + (indices[:, 2] - self._low[2])
        self._order = np.argsort(keys)
        self._keys = keys[self._order]
        self._span = span

    def at(self, xyz: np.ndarray) -> Found:
        """What the map says at positions (N, 3), m in its frame."""
        xyz = np.asarray(xyz, dtype=np.float64).reshape(-1, 3)
        with np.errstate(invalid="ignore"):
            cell = np.floor(xyz / self.size_m)
            inside = ((cell >= self._low) & (cell <= self._high)).all(axis=1)
        voxel = np.full(len(xyz), -1, dtype=np.int64)
        if inside.any():
            index = cell[inside].astype(np.int64) - self._low
            flat = index[:, 0] * self._span[1] + index[:, 1]
            column = np.minimum(np.searchsorted(self._columns, flat), len(self._columns) - 1)
            key = column * self._span[2] + index[:, 2]
            place = np.minimum(np.searchsorted(self._keys, key), len(self._keys) - 1)
            hit = (self._columns[column] == flat) & (self._keys[place] == key)
            voxel[inside] = np.where(hit, self._order[place], -1)
        known = voxel >= 0
        label = np.where(known, self.label[voxel], NO_LABEL).astype(np.uint8)
        confidence = np.where(known, self.confidence[voxel], 0).astype(np.float32)
        return Found(label, confidence, voxel)


def label_at(reader: MapReader, xyz: np.ndarray) -> np.ndarray:
    """(N,) uint8: the class at positions (N, 3), 255 = none. For more than one call keep a MapQuery."""
    return MapQuery(reader).at(xyz).label

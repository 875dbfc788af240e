# SPDX-License-Identifier: MIT
"""The ground below a voxel map, from its geometry alone.

In each cell the lowest voxel that was seen twice is a candidate. A morphological opening of these
heights (the highest of the lowest, both within OPENING_M) takes away what stands on the ground and is
narrower than that, and leaves slopes as they are: the first step of the filter of Zhang et al., "A
progressive morphological filter for removing nonground measurements from airborne lidar data"
(2003).
"""

import collections
from typing import Callable, Dict, Iterable, Tuple

import numpy as np

from semantic_lidar_fusion.maps.records import TILE_BITS, heights

OPENING_M = 4.0  # half the width of what is taken away
# A cell's lowest voxel belongs to the ground if it lies no higher above it (m).
GROUND_BAND_M = 0.2
TILE = 1 << TILE_BITS
_FAR = np.float32(1e9)


def lowest_heights(records: np.ndarray, voxel_size_m: float, x: int, y: int, shape: Tuple[int, int]) -> np.ndarray:  # fmt: skip
    """(height, width) float32: the lowest mean height (m) of the voxels of each cell that were seen
    by two points at least; NaN = none. Cell (0, 0) is that of the voxels x, y."""
    row = records["y"].astype(np.int64) - y
    column = records["x"].astype(np.int64) - x
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    inside &= records["observations"] >= 2
    result = np.full(shape[0] * shape[1], _FAR, dtype=np.float32)
    cells = (row * shape[1] + column)[inside]
    np.minimum.at(result, cells, heights(records[inside], voxel_size_m).astype(np.float32))
    result[result == _FAR] = np.nan
    return result.reshape(shape)


def ground_surface(lowest_m: np.ndarray, cell_m: float) -> np.ndarray:
    """(height, width) float32: the ground of cells within reach of lowest heights; NaN = unknown."""
    import cv2

    width = 2 * max(1, int(round(OPENING_M / cell_m))) + 1
    window = np.ones((width, width), dtype=np.uint8)
    low = np.where(np.isnan(lowest_m), _FAR, lowest_m).astype(np.float32)
    eroded = cv2.erode(low, window, borderType=cv2.BORDER_CONSTANT, borderValue=float(_FAR))
    eroded[eroded == _FAR] = -_FAR
    opened = cv2.dilate(eroded, window, borderType=cv2.BORDER_CONSTANT, borderValue=float(-_FAR))
    opened[opened == -_FAR] = np.nan
    return opened


class Ground:
    """The ground of a map of many tiles. Only the lowest heights of all tiles are kept (6 bytes for
    each cell that has one), and the surface of the last ones that were asked for."""

    _KEPT = 8  # tiles

    def __init__(
        self,
        tiles: Callable[[], Iterable[Tuple[Tuple[int, int], np.ndarray, np.ndarray]]],
        voxel_size_m: float,
    ):
        self._cell_m = voxel_size_m
        self._lowest: Dict[Tuple[int, int], Tuple[np.ndarray, np.ndarray]] = {}
        self._known: "collections.OrderedDict[Tuple[int, int], np.ndarray]" = (
            collections.OrderedDict()
        )
        for tile, records, _ in tiles():
            if len(records):
                lowest = lowest_heights(
                    records, voxel_size_m, tile[0] * TILE, tile[1] * TILE, (TILE, TILE)
                ).reshape(-1)
                cells = np.flatnonzero(~np.isnan(lowest)).astype(np.uint16)
                self._lowest[tile] = (cells, lowest[cells])

    def of(self, tile: Tuple[int, int]) -> np.ndarray:
        """(256, 256) float32: the ground of a tile (m), NaN = unknown."""
        if tile not in self._known:
            margin = min(TILE, 2 * max(1, int(round(OPENING_M / self._cell_m))))
            around = np.full((3 * TILE, 3 * TILE), np.nan, dtype=np.float32)
            for row in range(3):
                for column in range(3):
                    part = self._lowest.get((tile[0] + column - 1, tile[1] + row - 1))
                    if part is not None:
                        y, x = np.divmod(part[0].astype(np.int64), TILE)
                        around[row * TILE + y, column * TILE + x] = part[1]
            low, high = TILE - margin, 2 * TILE + margin
            surface = ground_surface(around[low:high, low:high], self._cell_m)
            self._known[tile] = surface[margin:-margin, margin:-margin]
            if len(self._known) > self._KEPT:
                self._known.popitem(last=False)
        return self._known[tile]

    def above(self, tile: Tuple[int, int], records: np.ndarray) -> np.ndarray:
        """(N,) float32: heights (m) of a tile's voxels above the ground; NaN = unknown."""
        surface = self.of(tile)
        row, column = records["y"] & (TILE - 1), records["x"] & (TILE - 1)
        return heights(records, self._cell_m).astype(np.float32) - surface[row, column]

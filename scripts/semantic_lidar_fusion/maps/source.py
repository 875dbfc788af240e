# SPDX-License-Identifier: MIT
"""What exports read: a map file with its ground, judged voxels and 2-D maps, part by part."""

from typing import Iterator, List, NamedTuple, Optional, Tuple

import numpy as np

from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.maps.ground import GROUND_BAND_M, TILE, Ground
from semantic_lidar_fusion.maps.map_file import MapReader, Tile
from semantic_lidar_fusion.maps.raster import Costs, Frame2d, Rasters, flatten
from semantic_lidar_fusion.maps.reading import labels_and_confidences, layers_of

# Single precision keeps a millimetre so far from the origin (m).
_FAR_M = 8192.0
# Cells of a 2-D map in one file; larger ones come in blocks of BLOCK_TILES x BLOCK_TILES tiles.
MAX_CELLS = 1 << 25
BLOCK_TILES = 16
_UNNAMED_RGB = (128, 128, 128)


class Extent(NamedTuple):
    """counts: voxels of the layers static, dynamic and gone; low, high: bounds of x, y and z,
    inclusive, of the first two; offset_m: of exports in single precision."""

    counts: Tuple[int, int, int]
    low: Tuple[int, int, int]
    high: Tuple[int, int, int]
    offset_m: Tuple[float, float, float]


class Block(NamedTuple):
    """A part of the 2-D maps; name: "" if it is the only one."""

    name: str
    rasters: Rasters


class MapSource:
    """A map to export. `epsg`: of the map's coordinates, None = not known; `title`: of pictures."""

    def __init__(
        self, reader: MapReader, costs: Costs, title: str = "", epsg: Optional[int] = None
    ):
        self.reader, self.costs, self.title, self.epsg = reader, costs, title, epsg
        self.header = reader.header
        self.config, self.labels = reader.header.config, reader.header.labels
        self.ground = Ground(reader.read_tiles, self.config.voxel_size_m)
        self.extent = self._measure()
        self._single: Optional[Rasters] = None

    def layers(self, tile: Tile, records: np.ndarray) -> np.ndarray:
        """(N,) uint8: `reading.layers_of` a tile's records."""
        label, confidence = labels_and_confidences(records, self.config, self.labels)
        is_ground = self.ground.above(tile, records) <= GROUND_BAND_M
        return layers_of(records, label, confidence, self.config, self.labels, is_ground)

    def layer(self, wanted: int) -> Iterator[np.ndarray]:
        """Records of a layer, tile by tile."""
        for tile, records, _ in self.reader.read_tiles():
            chosen = records[self.layers(tile, records) == wanted] if len(records) else records
            if len(chosen):
                yield chosen

    def _measure(self) -> Extent:
        counts = np.zeros(3, dtype=np.int64)
        lows: List[Tuple[int, ...]] = []
        highs: List[Tuple[int, ...]] = []
        for tile, records, _ in self.reader.read_tiles():
            if not len(records):
                continue
            layer = self.layers(tile, records)
            counts += np.bincount(layer, minlength=3)[:3]
            lows.append(tuple(int(records[axis].min()) for axis in "xyz"))
            highs.append(tuple(int(records[axis].max()) for axis in "xyz"))
        if not lows:
            raise DataError("%s: the map is empty; no point entered it" % self.reader.path_name)
        low, high = np.array(lows).min(axis=0), np.array(highs).max(axis=0)
        size = self.config.voxel_size_m
        offset = []
        for least, most in zip(low, high):
            far = max(abs(int(least)), abs(int(most))) * size > _FAR_M
            offset.append(float(np.floor(least * size / 1000.0) * 1000.0) if far else 0.0)
        return Extent(
            (int(counts[0]), int(counts[1]), int(counts[2])),
            (int(low[0]), int(low[1]), int(low[2])),
            (int(high[0]), int(high[1]), int(high[2])),
            (offset[0], offset[1], offset[2]),
        )

    def blocks(self) -> Iterator[Block]:
        """The 2-D maps: whole if they are not too large, else in blocks where something is."""
        low, high = self.extent.low[:2], self.extent.high[:2]
        size = self.config.voxel_size_m
        if (high[0] - low[0] + 1) * (high[1] - low[1] + 1) <= MAX_CELLS:
            if self._single is None:
                self._single = self._flat(Frame2d.around(low, high, size), list(self.reader.tiles))
            yield Block("", self._single)
            return
        tiles = [tile for tile, place in self.reader.tiles.items() if place.records]
        for x, y in sorted({(tile[0] // BLOCK_TILES, tile[1] // BLOCK_TILES) for tile in tiles}):
            own = [t for t in tiles if (t[0] // BLOCK_TILES, t[1] // BLOCK_TILES) == (x, y)]
            corner = (min(t[0] for t in own) * TILE, min(t[1] for t in own) * TILE)
            end = ((max(t[0] for t in own) + 1) * TILE - 1, (max(t[1] for t in own) + 1) * TILE - 1)
            frame = Frame2d.around(corner, end, size)
            yield Block("_%+05d_%+05d" % (x, y), self._flat(frame, own))

    def _flat(self, frame: Frame2d, tiles: List[Tile]) -> Rasters:
        """The 2-D maps of a frame, gathered tile by tile."""
        whole = Rasters.empty(frame)
        for tile in tiles:
            records, bricks = self.reader.tile(tile)
            if not len(records):
                continue
            part = Frame2d(tile[0] * TILE, tile[1] * TILE, TILE, TILE, frame.cell_m)
            whole.paste(
                flatten(
                    records,
                    bricks,
                    part,
                    self.ground.of(tile),
                    self.reader.path,
                    self.config,
                    self.labels,
                    self.costs,
                )
            )
        return whole


def class_colors(labels: LabelSet, label: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 of labels (N,); grey without a class."""
    table = np.full((256, 3), _UNNAMED_RGB, dtype=np.uint8)
    table[: len(labels)] = labels.colors_rgb
    return table[label]

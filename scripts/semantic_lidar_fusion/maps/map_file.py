# SPDX-License-Identifier: MIT
"""The map file (.voxels): records of semantic_map in canonical order, tile after tile.

  "SLFVOX01" | uint64 length of the header | header (JSON, padded with blanks to 8 bytes)
  | records | per tile: int32 x, int32 y, uint64 records | uint64 tiles | "SLFVOXEN"

Little-endian. The header holds the map's configuration, class set and frame. Equal maps are equal
files; a file without its end was cut off. A tile is 256 voxels wide in x and y.
"""

import json
import os
import struct
from typing import Any, BinaryIO, Dict, Iterator, List, NamedTuple, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.bags.bag_io import AtomicFile
from semantic_lidar_fusion.errors import ConfigError, DataError, cannot_write
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.maps.semantic_map import TILE_BITS, MapConfig, VoxelMap, record_dtype

_BEGIN, _END = b"SLFVOX01", b"SLFVOXEN"
_TILE = struct.Struct("<iiQ")
_LAST = struct.Struct("<Q8s")
Tile = Tuple[int, int]


class MapHeader(NamedTuple):
    """What a map is: `config` is checked (its prior written out)."""

    config: MapConfig
    labels: LabelSet
    frame_id: str

    def encoded(self) -> bytes:
        tree = {
            "config": self.config.tree(),
            "classes": self.labels.tree(),
            "frame_id": self.frame_id,
        }
        text = json.dumps(tree, sort_keys=True).encode("utf-8")
        return text + b" " * (-len(text) % 8)

    @staticmethod
    def decoded(data: bytes, path: str) -> "MapHeader":
        try:
            tree = json.loads(data.decode("utf-8"))
            labels = LabelSet.from_tree(tree["classes"], path)
            config = MapConfig.from_tree(tree["config"]).checked(len(labels))
            return MapHeader(config, labels, str(tree["frame_id"]))
        except (ValueError, KeyError, TypeError, ConfigError) as error:
            raise DataError("%s: damaged header (%s)" % (path, error)) from error

    def require_same(self, other: "MapHeader", what: str) -> None:
        """DataError unless the records of both may be added."""
        if not self.config.can_add(other.config):
            raise DataError(
                "%s: made with another configuration: %s, not %s"
                % (what, other.config.tree(), self.config.tree())
            )
        if self.labels != other.labels:
            raise DataError("%s: made with another class set" % what)
        if self.frame_id != other.frame_id:
            raise DataError("%s: in frame %s, not %s" % (what, other.frame_id, self.frame_id))


def tiles_of(records: np.ndarray) -> List[Tuple[Tile, int, int]]:
    """((tile x, tile y), begin, end) of records in canonical order."""
    if not len(records):
        return []
    x, y = records["x"] >> TILE_BITS, records["y"] >> TILE_BITS
    change = np.flatnonzero((x[1:] != x[:-1]) | (y[1:] != y[:-1])) + 1
    starts = [0] + change.tolist()
    ends = change.tolist() + [len(records)]
    return [((int(x[a]), int(y[a])), a, b) for a, b in zip(starts, ends)]


class MapWriter:
    """A new map file as a context manager; it gets its name only if the block ends well. Tiles must
    come in order."""

    def __init__(self, path: str, header: MapHeader):
        self.path = path
        self._tiles: List[Tuple[int, int, int]] = []
        self._file = AtomicFile(path)
        with self._file.opening():
            self._stream: BinaryIO = open(self._file.temporary, "wb")
            encoded = header.encoded()
            self._stream.write(_BEGIN + struct.pack("<Q", len(encoded)) + encoded)

    def __enter__(self) -> "MapWriter":
        return self

    def write(self, records: np.ndarray) -> None:
        """Appends whole tiles of records in canonical order."""
        for tile, begin, end in tiles_of(records):
            if self._tiles and tile <= self._tiles[-1][:2]:
                raise AssertionError("tile %s after %s" % (tile, self._tiles[-1]))
            self._tiles.append((tile[0], tile[1], end - begin))
        try:
            self._stream.write(np.ascontiguousarray(records).view(np.uint8))
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        try:
            if kind is None:
                for tile in self._tiles:
                    self._stream.write(_TILE.pack(*tile))
                self._stream.write(_LAST.pack(len(self._tiles), _END))
            self._stream.close()
            if kind is None:
                self._file.commit()
        except OSError as close_error:
            if kind is None:
                raise cannot_write(self.path, close_error) from close_error
        finally:
            self._file.discard()


class MapReader:
    """A map file: `header`, and its tiles one by one."""

    def __init__(self, path: str):
        self.path = path
        try:
            with open(path, "rb") as stream:
                self._open(stream, os.path.getsize(path))
        except OSError as error:
            raise DataError("%s: %s" % (path, error.strerror or error)) from error

    def _open(self, stream: BinaryIO, size: int) -> None:
        start = stream.read(16)
        if len(start) < 16 or start[:8] != _BEGIN:
            raise DataError("%s: not a map file" % self.path)
        (length,) = struct.unpack("<Q", start[8:])
        if size < 16 + length + _LAST.size:
            raise DataError("%s: cut off" % self.path)
        self.header = MapHeader.decoded(stream.read(length), self.path)
        self.dtype = record_dtype(len(self.header.labels))
        stream.seek(size - _LAST.size)
        count, end = _LAST.unpack(stream.read(_LAST.size))
        begin = 16 + length
        index_at = size - _LAST.size - count * _TILE.size
        if end != _END or index_at < begin:
            raise DataError("%s: cut off" % self.path)
        stream.seek(index_at)
        index = stream.read(count * _TILE.size)
        self.tiles: Dict[Tile, Tuple[int, int]] = {}  # tile -> offset in the file, records
        offset = begin
        for number in range(count):
            x, y, records = _TILE.unpack_from(index, number * _TILE.size)
            self.tiles[(x, y)] = (offset, records)
            offset += records * self.dtype.itemsize
        if offset != index_at:
            raise DataError("%s: damaged index of tiles" % self.path)

    def __len__(self) -> int:
        """Number of voxels."""
        return sum(count for _, count in self.tiles.values())

    def tile(self, tile: Tile) -> np.ndarray:
        """Records of a tile, (0,) if the map has none there."""
        if tile not in self.tiles:
            return np.zeros(0, dtype=self.dtype)
        offset, count = self.tiles[tile]
        with open(self.path, "rb") as stream:
            stream.seek(offset)
            data = stream.read(count * self.dtype.itemsize)
        return np.frombuffer(data, dtype=self.dtype)

    def read_tiles(self) -> Iterator[np.ndarray]:
        """Records, tile by tile, in order."""
        for tile in self.tiles:
            yield self.tile(tile)

    def records(self) -> np.ndarray:
        """All of them at once."""
        parts = list(self.read_tiles())
        return np.concatenate(parts) if parts else np.zeros(0, dtype=self.dtype)


def merge_files(paths: Sequence[str], target: str, header: MapHeader) -> None:
    """Adds map files tile by tile; needs the memory of the fullest tile."""
    readers = [MapReader(path) for path in paths]
    for reader in readers:
        header.require_same(reader.header, reader.path)
    with MapWriter(target, header) as writer:
        for tile in sorted(set().union(*(reader.tiles for reader in readers))):
            sources = [reader for reader in readers if tile in reader.tiles]
            if len(sources) == 1:
                writer.write(sources[0].tile(tile))
                continue
            total = VoxelMap(header.config, header.labels)
            for reader in sources:
                total.add(reader.tile(tile))
            writer.write(total.records())

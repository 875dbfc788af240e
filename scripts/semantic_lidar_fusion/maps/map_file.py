# SPDX-License-Identifier: MIT
"""The map file (.voxels): records and bricks in canonical order, tile after tile.

  "SLFVOX02" | uint64 length of the header | header (JSON, padded with blanks to 8 bytes)
  | per tile: records, bricks | path
  | per tile: int32 x, int32 y, uint64 records, uint64 bricks, uint32 CRC-32 of both, uint32 0
  | uint64 tiles, uint64 poses of the path, uint32 CRC-32 of the path, uint32 CRC-32 of everything
    from "SLFVOX02" to the header's end and from the index of tiles to here | "SLFVOXEN"

Little-endian. The header holds the map's configuration, class set and frame. Equal maps are equal
files; a file without its end was cut off. A tile is 256 voxels wide in x and y.
"""

import json
import os
import struct
import zlib
from typing import IO, Any, BinaryIO, Dict, Iterator, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.errors import ConfigError, DataError, cannot_write
from semantic_lidar_fusion.files import AtomicFile, open_file
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.maps.records import BRICK, BRICK_BITS, PATH, TILE_BITS, record_dtype
from semantic_lidar_fusion.maps.semantic_map import MapConfig, VoxelMap

_BEGIN, _END = b"SLFVOX02", b"SLFVOXEN"
_OLD = b"SLFVOX01"
_TILE = struct.Struct("<iiQQII")
_LAST = struct.Struct("<QQII8s")
_MAX_HEADER = 1 << 24  # bytes
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


def tiles_of(entries: np.ndarray, bits: int = 0) -> List[Tuple[Tile, int, int]]:
    """((tile x, tile y), begin, end) of records, or bricks of 2^bits voxels, in canonical order."""
    if not len(entries):
        return []
    x, y = entries["x"] >> (TILE_BITS - bits), entries["y"] >> (TILE_BITS - bits)
    change = np.flatnonzero((x[1:] != x[:-1]) | (y[1:] != y[:-1])) + 1
    bounds = [0, *(int(at) for at in change), len(entries)]
    return [((int(x[a]), int(y[a])), a, b) for a, b in zip(bounds[:-1], bounds[1:])]


def joined_path(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Paths (N,) of PATH as one, in the order of time; of equal stamps the first is kept."""
    path = np.concatenate([np.zeros(0, dtype=PATH), *parts])
    return path[np.unique(path["stamp_ns"], return_index=True)[1]]


class MapWriter:
    """A new map file as a context manager; it gets its name only if the block ends well. Tiles must
    come in order."""

    def __init__(self, path: str, header: MapHeader):
        self.path = path
        self._tiles: List[Tuple[int, int, int, int, int, int]] = []
        self._poses = np.zeros(0, dtype=PATH)
        self._file = AtomicFile(path)
        encoded = header.encoded()
        self._head = _BEGIN + struct.pack("<Q", len(encoded)) + encoded
        with self._file.opening():
            self._stream: BinaryIO = open(self._file.temporary, "wb")
            self._stream.write(self._head)

    def __enter__(self) -> "MapWriter":
        return self

    def write(self, records: np.ndarray, bricks: np.ndarray) -> None:
        """Appends whole tiles of records and bricks in canonical order."""
        spans: Dict[Tile, List[np.ndarray]] = {}
        for tile, begin, end in tiles_of(records):
            spans[tile] = [records[begin:end], bricks[:0]]
        for tile, begin, end in tiles_of(bricks, BRICK_BITS):
            spans.setdefault(tile, [records[:0], bricks[:0]])[1] = bricks[begin:end]
        for tile in sorted(spans):
            if self._tiles and tile <= self._tiles[-1][:2]:
                raise AssertionError("tile %s after %s" % (tile, self._tiles[-1]))
            crc = 0
            for part in spans[tile]:
                data = np.ascontiguousarray(part).tobytes()
                crc = zlib.crc32(data, crc)
                self._write(data)
            own, crossed = spans[tile]
            self._tiles.append((tile[0], tile[1], len(own), len(crossed), crc, 0))

    def add_path(self, path: np.ndarray) -> None:
        """The file's path, in the order of time."""
        self._poses = path

    def _write(self, data: Any) -> None:
        try:
            self._stream.write(data)
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        try:
            if kind is None:
                poses = self._poses.tobytes()
                index = b"".join(_TILE.pack(*tile) for tile in self._tiles)
                numbers = (len(self._tiles), len(self._poses), zlib.crc32(poses))
                crc = zlib.crc32(index + struct.pack("<QQI", *numbers), zlib.crc32(self._head))
                self._write(poses + index + _LAST.pack(*numbers, crc, _END))
            self._stream.close()
            if kind is None:
                self._file.commit()
        except OSError as close_error:
            if kind is None:
                raise cannot_write(self.path, close_error) from close_error
        finally:
            self._file.discard()


class _Place(NamedTuple):
    """Where a tile lies in its file."""

    offset: int
    records: int
    bricks: int
    crc: int


class MapReader:
    """A map file: `header`, `path` (PATH), and its tiles one by one. Whatever is read is checked
    against the file's checksums; DataError if it was damaged."""

    def __init__(self, path: str):
        self.path_name = path
        try:
            with open_file(path) as stream:
                self._open(stream, os.fstat(stream.fileno()).st_size)
        except OSError as error:
            raise DataError("%s: %s" % (path, error.strerror or error)) from error

    def _damaged(self, what: str) -> DataError:
        return DataError("%s: %s" % (self.path_name, what))

    def _open(self, stream: IO[bytes], size: int) -> None:
        start = stream.read(16)
        if start[:8] == _OLD:
            raise self._damaged("a map of an earlier version; build it again from its bags")
        if len(start) < 16 or start[:8] != _BEGIN:
            raise self._damaged("not a map file")
        (length,) = struct.unpack("<Q", start[8:])
        if length > _MAX_HEADER or size < 16 + length + _LAST.size:
            raise self._damaged("cut off, or damaged")
        encoded = stream.read(length)
        stream.seek(size - _LAST.size)
        tiles, poses, path_crc, crc, end = _LAST.unpack(stream.read(_LAST.size))
        index_at = size - _LAST.size - tiles * _TILE.size
        path_at = index_at - poses * PATH.itemsize
        if end != _END or path_at < 16 + length:
            raise self._damaged("cut off")
        stream.seek(path_at)
        path = stream.read(poses * PATH.itemsize)
        index = stream.read(tiles * _TILE.size)
        numbers = struct.pack("<QQI", tiles, poses, path_crc)
        if crc != zlib.crc32(index + numbers, zlib.crc32(start + encoded)):
            raise self._damaged("damaged: the checksum of its header does not match")
        if path_crc != zlib.crc32(path):
            raise self._damaged("damaged: the checksum of its path does not match")
        self.header = MapHeader.decoded(encoded, self.path_name)
        self.dtype = record_dtype(len(self.header.labels))
        self.path = np.frombuffer(path, dtype=PATH)
        self.tiles: Dict[Tile, _Place] = {}
        offset = 16 + length
        for x, y, records, bricks, tile_crc, _ in _TILE.iter_unpack(index):
            self.tiles[(x, y)] = _Place(offset, records, bricks, tile_crc)
            offset += records * self.dtype.itemsize + bricks * BRICK.itemsize
        if offset != path_at:
            raise self._damaged("damaged index of tiles")

    def __len__(self) -> int:
        """Number of voxels with returns."""
        return sum(place.records for place in self.tiles.values())

    @property
    def begin_ns(self) -> int:
        """The stamp of its first cloud."""
        return int(self.path["stamp_ns"][0]) if len(self.path) else 0

    def tile(self, tile: Tile) -> Tuple[np.ndarray, np.ndarray]:
        """Records and bricks of a tile, (0,) if the map has none there."""
        place = self.tiles.get(tile)
        if place is None:
            return np.zeros(0, dtype=self.dtype), np.zeros(0, dtype=BRICK)
        size = place.records * self.dtype.itemsize
        try:
            with open(self.path_name, "rb") as stream:
                stream.seek(place.offset)
                data = stream.read(size + place.bricks * BRICK.itemsize)
        except OSError as error:
            raise self._damaged(str(error.strerror or error)) from error
        if zlib.crc32(data) != place.crc:
            raise self._damaged("damaged: the checksum of tile %d, %d does not match" % tile)
        return (
            np.frombuffer(data, dtype=self.dtype, count=place.records),
            np.frombuffer(data, dtype=BRICK, offset=size),
        )

    def read_tiles(self) -> Iterator[Tuple[Tile, np.ndarray, np.ndarray]]:
        """Tile, records and bricks, in order."""
        for tile in self.tiles:
            yield (tile, *self.tile(tile))

    def records(self) -> np.ndarray:
        """All of them at once."""
        parts = [records for _, records, _ in self.read_tiles()]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=self.dtype)


def merge_files(
    paths: Sequence[str], target: str, header: MapHeader, path: Optional[np.ndarray] = None
) -> None:
    """Adds map files, which come in the order of time, tile by tile; needs the memory of the fullest
    tile. `path` takes the place of theirs."""
    readers = [MapReader(name) for name in paths]
    for reader in readers:
        header.require_same(reader.header, reader.path_name)
    with MapWriter(target, header) as writer:
        for tile in sorted(set().union(*(reader.tiles for reader in readers))):
            sources = [reader for reader in readers if tile in reader.tiles]
            if len(sources) == 1:
                writer.write(*sources[0].tile(tile))
                continue
            total = VoxelMap(header.config, header.labels)
            for reader in sources:
                total.add(*reader.tile(tile))
            writer.write(total.records(), total.bricks())
        writer.add_path(joined_path([r.path for r in readers]) if path is None else path)

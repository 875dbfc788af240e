# SPDX-License-Identifier: MIT
"""From bags with semantic clouds, or submaps, to one map file, in one process or many.

The drives are cut into parts of a few scans. Every part becomes records and bricks, wherever it is
computed; they are added up here in the order of time, and spilled to disk when they outgrow the memory
that they may take. One process, many workers and a cluster give the same bytes.
"""

import dataclasses
import functools
import os
from typing import (
    Dict,
    Iterable,
    List,
    NamedTuple,
    Optional,
    Sequence,
    Tuple,
    Union,
)

import numpy as np

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags.bag_io import BagReader
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.maps import submaps
from semantic_lidar_fusion.maps.drive import Drive, clouds_of
from semantic_lidar_fusion.maps.map_file import (
    MapHeader,
    MapReader,
    MapWriter,
    joined_path,
    merge_files,
)
from semantic_lidar_fusion.maps.records import pose_of_path
from semantic_lidar_fusion.maps.semantic_map import COUNTS, VoxelMap
from semantic_lidar_fusion.work import Work, in_order

SCANS_PER_PART = 20


class Part(NamedTuple):
    """Clouds of a drive recorded from begin_ns to end_ns, inclusive."""

    drive: Drive
    begin_ns: int
    end_ns: int


class Submaps(NamedTuple):
    """A file of submaps to place by files of poses: one for each of its drives, or none at all."""

    path: str
    poses: Tuple[str, ...] = ()
    poses_frame: str = ""


class SubmapPart(NamedTuple):
    """A submap and T_map_lidar (N, 4, 4) of its clouds, where they are known (N,)."""

    path: str
    number: int
    begin_ns: int
    poses: np.ndarray
    known: np.ndarray


AnyPart = Union[Part, SubmapPart]


def submap_parts(source: Submaps) -> List[List[SubmapPart]]:
    """The submaps of each drive of a file."""
    reader = submaps.SubmapReader(source.path)
    poses, known = reader.placed(source.poses, source.poses_frame)
    result: List[List[SubmapPart]] = [[] for _ in reader.drives]
    for number in np.unique(reader.clouds["submap"]):
        own = np.flatnonzero(reader.clouds["submap"] == number)
        first = reader.clouds[own[0]]
        begin = int(first["stamp_ns"])
        part = SubmapPart(source.path, int(number), begin, poses[own], known[own])
        result[int(first["drive"])].append(part)
    return result


def parts_of(drive: Drive, scans: int = SCANS_PER_PART) -> List[Part]:
    """The drive in parts of so many clouds; clouds of one record time stay together."""
    with BagReader(drive.clouds) as bag:
        bag.require_topic(drive.topic, "sensor_msgs/PointCloud2")
        stamps = sorted(set(bag.stamps_ns(drive.topic)))
    cuts = [stamps[i : i + scans] for i in range(0, len(stamps), scans)]
    return [Part(drive, cut[0], cut[-1]) for cut in cuts]


class PartResult(NamedTuple):
    """Records and bricks (in any order) and path of a part; clouds, of which without_pose were
    dropped, and what became of the points of the others (COUNTS)."""

    records: np.ndarray
    bricks: np.ndarray
    path: np.ndarray
    clouds: int
    without_pose: int
    points: Dict[str, int]
    submap: Optional[submaps.Submap] = None


def compute_part(
    part: AnyPart, header_bytes: bytes, keep: bool = False, native: Optional[bool] = None
) -> PartResult:
    """Maps a part; runs in any process that reaches its file. keep: also make its submap."""
    header = MapHeader.decoded(header_bytes, "header")
    if isinstance(part, SubmapPart):
        return _place_part(part, header, native)
    voxels = VoxelMap(header.config, header.labels, native)
    maker = submaps.SubmapMaker() if keep else None
    clouds = without_pose = 0
    path: List[np.ndarray] = []
    points = dict.fromkeys(COUNTS, 0)
    for seen in clouds_of(part.drive, header.frame_id, part.begin_ns, part.end_ns):
        clouds += 1
        if seen is None:
            without_pose += 1
            continue
        path.append(pose_of_path(seen.cloud.stamp_ns, seen.vehicle))
        for name, count in voxels.integrate(seen.cloud, seen.pose, seen.origins).items():
            points[name] += count
        if maker is not None:
            maker.add(seen)
    return PartResult(
        voxels.records(in_order=False),
        voxels.bricks(in_order=False),
        joined_path(path),
        clouds,
        without_pose,
        points,
        None if maker is None else maker.finish(voxels),
    )


def _place_part(part: SubmapPart, header: MapHeader, native: Optional[bool]) -> PartResult:
    submap = submaps.reader_of(part.path).submap(part.number)
    placed = submaps.place(submap, part.poses, part.known, header, native)
    return PartResult(
        placed.voxels.records(in_order=False),
        placed.voxels.bricks(in_order=False),
        placed.path,
        len(part.known),
        placed.without_pose,
        placed.points,
    )


class Accumulator:
    """Adds up what comes in the order of time, and spills it to files in `folder` beyond
    `memory_bytes`."""

    def __init__(self, header: MapHeader, folder: str, memory_bytes: int):
        self.header, self.folder, self.memory_bytes = header, folder, memory_bytes
        self.voxels = VoxelMap(header.config, header.labels)
        self._path: List[np.ndarray] = []
        self._runs: List[str] = []

    def add(self, records: np.ndarray, bricks: np.ndarray, path: np.ndarray) -> None:
        self.voxels.add(records, bricks)
        self._path.append(path)
        if self.voxels.memory_bytes > self.memory_bytes:
            self.spill()

    def spill(self) -> None:
        target = os.path.join(self.folder, "run%05d.voxels" % len(self._runs))
        with MapWriter(target, self.header) as writer:
            writer.write(self.voxels.records(), self.voxels.bricks())
            writer.add_path(joined_path(self._path))
        self._runs.append(target)
        self.voxels.clear()
        self._path = []

    def write(self, target: str, others: Iterable[str] = ()) -> None:
        """Writes the sum of everything, and of the map files `others`, as one map file."""
        if self._path:
            self.spill()
        sources = self._runs + list(others)
        if sources == self._runs and len(sources) == 1:
            os.replace(self._runs.pop(), target)
            return
        merge_files(sorted(sources, key=lambda p: MapReader(p).begin_ns), target, self.header)
        for run in self._runs:
            os.remove(run)
        self._runs = []


@dataclasses.dataclass
class Totals:
    clouds: int = 0
    without_pose: int = 0
    points: Dict[str, int] = dataclasses.field(default_factory=lambda: dict.fromkeys(COUNTS, 0))

    def add(self, result: PartResult) -> None:
        self.clouds += result.clouds
        self.without_pose += result.without_pose
        for name, count in result.points.items():
            self.points[name] += count


def map_drives(
    drives: List[Drive],
    header: MapHeader,
    work: Work,
    accumulator: Accumulator,
    kept: Sequence[Submaps] = (),
    writer: Optional[submaps.SubmapWriter] = None,
) -> Totals:
    """Adds all clouds of the drives and of files of submaps to the accumulator, the earliest drive
    first. `writer` takes the submaps of the drives."""
    by_drive: List[Sequence[AnyPart]] = [parts_of(drive) for drive in drives]
    for source in kept:
        by_drive += submap_parts(source)
    by_drive.sort(key=lambda p: p[0].begin_ns if p else 0)
    parts = [part for of_drive in by_drive for part in of_drive]
    compute = functools.partial(
        compute_part, header_bytes=header.encoded(), keep=writer is not None
    )
    totals = Totals()
    results = in_order(parts, compute, work)
    for part, result in zip(parts, cli.progress(results, len(parts), "map")):
        totals.add(result)
        if writer is not None and isinstance(part, Part) and result.submap is not None:
            writer.add(result.submap, drives.index(part.drive))
        accumulator.add(result.records, result.bricks, result.path)
    if totals.clouds and totals.clouds == totals.without_pose:
        raise DataError(
            "no pose covers any of the %d clouds; fused bags hold no tf: name the bags that do with "
            "--tf, or give --poses" % totals.clouds
        )
    return totals


class Inputs(NamedTuple):
    """What a map is made of: bags, files of submaps, and map files."""

    bags: List[str]
    submaps: List[str]
    maps: List[str]


def check_inputs(paths: Sequence[str]) -> Inputs:
    """Splits inputs by their endings."""
    maps = [path for path in paths if path.endswith(".voxels")]
    kept = [path for path in paths if path.endswith(submaps.ENDING)]
    return Inputs([path for path in paths if path not in maps + kept], kept, maps)

# SPDX-License-Identifier: MIT
"""From bags with semantic clouds, or submaps, to one map file, in one process or many.

The drives are cut into parts of a few scans. Every part becomes records and bricks, wherever it is
computed; they are added up here in the order of time, and spilled to disk when they outgrow the memory
that they may take. One process, many workers and a cluster give the same bytes.
"""

import collections
import dataclasses
import functools
import os
import time
from concurrent import futures
from typing import (
    Any,
    Callable,
    Deque,
    Dict,
    Iterable,
    Iterator,
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

SCANS_PER_PART = 20
# What does not answer for so long is lost (s).
DASK_PATIENCE_S = 5.0


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


Compute = Callable[[AnyPart], PartResult]


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


class Work(NamedTuple):
    """How to compute: workers > 1 are processes on this machine; scheduler is a Dask address."""

    workers: int = 1
    scheduler: Optional[str] = None


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
    results = _results(parts, compute, work)
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


def _results(parts: List[AnyPart], compute: Compute, work: Work) -> Iterator[PartResult]:
    if work.scheduler is not None:
        return _dask_results(parts, compute, work.scheduler)
    if work.workers > 1:
        return _process_results(parts, compute, work.workers)
    return (compute(part) for part in parts)


def _in_order(
    parts: List[AnyPart],
    limit: int,
    submit: Callable[[AnyPart], Any],
    wait: Callable[[Any], PartResult],
) -> Iterator[PartResult]:
    """Results in the order of the parts, with at most `limit` on their way: finished ones hold
    memory."""
    remaining: Deque[AnyPart] = collections.deque(parts)
    flying: Deque[Any] = collections.deque()
    try:
        while remaining or flying:
            while remaining and len(flying) < limit:
                flying.append(submit(remaining.popleft()))
            yield wait(flying[0])
            flying.popleft()
    finally:
        for future in flying:
            future.cancel()


def _process_results(parts: List[AnyPart], compute: Compute, workers: int) -> Iterator[PartResult]:
    with futures.ProcessPoolExecutor(max_workers=workers) as pool:
        try:
            yield from _in_order(
                parts,
                2 * workers,
                lambda part: pool.submit(compute, part),
                lambda future: future.result(),
            )
        except futures.process.BrokenProcessPool as error:
            raise DataError("a worker process died (out of memory?)") from error


def _dask_results(parts: List[AnyPart], compute: Compute, scheduler: str) -> Iterator[PartResult]:
    cli.require("distributed")
    import logging

    import distributed

    # Its own complaints, a page each, come before the line that says what it means.
    logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)
    logging.getLogger("tornado").setLevel(logging.CRITICAL + 1)
    try:
        client = distributed.Client(scheduler, timeout=DASK_PATIENCE_S)
    except Exception as error:  # whatever an address may be wrong in
        raise DataError("no Dask scheduler at %s (%s)" % (scheduler, error)) from error
    try:
        workers = _dask_workers(client)
        if not workers:
            try:
                client.wait_for_workers(1, timeout=DASK_PATIENCE_S)
            except Exception as error:
                raise DataError("the Dask scheduler at %s has no workers" % scheduler) from error
        yield from _in_order(
            parts,
            2 * max(1, workers),
            lambda part: client.submit(compute, part, pure=False),
            lambda future: _dask_wait(client, future, scheduler),
        )
    finally:
        try:
            client.close(timeout=1)
        except Exception:
            pass  # a scheduler that is gone cannot be told


def _dask_workers(client: Any) -> int:
    return len(client.scheduler_info().get("workers", {}))


def _dask_wait(client: Any, future: Any, scheduler: str) -> PartResult:
    """The result of a future; DataError if its cluster is lost."""
    from distributed.comm import CommClosedError
    from distributed.scheduler import KilledWorker

    good_at = time.monotonic()
    while not future.done():
        time.sleep(0.02)
        alive = client.status == "running"
        if alive and _dask_workers(client):
            good_at = time.monotonic()
        elif time.monotonic() - good_at > DASK_PATIENCE_S:
            what = (
                "all workers of the Dask scheduler at %s" if alive else "the Dask scheduler at %s"
            )
            raise DataError((what + " are gone" if alive else what + " is gone") % scheduler)
    try:
        return future.result(timeout=DASK_PATIENCE_S)  # type: ignore[no-any-return]
    except ImportError as error:
        raise DataError(
            "a Dask worker cannot import the package (%s); start the workers with its setup.bash "
            "sourced" % error
        ) from error
    except KilledWorker as error:
        raise DataError("Dask workers died again and again (out of memory?)") from error
    except (futures.CancelledError, CommClosedError, TimeoutError, OSError) as error:
        raise DataError("the Dask scheduler at %s is gone (%s)" % (scheduler, type(error).__name__)) from error  # fmt: skip


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

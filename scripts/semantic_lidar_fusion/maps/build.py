# SPDX-License-Identifier: MIT
"""From bags with semantic clouds to one map file, in one process or many.

The drives are cut into parts of a few scans. Every part becomes records and bricks, wherever it is
computed; they are added up here in the order of time, and spilled to disk when they outgrow the memory
that they may take. One process, many workers and a cluster give the same bytes.
"""

import collections
import dataclasses
import os
import time
from concurrent import futures
from typing import Any, Callable, Deque, Dict, Iterable, Iterator, List, NamedTuple, Optional, Tuple

import numpy as np

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags.bag_io import BagReader
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.maps.drive import Drive, clouds_of
from semantic_lidar_fusion.maps.map_file import (
    MapHeader,
    MapReader,
    MapWriter,
    joined_path,
    merge_files,
)
from semantic_lidar_fusion.maps.records import BRICK, PATH, record_dtype
from semantic_lidar_fusion.maps.semantic_map import COUNTS, VoxelMap

SCANS_PER_PART = 20
# What does not answer for so long is lost (s).
DASK_PATIENCE_S = 5.0


class Part(NamedTuple):
    """Clouds of a drive recorded from begin_ns to end_ns, inclusive."""

    drive: Drive
    begin_ns: int
    end_ns: int


def parts_of(drive: Drive, scans: int = SCANS_PER_PART) -> List[Part]:
    """The drive in parts of so many clouds; clouds of one record time stay together."""
    with BagReader(drive.clouds) as bag:
        bag.require_topic(drive.topic, "sensor_msgs/PointCloud2")
        stamps = sorted(set(bag.stamps_ns(drive.topic)))
    cuts = [stamps[i : i + scans] for i in range(0, len(stamps), scans)]
    return [Part(drive, cut[0], cut[-1]) for cut in cuts]


class PartResult(NamedTuple):
    """Records, bricks and path (bytes of their types) of a part; clouds, of which without_pose were
    dropped, and what became of the points of the others (COUNTS)."""

    records: bytes
    bricks: bytes
    path: bytes
    clouds: int
    without_pose: int
    points: Dict[str, int]


def pose_of_path(stamp_ns: int, position: np.ndarray) -> np.ndarray:
    """(1,) of PATH."""
    return np.array([(stamp_ns, *(float(v) for v in position))], dtype=PATH)


def compute_part(part: Part, header_bytes: bytes, native: Optional[bool] = None) -> PartResult:
    """Maps a part; runs in any process that reaches the bags."""
    header = MapHeader.decoded(header_bytes, "header")
    voxels = VoxelMap(header.config, header.labels, native)
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
    return PartResult(
        voxels.records().tobytes(),
        voxels.bricks().tobytes(),
        joined_path(path).tobytes(),
        clouds,
        without_pose,
        points,
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
    drives: List[Drive], header: MapHeader, work: Work, accumulator: Accumulator
) -> Totals:
    """Adds all clouds of the drives to the accumulator, the earliest drive first."""
    by_drive = sorted(
        (parts_of(drive) for drive in drives), key=lambda p: p[0].begin_ns if p else 0
    )
    parts = [part for of_drive in by_drive for part in of_drive]
    encoded = header.encoded()
    totals = Totals()
    dtype = record_dtype(len(header.labels))
    for result in cli.progress(_results(parts, encoded, work), len(parts), "map"):
        totals.add(result)
        accumulator.add(
            np.frombuffer(result.records, dtype=dtype),
            np.frombuffer(result.bricks, dtype=BRICK),
            np.frombuffer(result.path, dtype=PATH),
        )
    if totals.clouds and totals.clouds == totals.without_pose:
        raise DataError(
            "no pose covers any of the %d clouds; fused bags hold no tf: name the bags that do with "
            "--tf, or give --poses" % totals.clouds
        )
    return totals


def _results(parts: List[Part], header: bytes, work: Work) -> Iterator[PartResult]:
    if work.scheduler is not None:
        return _dask_results(parts, header, work.scheduler)
    if work.workers > 1:
        return _process_results(parts, header, work.workers)
    return (compute_part(part, header) for part in parts)


def _in_order(
    parts: List[Part], limit: int, submit: Callable[[Part], Any], wait: Callable[[Any], PartResult]
) -> Iterator[PartResult]:
    """Results in the order of the parts, with at most `limit` on their way: finished ones hold
    memory."""
    remaining: Deque[Part] = collections.deque(parts)
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


def _process_results(parts: List[Part], header: bytes, workers: int) -> Iterator[PartResult]:
    with futures.ProcessPoolExecutor(max_workers=workers) as pool:
        try:
            yield from _in_order(
                parts,
                2 * workers,
                lambda part: pool.submit(compute_part, part, header),
                lambda future: future.result(),
            )
        except futures.process.BrokenProcessPool as error:
            raise DataError("a worker process died (out of memory?)") from error


def _dask_results(parts: List[Part], header: bytes, scheduler: str) -> Iterator[PartResult]:
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
            lambda part: client.submit(compute_part, part, header, pure=False),
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


def check_inputs(paths: List[str]) -> Tuple[List[str], List[str]]:
    """Splits inputs into bags and map files."""
    maps = [path for path in paths if path.endswith(".voxels")]
    return [path for path in paths if path not in maps], maps


def same_header(maps: List[str]) -> MapHeader:
    """The header that these map files share."""
    header = MapReader(maps[0]).header
    for path in maps[1:]:
        header.require_same(MapReader(path).header, path)
    return header

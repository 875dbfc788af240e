# SPDX-License-Identifier: MIT
"""From bags with semantic clouds to one map file, in one process or many.

The drives are cut into parts of a few scans. Every part becomes records, wherever it is computed;
records are added up here and spilled to disk when they outgrow the memory that they may take. Sums
of whole numbers know no order, so that one process, many workers and a cluster give the same bytes.
"""

import dataclasses
import json
import os
from concurrent import futures
from typing import Any, Callable, Dict, Iterable, Iterator, List, NamedTuple, Optional, Tuple

import numpy as np

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags.bag_io import BagReader
from semantic_lidar_fusion.bags.cloud_io import SemanticCloud
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.bags.poses import TransformTree
from semantic_lidar_fusion.maps.semantic_map import COUNTS, VoxelMap, record_dtype
from semantic_lidar_fusion.maps.map_file import MapHeader, MapReader, MapWriter, merge_files

CLOUD_TOPIC = "/points_semantic"
FRAMES = ("map", "odom")  # of the map, the first that tf connects to the clouds
SCANS_PER_PART = 20


class Drive(NamedTuple):
    """A bag with semantic clouds, and the bags that hold its tf (itself, if they are none)."""

    clouds: str
    tf: Tuple[str, ...]
    topic: str = CLOUD_TOPIC
    odometry: str = ""  # topic of nav_msgs/Odometry to take beside tf


class Part(NamedTuple):
    """Clouds of a drive recorded from begin_ns to end_ns, inclusive."""

    drive: Drive
    begin_ns: int
    end_ns: int


_trees: Dict[Tuple[Tuple[str, ...], str], TransformTree] = {}


def transforms_of(drive: Drive) -> TransformTree:
    """The tf of a drive; the last one read is kept."""
    paths = drive.tf or (drive.clouds,)
    key = (paths, drive.odometry)
    if key in _trees:
        return _trees[key]
    tree = TransformTree()
    for path in paths:
        with BagReader(path) as bag:
            for topic in ("/tf_static", "/tf"):
                for item in bag.read([topic]):
                    for transform in item.message.transforms:
                        tree.add(transform, topic == "/tf_static")
            if drive.odometry:
                bag.require_topic(drive.odometry, "nav_msgs/Odometry")
                for item in bag.read([drive.odometry]):
                    tree.add(_as_transform(item.message), False)
    _trees.clear()
    _trees[key] = tree
    return tree


def _as_transform(odometry: Any) -> Any:
    from geometry_msgs.msg import TransformStamped

    result = TransformStamped()
    result.header = odometry.header
    result.child_frame_id = odometry.child_frame_id
    pose = odometry.pose.pose
    result.transform.translation.x = pose.position.x
    result.transform.translation.y = pose.position.y
    result.transform.translation.z = pose.position.z
    result.transform.rotation = pose.orientation
    return result


def first_cloud(drive: Drive) -> SemanticCloud:
    with BagReader(drive.clouds) as bag:
        bag.require_topic(drive.topic, "sensor_msgs/PointCloud2")
        for item in bag.read([drive.topic]):
            return SemanticCloud.from_message(item.message)
    raise DataError("%s: %s is empty" % (drive.clouds, drive.topic))


def class_set(drive: Drive, cloud: SemanticCloud, classes_file: Optional[str]) -> LabelSet:
    """From the file, else the bag's class_info; its names must be the cloud's."""
    if classes_file:
        labels = LabelSet.from_file(classes_file)
    else:
        with BagReader(drive.clouds) as bag:
            if "/class_info" not in bag.topics:
                raise DataError(
                    "%s: no topic /class_info; name the class set with --classes" % drive.clouds
                )
            (message,) = [item.message for item in bag.read(["/class_info"])][:1]
        try:
            labels = LabelSet.from_class_info(json.loads(message.data))
        except ValueError as error:
            raise DataError("%s: class_info is not JSON (%s)" % (drive.clouds, error)) from error
    if labels.names != cloud.class_names:
        raise DataError(
            "%s: its clouds have the classes %s; the class set has %s"
            % (drive.clouds, ", ".join(cloud.class_names), ", ".join(labels.names))
        )
    return labels


def choose_frame(drive: Drive, cloud: SemanticCloud, wanted: Optional[str]) -> str:
    """The map's frame: as wanted, else the first of FRAMES that tf connects to the clouds."""
    tree = transforms_of(drive)
    stamps = np.array([cloud.stamp_ns])
    if wanted:
        tree.lookup(wanted, cloud.frame_id, stamps)
        return wanted.lstrip("/")
    for frame in FRAMES:
        try:
            tree.lookup(frame, cloud.frame_id, stamps)
            return frame
        except DataError:
            continue
    raise DataError(
        "%s: tf connects %s to neither %s; name the map's frame with --frame, and the bag that has "
        "the tf with --tf" % (drive.clouds, cloud.frame_id, " nor ".join(FRAMES))
    )


def parts_of(drive: Drive, scans: int = SCANS_PER_PART) -> List[Part]:
    """The drive in parts of so many clouds; clouds of one record time stay together."""
    with BagReader(drive.clouds) as bag:
        bag.require_topic(drive.topic, "sensor_msgs/PointCloud2")
        stamps = sorted(set(bag.stamps_ns(drive.topic)))
    cuts = [stamps[i : i + scans] for i in range(0, len(stamps), scans)]
    return [Part(drive, cut[0], cut[-1]) for cut in cuts]


class PartResult(NamedTuple):
    """Records (bytes of `record_dtype`) of a part; clouds, of which without_pose were dropped, and
    what became of the points of the others (COUNTS)."""

    records: bytes
    clouds: int
    without_pose: int
    points: Dict[str, int]


def clouds_of(part: Part, frame_id: str) -> Iterator[Tuple[SemanticCloud, Optional[np.ndarray]]]:
    """Clouds of a part with T_map_lidar at their stamps, None where tf does not cover them."""
    tree = transforms_of(part.drive)
    with BagReader(part.drive.clouds) as bag:
        for item in bag.read([part.drive.topic], start_ns=part.begin_ns, end_ns=part.end_ns):
            cloud = SemanticCloud.from_message(item.message)
            poses, covered = tree.lookup(frame_id, cloud.frame_id, np.array([cloud.stamp_ns]))
            yield cloud, poses[0] if covered[0] else None


def compute_part(part: Part, header_bytes: bytes, native: Optional[bool] = None) -> PartResult:
    """Maps a part; runs in any process that reaches the bags."""
    header = MapHeader.decoded(header_bytes, "header")
    voxels = VoxelMap(header.config, header.labels, native)
    clouds = without_pose = 0
    points = dict.fromkeys(COUNTS, 0)
    for cloud, pose in clouds_of(part, header.frame_id):
        clouds += 1
        if pose is None:
            without_pose += 1
            continue
        for name, count in voxels.integrate(cloud, pose).items():
            points[name] += count
    return PartResult(voxels.records().tobytes(), clouds, without_pose, points)


class Accumulator:
    """Adds records up and spills them to files in `folder` beyond `memory_bytes`."""

    def __init__(self, header: MapHeader, folder: str, memory_bytes: int):
        self.header, self.folder, self.memory_bytes = header, folder, memory_bytes
        self.voxels = VoxelMap(header.config, header.labels)
        self._runs: List[str] = []

    def add(self, records: np.ndarray) -> None:
        self.voxels.add(records)
        if self.voxels.memory_bytes > self.memory_bytes:
            self.spill()

    def spill(self) -> None:
        path = os.path.join(self.folder, "run%05d.voxels" % len(self._runs))
        with MapWriter(path, self.header) as writer:
            writer.write(self.voxels.records())
        self._runs.append(path)
        self.voxels.clear()

    def write(self, target: str, others: Iterable[str] = ()) -> None:
        """Writes the sum of everything, and of the map files `others`, as one map file."""
        if len(self.voxels):
            self.spill()
        merge_files(self._runs + list(others), target, self.header)
        for path in self._runs:
            os.remove(path)
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
    """Adds all clouds of the drives to the accumulator."""
    parts = [part for drive in drives for part in parts_of(drive)]
    encoded = header.encoded()
    totals = Totals()
    dtype = record_dtype(len(header.labels))
    for result in cli.progress(_results(parts, encoded, work), len(parts), "map"):
        totals.add(result)
        accumulator.add(np.frombuffer(result.records, dtype=dtype))
    if totals.clouds and totals.clouds == totals.without_pose:
        raise DataError(
            "tf covers none of the %d clouds; fused bags hold no tf: name the bags that do with --tf"
            % totals.clouds
        )
    return totals


def _results(parts: List[Part], header: bytes, work: Work) -> Iterator[PartResult]:
    if work.scheduler:
        return _dask_results(parts, header, work.scheduler)
    if work.workers > 1:
        return _process_results(parts, header, work.workers)
    return (compute_part(part, header) for part in parts)


def _in_flight(
    parts: List[Part], limit: int, submit: Callable[[Part], Any], wait: Callable[[Any], Any]
) -> Iterator[PartResult]:
    """Results in any order, with at most `limit` parts on their way: finished ones hold memory."""
    remaining, flying = list(reversed(parts)), set()  # type: Any
    try:
        while remaining or flying:
            while remaining and len(flying) < limit:
                flying.add(submit(remaining.pop()))
            done, flying = wait(flying)
            for future in done:
                yield future.result()
    finally:
        for future in flying:
            future.cancel()


def _process_results(parts: List[Part], header: bytes, workers: int) -> Iterator[PartResult]:
    with futures.ProcessPoolExecutor(max_workers=workers) as pool:

        def wait(flying: Any) -> Any:
            return futures.wait(flying, return_when=futures.FIRST_COMPLETED)

        try:
            yield from _in_flight(
                parts, workers + 2, lambda part: pool.submit(compute_part, part, header), wait
            )
        except futures.process.BrokenProcessPool as error:
            raise DataError("a worker process died (out of memory?)") from error


def _dask_results(parts: List[Part], header: bytes, scheduler: str) -> Iterator[PartResult]:
    cli.require("distributed")
    import distributed

    try:
        client = distributed.Client(scheduler, timeout=20)
    except (OSError, ValueError, TimeoutError) as error:
        raise DataError("no Dask scheduler at %s (%s)" % (scheduler, error)) from error
    try:
        workers = max(1, len(client.scheduler_info()["workers"]))

        def wait(flying: Any) -> Any:
            return distributed.wait(list(flying), return_when="FIRST_COMPLETED")

        def submit(part: Part) -> Any:
            return client.submit(compute_part, part, header, pure=False)

        for result in _in_flight(parts, 2 * workers, submit, wait):
            yield result
    except ImportError as error:
        raise DataError(
            "a Dask worker cannot import the package (%s); start the workers with its setup.bash "
            "sourced" % error
        ) from error
    finally:
        client.close()


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

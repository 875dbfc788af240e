# SPDX-License-Identifier: MIT
"""From what build_semantic_map.py is asked for to its files."""

import dataclasses
import os
import tempfile
from typing import Dict, List, Optional, Tuple

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.errors import ConfigError, DataError
from semantic_lidar_fusion.installation import package_file
from semantic_lidar_fusion.labels import LabelSet
from semantic_lidar_fusion.maps import formats
from semantic_lidar_fusion.maps.build import (
    Accumulator,
    Totals,
    Work,
    check_inputs,
    map_drives,
    same_header,
)
from semantic_lidar_fusion.maps.drive import (
    CLOUD_TOPIC,
    VEHICLE_FRAME,
    Drive,
    choose_frame,
    class_set,
    first_cloud,
)
from semantic_lidar_fusion.maps.formats import MAP_FILE
from semantic_lidar_fusion.maps.map_file import MapHeader, MapReader
from semantic_lidar_fusion.maps.output import Exported, OutputFolder, export_map, written_files
from semantic_lidar_fusion.maps.raster import Costs
from semantic_lidar_fusion.maps.semantic_map import MapConfig


@dataclasses.dataclass(frozen=True)
class Request:
    """What to build: the options of build_semantic_map.py, which its --help explains."""

    out: str
    inputs: Tuple[str, ...] = ()
    live: str = ""
    duration: Optional[float] = None
    overwrite: bool = False
    formats: Optional[Tuple[str, ...]] = None
    epsg: Optional[int] = None
    scan_labels: bool = False
    tf: Tuple[str, ...] = ()
    topic: str = CLOUD_TOPIC
    odometry: str = ""
    poses: Tuple[str, ...] = ()
    poses_frame: str = ""
    vehicle_frame: str = VEHICLE_FRAME
    frame: str = ""
    classes: str = ""
    costs: str = ""
    prior: Tuple[Tuple[str, float], ...] = ()
    config: MapConfig = MapConfig()
    work: Work = Work()
    memory_mb: int = 1024


def build(request: Request) -> Tuple[str, bool]:
    """Does what is asked for; the text to print, and whether all was written."""
    wanted = _formats(request.formats)
    output = OutputFolder(request.out, request.overwrite)
    try:
        with output:
            header, totals, exported = _fill(request, output.partial, wanted)
    finally:
        output.discard()
    for name, reason in exported.failed.items():
        cli.warn("%s is not written: %s" % (name, reason))
    return _report(request.out, header, totals, exported.counts), not exported.failed


def _fill(request: Request, folder: str, wanted: List[str]) -> Tuple[MapHeader, Totals, Exported]:
    """Makes the map and its exports in a folder."""
    header, totals = (_map_live if request.live else _map_files)(request, folder)
    costs_file = request.costs or package_file("config/map_costs.yaml")
    costs = Costs.from_file(costs_file, header.labels)
    sources = [os.path.basename(path) for path in request.inputs] or [request.live]
    facts = {
        "sources": sources,
        "clouds": totals.clouds,
        "clouds_without_pose": totals.without_pose,
        "points": totals.points,
    }
    title = "%s, %.3g m voxels, frame %s" % (
        ", ".join(sources[:3]) + (", ..." if len(sources) > 3 else ""),
        header.config.voxel_size_m,
        header.frame_id,
    )
    exported = export_map(folder, wanted, costs, title, facts, request.epsg)
    if request.scan_labels:
        _label_scans(request, folder, exported)
    return header, totals, exported


def _label_scans(request: Request, folder: str, exported: Exported) -> None:
    from semantic_lidar_fusion.maps.scan_labels import write_scan_labels

    drives = drives_of(request, check_inputs(list(request.inputs))[0])
    reader = MapReader(os.path.join(folder, MAP_FILE))
    try:
        write_scan_labels(reader, drives, os.path.join(folder, formats.LABELS_FOLDER))
    except DataError as error:
        exported.failed[formats.LABELS_FOLDER] = str(error)


def _formats(wanted: Optional[Tuple[str, ...]]) -> List[str]:
    """As wanted, else all that can be written here."""
    if wanted is not None:
        return list(wanted)
    available = formats.available()
    if "octomap" in available:
        from semantic_lidar_fusion.maps.semantic_map import native_module

        if not native_module().has_octomap:  # type: ignore[union-attr]
            available.remove("octomap")
    return available


def _report(out: str, header: MapHeader, totals: Totals, counts: Dict[str, int]) -> str:
    lines = [
        "%d voxels of %.3g m in frame %s (%d of them in the dynamic layer), and %d that are no longer "
        "there"
        % (
            counts["static"] + counts["dynamic"],
            header.config.voxel_size_m,
            header.frame_id,
            counts["dynamic"],
            counts["gone"],
        )
    ]
    if totals.clouds:
        points = totals.points
        lines.append(
            "%d clouds, %d dropped for want of a pose; points: %s"
            % (
                totals.clouds,
                totals.without_pose,
                ", ".join("%d %s" % (n, name.replace("_", " ")) for name, n in points.items()),
            )
        )
    lines.append("written to %s: %s" % (out, ", ".join(written_files(out))))
    return "\n".join(lines)


def config_of(request: Request, labels: LabelSet) -> MapConfig:
    """The map's configuration; ConfigError with every problem."""
    given = dict(request.prior)
    prior = None
    if given:
        unknown = sorted(set(given) - set(labels.names))
        if unknown:
            raise ConfigError(
                "--prior: no class %s (of %s)" % (unknown[0], ", ".join(labels.names))
            )
        rest = 1.0 - sum(given.values())
        others = len(labels) - len(given)
        if others == 0 and abs(rest) > 1e-6 or others and rest <= 0:
            raise ConfigError("--prior: the probabilities must add up to 1")
        prior = tuple(given.get(name, rest / max(others, 1)) for name in labels.names)
    return dataclasses.replace(request.config, prior=prior).checked(len(labels))


def drives_of(request: Request, bags: List[str]) -> List[Drive]:
    """Bags with the bags of their tf and their poses; workers may run in another folder."""
    tf = [os.path.abspath(path) for path in request.tf]
    result = []
    for number, bag in enumerate(bags):
        own = tuple(tf) if len(bags) == 1 else tuple(tf[number : number + 1])
        poses = request.poses[number] if request.poses else ""
        result.append(
            Drive(
                os.path.abspath(bag),
                own,
                request.topic,
                request.odometry,
                os.path.abspath(poses) if poses else "",
                request.poses_frame,
                request.vehicle_frame,
            )
        )
    return result


def _map_files(request: Request, folder: str) -> Tuple[MapHeader, Totals]:
    bags, maps = check_inputs(list(request.inputs))
    header = same_header(maps) if maps else None
    drives = drives_of(request, bags)
    if drives:
        cloud = first_cloud(drives[0])
        labels = class_set(drives[0], cloud, request.classes)
        frame_id = choose_frame(drives[0], cloud, request.frame)
        ours = MapHeader(config_of(request, labels), labels, frame_id)
        if header is not None:
            ours.require_same(header, maps[0])
        header = ours
    elif header is not None:
        # What acts on reading alone is as asked for.
        config = dataclasses.replace(
            header.config,
            clamp=request.config.clamp,
            dynamic=request.config.dynamic,
            footprint_m=request.config.footprint_m,
        )
        header = header._replace(config=config.checked(len(header.labels)))
    assert header is not None
    with tempfile.TemporaryDirectory(prefix=".runs.", dir=folder) as runs:
        accumulator = Accumulator(header, runs, request.memory_mb << 20)
        totals = Totals()
        if drives:
            totals = map_drives(drives, header, request.work, accumulator)
        accumulator.write(os.path.join(folder, MAP_FILE), maps)
    return header, totals


def _map_live(request: Request, folder: str) -> Tuple[MapHeader, Totals]:
    from semantic_lidar_fusion.maps.live import record_live

    with tempfile.TemporaryDirectory(prefix=".runs.", dir=folder) as runs:
        mapper = record_live(request.live, request.frame or "odom", request.classes, request.duration, lambda labels: config_of(request, labels), runs, request.memory_mb << 20)  # fmt: skip
        header = mapper.header()
        if header is None or not mapper.write(os.path.join(folder, MAP_FILE)):
            raise DataError("no cloud with a pose came on %s" % request.live)
        return header, mapper.totals

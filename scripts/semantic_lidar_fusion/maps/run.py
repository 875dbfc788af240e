# SPDX-License-Identifier: MIT
"""From what build_semantic_map.py is asked for to its files."""

import contextlib
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
    Inputs,
    Submaps,
    Totals,
    check_inputs,
    map_drives,
)
from semantic_lidar_fusion.maps.drive import (
    CLOUD_TOPIC,
    FRAMES,
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
from semantic_lidar_fusion.maps.submaps import KeptDrive, SubmapReader, SubmapWriter
from semantic_lidar_fusion.work import Work


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
    submaps: bool = False
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
    workers = request.work.workers
    exported = export_map(folder, wanted, costs, title, facts, request.epsg, workers)
    if request.scan_labels:
        _label_scans(request, folder, exported)
    return header, totals, exported


def _label_scans(request: Request, folder: str, exported: Exported) -> None:
    from semantic_lidar_fusion.maps.scan_labels import write_scan_labels

    drives, _ = sources_of(request)
    reader = MapReader(os.path.join(folder, MAP_FILE))
    try:
        write_scan_labels(reader, drives, os.path.join(folder, formats.LABELS_FOLDER))
    except DataError as error:
        exported.failed[formats.LABELS_FOLDER] = str(error)


def _formats(wanted: Optional[Tuple[str, ...]]) -> List[str]:
    """As wanted, else all that can be written here."""
    if wanted is not None:
        return list(wanted)
    from semantic_lidar_fusion.maps.semantic_map import native_module

    module = native_module()
    if module is not None and module.has_octomap:
        return formats.available()
    return [name for name in formats.available() if not name.startswith("octomap")]


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


def sources_of(request: Request) -> Tuple[List[Drive], List[Submaps]]:
    """Bags with the bags of their tf and their poses, and files of submaps with theirs; workers may
    run in another folder. DataError unless there are as many files of poses as drives, or none."""
    tf = [os.path.abspath(path) for path in request.tf]
    remaining = [os.path.abspath(path) for path in request.poses]
    inputs = check_inputs(request.inputs)
    counts = {path: len(SubmapReader(path).drives) for path in inputs.submaps}
    needed = len(inputs.bags) + sum(counts[path] for path in inputs.submaps)
    if remaining and len(remaining) != needed:
        raise DataError(
            "--poses: %d files for %d drives; give one for each bag and each drive of the submaps, in "
            "the order of the inputs" % (len(remaining), needed)
        )
    drives: List[Drive] = []
    kept: List[Submaps] = []
    for path in request.inputs:
        count = counts.get(path, 1 if path in inputs.bags else 0)
        poses, remaining = tuple(remaining[:count]), remaining[count:]
        if path in inputs.submaps:
            kept.append(Submaps(os.path.abspath(path), poses, request.poses_frame))
        elif path in inputs.bags:
            number = len(drives)
            drives.append(
                Drive(
                    os.path.abspath(path),
                    tuple(tf) if len(inputs.bags) == 1 else tuple(tf[number : number + 1]),
                    request.topic,
                    request.odometry,
                    poses[0] if poses else "",
                    request.poses_frame,
                    request.vehicle_frame,
                )
            )
    return drives, kept


def _header_of(request: Request, drives: List[Drive], inputs: Inputs) -> MapHeader:
    """Of the map that the inputs make together; DataError where they do not fit."""
    known = [(path, SubmapReader(path).header) for path in inputs.submaps]
    if request.poses:
        # They say where the clouds are in another frame than tf does.
        frame = request.frame.lstrip("/") or FRAMES[0]
        known = [(path, header._replace(frame_id=frame)) for path, header in known]
    known += [(path, MapReader(path).header) for path in inputs.maps]
    if drives:
        cloud = first_cloud(drives[0])
        labels = class_set(drives[0], cloud, request.classes)
        frame_id = choose_frame(drives[0], cloud, request.frame)
        header = MapHeader(config_of(request, labels), labels, frame_id)
    else:
        # What acts on reading alone is as asked for.
        header = known[0][1]
        config = dataclasses.replace(
            header.config,
            clamp=request.config.clamp,
            dynamic=request.config.dynamic,
            footprint_m=request.config.footprint_m,
        )
        header = header._replace(config=config.checked(len(header.labels)))
    for path, other in known:
        header.require_same(other, path)
    return header


def _map_files(request: Request, folder: str) -> Tuple[MapHeader, Totals]:
    drives, kept = sources_of(request)
    inputs = check_inputs(request.inputs)
    header = _header_of(request, drives, inputs)
    with contextlib.ExitStack() as stack:
        runs = stack.enter_context(tempfile.TemporaryDirectory(prefix=".runs.", dir=folder))
        writer = None
        if request.submaps:
            frames = [first_cloud(drive).frame_id.lstrip("/") for drive in drives]
            names = [
                KeptDrive(os.path.basename(drive.clouds), frame, drive.vehicle_frame.lstrip("/"))
                for drive, frame in zip(drives, frames)
            ]
            target = os.path.join(folder, formats.SUBMAPS_FILE)
            writer = stack.enter_context(SubmapWriter(target, header, names))
        accumulator = Accumulator(header, runs, request.memory_mb << 20)
        totals = Totals()
        if drives or kept:
            totals = map_drives(drives, header, request.work, accumulator, kept, writer)
        accumulator.write(os.path.join(folder, MAP_FILE), inputs.maps)
    return header, totals


def _map_live(request: Request, folder: str) -> Tuple[MapHeader, Totals]:
    from semantic_lidar_fusion.maps.live import record_live

    with tempfile.TemporaryDirectory(prefix=".runs.", dir=folder) as runs:
        mapper = record_live(request.live, request.frame or "odom", request.classes, request.duration, lambda labels: config_of(request, labels), runs, request.memory_mb << 20)  # fmt: skip
        header = mapper.header()
        if header is None or not mapper.write(os.path.join(folder, MAP_FILE)):
            raise DataError("no cloud with a pose came on %s" % request.live)
        return header, mapper.totals

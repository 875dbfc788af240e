# SPDX-License-Identifier: MIT
"""From the options of build_semantic_map.py to its files."""

import os
import signal
import tempfile
from typing import Any, Dict, List, Optional, Tuple

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.errors import ConfigError, DataError
from semantic_lidar_fusion.labels import LabelSet, package_file
from semantic_lidar_fusion.maps.semantic_map import MapConfig, native_module
from semantic_lidar_fusion.maps.build import (
    Accumulator,
    Drive,
    Totals,
    Work,
    check_inputs,
    choose_frame,
    class_set,
    first_cloud,
    map_drives,
    same_header,
)
from semantic_lidar_fusion.maps.export import FORMATS, MAP_FILE
from semantic_lidar_fusion.maps.map_file import MapHeader
from semantic_lidar_fusion.maps.output import OutputFolder, export_map, written_files
from semantic_lidar_fusion.maps.raster import Costs


def build(options: Any) -> str:
    """Does what the options of build_semantic_map.py ask for; returns the text to print."""
    # Whoever ends us politely gets the same tidying up as Ctrl-C.
    signal.signal(signal.SIGTERM, _interrupt)
    formats = _formats(options.formats)
    costs_file = options.costs or package_file("config/map_costs.yaml")
    output = OutputFolder(options.out, options.overwrite)
    try:
        with output:
            header, totals, counts = _fill(options, output.partial, formats, costs_file)
    finally:
        output.discard()
    return _report(options.out, header, totals, counts)


def _fill(
    options: Any, folder: str, formats: List[str], costs_file: str
) -> Tuple[MapHeader, Totals, Dict[str, int]]:
    """Makes the map and its exports in a folder."""
    header, totals = (_map_live if options.live else _map_files)(options, folder)
    costs = Costs.from_file(costs_file, header.labels)
    facts = {
        "sources": [os.path.basename(path) for path in options.inputs] or [options.live],
        "clouds": totals.clouds,
        "clouds_without_pose": totals.without_pose,
        "points": totals.points,
    }
    title = "%s, %.3g m voxels, frame %s" % (
        ", ".join(facts["sources"][:3]) + (", ..." if len(facts["sources"]) > 3 else ""),
        header.config.voxel_size_m,
        header.frame_id,
    )
    return header, totals, export_map(folder, formats, costs, title, facts)


def _interrupt(number: int, frame: Any) -> None:
    raise KeyboardInterrupt


def _formats(wanted: Optional[List[str]]) -> List[str]:
    if wanted is not None:
        return wanted
    module = native_module()
    if module is not None and module.has_octomap:
        return list(FORMATS)
    cli.warn("no OctoMap files: the module _voxel_map was built without liboctomap, or not at all")
    return [name for name in FORMATS if name != "octomap"]


def _report(out: str, header: MapHeader, totals: Totals, counts: Dict[str, int]) -> str:
    lines = [
        "%d voxels of %.3g m in frame %s (%d of them in the dynamic layer)"
        % (
            sum(counts.values()),
            header.config.voxel_size_m,
            header.frame_id,
            counts["dynamic"],
        )
    ]
    if totals.clouds:
        points = totals.points
        lines.append(
            "%d clouds, %d dropped for want of tf; points: %s"
            % (
                totals.clouds,
                totals.without_pose,
                ", ".join("%d %s" % (n, name.replace("_", " ")) for name, n in points.items()),
            )
        )
    lines.append("written to %s: %s" % (out, ", ".join(written_files(out))))
    return "\n".join(lines)


def config_of(options: Any, labels: LabelSet) -> MapConfig:
    """The map's configuration; ConfigError with every problem."""
    defaults = MapConfig()
    prior = None
    if options.prior:
        unknown = sorted(set(options.prior) - set(labels.names))
        if unknown:
            raise ConfigError(
                "--prior: no class %s (of %s)" % (unknown[0], ", ".join(labels.names))
            )
        rest = 1.0 - sum(options.prior.values())
        others = len(labels) - len(options.prior)
        if others == 0 and abs(rest) > 1e-6 or others and rest <= 0:
            raise ConfigError("--prior: the probabilities must add up to 1")
        prior = tuple(options.prior.get(name, rest / max(others, 1)) for name in labels.names)

    def given(value: Optional[float], default: float) -> float:
        return default if value is None else value

    return MapConfig(
        voxel_size_m=options.voxel,
        kind=options.evidence,
        weight=given(options.weight, defaults.weight),
        floor=given(options.floor, defaults.floor),
        prior=prior,
        clamp=given(options.clamp, defaults.clamp),
        min_range_m=options.min_range,
        max_range_m=options.max_range,
        dynamic=options.dynamic,
    ).checked(len(labels))


def drives_of(options: Any, bags: List[str]) -> List[Drive]:
    """Bags with the bags of their tf; workers may run in another folder."""
    tf = [os.path.abspath(path) for path in options.tf]
    result = []
    for number, bag in enumerate(bags):
        own = tuple(tf) if len(bags) == 1 else tuple(tf[number : number + 1])
        result.append(Drive(os.path.abspath(bag), own, options.topic, options.odometry))
    return result


def _map_files(options: Any, folder: str) -> Tuple[MapHeader, Totals]:
    bags, maps = check_inputs(options.inputs)
    header = same_header(maps) if maps else None
    drives = drives_of(options, bags)
    if drives:
        cloud = first_cloud(drives[0])
        labels = class_set(drives[0], cloud, options.classes)
        frame_id = choose_frame(drives[0], cloud, options.frame)
        ours = MapHeader(config_of(options, labels), labels, frame_id)
        if header is not None:
            ours.require_same(header, maps[0])
        header = ours
    assert header is not None
    with tempfile.TemporaryDirectory(prefix=".runs.", dir=folder) as runs:
        accumulator = Accumulator(header, runs, options.memory << 20)
        totals = Totals()
        if drives:
            work = Work(options.workers, options.scheduler)
            totals = map_drives(drives, header, work, accumulator)
        accumulator.write(os.path.join(folder, MAP_FILE), maps)
    return header, totals


def _map_live(options: Any, folder: str) -> Tuple[MapHeader, Totals]:
    from semantic_lidar_fusion.maps.live import record_live

    voxels, header, totals = record_live(options, config_of)
    if voxels is None or not len(voxels):
        raise DataError("no cloud with a pose came on %s" % options.live)
    with tempfile.TemporaryDirectory(prefix=".runs.", dir=folder) as runs:
        accumulator = Accumulator(header, runs, options.memory << 20)
        accumulator.add(voxels.records())
        accumulator.write(os.path.join(folder, MAP_FILE))
    return header, totals

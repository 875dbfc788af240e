# SPDX-License-Identifier: MIT
"""The exports of a map: the one table of them. Imports nothing heavy, so that --help can name them.

An export is a function `write(source, folder)` of a `source.MapSource`; it returns what map.json
should say about it. CONTRIBUTING.md, "Add a map export", tells the steps."""

import importlib
from typing import Any, Callable, Dict, List, NamedTuple, Tuple

MAP_FILE, ABOUT_FILE = "map.voxels", "map.json"
SUBMAPS_FILE = "map.submaps"  # on request
TILES_FOLDER = "tiles"  # of 2-D maps that are too large for one file
LABELS_FOLDER = "labels"  # of the scans


class Format(NamedTuple):
    """An export. writer: "module:function" within semantic_lidar_fusion.maps; files: every name that
    it may write; needs: modules of Python without which it is left out unless asked for."""

    name: str
    writer: str
    files: Tuple[str, ...]
    needs: Tuple[str, ...] = ()

    def load(self) -> Callable[[Any, str], Dict[str, Any]]:
        module, _, function = self.writer.partition(":")
        loaded = importlib.import_module("semantic_lidar_fusion.maps." + module)
        return getattr(loaded, function)  # type: ignore[no-any-return]


def _both(*ends: str) -> Tuple[str, ...]:
    return tuple(name + end for name in ("map", "dynamic") for end in ends)


FORMATS: List[Format] = [
    Format("ply", "points:write_ply", _both(".ply")),
    Format("pcd", "points:write_pcd", _both(".pcd")),
    Format("npz", "points:write_npz", ("map.npz",)),
    Format("laz", "gis:write_laz", _both(".laz"), ("laspy",)),
    Format(
        "octomap",
        "octomap:write_octomap",
        ("map.ot", "map.bt"),
        ("semantic_lidar_fusion._core",),
    ),
    Format(
        "grid",
        "flat_files:write_grid",
        ("costs.pgm", "costs.yaml", "occupancy.pgm", "occupancy.yaml"),
    ),
    Format(
        "raster",
        "flat_files:write_rasters",
        tuple(
            name + end
            for name in ("classes", "labels", "confidence", "elevation")
            for end in (".png", ".pgw")
        ),
    ),
    Format(
        "geotiff",
        "gis:write_geotiff",
        ("classes.tif", "confidence.tif", "elevation.tif", "costs.tif"),
        ("osgeo.gdal",),
    ),
    Format("grid_map", "gridmap:write_grid_map", ("grid_map.bag",), ("grid_map_msgs.msg",)),
    Format(
        "octomap_msgs",
        "octomap:write_octomap_message",
        ("octomap.bag",),
        ("semantic_lidar_fusion._core", "octomap_msgs.msg"),
    ),
    Format("picture", "flat_files:write_picture", ("map.png",)),
]


def names() -> List[str]:
    return [entry.name for entry in FORMATS]


def find(name: str) -> Format:
    """The format of a name; KeyError if there is none."""
    return {entry.name: entry for entry in FORMATS}[name]


def all_files() -> List[str]:
    """Every name that a map's folder may hold."""
    names_of_files = [MAP_FILE, ABOUT_FILE, SUBMAPS_FILE, TILES_FOLDER, LABELS_FOLDER]
    return names_of_files + [name for entry in FORMATS for name in entry.files]


def split(text: str) -> List[str]:
    """The formats that a comma-separated text names; ValueError names an unknown one."""
    chosen = [name for name in text.split(",") if name]
    for name in chosen:
        if name not in names():
            raise ValueError("no format %s (of %s)" % (name, ", ".join(names())))
    return chosen


def available() -> List[str]:
    """Those whose modules are there."""
    result = []
    for entry in FORMATS:
        try:
            for module in entry.needs:
                importlib.import_module(module)
        except ImportError:
            continue
        result.append(entry.name)
    return result

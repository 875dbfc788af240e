# SPDX-License-Identifier: MIT
"""A map file as files of other programs: PLY, PCD, NPZ, OctoMap, 2-D maps and a picture.

Point files are written tile by tile. Their coordinates are single precision, as PCL reads them, and
therefore relative to `offset` (zero unless the map lies far from its frame's origin), which
map.json names, and the PLY's comments; NPZ and the world files are in the map frame itself.
"""

import io
import json
import os
import zipfile
from typing import Any, Callable, Dict, Iterator, List, NamedTuple, Tuple

import numpy as np

from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet
from semantic_lidar_fusion.maps.semantic_map import (
    DYNAMIC,
    STATIC,
    Reading,
    native_module,
    read,
    voxel_indices,
)
from semantic_lidar_fusion.maps.map_file import MapReader
from semantic_lidar_fusion.maps.raster import (
    Costs,
    Frame2d,
    draw_picture,
    extent,
    rasterise,
    write_occupancy,
    write_rasters,
)

FORMATS = ("ply", "pcd", "npz", "octomap", "grid", "raster", "picture")
MAP_FILE, ABOUT_FILE = "map.voxels", "map.json"
# Every name that an export may write.
FILES = (
    [MAP_FILE, ABOUT_FILE, "map.npz", "map.ot", "map.bt", "map.png"]
    + [name + end for name in ("map", "dynamic") for end in (".ply", ".pcd")]
    + [name + end for name in ("costs", "occupancy") for end in (".pgm", ".yaml")]
    + [
        name + end
        for name in ("classes", "labels", "confidence", "elevation")
        for end in (".png", ".pgw")
    ]
)
# Single precision keeps a millimetre so far from the origin (m).
_FAR_M = 8192.0
_UNNAMED_RGB = (128, 128, 128)


class Extent(NamedTuple):
    """Voxels of a map: number in each layer; bounds of x and y, inclusive; offset of the exports
    (m)."""

    counts: Tuple[int, int]
    low: Tuple[int, int]
    high: Tuple[int, int]
    offset_m: Tuple[float, float, float]


def measure(reader: MapReader) -> Extent:
    """One pass over the map; DataError if it is empty."""
    counts = np.zeros(2, dtype=np.int64)
    low_z = high_z = None
    for records in reader.read_tiles():
        counts += np.bincount(records["layer"], minlength=2)[:2]
        least, most = int(records["z"].min()), int(records["z"].max())
        low_z = least if low_z is None else min(low_z, least)
        high_z = most if high_z is None else max(high_z, most)
    if low_z is None:
        raise DataError("%s: the map is empty; no point entered it" % reader.path)
    bounds = np.array(list(extent(reader.read_tiles())))
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    size = reader.header.config.voxel_size_m
    corners = [(low[0], high[0]), (low[1], high[1]), (low_z, high_z)]
    offset = []
    for least, most in corners:
        far = max(abs(least), abs(most)) * size > _FAR_M
        offset.append(float(np.floor(least * size / 1000.0) * 1000.0) if far else 0.0)
    return Extent(
        (int(counts[0]), int(counts[1])),
        (int(low[0]), int(low[1])),
        (int(high[0]), int(high[1])),
        (offset[0], offset[1], offset[2]),
    )


def class_colors(labels: LabelSet, label: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 of labels (N,); grey without a class."""
    table = np.full((256, 3), _UNNAMED_RGB, dtype=np.uint8)
    table[: len(labels)] = labels.colors_rgb
    return table[label]


def point_fields(labels: LabelSet) -> List[Tuple[str, str]]:
    """Fields of the PCD: (name, numpy type)."""
    names = ["x", "y", "z", "intensity", "confidence", "entropy"]
    fields = [(name, "<f4") for name in names] + [("rgb", "<u4"), ("label", "<u4")]
    fields += [("observations", "<u4"), ("labelled", "<u4")]
    return fields + [("p_" + name, "<f4") for name in labels.names]


def points_of(
    records: np.ndarray, reading: Reading, labels: LabelSet, offset: Tuple[float, float, float]
) -> np.ndarray:
    """Voxels as a packed structured array with `point_fields`."""
    points = np.zeros(len(records), dtype=point_fields(labels))
    for column, axis in enumerate("xyz"):
        points[axis] = reading.position[:, column] - offset[column]
    for name in ("intensity", "confidence", "entropy", "label"):
        points[name] = getattr(reading, name)
    for name in ("observations", "labelled"):
        points[name] = records[name]
    color = class_colors(labels, reading.label).astype(np.uint32)
    points["rgb"] = color[:, 0] << 16 | color[:, 1] << 8 | color[:, 2]
    for column, name in enumerate(labels.names):
        points["p_" + name] = reading.probabilities[:, column]
    return points


class Exporter:
    """Writes a map's exports into a folder that is not in use yet."""

    def __init__(self, reader: MapReader, folder: str, costs: Costs):
        self.reader, self.folder, self.costs = reader, folder, costs
        self.header = reader.header
        self.extent = measure(reader)
        self.about: Dict[str, Any] = {}

    def path(self, name: str) -> str:
        return os.path.join(self.folder, name)

    def _layer(self, layer: int) -> Iterator[np.ndarray]:
        """Points of a layer, tile by tile."""
        for records in self.reader.read_tiles():
            chosen = records[records["layer"] == layer]
            if len(chosen):
                reading = read(chosen, self.header.config)
                yield points_of(chosen, reading, self.header.labels, self.extent.offset_m)

    def _layers(self) -> List[Tuple[str, int]]:
        names = [("map", STATIC), ("dynamic", DYNAMIC)]
        return [(name, layer) for name, layer in names if layer == STATIC or self.extent.counts[1]]

    def write_pcd(self) -> None:
        """map.pcd, and dynamic.pcd if there are such voxels: binary, PCL's rgb."""
        fields = point_fields(self.header.labels)
        for name, layer in self._layers():
            count = self.extent.counts[layer]
            kinds = ["U" if kind == "<u4" else "F" for _, kind in fields]
            with open(self.path(name + ".pcd"), "wb") as file:
                text = "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
                text += "FIELDS %s\n" % " ".join(field for field, _ in fields)
                text += "SIZE %s\n" % " ".join("4" for _ in fields)
                text += "TYPE %s\n" % " ".join(kinds)
                text += "COUNT %s\n" % " ".join("1" for _ in fields)
                text += "WIDTH %d\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n" % count
                text += "POINTS %d\nDATA binary\n" % count
                file.write(text.encode("ascii"))
                for points in self._layer(layer):
                    file.write(points)

    def write_ply(self) -> None:
        """map.ply, and dynamic.ply if there are such voxels: binary, colours as red, green, blue."""
        kinds = {"<f4": "float", "<u4": "uint", "u1": "uchar"}
        fields = [(n, k) for n, k in point_fields(self.header.labels) if n not in ("rgb", "label")]
        colors = [(name, "u1") for name in ("red", "green", "blue", "label")]
        fields = fields[:3] + colors + fields[3:]
        for name, layer in self._layers():
            with open(self.path(name + ".ply"), "wb") as file:
                text = "ply\nformat binary_little_endian 1.0\n"
                text += "comment frame %s\n" % self.header.frame_id
                text += "comment offset %.3f %.3f %.3f\n" % self.extent.offset_m
                text += "comment label %d = none\n" % NO_LABEL
                for number, info in enumerate(self.header.labels.classes):
                    text += "comment class %d %s\n" % (number, info.name)
                text += "element vertex %d\n" % self.extent.counts[layer]
                text += "".join("property %s %s\n" % (kinds[k], n) for n, k in fields)
                file.write((text + "end_header\n").encode("ascii"))
                for points in self._layer(layer):
                    vertices = np.zeros(len(points), dtype=fields)
                    for field, _ in fields:
                        if field in points.dtype.names:
                            vertices[field] = points[field]
                    for shift, field in ((16, "red"), (8, "green"), (0, "blue")):
                        vertices[field] = points["rgb"] >> shift & 255
                    file.write(vertices)

    def write_npz(self) -> None:
        """map.npz, one array after the other; see `_columns`."""
        config, labels = self.header.config, self.header.labels
        fixed = {
            "voxel_size_m": np.float64(config.voxel_size_m),
            "class_names": np.array(labels.names),
            "class_colors": labels.colors_rgb,
            "prior": np.array(config.prior),
            "weight": np.float64(config.weight),
            "frame_id": np.array(self.header.frame_id),
        }
        count = sum(self.extent.counts)
        with zipfile.ZipFile(self.path("map.npz"), "w", zipfile.ZIP_DEFLATED) as archive:
            for name, values in fixed.items():
                buffer = io.BytesIO()
                np.save(buffer, values, allow_pickle=False)
                archive.writestr(_member(name), buffer.getvalue())
            for name, get in self._columns().items():
                example = get(np.zeros(0, dtype=self.reader.dtype))
                header = {
                    "descr": example.dtype.str,
                    "fortran_order": False,
                    "shape": (count,) + example.shape[1:],
                }
                with archive.open(_member(name), "w", force_zip64=True) as stream:
                    np.lib.format.write_array_header_1_0(stream, header)
                    for records in self.reader.read_tiles():
                        stream.write(np.ascontiguousarray(get(records)).tobytes())

    def _columns(self) -> Dict[str, Callable[[np.ndarray], np.ndarray]]:
        """Arrays (voxels, ...) of the NPZ, in canonical order of the voxels."""
        config = self.header.config
        result: Dict[str, Callable[[np.ndarray], np.ndarray]] = {
            "index": lambda records: voxel_indices(records).astype(np.int32),
            "layer": lambda records: records["layer"].astype(np.uint8),
        }
        for name in ("observations", "labelled", "first_ns", "last_ns", "evidence"):
            result[name] = lambda records, name=name: records[name]
        for name in Reading._fields:
            result[name] = lambda records, name=name: getattr(read(records, config), name)
        return result

    def write_octomap(self) -> None:
        """map.ot (ColorOcTree, class colours) and map.bt (occupancy only) of the static layer."""
        module = native_module()
        if module is None or not module.has_octomap:
            raise DataError(
                "OctoMap files need the module _voxel_map, built with pybind11 and liboctomap; leave "
                "octomap out of --formats"
            )
        size = self.header.config.voxel_size_m
        centers, colors = [], []
        offset = np.floor(np.array(self.extent.offset_m) / size) * size
        for records in self.reader.read_tiles():
            chosen = records[records["layer"] == STATIC]
            centers.append((voxel_indices(chosen) + 0.5) * size - offset)
            label = read(chosen, self.header.config).label
            colors.append(class_colors(self.header.labels, label))
        try:
            module.write_octomap(
                np.concatenate(centers),
                np.concatenate(colors),
                size,
                self.path("map.ot"),
                self.path("map.bt"),
            )
        except module.Error as error:
            raise DataError(str(error)) from error
        self.about["octomap_offset_m"] = [float(value) for value in offset]

    def write_2d(self, grid: bool, raster: bool, picture: bool, title: str) -> None:
        """Occupancy maps, rasters with world files, and the picture."""
        frame = Frame2d.around(self.extent.low, self.extent.high, self.header.config.voxel_size_m)
        rasters = rasterise(self.reader.read_tiles, frame, self.header.config, self.costs)
        if grid:
            write_occupancy(self.folder, rasters)
        if raster:
            self.about["elevation"] = write_rasters(self.folder, rasters, self.header.labels)
        if picture:
            draw_picture(self.path("map.png"), rasters, self.header.labels, title)

    def write(self, formats: List[str], title: str, facts: Dict[str, Any]) -> None:
        """Writes these formats and map.json."""
        for name in ("ply", "pcd", "npz", "octomap"):
            if name in formats:
                getattr(self, "write_" + name)()
        flat = [name in formats for name in ("grid", "raster", "picture")]
        if any(flat):
            self.write_2d(flat[0], flat[1], flat[2], title)
        about = {
            "frame_id": self.header.frame_id,
            "config": self.header.config.tree(),
            "classes": self.header.labels.tree()["classes"],
            "voxels": {"static": self.extent.counts[0], "dynamic": self.extent.counts[1]},
            "points_offset_m": list(self.extent.offset_m),
        }
        about.update(self.about)
        about.update(facts)
        with open(self.path(ABOUT_FILE), "w", encoding="utf-8") as file:
            json.dump(about, file, indent=2, sort_keys=True)
            file.write("\n")


def _member(name: str) -> zipfile.ZipInfo:
    """With a fixed date, so that equal maps give equal files."""
    info = zipfile.ZipInfo(name + ".npy", (1980, 1, 1, 0, 0, 0))
    info.compress_type = zipfile.ZIP_DEFLATED
    info.external_attr = 0o600 << 16
    return info

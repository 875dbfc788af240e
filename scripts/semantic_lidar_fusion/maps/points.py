# SPDX-License-Identifier: MIT
"""A map's voxels as points: PLY, PCD and NPZ.

PLY and PCD are written tile by tile. Their coordinates are single precision, as PCL reads them, and
therefore relative to `offset` (zero unless the map lies far from its frame's origin), which map.json
names, and the PLY's comments; NPZ is in the map frame itself. Voxels that rays show to be gone are
in the NPZ alone (layer 2)."""

import os
import tempfile
import zipfile
from typing import Any, Dict, Iterator, List, Tuple

import numpy as np

from semantic_lidar_fusion.labels import NO_LABEL, LabelSet
from semantic_lidar_fusion.maps.reading import DYNAMIC, STATIC, Reading, read
from semantic_lidar_fusion.maps.records import voxel_indices
from semantic_lidar_fusion.maps.source import MapSource, class_colors
from semantic_lidar_fusion.texts import plain_text

_COUNTS = ("observations", "looks", "labelled")


def point_fields(labels: LabelSet) -> List[Tuple[str, str]]:
    """Fields of the PCD: (name, numpy type)."""
    names = ["x", "y", "z", "intensity", "confidence", "entropy"]
    fields = [(name, "<f4") for name in names] + [("rgb", "<u4"), ("label", "<u4")]
    fields += [(name, "<u4") for name in _COUNTS]
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
    for name in _COUNTS:
        points[name] = records[name]
    color = class_colors(labels, reading.label).astype(np.uint32)
    points["rgb"] = color[:, 0] << 16 | color[:, 1] << 8 | color[:, 2]
    for column, name in enumerate(labels.names):
        points["p_" + name] = reading.probabilities[:, column]
    return points


def _points(source: MapSource, layer: int) -> Iterator[np.ndarray]:
    """Points of a layer, tile by tile."""
    for records in source.layer(layer):
        reading = read(records, source.config, source.labels)
        yield points_of(records, reading, source.labels, source.extent.offset_m)


def files_of(source: MapSource) -> List[Tuple[str, int]]:
    """Names without ending, and layers: what moves has a file of its own, if there is something."""
    names = [("map", STATIC), ("dynamic", DYNAMIC)]
    return [
        (name, layer) for name, layer in names if layer == STATIC or source.extent.counts[layer]
    ]


def write_pcd(source: MapSource, folder: str) -> Dict[str, Any]:
    """map.pcd, and dynamic.pcd if there are such voxels: binary, PCL's rgb."""
    fields = point_fields(source.labels)
    for name, layer in files_of(source):
        count = source.extent.counts[layer]
        kinds = ["U" if kind == "<u4" else "F" for _, kind in fields]
        with open(os.path.join(folder, name + ".pcd"), "wb") as file:
            text = "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
            text += "FIELDS %s\n" % " ".join(field for field, _ in fields)
            text += "SIZE %s\n" % " ".join("4" for _ in fields)
            text += "TYPE %s\n" % " ".join(kinds)
            text += "COUNT %s\n" % " ".join("1" for _ in fields)
            text += "WIDTH %d\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n" % count
            text += "POINTS %d\nDATA binary\n" % count
            file.write(text.encode("ascii"))
            for points in _points(source, layer):
                file.write(points.tobytes())
    return {}


def write_ply(source: MapSource, folder: str) -> Dict[str, Any]:
    """map.ply, and dynamic.ply if there are such voxels: binary, colours as red, green, blue."""
    kinds = {"<f4": "float", "<u4": "uint", "u1": "uchar"}
    fields = [(n, k) for n, k in point_fields(source.labels) if n not in ("rgb", "label")]
    colors = [(name, "u1") for name in ("red", "green", "blue", "label")]
    fields = fields[:3] + colors + fields[3:]
    frame = plain_text(source.header.frame_id).encode("ascii", "backslashreplace").decode("ascii")
    for name, layer in files_of(source):
        with open(os.path.join(folder, name + ".ply"), "wb") as file:
            text = "ply\nformat binary_little_endian 1.0\n"
            text += "comment frame %s\n" % " ".join(frame.split())
            text += "comment offset %.3f %.3f %.3f\n" % source.extent.offset_m
            text += "comment label %d = none\n" % NO_LABEL
            for number, info in enumerate(source.labels.classes):
                text += "comment class %d %s\n" % (number, info.name)
            text += "element vertex %d\n" % source.extent.counts[layer]
            text += "".join("property %s %s\n" % (kinds[k], n) for n, k in fields)
            file.write((text + "end_header\n").encode("ascii"))
            for points in _points(source, layer):
                vertices = np.zeros(len(points), dtype=fields)
                for field, _ in fields:
                    if field in points.dtype.names:
                        vertices[field] = points[field]
                for shift, field in ((16, "red"), (8, "green"), (0, "blue")):
                    vertices[field] = points["rgb"] >> shift & 255
                file.write(vertices.tobytes())
    return {}


def write_npz(source: MapSource, folder: str) -> Dict[str, Any]:
    """map.npz: every voxel with its record, what it says, and its layer (2 = gone); in canonical
    order. Each tile is read once; its columns wait in files."""
    config, labels = source.config, source.labels
    fixed = {
        "voxel_size_m": np.float64(config.voxel_size_m),
        "class_names": np.array(labels.names),
        "class_colors": labels.colors_rgb,
        "prior": np.array(config.prior),
        "weight": np.float64(config.weight),
        "frame_id": np.array(source.header.frame_id),
        "path": source.reader.path,
    }
    path = os.path.join(folder, "map.npz")
    with tempfile.TemporaryDirectory(prefix=".columns.", dir=folder) as parts:
        headers = _spool(source, parts)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, values in fixed.items():
                with archive.open(_member(name), "w") as stream:
                    np.lib.format.write_array(stream, np.asarray(values), allow_pickle=False)
            for name, header in headers.items():
                with archive.open(_member(name), "w", force_zip64=True) as stream:
                    np.lib.format.write_array_header_1_0(stream, header)
                    with open(os.path.join(parts, name), "rb") as column:
                        for block in iter(lambda: column.read(1 << 22), b""):
                            stream.write(block)
    return {}


def _spool(source: MapSource, folder: str) -> Dict[str, Dict[str, Any]]:
    """Writes the columns of all voxels to files in a folder; their NPY headers by name."""
    headers: Dict[str, Dict[str, Any]] = {}
    files: Dict[str, Any] = {}
    count = sum(source.extent.counts)
    try:
        for tile, records, _ in source.reader.read_tiles():
            reading = read(records, source.config, source.labels)
            columns: Dict[str, np.ndarray] = {
                "index": voxel_indices(records).astype(np.int32),
                "layer": source.layers(tile, records),
            }
            for name in (*_COUNTS, "passes", "passes_after", "first_ns", "last_ns", "evidence"):
                columns[name] = records[name]
            columns.update((name, getattr(reading, name)) for name in Reading._fields)
            for name, values in columns.items():
                if name not in files:
                    files[name] = open(os.path.join(folder, name), "wb")
                    headers[name] = {
                        "descr": values.dtype.str,
                        "fortran_order": False,
                        "shape": (count,) + values.shape[1:],
                    }
                files[name].write(np.ascontiguousarray(values))
    finally:
        for file in files.values():
            file.close()
    return headers


def _member(name: str) -> zipfile.ZipInfo:
    """With a fixed date, so that equal maps give equal files."""
    info = zipfile.ZipInfo(name + ".npy", (1980, 1, 1, 0, 0, 0))
    info.compress_type = zipfile.ZIP_DEFLATED
    info._compresslevel = 1  # type: ignore[attr-defined]
    info.external_attr = 0o600 << 16
    return info

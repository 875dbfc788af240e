# SPDX-License-Identifier: MIT
"""Point cloud files of PCL (.pcd), ascii and binary."""

from typing import Dict, List

import numpy as np

from semantic_lidar_fusion.datasets import records
from semantic_lidar_fusion.errors import DataError

_KINDS = {
    ("F", 4): "<f4",
    ("F", 8): "<f8",
    ("U", 1): "u1",
    ("U", 2): "<u2",
    ("U", 4): "<u4",
    ("I", 1): "i1",
    ("I", 2): "<i2",
    ("I", 4): "<i4",
}
MAX_POINTS = 10_000_000


def read(path: str) -> Dict[str, np.ndarray]:
    """Field name -> values (N,). DataError names the file and what is wrong; compressed files are
    refused with the command that converts them."""
    data = records.read_bytes(path)
    header: Dict[str, List[str]] = {}
    at = 0
    while "DATA" not in header:
        end = data.find(b"\n", at)
        if end < 0 or at > 4096:
            raise DataError("%s: not a PCD file" % path)
        words = data[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    dtype = _dtype(header, path)
    count = _count(header, path)
    kind = " ".join(header["DATA"])
    if kind == "binary":
        if len(data) - at < count * dtype.itemsize:
            raise DataError("%s: cut off, %d points expected" % (path, count))
        points = np.frombuffer(data, dtype=dtype, count=count, offset=at)
    elif kind == "ascii":
        points = _ascii(data[at:], dtype, count, path)
    else:
        raise DataError(
            "%s: DATA %s is not read; convert it with pcl_convert_pcd_ascii_binary IN OUT 1"
            % (path, kind)
        )
    return {name: points[name] for name in dtype.names or () if name != "_"}


def _dtype(header: Dict[str, List[str]], path: str) -> np.dtype:
    names, sizes, types = (header.get(key, []) for key in ("FIELDS", "SIZE", "TYPE"))
    counts = header.get("COUNT", ["1"] * len(names))
    if not names or not len(names) == len(sizes) == len(types) == len(counts):
        raise DataError("%s: FIELDS, SIZE, TYPE and COUNT do not fit together" % path)
    fields = []
    for k, name in enumerate(names):
        kind = _KINDS.get((types[k], int(sizes[k]) if sizes[k].isdigit() else 0))
        if kind is None or not counts[k].isdigit() or int(counts[k]) < 1:
            raise DataError("%s: field %s has an unknown type" % (path, name))
        unique = name if name != "_" else "_%d" % k  # padding
        fields.append((unique, kind) if counts[k] == "1" else (unique, kind, (int(counts[k]),)))
    return np.dtype(fields)


def _count(header: Dict[str, List[str]], path: str) -> int:
    text = " ".join(header.get("POINTS", []))
    if not text.isdigit() or int(text) > MAX_POINTS:
        raise DataError("%s: POINTS %s: must be 0 to %d" % (path, text or "missing", MAX_POINTS))
    return int(text)


def _ascii(data: bytes, dtype: np.dtype, count: int, path: str) -> np.ndarray:
    lines = data.decode("ascii", "replace").split("\n")
    rows = [line.split() for line in lines if line.strip()]
    columns = sum(int(np.prod(dtype[name].shape or (1,))) for name in dtype.names or ())
    if len(rows) < count or any(len(row) != columns for row in rows[:count]):
        raise DataError("%s: %d points of %d numbers are expected" % (path, count, columns))
    try:
        table = np.array(rows[:count], dtype=np.float64).reshape(count, columns)
    except ValueError as error:
        raise DataError("%s: %s" % (path, error)) from error
    points = np.zeros(count, dtype=dtype)
    at = 0
    for name in dtype.names or ():
        width = int(np.prod(dtype[name].shape or (1,)))
        block = table[:, at : at + width]
        points[name] = block.reshape(points[name].shape)
        at += width
    return points

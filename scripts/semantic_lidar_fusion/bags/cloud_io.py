# SPDX-License-Identifier: MIT
"""PointCloud2 messages <-> numpy, without a loop over points.

`to_array` checks a message's layout by arithmetic and views its bytes as a structured array, field
by name; `from_array` goes back. `SemanticCloud` reads what the projection nodelet publishes.
Only the shape of the message matters, not where its class comes from.
"""

from typing import Any, Dict, List, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.errors import DataError

# sensor_msgs/PointField.datatype -> numpy
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_DATATYPE_OF = {np.dtype(name): number for number, name in _DATATYPES.items()}
_PROBABILITY_PREFIX = "p_"

# `status` of points_semantic
FUSED, OCCLUDED, OUTSIDE, NO_IMAGE, NO_ODOMETRY = range(5)


def point_dtype(fields: Sequence[Tuple[str, str]]) -> np.dtype:
    """A structured type with naturally aligned offsets and a size that is a multiple of 4 (and of
    the widest field). `fields`: (name, numpy type) in order, e.g. ("x", "f4")."""
    names, formats, offsets = [], [], []
    end, widest = 0, 4
    for name, code in fields:
        kind = np.dtype(code)
        if kind not in _DATATYPE_OF:
            raise ValueError("field %s: %s is no PointCloud2 type" % (name, code))
        end = -(-end // kind.itemsize) * kind.itemsize
        names.append(name)
        formats.append(kind)
        offsets.append(end)
        end += kind.itemsize
        widest = max(widest, kind.itemsize)
    size = -(-end // widest) * widest
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})


def to_array(message: Any) -> np.ndarray:
    """The points of a PointCloud2 as a structured array (height * width,), row by row.

    A read-only view of the message's bytes (a copy only if its rows are padded). Fields with a
    count above 1 become sub-arrays. Raises DataError that names the field or size that is wrong.
    """
    step, width, height = int(message.point_step), int(message.width), int(message.height)
    row_step = int(message.row_step)
    if width == 0 or height == 0:
        return np.zeros(0, dtype=_message_dtype(message, step))
    dtype = _message_dtype(message, step)
    if step == 0:
        raise DataError("point cloud: point_step is 0 with %d points" % (width * height))
    if row_step < width * step:
        raise DataError(
            "point cloud: row_step is %d, less than width * point_step = %d"
            % (row_step, width * step)
        )
    data = message.data if isinstance(message.data, (bytes, bytearray)) else bytes(message.data)
    if len(data) != row_step * height:
        raise DataError(
            "point cloud: %d bytes of data; row_step * height = %d" % (len(data), row_step * height)
        )
    if row_step == width * step:
        return np.frombuffer(data, dtype=dtype, count=width * height)
    rows = np.frombuffer(data, dtype=np.uint8).reshape(height, row_step)[:, : width * step]
    return np.ascontiguousarray(rows).reshape(-1).view(dtype)


def _message_dtype(message: Any, step: int) -> np.dtype:
    order = ">" if message.is_bigendian else "<"
    names: List[str] = []
    formats: List[Any] = []
    offsets: List[int] = []
    for field in message.fields:
        code = _DATATYPES.get(field.datatype)
        count = max(1, int(field.count))  # some writers leave 0
        if code is None:
            raise DataError(
                "point cloud: field %s has the unknown datatype %s" % (field.name, field.datatype)
            )
        if not field.name or field.name in names:
            raise DataError("point cloud: the field name '%s' occurs twice" % field.name)
        kind = np.dtype(order + code)
        if field.offset + kind.itemsize * count > step:
            raise DataError(
                "point cloud: field %s ends at byte %d; point_step is %d"
                % (field.name, field.offset + kind.itemsize * count, step)
            )
        names.append(field.name)
        formats.append(kind if count == 1 else (kind, (count,)))
        offsets.append(int(field.offset))
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})


def names_of(points: np.ndarray) -> Tuple[str, ...]:
    """The field names of a structured array."""
    return tuple(points.dtype.names or ())


def _fields(points: np.ndarray) -> Dict[str, Tuple[np.dtype, int]]:
    """Type and offset of each field of a structured array."""
    return {name: (entry[0], int(entry[1])) for name, entry in (points.dtype.fields or {}).items()}


def from_array(points: np.ndarray, stamp_ns: int, frame_id: str) -> Any:
    """A PointCloud2 (height 1) of a structured array (N,), with the array's own layout.

    Use `point_dtype` for that layout. `is_dense` is true unless x, y or z holds a non-finite value.
    """
    from sensor_msgs.msg import PointCloud2, PointField

    from semantic_lidar_fusion.bags.bag_io import to_stamp

    points = np.ascontiguousarray(points)
    message = PointCloud2()
    message.header.stamp = to_stamp(stamp_ns)
    message.header.frame_id = frame_id
    message.height, message.width = 1, len(points)
    for name in names_of(points):
        kind, offset = _fields(points)[name]
        datatype = _DATATYPE_OF.get(kind.base.newbyteorder("="))
        if datatype is None:
            raise ValueError("field %s: %s is no PointCloud2 type" % (name, kind))
        count = int(np.prod(kind.shape)) if kind.shape else 1
        message.fields.append(PointField(name, offset, datatype, count))
    message.point_step = points.dtype.itemsize
    message.row_step = message.point_step * len(points)
    message.data = points.tobytes()
    axes = [axis for axis in "xyz" if axis in names_of(points)]
    message.is_dense = all(bool(np.isfinite(points[axis]).all()) for axis in axes)
    return message


def require_fields(points: np.ndarray, names: Sequence[str], what: str) -> None:
    """DataError unless `points` has all these fields."""
    missing = [name for name in names if name not in (points.dtype.names or ())]
    if missing:
        raise DataError(
            "%s: no field %s (it has %s)"
            % (what, ", ".join(missing), ", ".join(points.dtype.names or ()) or "none")
        )


def xyz(points: np.ndarray, dtype: Any = np.float64) -> np.ndarray:
    """(N, 3) positions, m."""
    require_fields(points, ("x", "y", "z"), "point cloud")
    result = np.empty((len(points), 3), dtype=dtype)
    for column, axis in enumerate("xyz"):
        result[:, column] = points[axis]
    return result


class SemanticCloud:
    """A `points_semantic` message: N points of which those with status FUSED carry a distribution.

    stamp_ns: int; frame_id: str; points: the structured array (N,), all fields by name;
    class_names: C names from the fields p_<class>, in their order (= class id).
    """

    def __init__(self, points: np.ndarray, stamp_ns: int, frame_id: str):
        require_fields(points, ("x", "y", "z", "label", "status"), "semantic cloud")
        self.points = points
        self.stamp_ns = stamp_ns
        self.frame_id = frame_id
        self.class_names = [
            name[len(_PROBABILITY_PREFIX) :]
            for name in points.dtype.names
            if name.startswith(_PROBABILITY_PREFIX)
        ]
        if not self.class_names:
            raise DataError("semantic cloud: no field p_<class>")

    @staticmethod
    def from_message(message: Any) -> "SemanticCloud":
        from semantic_lidar_fusion.bags.bag_io import to_ns

        return SemanticCloud(
            to_array(message), to_ns(message.header.stamp), message.header.frame_id
        )

    def __len__(self) -> int:
        return len(self.points)

    @property
    def xyz(self) -> np.ndarray:
        """(N, 3) float64, m, in `frame_id` at `stamp_ns`."""
        return xyz(self.points)

    @property
    def label(self) -> np.ndarray:
        """(N,) uint8; 255 = none."""
        return self.points["label"]

    @property
    def status(self) -> np.ndarray:
        """(N,) uint8; see FUSED and its neighbours."""
        return self.points["status"]

    @property
    def fused(self) -> np.ndarray:
        """(N,) bool: has a distribution."""
        return self.points["status"] == FUSED

    def optional(self, name: str) -> Optional[np.ndarray]:
        """A field that older writers may lack (confidence, entropy, cameras, ring, dt, ...)."""
        return self.points[name] if name in self.points.dtype.names else None

    @property
    def probabilities(self) -> np.ndarray:
        """(N, C) float32, columns as in class_names; a view where the fields are evenly spaced."""
        fields = self.points.dtype.fields
        names = [_PROBABILITY_PREFIX + name for name in self.class_names]
        kinds = [fields[name][0] for name in names]
        offsets = [fields[name][1] for name in names]
        step = 4 if len(offsets) == 1 else offsets[1] - offsets[0]
        evenly = all(b - a == step for a, b in zip(offsets, offsets[1:]))
        if len(self.points) and evenly and step > 0 and all(kind == "<f4" for kind in kinds):
            return np.ndarray(
                (len(self.points), len(names)),
                dtype="<f4",
                buffer=self.points,
                offset=offsets[0],
                strides=(self.points.dtype.itemsize, step),
            )
        result = np.empty((len(self.points), len(names)), dtype=np.float32)
        for column, name in enumerate(names):
            result[:, column] = self.points[name]
        return result

    def to_pandas(self) -> Any:
        """A pandas.DataFrame with a column for each field and a row for each point. ImportError
        where pandas is not installed."""
        import pandas

        return pandas.DataFrame({name: self.points[name] for name in names_of(self.points)})

    def to_open3d(self, colors: Optional[np.ndarray] = None) -> Any:
        """An open3d.geometry.PointCloud of the points, in the colours of their classes (field rgb)
        or those given, (N, 3) in 0..1. ImportError where open3d is not installed."""
        import open3d

        if colors is None and self.optional("rgb") is not None:
            packed = np.ascontiguousarray(self.points["rgb"]).view(np.uint32)
            channels = [(packed >> shift) & 255 for shift in (16, 8, 0)]
            colors = np.stack(channels, axis=-1) / 255.0
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(self.xyz))
        if colors is not None:
            cloud.colors = open3d.utility.Vector3dVector(np.asarray(colors, dtype=np.float64))
        return cloud


def append_fields(points: np.ndarray, extra: Dict[str, np.ndarray]) -> np.ndarray:
    """A new structured array (N,) with the fields of `points`, then those of `extra`."""
    fields = [(name, points.dtype[name].str) for name in points.dtype.names]
    fields += [(name, np.asarray(values).dtype.str) for name, values in extra.items()]
    result = np.zeros(len(points), dtype=point_dtype(fields))
    for name in points.dtype.names:
        result[name] = points[name]
    for name, values in extra.items():
        result[name] = values
    return result

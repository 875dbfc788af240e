# SPDX-License-Identifier: MIT
"""A scene of nuScenes v1.0 (Caesar et al., CVPR 2020), in its public layout.

  v1.0-*/*.json       tables: scene, sample, sample_data, calibrated_sensor, sensor, ego_pose, and
                      with labels category (lidarseg.json)
  samples/, sweeps/   CAM_*/*.jpg (undistorted, 1600 x 900) and LIDAR_TOP/*.pcd.bin (x y z intensity
                      ring, f32), keyframes at 2 Hz and what lies between
  lidarseg/v1.0-*/    TOKEN_lidarseg.bin: a class id per point of a keyframe

The provider has corrected the HDL-32E's sweeps for motion: all points are of the sweep's stamp. So a
scan has no time per point, and motion takes it from that stamp to each camera's. Odometry is the ego
pose at the stamp of every lidar sweep and image. Only tables are read whole; files that a partial
download lacks are left out with a warning.
"""

import glob
import json
import os
from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.bags import poses
from semantic_lidar_fusion.datasets import records
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import LabelSet

LIDAR, LIDAR_FRAME, LIDAR_TOPIC = "LIDAR_TOP", "lidar_top", "/lidar_top/points"
CAMERAS = (
    *("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT"),
    *("CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"),
)
_TABLES = ("scene", "sample", "sample_data", "calibrated_sensor", "sensor", "ego_pose")
POINT_BYTES = 20

# Names of the data set's categories -> names in the class sets, best first.
CLASSES: Dict[str, Sequence[str]] = {
    "flat.driveable_surface": ("road",),
    "flat.sidewalk": ("sidewalk", "pavement", "undrivable_road"),
    "flat.terrain": ("terrain", "grass", "vegetation"),
    "flat.other": ("terrain", "undrivable_road", "pavement"),
    "static.manmade": ("building",),
    "static.vegetation": ("vegetation", "tree"),
    "static.other": ("pole", "building"),
    "vehicle.car": ("car", "vehicle"),
    "vehicle.truck": ("truck", "vehicle", "car"),
    "vehicle.trailer": ("truck", "vehicle", "car"),
    "vehicle.construction": ("truck", "vehicle", "car"),
    "vehicle.bus.rigid": ("bus", "vehicle", "car"),
    "vehicle.bus.bendy": ("bus", "vehicle", "car"),
    "vehicle.motorcycle": ("motorcycle", "vehicle", "bicyclist"),
    "vehicle.bicycle": ("bicycle", "bicyclist", "rider"),
    "human.pedestrian.adult": ("person", "pedestrian"),
    "human.pedestrian.child": ("person", "pedestrian"),
    "human.pedestrian.construction_worker": ("person", "pedestrian"),
    "human.pedestrian.police_officer": ("person", "pedestrian"),
    "movable_object.barrier": ("fence", "barrier"),
    "movable_object.trafficcone": ("pole", "sign"),
}

Row = Dict[str, Any]


class Tables:
    """The JSON tables of a version folder, by token."""

    def __init__(self, folder: str):
        self.folder = folder
        self._rows: Dict[str, List[Row]] = {}
        self._by_token: Dict[str, Dict[str, Row]] = {}

    def rows(self, name: str) -> List[Row]:
        """All rows of a table; DataError names the file."""
        if name not in self._rows:
            path = os.path.join(self.folder, name + ".json")
            try:
                rows = json.loads(records.read_bytes(records.require_file(path)))
            except (ValueError, RecursionError) as error:
                raise DataError("%s: not JSON (%s)" % (path, error)) from error
            if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
                raise DataError("%s: must be a list of mappings" % path)
            self._rows[name] = rows
        return self._rows[name]

    def get(self, name: str, token: Any) -> Row:
        if name not in self._by_token:
            self._by_token[name] = {str(row.get("token")): row for row in self.rows(name)}
        row = self._by_token[name].get(str(token))
        if row is None:
            raise DataError("%s/%s.json: no row with token %s" % (self.folder, name, token))
        return row


def read(
    folder: str,
    labels: LabelSet,
    scene: Optional[str],
    cameras: Optional[List[str]],
    first: int,
    last: Optional[int],
) -> records.Drive:
    """`folder`: the root that holds v1.0-mini, v1.0-trainval or v1.0-test; `scene`: name (default:
    the first); `cameras`: channels (default: all six); `first`, `last`: numbers of lidar sweeps."""
    folder = os.path.abspath(records.require_folder(folder))
    tables = Tables(_version_folder(folder))
    chosen = _scene(tables, scene)
    data = _sample_data(tables, chosen)
    sweeps, lost = _present(folder, data.get(LIDAR, []))
    records.say_gaps(os.path.join(folder, LIDAR), lost)
    numbers = records.pick(range(len(sweeps)), first, last, folder)
    sweeps = [sweeps[n] for n in numbers]
    seglabels = _label_files(folder, tables)
    table = _category_table(tables, labels) if seglabels else {}
    t_ego_lidar = _extrinsics(tables, sweeps[0])
    span = _ns(sweeps[0]) - 10**9, _ns(sweeps[-1]) + 10**9

    read_cameras, odometry = [], {_ns(row): row for row in sweeps}
    for channel in cameras or CAMERAS:
        if channel not in CAMERAS:
            raise DataError("--cameras %s: must be of %s" % (channel, ", ".join(CAMERAS)))
        rows = [row for row in data.get(channel, []) if span[0] <= _ns(row) <= span[1]]
        rows, lost = _present(folder, rows)
        records.say_gaps(os.path.join(folder, channel), lost)
        if not rows:
            continue
        odometry.update({_ns(row): row for row in rows})
        read_cameras.append(_camera(tables, folder, channel, rows))
    if not read_cameras:
        raise DataError(
            "%s: no image of %s in scene %s" % (folder, ", ".join(CAMERAS), chosen["name"])
        )
    stamps = sorted(odometry)
    trajectory = np.array([_ego_pose(tables, odometry[stamp]) for stamp in stamps])
    return records.Drive(
        "nuscenes_" + str(chosen["name"]).replace("-", "_"),
        labels,
        read_cameras,
        LIDAR_TOPIC,
        LIDAR_FRAME,
        t_ego_lidar,
        [
            records.ScanRecord(
                _ns(row),
                _loader(os.path.join(folder, row["filename"]), seglabels.get(row["token"]), table),
            )
            for row in sweeps
        ],
        (np.array(stamps, dtype=np.int64), trajectory),
        True,
        [
            "nuScenes %s. Its sweeps are corrected for motion: all points are of the stamp."
            % chosen["name"]
        ],
        None,
    )


def _version_folder(folder: str) -> str:
    found = sorted(glob.glob(os.path.join(folder, "v1.0-*")))
    found = [path for path in found if os.path.isfile(os.path.join(path, "scene.json"))]
    if not found:
        raise DataError("%s: no folder v1.0-* with scene.json" % folder)
    return found[0]


def _scene(tables: Tables, name: Optional[str]) -> Row:
    scenes = tables.rows("scene")
    if name is None and scenes:
        return scenes[0]
    for row in scenes:
        if row.get("name") == name:
            return row
    known = ", ".join(str(row.get("name")) for row in scenes[:8])
    raise DataError("%s: no scene %s (it has: %s)" % (tables.folder, name, known or "none"))


def _sample_data(tables: Tables, scene: Row) -> Dict[str, List[Row]]:
    """Channel -> rows of a scene, keyframes and sweeps, in order of time."""
    samples = {
        row["token"] for row in tables.rows("sample") if row.get("scene_token") == scene["token"]
    }
    if not samples:
        raise DataError("%s: scene %s has no sample" % (tables.folder, scene.get("name")))
    result: Dict[str, List[Row]] = {}
    for row in tables.rows("sample_data"):
        if row.get("sample_token") not in samples:
            continue
        sensor = tables.get("calibrated_sensor", row["calibrated_sensor_token"])
        channel = str(tables.get("sensor", sensor["sensor_token"])["channel"])
        result.setdefault(channel, []).append(row)
    for rows in result.values():
        rows.sort(key=_ns)
    return {
        channel: [row for k, row in enumerate(rows) if k == 0 or _ns(row) > _ns(rows[k - 1])]
        for channel, rows in result.items()
    }


def _ns(row: Row) -> int:
    """The stamp of a row (us) in ns."""
    value = row.get("timestamp")
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < 4e15:
        raise DataError("nuScenes: timestamp %s of %s is no time in us" % (value, row.get("token")))
    return int(value) * 1000


def _present(folder: str, rows: List[Row]) -> Tuple[List[Row], Dict[int, str]]:
    kept, lost = [], {}
    for number, row in enumerate(rows):
        if os.path.isfile(os.path.join(folder, str(row.get("filename")))):
            kept.append(row)
        else:
            lost[number] = "no file %s" % row.get("filename")
    return kept, lost


def _transform(row: Row, where: str) -> np.ndarray:
    """T (4, 4) of `translation` (m) and `rotation` (quaternion w x y z)."""
    try:
        t = np.array(row["translation"], dtype=float).reshape(3)
        w, x, y, z = np.array(row["rotation"], dtype=float).reshape(4)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError("%s: translation or rotation (%s)" % (where, error)) from error
    norm = float(np.linalg.norm([w, x, y, z]))
    if not (np.isfinite(t).all() and abs(norm - 1) < 1e-2):
        raise DataError("%s: not a rigid transform (norm of the rotation %g)" % (where, norm))
    return poses.make_transform(poses.to_rotation(np.array([x, y, z, w])), t)


def _extrinsics(tables: Tables, row: Row) -> np.ndarray:
    token = row["calibrated_sensor_token"]
    return _transform(tables.get("calibrated_sensor", token), "calibrated_sensor " + str(token))


def _ego_pose(tables: Tables, row: Row) -> np.ndarray:
    token = row["ego_pose_token"]
    return _transform(tables.get("ego_pose", token), "ego_pose " + str(token))


def _camera(tables: Tables, folder: str, channel: str, rows: List[Row]) -> records.CameraRecord:
    sensor = tables.get("calibrated_sensor", rows[0]["calibrated_sensor_token"])
    intrinsic = np.array(sensor.get("camera_intrinsic") or [], dtype=float)
    if intrinsic.shape != (3, 3) or not np.isfinite(intrinsic).all():
        raise DataError("calibrated_sensor of %s: camera_intrinsic must be 3 x 3" % channel)
    name = channel.lower()
    return records.CameraRecord(
        name,
        name + "_optical_frame",
        "base_link",
        _extrinsics(tables, rows[0]),
        intrinsic,
        "plumb_bob",
        [0.0] * 5,
        True,
        [records.ImageRecord(_ns(row), os.path.join(folder, row["filename"])) for row in rows],
    )


def _label_files(folder: str, tables: Tables) -> Dict[str, str]:
    """Token of sample_data -> label file, where lidarseg was downloaded."""
    if not os.path.isfile(os.path.join(tables.folder, "lidarseg.json")):
        return {}
    return {
        str(row.get("sample_data_token")): os.path.join(folder, str(row.get("filename")))
        for row in tables.rows("lidarseg")
        if os.path.isfile(os.path.join(folder, str(row.get("filename"))))
    }


def _category_table(tables: Tables, labels: LabelSet) -> Dict[int, int]:
    names = {
        int(row["index"]): CLASSES[row["name"]]
        for row in tables.rows("category")
        if "index" in row and row.get("name") in CLASSES
    }
    return records.class_table(names, labels)


def _loader(
    path: str, label_path: Optional[str], table: Dict[int, int]
) -> Callable[[], records.Scan]:
    def load() -> records.Scan:
        data = records.read_bytes(path)
        if len(data) % POINT_BYTES:
            raise DataError("%s: %d bytes, not a multiple of %d" % (path, len(data), POINT_BYTES))
        values = np.frombuffer(data, dtype="<f4").reshape(-1, 5)
        keep = np.isfinite(values).all(axis=1) & (values[:, :3] != 0).any(axis=1)
        label = None
        if label_path is not None:
            ids = np.frombuffer(records.read_bytes(label_path), dtype=np.uint8)
            if len(ids) != len(values):
                raise DataError(
                    "%s: %d labels; its scan has %d points" % (label_path, len(ids), len(values))
                )
            label = records.map_ids(ids.astype(np.int64), table)[keep]
        ring = np.clip(values[keep, 4], 0, 65535).astype(np.uint16)
        return records.Scan(values[keep, :3].copy(), values[keep, 3].copy(), ring, None, label)

    return load

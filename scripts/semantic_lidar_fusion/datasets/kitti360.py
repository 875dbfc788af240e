# SPDX-License-Identifier: MIT
"""A drive of KITTI-360 (Liao et al., PAMI 2022), in its public layout.

  data_2d_raw/DRIVE/image_00, image_01    data_rect/NNNNNNNNNN.png, timestamps.txt (perspective)
  data_2d_raw/DRIVE/image_02, image_03    data_rgb/NNNNNNNNNN.png, timestamps.txt (fisheyes, MEI)
  data_3d_raw/DRIVE/velodyne_points       data/NNNNNNNNNN.bin, timestamps.txt (HDL-64E)
  data_poses/DRIVE/poses.txt              frame and T_world_pose (3 x 4), for most frames
  calibration/                            calib_cam_to_pose.txt, calib_cam_to_velo.txt,
                                          perspective.txt, image_02.yaml, image_03.yaml
  data_2d_semantics/train/DRIVE/image_00/semantic/NNNNNNNNNN.png   labels, where downloaded
  data_3d_semantics/train/DRIVE/static/FFFFFFFFFF_LLLLLLLLLL.ply   labels of the accumulated points

`base_link` is the data set's pose frame (GPS/IMU). A scan's stamp is the moment when it looks
ahead; its sweep takes SWEEP_NS, from behind to behind. Fisheyes take their lens from the data set's
own file, which the rig names. Poses.txt skips frames at rest: odometry is interpolated there.
Labels of scans are those of the static accumulated points within LABEL_REACH_M; moving things have
none. Frames that a partial download lacks are left out with a warning.
"""

import glob
import os
import re
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.bags import poses
from semantic_lidar_fusion.datasets import records, rellis
from semantic_lidar_fusion.datasets.timed_frames import frames_of
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet
from semantic_lidar_fusion.pictures import decoded

LIDAR_FRAME, LIDAR_TOPIC = "velodyne", "/velodyne_points"
CAMERAS = ("image_00", "image_01", "image_02", "image_03")
PERSPECTIVE = CAMERAS[:2]
SWEEP_NS = 103_600_000
LABEL_REACH_M = 0.2

# The data set's ids (those of Cityscapes, and its own from 34) -> names in the class sets.
CLASSES: Dict[int, Sequence[str]] = {
    7: ("road",),
    8: ("sidewalk", "pavement", "undrivable_road"),
    9: ("parking", "sidewalk", "undrivable_road", "pavement"),
    10: ("terrain", "undrivable_road", "pavement"),
    11: ("building",),
    12: ("wall", "building"),
    13: ("fence",),
    14: ("fence",),
    17: ("pole",),
    18: ("pole",),
    19: ("traffic_light", "pole", "sign"),
    20: ("traffic_sign", "sign"),
    21: ("vegetation", "tree"),
    22: ("terrain", "undrivable_road", "pavement"),
    23: ("sky",),
    24: ("person", "pedestrian"),
    25: ("rider", "bicyclist"),
    26: ("car", "vehicle"),
    27: ("truck", "vehicle", "car"),
    28: ("bus", "vehicle", "car"),
    29: ("truck", "vehicle", "car"),
    30: ("truck", "vehicle", "car"),
    31: ("train", "vehicle", "car"),
    32: ("motorcycle", "vehicle", "bicyclist"),
    33: ("bicycle", "bicyclist", "vehicle"),
    34: ("building",),
    35: ("fence",),
    37: ("pole",),
    38: ("pole",),
    43: ("vehicle", "car"),
}


class _Folders(NamedTuple):
    """The places of one drive."""

    root: str
    drive: str

    def images(self, camera: str) -> str:
        return os.path.join(self.root, "data_2d_raw", self.drive, camera)

    @property
    def scans(self) -> str:
        return os.path.join(self.root, "data_3d_raw", self.drive, "velodyne_points")

    @property
    def poses(self) -> str:
        return os.path.join(self.root, "data_poses", self.drive, "poses.txt")

    def calibration(self, name: str) -> str:
        return os.path.join(self.root, "calibration", name)


def read(
    root: str,
    labels: LabelSet,
    drive: Optional[str],
    cameras: Optional[List[str]],
    first: int,
    last: Optional[int],
) -> records.Drive:
    """`root`: the folder KITTI-360; `drive`: like 2013_05_28_drive_0000_sync (default: the only one
    that is there); `cameras`: image folders (default: all that exist)."""
    folders = _Folders(os.path.abspath(records.require_folder(root)), "")
    folders = folders._replace(drive=_drive(folders.root, drive))
    frames = frames_of(folders.scans, [".bin"])
    numbers = records.pick(frames.files, first, last, folders.scans)
    records.say_gaps(folders.scans, frames.within(first, last))
    to_pose = _cameras_to_pose(folders.calibration("calib_cam_to_pose.txt"))
    t_velo_cam0 = _rigid(folders.calibration("calib_cam_to_velo.txt"))
    t_pose_velo = to_pose["image_00"] @ poses.invert(t_velo_cam0)
    table = records.class_table(CLASSES, labels)
    odometry = _odometry(folders.poses, frames.times)
    found = [
        _camera(folders, name, to_pose, (first, last))
        for name in cameras or CAMERAS
        if cameras or os.path.isdir(folders.images(name))
    ]
    if not found:
        raise DataError("%s: no image folder" % os.path.dirname(folders.images("")))
    clouds = _Accumulated(folders, odometry, t_pose_velo, table)
    return records.Drive(
        "kitti360_" + folders.drive.replace("2013_05_28_drive_", "").replace("_sync", ""),
        labels,
        found,
        LIDAR_TOPIC,
        LIDAR_FRAME,
        t_pose_velo,
        [
            records.ScanRecord(
                frames.times[n] - SWEEP_NS // 2,
                _loader(frames.files[n], n, frames.times[n], clouds),
            )
            for n in numbers
        ],
        odometry,
        odometry is not None,
        ["KITTI-360 %s." % folders.drive],
        _label_values(table),
    )


def _drive(root: str, name: Optional[str]) -> str:
    found = sorted(
        os.path.basename(path) for path in glob.glob(os.path.join(root, "data_3d_raw", "*_sync"))
    )
    if name is not None:
        matching = [d for d in found if d == name or d == "2013_05_28_drive_%s_sync" % name]
        if not matching:
            raise DataError(
                "%s: no drive %s (it has: %s)" % (root, name, ", ".join(found) or "none")
            )
        return matching[0]
    if len(found) != 1:
        raise DataError(
            "%s: name a drive with --drive (it has: %s)" % (root, ", ".join(found) or "none")
        )
    return found[0]


def _rigid(path: str) -> np.ndarray:
    lines = records.read_lines(records.require_file(path))
    return _matrix(" ".join(lines[:1]), path)


def _matrix(text: str, where: str) -> np.ndarray:
    matrix = np.vstack([records.parse_numbers(text, 12, where).reshape(3, 4), [0, 0, 0, 1]])
    records.check_rotation(matrix[:3, :3], where)
    return matrix


def _cameras_to_pose(path: str) -> Dict[str, np.ndarray]:
    """Camera -> T_pose_camera, of the raw (unrectified) camera frame."""
    entries = records.read_calibration(path, {name: 12 for name in CAMERAS})
    return {
        name: np.vstack([values.reshape(3, 4), [0, 0, 0, 1]]) for name, values in entries.items()
    }


def _camera(
    folders: _Folders,
    name: str,
    to_pose: Dict[str, np.ndarray],
    span: Tuple[int, Optional[int]],
) -> records.CameraRecord:
    if name not in CAMERAS:
        raise DataError("--cameras %s: must be of %s" % (name, ", ".join(CAMERAS)))
    folder = folders.images(name)
    rectified = name in PERSPECTIVE
    frames = frames_of(folder, [".png", ".jpg"], "data_rect" if rectified else "data_rgb")
    records.say_gaps(folder, frames.within(*span))
    semantic = os.path.join(
        folders.root, "data_2d_semantics", "train", folders.drive, name, "semantic"
    )
    labels = records.numbered_files(semantic, [".png"]) if os.path.isdir(semantic) else {}
    images = [
        records.ImageRecord(frames.times[n], frames.files[n], labels.get(n))
        for n in sorted(frames.files)
        if n >= span[0] - 1 and (span[1] is None or n <= span[1] + 1)
    ]
    if not images:
        raise DataError("%s: no image among the chosen frames" % folder)
    frame = name + "_optical_frame"
    if not rectified:
        lens = records.require_file(folders.calibration(name + ".yaml"))
        return records.CameraRecord(
            name, frame, "base_link", to_pose[name], np.zeros((3, 3)), "", [], False, images, lens
        )
    number = name[-2:]
    entries = records.read_calibration(
        folders.calibration("perspective.txt"), {"P_rect_" + number: 12, "R_rect_" + number: 9}
    )
    rotation = np.eye(4)
    rotation[:3, :3] = entries["R_rect_" + number].reshape(3, 3)
    records.check_rotation(rotation[:3, :3], "perspective.txt (R_rect_%s)" % number)
    k = entries["P_rect_" + number].reshape(3, 4)[:, :3]
    t_pose_rect = to_pose[name] @ poses.invert(rotation)
    return records.CameraRecord(
        name, frame, "base_link", t_pose_rect, k, "plumb_bob", [0.0] * 5, True, images
    )


def _odometry(path: str, times: Dict[int, int]) -> Optional[Tuple[np.ndarray, np.ndarray]]:
    """Poses at the scans' times; None without the file. Frames without a time are left out."""
    if not os.path.isfile(path):
        return None
    stamps, trajectory = [], []
    for number, line in enumerate(records.read_lines(path), 1):
        where = "%s line %d" % (path, number)
        values = records.parse_numbers(line, 13, where)
        frame = int(values[0])
        if frame not in times:
            continue
        pose = np.vstack([values[1:].reshape(3, 4), [0, 0, 0, 1]])
        records.check_rotation(pose[:3, :3], where)
        stamps.append(times[frame])
        trajectory.append(pose)
    if not stamps:
        raise DataError("%s: no pose of a frame that has a time" % path)
    keep = records.rising(stamps)
    return np.array(stamps, dtype=np.int64)[keep], np.array(trajectory)[keep]


def _label_values(table: Dict[int, int]) -> Callable[[str], np.ndarray]:
    def values(path: str) -> np.ndarray:
        ids = decoded(records.read_bytes(path), "unchanged", path)
        if ids.ndim != 2:
            raise DataError("%s: not a label image of one channel" % path)
        return records.map_ids(ids.astype(np.int64), table)

    return values


class _Accumulated:
    """Labels of scans from the accumulated static points, one file (some 250 frames) in memory."""

    def __init__(
        self,
        folders: _Folders,
        odometry: Optional[Tuple[np.ndarray, np.ndarray]],
        t_pose_velo: np.ndarray,
        table: Dict[int, int],
    ):
        pattern = os.path.join(
            folders.root, "data_3d_semantics", "train", folders.drive, "static", "*.ply"
        )
        self._files: List[Tuple[int, int, str]] = []
        for path in sorted(glob.glob(pattern)):
            match = re.match(r"(\d+)_(\d+)\.ply\Z", os.path.basename(path))
            if match:
                self._files.append((int(match.group(1)), int(match.group(2)), path))
        self._series = poses.PoseSeries(*odometry) if odometry is not None else None
        self._t_pose_velo = t_pose_velo
        self._table = table
        self._loaded = ""
        self._tree: Any = None  # scipy tells no types
        self._labels = np.zeros(0, dtype=np.uint8)

    def label(self, frame: int, xyz: np.ndarray, times_ns: np.ndarray) -> Optional[np.ndarray]:
        """(N,) u8 of points in the lidar's frame at their own times; None without labels."""
        path = next((p for a, b, p in self._files if a <= frame <= b), None)
        if path is None or self._series is None:
            return None
        self._load(path)
        ticks, which = np.unique(times_ns // 1_000_000, return_inverse=True)
        world, covered = self._series.lookup(ticks * 1_000_000)
        matrix = world @ self._t_pose_velo
        placed = np.einsum("nij,nj->ni", matrix[which, :3, :3], xyz) + matrix[which, :3, 3]
        known = covered[which] & np.isfinite(placed).all(axis=1)
        label = np.full(len(xyz), NO_LABEL, dtype=np.uint8)
        distance, index = self._tree.query(placed[known], distance_upper_bound=LABEL_REACH_M)
        near = np.isfinite(distance)
        found = np.full(len(distance), NO_LABEL, dtype=np.uint8)
        found[near] = self._labels[index[near]]
        label[known] = found
        return label

    def _load(self, path: str) -> None:
        if self._loaded == path:
            return
        from scipy.spatial import cKDTree

        points = rellis.read_ply(path)
        for name in ("x", "y", "z", "semantic"):
            if name not in (points.dtype.names or ()):
                raise DataError("%s: no property %s" % (path, name))
        xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(float)
        self._tree = cKDTree(xyz)
        ids = np.clip(points["semantic"].astype(np.int64), 0, 65535)
        self._labels = records.map_ids(ids, self._table)
        self._loaded = path


def _loader(
    path: str, frame: int, forward_ns: int, clouds: _Accumulated
) -> Callable[[], records.Scan]:
    def load() -> records.Scan:
        xyz, intensity = records.read_points(path)
        start = forward_ns - SWEEP_NS // 2
        times = records.sweep_times(xyz, start, forward_ns, start + SWEEP_NS)
        label = clouds.label(frame, xyz.astype(float), start + times.astype(np.int64))
        return records.Scan(xyz, intensity, records.rings_of_scan(xyz), times, label)

    return load

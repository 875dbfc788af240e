# SPDX-License-Identifier: MIT
"""SemanticKITTI sequences (Behley et al.): the KITTI odometry scans with a label for each point.

Layout: sequences/NN/{velodyne/NNNNNN.bin, labels/NNNNNN.label, image_2/NNNNNN.png, calib.txt,
times.txt, poses.txt}; image_2 and image_3 come from the KITTI odometry download. The scans are
corrected for motion already, to the time of their line in times.txt, which is the images' too:
every point is of that instant, and the rig file disables motion. `base_link` is the lidar
(`velodyne`), `odom` its pose at the first line of poses.txt, x forward, z up.
"""

import os
from typing import Callable, Dict, Mapping, List, Optional, Sequence

import numpy as np

from semantic_lidar_fusion.datasets import records
from semantic_lidar_fusion.bags import poses
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import LabelSet

LIDAR_FRAME = "velodyne"
LIDAR_TOPIC = "/velodyne_points"

_VEHICLE = ("vehicle", "car")
# Class ids of the .label files -> names in the class sets, best first.
CLASSES: Dict[int, Sequence[str]] = {
    0: ("unlabeled", "unlabelled", "void"),
    1: ("unlabeled", "unlabelled", "void"),  # outlier
    10: ("car",) + _VEHICLE,
    11: ("bicycle", "rider", "bicyclist") + _VEHICLE,
    13: ("other_vehicle", "bus") + _VEHICLE,
    15: ("motorcycle", "rider", "bicyclist") + _VEHICLE,
    16: ("other_vehicle", "train") + _VEHICLE,  # on rails
    18: ("truck",) + _VEHICLE,
    20: ("other_vehicle", "truck") + _VEHICLE,
    30: ("person", "pedestrian"),
    31: ("bicyclist", "rider"),
    32: ("motorcyclist", "rider", "bicyclist"),
    40: ("road", "asphalt"),
    44: ("parking", "road", "asphalt"),
    48: ("sidewalk", "pavement", "undrivable_road", "concrete"),
    49: ("other_ground", "undrivable_road", "pavement", "sidewalk"),
    50: ("building",),
    51: ("fence",),
    52: ("unlabeled", "unlabelled", "void"),  # other structure
    60: ("road", "asphalt"),  # lane marking
    70: ("vegetation", "tree"),
    71: ("trunk", "vegetation", "tree"),
    72: ("terrain", "undrivable_road", "grass", "pavement"),
    80: ("pole",),
    81: ("traffic_sign", "sign"),
    99: ("unlabeled", "unlabelled", "void"),  # other object
}
# Moving objects have ids of their own.
for _moving, _still in {
    252: 10,
    253: 31,
    254: 30,
    255: 32,
    256: 16,
    257: 13,
    258: 18,
    259: 20,
}.items():
    CLASSES[_moving] = CLASSES[_still]


def read(
    folder: str, labels: LabelSet, cameras: Optional[List[str]], first: int, last: Optional[int]
) -> records.Drive:
    """The sequence in folder `sequences/NN`. `cameras`: image_2 (default), image_3."""
    folder = os.path.abspath(records.require_folder(folder))
    times = _read_times(os.path.join(folder, "times.txt"))
    scan_files = records.numbered_files(os.path.join(folder, "velodyne"), [".bin"])
    _check_count(scan_files, times, os.path.join(folder, "velodyne"))
    label_files: Dict[int, str] = {}
    if os.path.isdir(os.path.join(folder, "labels")):
        label_files = records.numbered_files(os.path.join(folder, "labels"), [".label"])
        _check_count(label_files, times, os.path.join(folder, "labels"))
    table = class_ids(labels)
    numbers = records.pick(scan_files, first, last, folder)

    calibration = os.path.join(folder, "calib.txt")
    wanted = {"Tr": 12}
    names = cameras or ["image_2"]
    for name in names:
        if name not in ("image_0", "image_1", "image_2", "image_3"):
            raise DataError("--cameras %s: must be image_0 to image_3" % name)
        wanted["P" + name[-1]] = 12
    entries = records.read_calibration(calibration, wanted)
    t_cam0_velo = np.vstack([entries["Tr"].reshape(3, 4), [0, 0, 0, 1]])
    records.check_rotation(t_cam0_velo[:3, :3], calibration + " (Tr)")
    read_cameras = []
    for name in names:
        files = records.numbered_files(os.path.join(folder, name), [".png", ".jpg"])
        _check_count(files, times, os.path.join(folder, name))
        k, t_velo_camera = records.rectified_camera(
            entries["P" + name[-1]].reshape(3, 4), poses.invert(t_cam0_velo)
        )
        camera = "camera_" + name[-1]
        read_cameras.append(
            records.CameraRecord(
                camera,
                camera + "_optical_frame",
                LIDAR_FRAME,
                t_velo_camera,
                k,
                "plumb_bob",
                [0.0] * 5,
                True,
                [records.ImageRecord(times[n], files[n]) for n in numbers],
            )
        )

    odometry = None
    poses_file = os.path.join(folder, "poses.txt")
    if os.path.isfile(poses_file):
        t_world_cam0 = records.read_poses(poses_file)
        _check_count(dict(enumerate(t_world_cam0)), times, poses_file)
        trajectory = poses.invert(t_cam0_velo) @ t_world_cam0 @ t_cam0_velo
        odometry = (np.array(times, dtype=np.int64), trajectory)
    return records.Drive(
        "semantickitti_" + os.path.basename(folder),
        labels,
        read_cameras,
        LIDAR_TOPIC,
        LIDAR_FRAME,
        np.eye(4),
        [
            records.ScanRecord(times[n], _scan_loader(scan_files[n], label_files.get(n), table))
            for n in numbers
        ],
        odometry,
        False,
        [
            "SemanticKITTI sequence %s. Its scans are corrected for motion already: all points are"
            % os.path.basename(folder),
            "of the images' time, so motion is disabled.",
        ],
    )


def class_ids(labels: LabelSet) -> Dict[int, int]:
    """SemanticKITTI id -> id in `labels`."""
    return records.class_table(CLASSES, labels)


def _scan_loader(
    path: str, label_path: Optional[str], table: Dict[int, int]
) -> Callable[[], records.Scan]:
    def load() -> records.Scan:
        xyz, intensity = records.read_points(path)
        label = None
        if label_path is not None:
            label = records.map_ids(records.read_label_ids(label_path, len(xyz)), table)
        return records.Scan(xyz, intensity, records.rings_of_scan(xyz), None, label)

    return load


def _read_times(path: str) -> List[int]:
    times = []
    for number, line in enumerate(records.read_lines(records.require_file(path)), 1):
        seconds = records.parse_numbers(line, 1, "%s line %d" % (path, number))[0]
        if abs(seconds) > 1e9:
            raise DataError("%s line %d: %g s; at most 1e9 are" % (path, number, seconds))
        times.append(records.EPOCH_NS + int(round(seconds * 1e9)))
    if not times:
        raise DataError("%s: empty" % path)
    records.check_increasing(times, path)
    return times


def _check_count(files: Mapping[int, object], times: List[int], where: str) -> None:
    if sorted(files) != list(range(len(times))):
        gaps = [n for n in range(len(times)) if n not in files]
        raise DataError(
            "%s: %d entries; times.txt has %d lines%s"
            % (where, len(files), len(times), " (no number %d)" % gaps[0] if gaps else "")
        )

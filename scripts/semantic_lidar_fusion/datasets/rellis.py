# SPDX-License-Identifier: MIT
"""RELLIS-3D sequences (Jiang et al.), and the compact form of one frame.

Public layout, as the downloads unpack into one folder Rellis-3D/0000N:
  pylon_camera_node/frameNNNNNN-SECONDS_MILLIS.jpg   raw images 1920x1200
  pylon_camera_node_label_id/frame....png            human labels of some images
  os1_cloud_node_color_ply/frame....ply              OS1-64 scans: x y z intensity t ring label
  os1_cloud_node_kitti_bin/NNNNNN.bin                the same points, x y z intensity only
  os1_cloud_node_semantickitti_label_id/NNNNNN.label labels for the .bin files
  camera_info.txt (fx fy cx cy), transforms.yaml (the camera in the lidar's frame), poses.txt
The .ply scans are preferred: they alone have times and rings. Without them a scan takes the time of
the image with its number, all points are of that instant, and motion is disabled.
Compact form: frame.npz, image.jpg, image_label_ids.png. It has no stamps: the image is placed at
the middle of the scan, and motion is disabled for want of poses.

The camera is a pinhole, as camera_info.txt says. The data set's own projection example adds the
distortion -0.134313, -0.025905, 0.002181, 0.00084; on the frame that is at hand, points and human
labels agree better without it (77.3 against 76.9 %), so it is an option (`published`).
`base_link` is the lidar (`os1_cloud_node`).
"""

import os
import re
from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.datasets import records
from semantic_lidar_fusion.bags import poses
from semantic_lidar_fusion.cli import warn
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import LabelSet, load_yaml
from semantic_lidar_fusion.pictures import decoded

LIDAR_FRAME = "os1_cloud_node"
LIDAR_TOPIC = "/os1_cloud_node/points"
CAMERA = "pylon"
CAMERA_FRAME = "pylon_camera_node"
DISTORTIONS: Dict[str, Tuple[float, ...]] = {
    "none": (),
    "published": (-0.134313, -0.025905, 0.002181, 0.00084),
}
_COMPACT_FILE = "frame.npz"

# Ids of the label images and scans -> names in the class sets, best first.
CLASSES: Dict[int, Sequence[str]] = {
    0: ("void", "unlabeled", "unlabelled"),
    1: ("dirt", "terrain", "undrivable_road", "pavement"),
    3: ("grass", "terrain", "vegetation", "undrivable_road", "tree"),
    4: ("tree", "vegetation"),
    5: ("pole",),
    6: ("water",),
    7: ("sky",),
    8: ("vehicle", "car"),
    9: ("object",),
    10: ("asphalt", "road"),
    12: ("building",),
    15: ("log",),
    17: ("person", "pedestrian"),
    18: ("fence",),
    19: ("bush", "vegetation", "tree"),
    23: ("concrete", "sidewalk", "pavement", "undrivable_road"),
    27: ("barrier", "fence"),
    31: ("puddle",),
    33: ("mud", "terrain", "undrivable_road", "pavement"),
    34: ("rubble",),
}
_PLY_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}


def read(
    folder: str,
    labels: LabelSet,
    distortion: str,
    first: int,
    last: Optional[int],
) -> records.Drive:
    """A sequence or the compact frame. `distortion`: a key of DISTORTIONS."""
    folder = os.path.abspath(records.require_folder(folder))
    coefficients = DISTORTIONS[distortion]
    if os.path.isfile(os.path.join(folder, _COMPACT_FILE)):
        return _read_compact(folder, labels, coefficients)
    return _read_sequence(folder, labels, coefficients, first, last)


def class_ids(labels: LabelSet) -> Dict[int, int]:
    """RELLIS-3D id -> id in `labels`."""
    return records.class_table(CLASSES, labels)


def frame_stamp(path: str) -> Tuple[int, int]:
    """(number, ns) of a file named frame000104-1581624663_149.jpg."""
    match = re.match(r"frame(\d+)-(\d+)_(\d{3})\.\w+\Z", os.path.basename(path))
    if not match:
        raise DataError("%s: not named frameNNNNNN-SECONDS_MILLIS" % path)
    number, seconds, millis = (int(group) for group in match.groups())
    return number, records.check_stamp(seconds * 1000000000 + millis * 1000000, path)


def read_ply(path: str) -> np.ndarray:
    """The vertices of a binary little-endian PLY file as a structured array."""
    data = records.read_bytes(path)
    end = data.find(b"end_header\n")
    if not data.startswith(b"ply") or end < 0:
        raise DataError("%s: not a PLY file" % path)
    header = data[:end].decode("ascii", "replace").split("\n")
    if "format binary_little_endian 1.0" not in [line.strip() for line in header]:
        raise DataError("%s: its format must be binary_little_endian 1.0" % path)
    count, fields, inside = None, [], False
    for line in header:
        words = line.split()
        if words[:1] == ["element"]:
            if count is not None:
                break  # only what comes first can be read without knowing the rest
            if len(words) != 3 or words[1] != "vertex" or not words[2].isdigit():
                raise DataError("%s: its first element must be vertex" % path)
            count, inside = int(words[2]), True
        elif words[:1] == ["property"] and inside:
            if len(words) != 3 or words[1] not in _PLY_TYPES:
                raise DataError("%s: cannot read '%s'" % (path, line.strip()))
            fields.append((words[2], "<" + _PLY_TYPES[words[1]]))
    if count is None:
        raise DataError("%s: no vertices" % path)
    dtype = np.dtype(fields)
    start = end + len(b"end_header\n")
    if len(data) - start < count * dtype.itemsize:
        raise DataError("%s: cut off, %d points expected" % (path, count))
    return np.frombuffer(data, dtype=dtype, count=count, offset=start)


def _make_scan(points: Dict[str, np.ndarray], table: Dict[int, int], where: str) -> records.Scan:
    """A scan of arrays x, y, z, intensity and perhaps t, ring, label; without the empty returns,
    which the sensor puts at its origin."""
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float32)
    if not np.isfinite(xyz).all():
        raise DataError("%s: a point is not finite" % where)
    keep = (xyz != 0).any(axis=1)

    def chosen(name: str, dtype: Any) -> Optional[np.ndarray]:
        return points[name][keep].astype(dtype) if name in points else None

    label = chosen("label", np.int64)
    return records.Scan(
        xyz[keep],
        points["intensity"][keep].astype(np.float32),
        chosen("ring", np.uint16),
        chosen("t", np.uint32),
        None if label is None else records.map_ids(label, table),
    )


def _ply_loader(path: str, table: Dict[int, int]) -> Callable[[], records.Scan]:
    def load() -> records.Scan:
        vertices = read_ply(path)
        missing = [n for n in ("x", "y", "z", "intensity") if n not in vertices.dtype.names]
        if missing:
            raise DataError("%s: no property %s" % (path, ", ".join(missing)))
        return _make_scan({name: vertices[name] for name in vertices.dtype.names}, table, path)

    return load


def _bin_loader(
    path: str, label_path: Optional[str], table: Dict[int, int]
) -> Callable[[], records.Scan]:
    def load() -> records.Scan:
        xyz, intensity = records.read_points(path)
        points = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], "intensity": intensity}
        if label_path is not None:
            points["label"] = records.read_label_ids(label_path, len(xyz))
        return _make_scan(points, table, path)

    return load


def _label_image_reader(table: Dict[int, int]) -> Callable[[str], np.ndarray]:
    def read_image(path: str) -> np.ndarray:
        image = decoded(records.read_bytes(path), "unchanged", path)
        if image.ndim == 3:
            # Some copies repeat the id in three channels.
            if (image[..., :3] != image[..., :1]).any():
                raise DataError("%s: a colour image; class ids are wanted" % path)
            image = image[..., 0]
        return records.map_ids(image.astype(np.int64), table)

    return read_image


def _camera(
    k: np.ndarray,
    t_lidar_camera: np.ndarray,
    distortion: Sequence[float],
    images: List[records.ImageRecord],
) -> records.CameraRecord:
    d = [float(value) for value in distortion] + [0.0] * (5 - len(distortion))
    return records.CameraRecord(
        CAMERA, CAMERA_FRAME, LIDAR_FRAME, t_lidar_camera, k, "plumb_bob", d, False, images
    )


def _read_transform(path: str) -> np.ndarray:
    """T_os1_camera of transforms.yaml."""
    tree = load_yaml(records.require_file(path))
    key = "os1_cloud_node-pylon_camera_node"
    try:
        q = np.array([float(tree[key]["q"][axis]) for axis in "xyzw"])
        t = np.array([float(tree[key]["t"][axis]) for axis in "xyz"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError("%s: no %s with q {x, y, z, w} and t {x, y, z}" % (path, key)) from error
    if not (abs(np.linalg.norm(q) - 1.0) <= 1e-3 and np.isfinite(t).all()):
        raise DataError("%s: q must be a unit quaternion and t finite" % path)
    return poses.make_transform(poses.to_rotation(q), t)


def _read_intrinsics(path: str) -> np.ndarray:
    line = " ".join(records.read_lines(records.require_file(path)))
    fx, fy, cx, cy = records.parse_numbers(line, 4, path)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _frame_files(folder: str, endings: Sequence[str]) -> Dict[int, Tuple[int, str]]:
    """Number -> (ns, path) of the files frameNNNNNN-SECONDS_MILLIS in a folder."""
    records.require_folder(folder)
    found = {}
    for name in sorted(os.listdir(folder)):
        if os.path.splitext(name)[1].lower() in endings:
            path = os.path.join(folder, name)
            number, stamp_ns = frame_stamp(path)
            found[number] = (stamp_ns, path)
    if not found:
        raise DataError("%s: no %s files" % (folder, " or ".join(endings)))
    return found


def _read_sequence(
    folder: str, labels: LabelSet, distortion: Sequence[float], first: int, last: Optional[int]
) -> records.Drive:
    table = class_ids(labels)
    image_files = _frame_files(os.path.join(folder, "pylon_camera_node"), [".jpg", ".png"])
    label_folder = os.path.join(folder, "pylon_camera_node_label_id")
    label_paths: Dict[str, str] = {}
    if os.path.isdir(label_folder):
        for name in os.listdir(label_folder):
            label_paths[os.path.splitext(name)[0]] = os.path.join(label_folder, name)
    k = _read_intrinsics(os.path.join(folder, "camera_info.txt"))
    t_lidar_camera = _read_transform(os.path.join(folder, "transforms.yaml"))

    scans: Dict[int, records.ScanRecord] = {}
    timed = os.path.isdir(os.path.join(folder, "os1_cloud_node_color_ply"))
    if timed:
        files = _frame_files(os.path.join(folder, "os1_cloud_node_color_ply"), [".ply"])
        for number, (stamp_ns, path) in files.items():
            scans[number] = records.ScanRecord(stamp_ns, _ply_loader(path, table))
    else:
        bins = records.numbered_files(os.path.join(folder, "os1_cloud_node_kitti_bin"), [".bin"])
        point_labels: Dict[int, str] = {}
        label_bins = os.path.join(folder, "os1_cloud_node_semantickitti_label_id")
        if os.path.isdir(label_bins):
            point_labels = records.numbered_files(label_bins, [".label"])
            if sorted(point_labels) != sorted(bins):
                raise DataError(
                    "%s: %d label files; there are %d scans with other numbers"
                    % (label_bins, len(point_labels), len(bins))
                )
        for number, path in bins.items():
            if number in image_files:
                load = _bin_loader(path, point_labels.get(number), table)
                scans[number] = records.ScanRecord(image_files[number][0], load)
        if len(scans) < len(bins):
            warn("%d scans have no image of their number, so no time" % (len(bins) - len(scans)))
    numbers = records.pick(scans, first, last, folder)
    records.check_increasing([scans[n].stamp_ns for n in numbers], folder + " (scans)")

    odometry = None
    poses_file = os.path.join(folder, "poses.txt")
    if os.path.isfile(poses_file):
        trajectory = records.read_poses(poses_file)
        every = sorted(scans)
        if len(trajectory) <= max(every):
            raise DataError(
                "%s: %d poses; the last scan is number %d"
                % (poses_file, len(trajectory), every[-1])
            )
        stamps = np.array([scans[n].stamp_ns for n in every], dtype=np.int64)
        odometry = (stamps, trajectory[every])
    images = []
    for number in sorted(image_files):
        stamp_ns, path = image_files[number]
        stem = os.path.splitext(os.path.basename(path))[0]
        images.append(records.ImageRecord(stamp_ns, path, label_paths.get(stem)))
    images = [i for i in images if _near(i.stamp_ns, [scans[n].stamp_ns for n in numbers])]
    return records.Drive(
        "rellis_" + os.path.basename(folder),
        labels,
        [_camera(k, t_lidar_camera, distortion, images)],
        LIDAR_TOPIC,
        LIDAR_FRAME,
        np.eye(4),
        [scans[n] for n in numbers],
        odometry,
        timed and odometry is not None,
        [
            "RELLIS-3D sequence %s." % os.path.basename(folder),
            "Scans have a time for each point."
            if timed
            else "Scans without times: each is taken at the image of its number.",
        ],
        _label_image_reader(table),
    )


def _near(stamp_ns: int, scan_stamps: List[int]) -> bool:
    """Within the chosen scans, with half a second to either side."""
    return scan_stamps[0] - 500000000 <= stamp_ns <= scan_stamps[-1] + 600000000


def _read_compact(folder: str, labels: LabelSet, distortion: Sequence[float]) -> records.Drive:
    path = os.path.join(folder, _COMPACT_FILE)
    image = records.require_file(os.path.join(folder, "image.jpg"))
    label_image: Optional[str] = os.path.join(folder, "image_label_ids.png")
    if not os.path.isfile(label_image or ""):
        label_image = None
    table = class_ids(labels)
    try:
        with np.load(path) as arrays:
            xyz = np.array(arrays["xyz"])
            points = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2]}
            points["intensity"] = np.array(arrays["intensity"])
            points["t"] = np.array(arrays["t_ns"])
            points["ring"] = np.array(arrays["ring"])
            points["label"] = np.array(arrays["label"])
            k = np.array(arrays["K"], dtype=float).reshape(3, 3)
            t_camera_lidar = np.array(arrays["camera_from_os1"], dtype=float).reshape(4, 4)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise DataError("%s: %s" % (path, error)) from error
    if len({len(values) for values in points.values()}) != 1:
        raise DataError("%s: its arrays differ in length" % path)
    scan = _make_scan(points, table, path)
    if not len(scan.xyz) or scan.time_ns is None:
        raise DataError("%s: no points" % path)
    middle = (int(scan.time_ns.min()) + int(scan.time_ns.max())) // 2
    images = [records.ImageRecord(records.EPOCH_NS + middle, image, label_image)]
    return records.Drive(
        os.path.basename(folder),
        labels,
        [_camera(k, poses.invert(t_camera_lidar), distortion, images)],
        LIDAR_TOPIC,
        LIDAR_FRAME,
        np.eye(4),
        [records.ScanRecord(records.EPOCH_NS, lambda: scan)],
        None,
        False,
        [
            "One RELLIS-3D frame without stamps or pose: the image is placed at the middle of the",
            "scan, and motion is disabled.",
        ],
        _label_image_reader(table),
    )

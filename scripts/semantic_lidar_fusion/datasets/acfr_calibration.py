# SPDX-License-Identifier: MIT
"""Folders of the camera-lidar calibration tool of ACFR (cam_lidar_calibration).

  images/poseN.png|jpg   one image for each pose of the board, the vehicle at rest
  pcd/poseN_full.pcd     the scan of that pose: x y z intensity ring, no time per point
  *.csv                  calibration runs: roll,pitch,yaw,x,y,z of the camera in the lidar's frame
                         (rad, fixed axes x y z; m); the mean is the calibration
  camera_info.yaml       distortion_model (fisheye, non-fisheye), width, height, K, D
Compact form: poseN.jpg and poseN.npz beside extrinsic_runs.csv; with `board_corners_camera_m` (4, 3)
and `on_board` (one for each point) in the .npz files, images and points have the labels board and
background (sign and building in a class set of streets).

Poses are one second apart; the vehicle stands, so motion is disabled. The runs become a file
`extrinsic_runs.csv` that a rig names for its errors. `base_link` is the lidar.
"""

import glob
import os
import re
from typing import Callable, Dict, List, Optional, Sequence, Tuple

import numpy as np

from semantic_lidar_fusion.bags import poses
from semantic_lidar_fusion.datasets import pcd, records
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import LabelSet, load_yaml

LIDAR_FRAME, LIDAR_TOPIC = "velodyne", "/velodyne_points"
CAMERA, CAMERA_FRAME = "camera", "camera_optical_frame"
PERIOD_NS = 1000000000
RUNS_HEADER = "roll,pitch,yaw,x,y,z"
# The tool's names of lenses -> camera_info's, with the number of coefficients.
_LENSES = {
    "fisheye": ("equidistant", 4),
    "equidistant": ("equidistant", 4),
    "non-fisheye": ("plumb_bob", 5),
    "plumb_bob": ("plumb_bob", 5),
}
# Of the compact form, which holds one vehicle's front camera (its README).
_COMPACT_K = ((1176.93, 0.0, 962.275), (0.0, 1177.72, 612.725), (0.0, 0.0, 1.0))
_COMPACT_D = (-0.0540096, -0.0784275, 0.0959641, -0.0515253)
_CLASSES: Dict[int, Sequence[str]] = {0: ("background", "building"), 1: ("board", "sign")}
_FIELDS = ("x", "y", "z", "intensity", "ring", "on_board", "board_corners_camera_m")
_STEPS_OF_EDGE = 64  # straight edges bend in a fisheye


def read(
    folder: str, labels: LabelSet, camera_info: Optional[str], first: int, last: Optional[int]
) -> records.Drive:
    """`camera_info`: path of the YAML file, if it is not in the folder (or its cfg/ or parent)."""
    folder = os.path.abspath(records.require_folder(folder))
    compact = bool(glob.glob(os.path.join(folder, "pose*.npz")))
    scans, images = _poses(folder, compact)
    numbers = records.pick([n for n in scans if n in images], first, last, folder)
    lost = {n: "no image" for n in scans if n not in images}
    lost.update({n: "no scan" for n in images if n not in scans})
    records.say_gaps(folder, lost)
    runs_path = _runs_path(folder)
    runs = read_runs(runs_path)
    k, model, d = _lens(folder, compact, camera_info)
    stamps = {n: records.EPOCH_NS + index * PERIOD_NS for index, n in enumerate(numbers)}
    table = _board_table(labels) if compact else {}
    board = _BoardImages({scans[n]: images[n] for n in numbers}, k, model, d, table)
    camera = records.CameraRecord(
        CAMERA,
        CAMERA_FRAME,
        LIDAR_FRAME,
        mean_pose(runs),
        k,
        model,
        d,
        False,
        [records.ImageRecord(stamps[n], images[n], board.path(scans[n])) for n in numbers],
    )
    return records.Drive(
        "acfr_calibration",
        labels,
        [camera],
        LIDAR_TOPIC,
        LIDAR_FRAME,
        np.eye(4),
        [records.ScanRecord(stamps[n], _loader(scans[n], table)) for n in numbers],
        None,
        False,
        [
            "Calibration poses of a standing vehicle, one second apart.",
            "Extrinsics: the mean of %d runs of the target calibration (%s)."
            % (len(runs), os.path.basename(runs_path)),
        ],
        board.labels if compact else None,
    )


def _board_table(labels: LabelSet) -> Dict[int, int]:
    """0 (not the board) and 1 -> id in `labels`; empty where the set has no such classes."""
    try:
        return records.class_table(_CLASSES, labels)
    except DataError:
        return {}


class _BoardImages:
    """Label images of the board, drawn from its corners as the camera found them."""

    def __init__(
        self,
        images: Dict[str, str],
        k: np.ndarray,
        model: str,
        d: Sequence[float],
        table: Dict[int, int],
    ):
        """`images`: .npz file -> its image."""
        self._images, self._k, self._model, self._table = images, k, model, table
        self._d = np.asarray(d, dtype=float)

    def path(self, scan: str) -> Optional[str]:
        """The .npz file if it holds corners."""
        return scan if self._table and "board_corners_camera_m" in _npz(scan) else None

    def labels(self, path: str) -> np.ndarray:
        """(H, W) u8 ids."""
        import cv2

        corners = np.asarray(_npz(path)["board_corners_camera_m"], dtype=float)
        if corners.shape != (4, 3) or not (corners[:, 2] > 0).all():
            raise DataError(
                "%s: board_corners_camera_m are not four points before the camera" % path
            )
        part = np.linspace(0.0, 1.0, _STEPS_OF_EDGE, endpoint=False)[:, None]
        edges = [a + part * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0))]
        outline = np.concatenate(edges)[:, None]
        project = cv2.fisheye.projectPoints if self._model == "equidistant" else cv2.projectPoints
        pixels = project(outline, np.zeros(3), np.zeros(3), self._k, self._d)[0]
        image = self._images[path]
        width, height, _ = records.image_size(records.read_bytes(image), image)
        ids = np.zeros((height, width), dtype=np.uint8)
        cv2.fillPoly(ids, [np.rint(pixels).astype(np.int32)], 1)
        return records.map_ids(ids.astype(np.int64), self._table)


def read_runs(path: str) -> np.ndarray:
    """(R, 6) roll pitch yaw (rad, fixed axes x y z) x y z (m) of the camera in the lidar's frame;
    lines that begin with # or a letter are headers."""
    runs = []
    for number, line in enumerate(records.read_lines(path), 1):
        if not line.strip() or re.match(r"\s*[#A-Za-z]", line):
            continue
        values = records.parse_numbers(line.replace(",", " "), 6, "%s line %d" % (path, number))
        runs.append(values)
    if not runs:
        raise DataError("%s: no calibration run" % path)
    return np.array(runs)


def mean_pose(runs: np.ndarray) -> np.ndarray:
    """T_lidar_camera (4, 4): the mean rotation (chordal) and translation of the runs."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_euler("xyz", runs[:, :3]).mean().as_matrix()
    return poses.make_transform(rotation, runs[:, 3:].mean(axis=0))


def _poses(folder: str, compact: bool) -> Tuple[Dict[int, str], Dict[int, str]]:
    if compact:
        scans = _numbered(folder, r"pose(\d+)\.npz\Z")
        return scans, _numbered(folder, r"pose(\d+)\.(?:jpg|jpeg|png)\Z")
    scans = _numbered(os.path.join(folder, "pcd"), r"pose(\d+)_full\.pcd\Z")
    images = _numbered(os.path.join(folder, "images"), r"pose(\d+)\.(?:jpg|jpeg|png)\Z")
    return scans, images


def _numbered(folder: str, pattern: str) -> Dict[int, str]:
    records.require_folder(folder)
    found = {}
    for name in sorted(os.listdir(folder)):
        match = re.match(pattern, name)
        if match:
            found[int(match.group(1))] = os.path.join(folder, name)
    if not found:
        raise DataError("%s: no files named like poseN" % folder)
    return found


def _runs_path(folder: str) -> str:
    """The calibration runs: extrinsic_runs.csv, or the newest calibration*.csv."""
    fixed = os.path.join(folder, "extrinsic_runs.csv")
    if os.path.isfile(fixed):
        return fixed
    found = sorted(glob.glob(os.path.join(folder, "calibration*.csv")))
    if not found:
        raise DataError("%s: no extrinsic_runs.csv and no calibration*.csv" % folder)
    return found[-1]


def _lens(
    folder: str, compact: bool, given: Optional[str]
) -> Tuple[np.ndarray, str, Tuple[float, ...]]:
    places = [folder, os.path.join(folder, "cfg"), os.path.dirname(folder)]
    candidates = [given] if given else [os.path.join(p, "camera_info.yaml") for p in places]
    path = next((c for c in candidates if os.path.isfile(c)), None)
    if path is None:
        if compact and not given:
            return np.array(_COMPACT_K), "equidistant", _COMPACT_D
        raise DataError("%s: no camera_info.yaml; name it with --camera-info" % (given or folder))
    tree = load_yaml(path)
    if not isinstance(tree, dict):
        raise DataError("%s: must be a mapping" % path)
    name = str(tree.get("distortion_model"))
    if name not in _LENSES:
        raise DataError(
            "%s: distortion_model = %s: must be one of %s" % (path, name, ", ".join(_LENSES))
        )
    model, most = _LENSES[name]
    k = records.parse_numbers(" ".join(map(str, tree.get("K") or [])), 9, path + " (K)")
    d = [float(value) for value in tree.get("D") or []]
    if not 4 <= len(d) <= most:
        raise DataError("%s: D has %d numbers; %s has 4 to %d" % (path, len(d), model, most))
    if model == "plumb_bob" and len(d) == 4:
        d.append(0.0)
    return k.reshape(3, 3), model, tuple(d)


def _loader(path: str, table: Dict[int, int]) -> Callable[[], records.Scan]:
    def load() -> records.Scan:
        if path.endswith(".npz"):
            fields = _npz(path)
        else:
            fields = pcd.read(path)
        missing = [name for name in ("x", "y", "z") if name not in fields]
        if missing:
            raise DataError("%s: no field %s" % (path, ", ".join(missing)))
        xyz = np.stack([fields[axis] for axis in "xyz"], axis=1).astype(np.float32)
        keep = np.isfinite(xyz).all(axis=1) & (xyz != 0).any(axis=1)
        intensity = fields.get("intensity", np.zeros(len(xyz), np.float32)).astype(np.float32)
        ring = fields["ring"][keep].astype(np.uint16) if "ring" in fields else None
        label = None
        if table and "on_board" in fields:
            label = records.map_ids(fields["on_board"][keep].astype(np.int64), table)
        return records.Scan(xyz[keep], intensity[keep], ring, None, label)

    return load


def _npz(path: str) -> Dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            names: List[str] = [n for n in _FIELDS if n in file]
            return {name: file[name] for name in names}
    except (OSError, ValueError, KeyError) as error:
        raise DataError("%s: not a readable .npz file (%s)" % (path, error)) from error

# SPDX-License-Identifier: MIT
"""Expected distributions on real data: a calibration board whose outline in the image is known.

A folder of calibration poses (datasets/acfr_calibration.py, compact form: poseN.jpg, poseN.npz,
extrinsic_runs.csv) becomes a bag. The board's corners, which the chessboard alone tells, give an
image of P(board) = 0.999 within its outline and 0.001 outside; the returns from the board, which the
lidar alone tells, are the truth. Between the two stands the calibration, which errs by the spread of
its runs. Points that the board hides from the camera have no truth; the lidar's own place of the board
tells which, for the outline in the image would leave out what the calibration gets wrong.
"""

import os
from typing import Any, Dict, List, NamedTuple, Tuple

import numpy as np
import yaml

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags import cloud_io, poses
from semantic_lidar_fusion.bags.bag_io import BagWriter, to_stamp, write_text
from semantic_lidar_fusion.cameras import Camera
from semantic_lidar_fusion.datasets import acfr_calibration, records, writer
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.evaluation import scoring, tables
from semantic_lidar_fusion.evaluation.metrics import Confusion, Reliability
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet

SURE = 0.999
# What an outline of two per mille of the image's width away may be wrong about, px.
EDGE_PX = 30.0
# Things nearer behind the board than this may be the board itself, m.
_MARGIN_M = 0.3
# Corners further than this (rms, m) from the plane of the board's returns are not to be trusted.
_MOST_OFF_PLANE_M = 0.05
_CLASSES = {
    "classes": [
        {"name": "other", "color": [128, 128, 128], "dynamic": False},
        {"name": "board", "color": [255, 0, 0], "dynamic": False},
    ],
    "evaluation": {"discard": [], "merge": {"other": ["other"], "board": ["board"]}},
}
TRANSFERS = ("pixel", "expected")
_POINT_FIELDS = ("x", "y", "z", "intensity", "ring")
_FIELDS = _POINT_FIELDS + ("on_board", "board_corners_camera_m", "board_centre_lidar_m")


class Pose(NamedTuple):
    """points: (N,) truth with x y z label edge_px. off_plane_m: rms of the board's returns."""

    points: np.ndarray
    off_plane_m: float


def compare(folder: str, program: str, settings: List[str], workspace: str) -> Tuple[str, str]:
    """Tables of both transfers, as Markdown and CSV; `settings` override the rig's keys."""
    bag, rig = os.path.join(workspace, "board.bag"), os.path.join(workspace, "board.yaml")
    sound = write_bag(folder, bag, rig)
    targets = [
        scoring.FuseTarget(
            os.path.join(workspace, "board_%s.bag" % transfer),
            ("transfer=" + transfer,) + tuple(settings),
        )
        for transfer in TRANSFERS
    ]
    scoring.run_fuse_bag(program, bag, rig, targets)
    rows: List[List[object]] = []
    for transfer, target in zip(TRANSFERS, targets):
        rows += _scores(transfer, bag, target.path, sound)
    header = ["points", "transfer", "scored", "NLL", "Brier", "ECE", "accuracy"]
    rows.sort(key=lambda row: _SETS.index(str(row[0])))
    return tables.markdown(header, [_shown(row) for row in rows]), tables.csv_text(header, rows)


_SETS = (
    "all",
    "next to edges",
    "all, sound poses",
    "next to edges, sound poses",
)


def _shown(row: List[object]) -> List[object]:
    return row[:3] + [tables.number(float(str(value)), 4) for value in row[3:]]


def _scores(transfer: str, bag: str, fused: str, sound: Dict[int, bool]) -> List[List[object]]:
    truth = scoring.Truth(bag, 2)
    scores = {name: (Reliability(), Confusion(2)) for name in _SETS}
    for index, cloud, scan in scoring.paired(truth, scoring.FusedBag(fused, ["other", "board"])):
        near = scan.points["edge_px"] < EDGE_PX
        for name in _SETS:
            if "sound" in name and not sound[index]:
                continue
            chosen = cloud.fused & (near if "edges" in name else True)
            label = np.where(chosen, scan.label, NO_LABEL)
            reliability, confusion = scores[name]
            reliability.add(cloud.probabilities, label, cloud.label, cloud.points["confidence"])
            confusion.add(label, cloud.label)
    return [
        [name, transfer, found.total, found.nll, found.brier, found.ece, confusion.accuracy]
        for name, (found, confusion) in scores.items()
    ]


def write_bag(folder: str, bag: str, rig: str) -> Dict[int, bool]:
    """Writes the bag and its rig file; says of each pose whether its corners can be trusted."""
    from tf2_msgs.msg import TFMessage

    drive = acfr_calibration.read(folder, LabelSet.from_tree(_CLASSES, "board"), None, 0, None)
    camera = drive.cameras[0]
    t_camera_lidar = poses.invert(camera.t_parent_camera)
    sound: Dict[int, bool] = {}
    with BagWriter(bag) as bag_writer:
        stamp_ns = camera.images[0].stamp_ns
        transforms = [
            poses.to_message("base_link", drive.lidar_frame, np.eye(4), stamp_ns),
            poses.to_message(drive.lidar_frame, camera.frame, camera.t_parent_camera, stamp_ns),
        ]
        bag_writer.write("/tf_static", TFMessage(transforms), stamp_ns, latched=True)
        for number, image in enumerate(cli.progress(camera.images, label="poses")):
            width, height, _ = records.image_size(records.read_bytes(image.path), image.path)
            info = writer.camera_info(camera, width, height, image.stamp_ns)
            fields = _fields(os.path.splitext(image.path)[0] + ".npz")
            inside = _outline(Camera(info), fields["board_corners_camera_m"], (height, width))
            pose = _pose(fields, t_camera_lidar, Camera(info), inside)
            sound[number] = pose.off_plane_m <= _MOST_OFF_PLANE_M
            bag_writer.write("/camera/camera_info", info, image.stamp_ns)
            message = _probabilities(inside)
            message.header = info.header
            bag_writer.write("/camera/probabilities", message, image.stamp_ns)
            for topic, names in (
                ("/points", _POINT_FIELDS),
                ("/points_truth", pose.points.dtype.names),
            ):
                cloud = np.zeros(
                    len(pose.points),
                    dtype=cloud_io.point_dtype([(n, _kind(pose.points, n)) for n in names]),
                )
                for name in names:
                    cloud[name] = pose.points[name]
                message = cloud_io.from_array(cloud, image.stamp_ns, drive.lidar_frame)
                bag_writer.write(topic, message, image.stamp_ns)
    tree = {
        "name": "board",
        "classes": _CLASSES,
        "cameras": [
            {
                "name": "camera",
                "input": "probabilities",
                "errors": {"extrinsic_runs": _runs_of(folder)},
            }
        ],
        "lidar": {"input": "points", "topic": "/points"},
        "motion": {"enabled": False},
        "occlusion": {"mode": "off"},
    }
    write_text(rig, yaml.safe_dump(tree, sort_keys=False))
    return sound


def _runs_of(folder: str) -> str:
    return os.path.join(os.path.abspath(folder), "extrinsic_runs.csv")


def _kind(points: np.ndarray, name: str) -> str:
    return str(points.dtype[name].str[1:])


def _fields(path: str) -> Dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            fields = {name: file[name] for name in file.files}
    except (OSError, ValueError) as error:
        raise DataError("%s: not a readable .npz file (%s)" % (path, error)) from error
    missing = set(_FIELDS) - set(fields)
    if missing:
        raise DataError("%s: no field %s" % (path, ", ".join(sorted(missing))))
    return fields


def _outline(camera: Camera, corners: np.ndarray, shape: Tuple[int, int]) -> np.ndarray:
    """(H, W) bool: the board in the image; its straight edges are bent by the lens."""
    import cv2

    ends = np.roll(corners, -1, axis=0)
    part = np.linspace(0.0, 1.0, 200, endpoint=False)[:, None]
    edge = np.concatenate([a + part * (b - a) for a, b in zip(corners, ends)])
    pixels = camera.project(edge)[0]
    if not np.isfinite(pixels).all():
        raise DataError("the board's corners are not in the camera's view")
    image = np.zeros(shape, np.uint8)
    cv2.fillPoly(image, [np.round(pixels).astype(np.int32)], 1)
    return image.astype(bool)


def _pose(
    fields: Dict[str, np.ndarray], t_camera_lidar: np.ndarray, camera: Camera, inside: np.ndarray
) -> Pose:
    import cv2

    xyz = np.stack([fields[axis] for axis in "xyz"], axis=1).astype(np.float64)
    keep = np.isfinite(xyz).all(axis=1) & (xyz != 0).any(axis=1)
    xyz, on_board = xyz[keep], fields["on_board"][keep] != 0
    seen = poses.transform_points(t_camera_lidar, xyz)
    corners = fields["board_corners_camera_m"].astype(np.float64)
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    normal /= np.linalg.norm(normal)
    centre = poses.transform_points(t_camera_lidar, fields["board_centre_lidar_m"][None])[0]
    behind = _behind(seen, corners + (centre - corners.mean(axis=0)), normal)
    label = np.where(behind, NO_LABEL, on_board).astype(np.uint8)

    grey = inside.astype(np.uint8)
    distance = cv2.distanceTransform(1 - grey, cv2.DIST_L2, 5)
    distance += cv2.distanceTransform(grey, cv2.DIST_L2, 5)
    pixel, visible = camera.project(seen)
    edge_px = np.full(len(seen), -1.0, np.float32)
    column, row = np.floor(pixel[visible] + 0.5).astype(int).T
    edge_px[visible] = distance[row, column]

    kinds = [(axis, "f4") for axis in "xyz"] + [("label", "u1"), ("edge_px", "f4")]
    points = np.zeros(len(xyz), cloud_io.point_dtype(kinds + [("intensity", "f4"), ("ring", "u2")]))
    for column, axis in enumerate("xyz"):
        points[axis] = xyz[:, column]
    points["label"], points["edge_px"] = label, edge_px
    for name in ("intensity", "ring"):
        points[name] = fields[name][keep]
    off_plane = (seen[on_board] - corners[0]) @ normal
    return Pose(points, float(np.sqrt(np.mean(np.square(off_plane)))) if on_board.any() else 0.0)


def _behind(seen: np.ndarray, corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(N,) bool: the line of sight crosses the board well before the point."""
    with np.errstate(divide="ignore", invalid="ignore"):
        part = (corners[0] @ normal) / (seen @ normal)
    hidden = (part > 0) & ((1 - part) * np.linalg.norm(seen, axis=1) > _MARGIN_M)
    crossing = seen * np.where(np.isfinite(part), part, 0.0)[:, None]
    for begin, end in zip(corners, np.roll(corners, -1, axis=0)):
        hidden &= np.cross(end - begin, crossing - begin) @ normal > 0
    return np.asarray(hidden)


def _probabilities(inside: np.ndarray) -> Any:
    from sensor_msgs.msg import Image

    board = np.where(inside, SURE, 1.0 - SURE).astype("<f4")
    values = np.stack([1.0 - board, board], axis=2).astype("<f4")
    height, width = inside.shape
    message = Image(height=height, width=width, encoding="32FC2", step=8 * width)
    message.data = values.tobytes()
    return message

# SPDX-License-Identifier: MIT
"""Ordinary mistakes in a rig or a recording, made on a bag of simulate_drive.

`plain_bag` turns such a bag into that of a plain vehicle with two cameras (front: scores; left:
labels), a lidar that sends clouds with a time per point, and tf. Each Mistake changes that bag or
its rig; `cause` is a regular expression that the cause or figure of a finding must match.
"""

import copy
import dataclasses
import re
from typing import Any, Callable, Dict, List, Optional

import numpy as np

from semantic_lidar_fusion.bags.bag_io import BagReader, BagWriter, to_ns, to_stamp
from semantic_lidar_fusion.bags.cloud_io import from_array, point_dtype, to_array
from semantic_lidar_fusion.bags.poses import (
    from_message,
    invert,
    make_transform,
    to_message,
)

LIDAR, FRONT, LEFT = "/points", "front", "left"
# The simulator's cameras by the vehicle's names for them.
PLAIN = {FRONT: "A0", LEFT: "B0"}
REFERENCE = {FRONT: "A0", LEFT: "B0", "front_left": "A1", "front_right": "A2", "right": "B1"}
VEHICLES = {"plain": PLAIN, "reference": REFERENCE}
OPTICAL_FROM_BODY = np.eye(4)
OPTICAL_FROM_BODY[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]


@dataclasses.dataclass
class Item:
    topic: str
    message: Any
    stamp_ns: int


def plain_bag(drive: str, raw_clouds: str, sources: Dict[str, str] = PLAIN) -> List[Item]:
    """The messages of a vehicle with the cameras `sources`. `drive`: a bag of simulate_drive;
    `raw_clouds`: what fuse_bag makes of it with motion.enabled=false."""
    items: List[Item] = []
    with BagReader(raw_clouds) as reader:
        for entry in reader.read(["/points_compensated"]):
            items.append(_cloud(entry.message))
    with BagReader(drive) as reader:
        for entry in reader.read():
            if entry.topic in ("/tf", "/tf_static"):
                items.append(Item(entry.topic, entry.message, entry.stamp_ns))
            for name, source in sources.items():
                part = entry.topic.replace("/gmsl/%s/" % source, "")
                if part == entry.topic:
                    continue
                if part == "scores" and name == LEFT:
                    items.append(Item("/left/labels", _labels(entry.message), entry.stamp_ns))
                elif part in ("camera_info", "scores", "image_color/compressed"):
                    topic = "/%s/%s" % (name, part.replace("image_color", "image"))
                    items.append(Item(topic, entry.message, entry.stamp_ns))
    return sorted(items, key=lambda item: item.stamp_ns)


def _cloud(message: Any) -> Item:
    points = to_array(message)
    first_ns = to_ns(message.header.stamp) + int(round(float(points["dt"].min()) * 1e9))
    fields = [
        ("x", "f4"),
        ("y", "f4"),
        ("z", "f4"),
        ("intensity", "f4"),
        ("ring", "u2"),
        ("t", "u4"),
    ]
    out = np.zeros(len(points), dtype=point_dtype(fields))
    for name in ("x", "y", "z", "intensity", "ring"):
        out[name] = points[name]
    dt = points["dt"].astype(float)
    out["t"] = np.round((dt - dt.min()) * 1e9)
    return Item(LIDAR, from_array(out, first_ns, message.header.frame_id), first_ns + 110_000_000)


def scores_of(message: Any) -> np.ndarray:
    """(H, W, C) float32, a copy."""
    channels = int(message.encoding[len("32FC") :])
    data = np.frombuffer(message.data, dtype="<f4")
    return data.reshape(message.height, message.width, channels).copy()


def _image(like: Any, pixels: np.ndarray, encoding: str) -> Any:
    from sensor_msgs.msg import Image

    message = Image(header=copy.deepcopy(like.header))
    message.height, message.width = pixels.shape[:2]
    message.encoding = encoding
    message.step = pixels.strides[0] if pixels.flags.c_contiguous else 0
    pixels = np.ascontiguousarray(pixels)
    message.step = pixels.nbytes // message.height
    message.data = pixels.tobytes()
    return message


def _labels(scores: Any) -> Any:
    return _image(scores, scores_of(scores).argmax(axis=2).astype(np.uint8), "mono8")


def rig(classes: str, sources: Dict[str, str] = PLAIN) -> Dict[str, Any]:
    """The right rig of a vehicle; `classes`: path of its class set."""
    return {
        "name": "plain",
        "classes": {"file": classes},
        "cameras": [
            {
                "name": name,
                "transport": "compressed",
                "input": "labels" if name == LEFT else "scores",
            }
            for name in sources
        ],
        "lidar": {"input": "points", "topic": LIDAR},
        "fixed_frame": "odom",
        "vehicle_frame": "base_link",
        "odometry": {"source": "tf"},
        "reference": {"choose": "closest_image", "camera": FRONT},
    }


@dataclasses.dataclass(frozen=True)
class Mistake:
    """bag, rig: change copies in place (or None); sensor: where the finding must be, empty = any."""

    name: str
    cause: str
    bag: Optional[Callable[[List[Item]], None]] = None
    rig: Optional[Callable[[Dict[str, Any]], None]] = None

    def made(self, items: List[Item], tree: Dict[str, Any]) -> Any:
        """Copies of the bag's messages and the rig with the mistake."""
        items = copy.deepcopy(items) if self.bag else items
        tree = copy.deepcopy(tree)
        if self.bag:
            self.bag(items)
        if self.rig:
            self.rig(tree)
        return items, tree

    def named_in(self, text: str) -> bool:
        return re.search(self.cause, text) is not None


def write(path: str, items: List[Item]) -> None:
    with BagWriter(path, compression="none") as writer:
        for item in sorted(items, key=lambda entry: entry.stamp_ns):
            latched = item.topic == "/tf_static"
            writer.write(item.topic, item.message, item.stamp_ns, latched)


def _static(items: List[Item], change: Callable[[str, np.ndarray], np.ndarray]) -> None:
    """Applies `change` to the static transforms (child frame, T_parent_child)."""
    for item in items:
        if item.topic == "/tf_static":
            for k, t in enumerate(item.message.transforms):
                matrix = change(t.child_frame_id, from_message(t.transform))
                item.message.transforms[k] = to_message(
                    t.header.frame_id, t.child_frame_id, matrix, to_ns(t.header.stamp)
                )


def _camera_frames(items: List[Item]) -> Dict[str, str]:
    frames = {}
    for item in items:
        for name in (FRONT, LEFT):
            if item.topic == "/%s/camera_info" % name:
                frames[name] = item.message.header.frame_id
    return frames


def _cameras(change: Callable[[np.ndarray], np.ndarray], names: Any = (FRONT, LEFT)) -> Any:
    def edit(items: List[Item]) -> None:
        frames = [_camera_frames(items)[name] for name in names]
        _static(items, lambda child, m: change(m) if child in frames else m)

    return edit


def _swapped(items: List[Item]) -> None:
    frames = _camera_frames(items)
    known = {}
    _static(items, lambda child, m: known.setdefault(child, m))
    other = {frames[FRONT]: frames[LEFT], frames[LEFT]: frames[FRONT]}
    _static(items, lambda child, m: known[other[child]] if child in other else m)


def _lidar_frame(matrix: np.ndarray) -> Any:
    def edit(items: List[Item]) -> None:
        frame = next(item.message.header.frame_id for item in items if item.topic == LIDAR)
        _static(items, lambda child, m: m @ matrix if child == frame else m)

    return edit


def _odometry(change: Callable[[np.ndarray], np.ndarray]) -> Any:
    def edit(items: List[Item]) -> None:
        for item in items:
            if item.topic == "/tf":
                for k, t in enumerate(item.message.transforms):
                    item.message.transforms[k] = to_message(
                        t.header.frame_id,
                        t.child_frame_id,
                        change(from_message(t.transform)),
                        to_ns(t.header.stamp),
                    )

    return edit


def _frozen(items: List[Item]) -> None:
    first: List[np.ndarray] = []

    def hold(matrix: np.ndarray) -> np.ndarray:
        first.append(matrix)
        return first[0]

    _odometry(hold)(items)


def _yaw_sign(matrix: np.ndarray) -> np.ndarray:
    """The heading turns the other way; the path is integrated with it, so the position too."""
    result = np.eye(4)
    result[:3, :3] = matrix[:3, :3].T
    result[:3, 3] = matrix[:3, 3] * (1, -1, 1)
    return result


def _stamps(seconds: float, topics: Any) -> Any:
    def edit(items: List[Item]) -> None:
        for item in items:
            if re.fullmatch(topics, item.topic):
                header = item.message.header
                header.stamp = to_stamp(to_ns(header.stamp) + int(seconds * 1e9))

    return edit


def _clouds(change: Callable[[np.ndarray], None], stamp_s: Any = 0.0) -> Any:
    def edit(items: List[Item]) -> None:
        for item in items:
            if item.topic == LIDAR:
                points = to_array(item.message).copy()
                later = stamp_s(points) if callable(stamp_s) else stamp_s
                change(points)
                stamp = to_ns(item.message.header.stamp) + int(later * 1e9)
                item.message = from_array(points, stamp, item.message.header.frame_id)

    return edit


def _scale_xyz(factor: float) -> Any:
    def change(points: np.ndarray) -> None:
        for axis in "xyz":
            points[axis] *= factor

    return change


def _times(divisor: float) -> Any:
    def change(points: np.ndarray) -> None:
        points["t"] = points["t"] // divisor

    return change


def _front_scores(change: Callable[[np.ndarray], np.ndarray]) -> Any:
    def edit(items: List[Item]) -> None:
        for item in items:
            if item.topic == "/front/scores":
                pixels = change(scores_of(item.message)).astype("<f4")
                item.message = _image(item.message, pixels, "32FC%d" % pixels.shape[2])

    return edit


def _left_labels(change: Callable[[np.ndarray], np.ndarray]) -> Any:
    def edit(items: List[Item]) -> None:
        for item in items:
            if item.topic == "/left/labels":
                m = item.message
                pixels = np.frombuffer(m.data, dtype=np.uint8).reshape(m.height, m.width)
                item.message = _image(m, change(pixels.astype(int)).astype(np.uint8), "mono8")

    return edit


def _front_info(change: Callable[[Any], None], names: Any = (FRONT,)) -> Any:
    def edit(items: List[Item]) -> None:
        for item in items:
            if item.topic in ["/%s/camera_info" % name for name in names]:
                change(item.message)

    return edit


def _half_k(info: Any) -> None:
    info.K = [value * 0.5 if k < 6 else value for k, value in enumerate(info.K)]
    info.P = [value * 0.5 if k < 8 else value for k, value in enumerate(info.P)]


def _as_plumb_bob(info: Any) -> None:
    info.distortion_model = "plumb_bob"
    info.D = list(info.D[:4]) + [0.0]


def _letterboxed(scores: np.ndarray) -> np.ndarray:
    """The image in the middle of a square input, as many inference nodes pad it."""
    h, w, c = scores.shape
    padded = np.zeros((w, w, c), dtype=np.float32)
    padded[:, :, 0] = 5.0
    padded[(w - h) // 2 : (w - h) // 2 + h] = scores
    return padded


def _softmax(scores: np.ndarray) -> np.ndarray:
    e = np.exp(scores - scores.max(axis=2, keepdims=True))
    return e / e.sum(axis=2, keepdims=True)


def _set(path: str, value: Any) -> Any:
    def edit(tree: Dict[str, Any]) -> None:
        *parents, key = path.split(".")
        node = tree
        for parent in parents:
            node = node["cameras"][int(parent)] if parent.isdigit() else node.setdefault(parent, {})
        node[key] = value

    return edit


def _turned(deg: float, axis: int) -> Any:
    vector = np.zeros(3)
    vector[axis] = np.radians(deg)
    from scipy.spatial.transform import Rotation

    turn = make_transform(Rotation.from_rotvec(vector).as_matrix(), np.zeros(3))
    return lambda m: m @ turn


def _translation(factor: float) -> Any:
    return lambda m: make_transform(m[:3, :3], m[:3, 3] * factor)


def _reverse_x(items: List[Item]) -> None:
    _lidar_frame(np.diag([-1.0, -1.0, 1.0, 1.0]))(items)


def _twice(items: List[Item]) -> None:
    item = copy.deepcopy(next(item for item in items if item.topic == "/tf_static"))
    for t in item.message.transforms:
        t.transform.translation.x += 0.3
    item.stamp_ns += 1_000_000
    items.append(item)


UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
SCORES, IMAGES = "/front/scores", r"/\w+/(image/compressed|scores|labels)"

ORDINARY = [
    Mistake("extrinsics inverted", "extrinsics are inverted", _cameras(invert)),
    Mistake(
        "camera frames x forward",
        "x forward",
        _cameras(lambda m: m @ OPTICAL_FROM_BODY),
    ),
    Mistake("lidar upside down", "upside down", _lidar_frame(UPSIDE_DOWN)),
    Mistake("extrinsics swapped", "extrinsics are those of camera", _swapped),
    Mistake(
        "labels one too high",
        "one too high|at or above the number of classes",
        _left_labels(lambda m: m + 1),
    ),
    Mistake(
        "labels one too low", "one too low", _left_labels(lambda m: np.where(m > 0, m - 1, 255))
    ),
    Mistake(
        "score channels permuted",
        "another order",
        _front_scores(lambda s: s[:, :, np.random.RandomState(1).permutation(s.shape[2])]),
    ),
    Mistake("score map flipped", "mirrored left to right", _front_scores(lambda s: s[:, ::-1])),
    Mistake("score map letterboxed", "letterboxed", _front_scores(_letterboxed)),
    Mistake("K of half the size", "image of another size|K belongs", _front_info(_half_k)),
    Mistake("stamps 0.2 s late", "time_offset|differ from the lidar|ahead", _stamps(0.2, IMAGES)),
    Mistake(
        "stamps 0.2 s early",
        "time_offset|differ from the lidar|earlier|later",
        _stamps(-0.2, IMAGES),
    ),
    Mistake("stamps 0.05 s late", "time_offset|differ from the lidar", _stamps(0.05, IMAGES)),
    Mistake("time_offset of one camera", "than the rig says", rig=_set("0.time_offset", 0.2)),
    Mistake("time_offset in ms", "its unit is seconds", rig=_set("0.time_offset", 20.0)),
    Mistake("cloud in mm", "millimetres", _clouds(_scale_xyz(1000.0))),
    Mistake("front translation in mm", "millimetres", _cameras(_translation(1000.0), (FRONT,))),
    Mistake(
        "lidar stamped at its end",
        "scan's end|scan_end",
        _clouds(lambda points: None, lambda points: points["t"].max() * 1e-9),
    ),
    Mistake("scan_end set wrongly", "scan_end", rig=_set("lidar.time_reference", "scan_end")),
    Mistake("odometry inverted", "odometry is inverted", _odometry(invert)),
    Mistake("yaw sign wrong", "sign of yaw", _odometry(_yaw_sign)),
    Mistake("odometry frozen", "frozen", _frozen),
    Mistake("time field in us", "unit of the points' times|time_unit", _clouds(_times(1000.0))),
    Mistake("fisheye called plumb_bob", "equidistant", _front_info(_as_plumb_bob, (FRONT, LEFT))),
    Mistake("rectified on raw images", "images are raw", rig=_set("0.rectified", True)),
    Mistake("yaw 2 deg off", "turned by .* of yaw", _cameras(_turned(2.0, 1), (FRONT,))),
    Mistake("probabilities sent as scores", "probabilities", _front_scores(_softmax)),
    Mistake("scores 80 ms late", "exactly the stamp", _stamps(0.08, SCORES)),
]
FURTHER = [
    Mistake("pitch 1.5 deg off", "turned by .* of pitch", _cameras(_turned(1.5, 0), (FRONT,))),
    Mistake("roll 3 deg off", "turned by .* of roll", _cameras(_turned(2.5, 2), (FRONT,))),
    Mistake("lidar turned by 180 deg", "x points backwards", _reverse_x),
    Mistake("lidar mirrored", "mirrored", _clouds(lambda p: p.__setitem__("y", -p["y"]))),
    Mistake("score map upside down", "upside down", _front_scores(lambda s: s[::-1])),
    Mistake("time field in ms", "unit of the points' times|time_unit", _clouds(_times(1e6))),
    Mistake("odometry half as fast", "another scale", _odometry(_translation(0.5))),
    Mistake("static transforms told twice", "told twice", _twice),
    Mistake(
        "left camera 40 ms late", "than the rig says", _stamps(0.04, "/left/.*(compressed|labels)")
    ),
    Mistake("lidar 0.1 s of another clock", "differ from the lidar|scan", _stamps(-0.06, LIDAR)),
]
ALL = ORDINARY + FURTHER

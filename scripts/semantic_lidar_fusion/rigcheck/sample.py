# SPDX-License-Identifier: MIT
"""What the checks look at: some scans of a drive with all that belongs to them.

Whole are read only the small topics (tf, odometry, camera_info) and the bag's index. Pairs of
consecutive scans, with the images and scores of their time, are copied to a bag of their own, which
fuse_bag turns into points, as measured and fused: the checks see what the package sees.
"""

import contextlib
import dataclasses
import os
import struct
import tempfile
from typing import Any, Dict, Iterator, List, Optional, Sequence, Set, Tuple

import numpy as np

from semantic_lidar_fusion.bags.bag_io import BagReader, BagWriter, RawMessage, to_ns
from semantic_lidar_fusion.bags.cloud_io import SemanticCloud, to_array
from semantic_lidar_fusion.bags.poses import PoseSeries, TransformTree, from_message, invert
from semantic_lidar_fusion.cameras import Camera
from semantic_lidar_fusion.errors import DataError, SemanticLidarFusionError
from semantic_lidar_fusion.evaluation.scoring import FuseTarget, run_fuse_bag
from semantic_lidar_fusion.pictures import decoded
from semantic_lidar_fusion.texts import plain_text

PAIRS = 12  # of consecutive scans
BEFORE_NS, AFTER_NS = 500_000_000, 500_000_000  # copied around each pair, by record time
IMAGES_A_SCAN = 3  # per camera, the nearest in time
SMALL_TYPES = (
    "tf2_msgs/TFMessage",
    "tf/tfMessage",
    "sensor_msgs/CameraInfo",
    "nav_msgs/Odometry",
)


def header_stamp_ns(raw: RawMessage) -> int:
    """The stamp of a message that begins with a std_msgs/Header, from its bytes (ns)."""
    data = raw.content[1]
    if len(data) < 12:
        raise DataError("%s: a message of %d bytes has no header" % (raw.topic, len(data)))
    seconds, nanoseconds = struct.unpack_from("<II", data, 4)
    return seconds * 10**9 + nanoseconds


@dataclasses.dataclass
class Topic:
    """A topic of the bags: record times (M,) ns, sorted; of a sample of its messages, stamp and
    record time (ns), by the latter."""

    name: str
    kind: str
    times_ns: np.ndarray
    stamps: List[Tuple[int, int]] = dataclasses.field(default_factory=list)

    @property
    def rate_hz(self) -> float:
        """Messages a second between the first and the last; 0 with fewer than two."""
        span = self.times_ns[-1] - self.times_ns[0] if len(self.times_ns) > 1 else 0
        return (len(self.times_ns) - 1) * 1e9 / span if span > 0 else 0.0


@dataclasses.dataclass
class Scan:
    """One scan as measured. points: structured (N,) with x y z (m, lidar frame at each point's own
    time), intensity, ring, dt (s after stamp_ns)."""

    stamp_ns: int
    frame_id: str
    points: np.ndarray

    @property
    def times_ns(self) -> np.ndarray:
        """(N,) int64, of the points."""
        return self.stamp_ns + np.round(self.points["dt"].astype(float) * 1e9).astype(np.int64)

    @property
    def middle_ns(self) -> int:
        """The middle of the scan, robust against single wild times."""
        low, high = np.percentile(self.points["dt"].astype(float), (1, 99))
        return self.stamp_ns + int((low + high) / 2 * 1e9)


@dataclasses.dataclass
class CameraSample:
    """One camera. info: its CameraInfo, or None; images, semantics: stamp (raw, ns) -> pixels;
    semantics_stamps: all that were seen; config: its entry of the resolved rig."""

    config: Dict[str, Any]
    info: Optional[Any] = None
    images: Dict[int, np.ndarray] = dataclasses.field(default_factory=dict)
    semantics: Dict[int, np.ndarray] = dataclasses.field(default_factory=dict)
    image_stamps: List[int] = dataclasses.field(default_factory=list)
    semantics_stamps: List[int] = dataclasses.field(default_factory=list)
    problems: List[str] = dataclasses.field(default_factory=list)

    @property
    def name(self) -> str:
        return str(self.config["name"])

    @property
    def has_lens_file(self) -> bool:
        """Whether the rig names a file that calibrates the lens in place of camera_info."""
        return bool((self.config.get("lens") or {}).get("file"))

    @property
    def offset_ns(self) -> int:
        return int(round(float(self.config.get("time_offset", 0.0)) * 1e9))

    def model(self) -> Optional[Camera]:
        """The lens of the rig; None, with the reason in `problems`, if it cannot be read."""
        if self.info is None:
            return None
        try:
            return Camera(
                self.info,
                bool(self.config.get("rectified", False)),
                self.config.get("lens"),
                float(self.config.get("max_theta_deg", 0.0)),
            )
        except DataError as error:
            if str(error) not in self.problems:
                self.problems.append(str(error))
            return None

    def image_at(self, time_ns: int) -> Optional[int]:
        """The raw stamp of the image nearest to a true time, at most 0.2 s off."""

        def distance(stamp: int) -> int:
            return abs(stamp + self.offset_ns - time_ns)

        stamps = [stamp for stamp in self.images if distance(stamp) <= 200_000_000]
        return min(stamps, key=distance) if stamps else None


@dataclasses.dataclass
class Sample:
    """All of it. rig: the resolved rig as a tree; pairs: indices (a, b) of consecutive scans;
    odometry: poses T_fixed_vehicle; twists: stamp (ns) and twist (6,) of an odometry topic, if the
    bags have one; fused: scan stamp -> semantic cloud of fuse_bag; failure: why fuse_bag fused
    nothing."""

    rig: Dict[str, Any]
    topics: Dict[str, Topic]
    tree: TransformTree
    static_told: Dict[str, List[Tuple[str, np.ndarray]]]
    scans: List[Scan]
    pairs: List[Tuple[int, int]]
    cameras: List[CameraSample]
    odometry: PoseSeries
    odometry_message: List[Tuple[int, np.ndarray, np.ndarray]]
    fused: Dict[int, SemanticCloud] = dataclasses.field(default_factory=dict)
    failure: str = ""

    @property
    def lidar_frame(self) -> str:
        return self.scans[0].frame_id if self.scans else ""

    def corrects_motion(self) -> bool:
        """Whether the rig uses odometry and the points' times."""
        return bool(self.rig.get("motion", {}).get("enabled", True))

    def T_vehicle_lidar(self) -> Optional[np.ndarray]:
        return self._static(str(self.rig["vehicle_frame"]), self.lidar_frame)

    def T_camera_vehicle(self, camera: CameraSample) -> Optional[np.ndarray]:
        if camera.info is None:
            return None
        return self._static(camera.info.header.frame_id, str(self.rig["vehicle_frame"]))

    def _static(self, target: str, source: str) -> Optional[np.ndarray]:
        try:
            return self.tree.static(target, source)
        except SemanticLidarFusionError:
            return None


def input_topic(camera: Dict[str, Any], name: str) -> str:
    """The absolute topic that others publish for a camera of the rig."""
    topic = "/".join([str(camera.get("namespace", camera["name"])).rstrip("/"), name])
    return topic if topic.startswith("/") else "/" + topic


def image_topic(camera: Dict[str, Any]) -> str:
    raw = input_topic(camera, str(camera.get("image", "image")))
    return raw + "/compressed" if camera.get("transport") == "compressed" else raw


def semantics_topic(camera: Dict[str, Any]) -> str:
    """Of the camera's scores, labels or probabilities."""
    return input_topic(camera, str(camera.get("scores") or camera.get("input", "scores")))


def lidar_topic(rig: Dict[str, Any]) -> str:
    lidar = rig["lidar"]
    default = "velodyne_packets" if lidar.get("input", "packets") == "packets" else "points"
    topic = str(lidar.get("topic") or default)
    return topic if topic.startswith("/") else "/" + topic


@contextlib.contextmanager
def sampled(
    bags: Sequence[str],
    rig_path: str,
    rig: Dict[str, Any],
    overrides: Sequence[str],
    program: str,
) -> Iterator[Sample]:
    """Reads the bags; the temporary files live as long as the context. DataError where the lidar's
    topic is absent or has no scan that fuse_bag can read."""
    with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory(prefix="check_rig") as folder:
        readers = [stack.enter_context(BagReader(path)) for path in bags]
        topics = _index(readers)
        lidar = lidar_topic(rig)
        if lidar not in topics:
            known = ", ".join(sorted(topics)) or "none"
            raise DataError(
                "no topic %s with the lidar's data (the bags have: %s)" % (lidar, known)
            )
        small = list(_small(readers))
        cameras = [CameraSample(dict(entry)) for entry in rig.get("cameras", [])]
        windows, chosen = _windows(topics[lidar].times_ns)
        cut = os.path.join(folder, "sample.bag")
        _cut(readers, topics, cameras, lidar, windows, chosen, small, cut)
        for topic in topics.values():
            topic.stamps.sort(key=lambda entry: entry[1])

        scans = _raw_scans(program, cut, folder, rig)
        tree, told, odometry_message = _transforms(small, rig)
        result = Sample(
            rig,
            topics,
            tree,
            told,
            scans,
            _pairs(scans),
            cameras,
            _odometry(tree, rig, odometry_message),
            odometry_message,
        )
        _read_fused(program, cut, folder, rig_path, overrides, result)
        yield result


def _index(readers: Sequence[BagReader]) -> Dict[str, Topic]:
    times: Dict[str, List[int]] = {}
    kinds: Dict[str, str] = {}
    for reader in readers:
        for name, kind in reader.topics.items():
            times.setdefault(name, []).extend(reader.stamps_ns(name))
            kinds[name] = kind
    return {
        name: Topic(name, kinds[name], np.sort(np.array(values, dtype=np.int64)))
        for name, values in times.items()
    }


def _small(readers: Sequence[BagReader]) -> Iterator[RawMessage]:
    for reader in readers:
        names = [name for name, kind in reader.topics.items() if kind in SMALL_TYPES]
        if names:
            yield from reader.read_raw(names)


def _windows(times_ns: np.ndarray) -> Tuple[List[Tuple[int, int]], Set[int]]:
    """Record times (ns) from which to which is read, around pairs of scans spread evenly over the
    drive, and the record times of those scans."""
    last = max(0, len(times_ns) - 2)
    first = np.unique(np.linspace(0, last, min(PAIRS, last + 1)).round().astype(int))
    windows: List[Tuple[int, int]] = []
    chosen: Set[int] = set()
    for k in first:
        pair = times_ns[k : k + 2]
        chosen.update(int(time) for time in pair)
        start, end = int(pair[0]) - BEFORE_NS, int(pair[-1]) + AFTER_NS
        if windows and start <= windows[-1][1]:
            windows[-1] = (windows[-1][0], end)
        else:
            windows.append((start, end))
    return windows, chosen


def _cut(
    readers: Sequence[BagReader],
    topics: Dict[str, Topic],
    cameras: List[CameraSample],
    lidar: str,
    windows: List[Tuple[int, int]],
    wanted: Set[int],
    small: List[RawMessage],
    path: str,
) -> None:
    """Writes the windows to a bag and keeps the images and scores that scans can use."""
    images = {image_topic(c.config): c for c in cameras}
    semantics = {semantics_topic(c.config): c for c in cameras}
    infos = {
        input_topic(c.config, str(c.config.get("camera_info", "camera_info"))): c for c in cameras
    }
    for raw in small:
        if raw.topic in infos and infos[raw.topic].info is None:
            infos[raw.topic].info = raw.message()
    with BagWriter(path, compression="none") as writer:
        for raw in small:
            writer.write_raw(raw)
            if topics[raw.topic].kind != "tf2_msgs/TFMessage":
                _note(topics[raw.topic], raw)
        for start, end in windows:
            inside: Dict[str, List[RawMessage]] = {}
            for reader in readers:
                names = [t for t in (lidar, *images, *semantics) if t in reader.topics]
                for raw in reader.read_raw(names, start, end):
                    _note(topics[raw.topic], raw)
                    inside.setdefault(raw.topic, []).append(raw)
            scans = inside.get(lidar, [])
            chosen = [raw for raw in scans if raw.stamp_ns in wanted]
            for raw in chosen:
                writer.write_raw(raw)
            targets = [header_stamp_ns(raw) for raw in chosen]
            for topic, camera in images.items():
                kept = _nearest(inside.get(topic, []), targets, camera.offset_ns)
                camera.image_stamps += [header_stamp_ns(raw) for raw in inside.get(topic, [])]
                for raw in kept:
                    writer.write_raw(raw)
                    _decode(raw, camera, camera.images)
            for topic, camera in semantics.items():
                seen = inside.get(topic, [])
                camera.semantics_stamps += [header_stamp_ns(raw) for raw in seen]
                kept = [raw for raw in seen if header_stamp_ns(raw) in camera.images]
                for raw in kept or _nearest(seen, targets, camera.offset_ns):
                    writer.write_raw(raw)
                    _decode(raw, camera, camera.semantics)


def _note(topic: Topic, raw: RawMessage) -> None:
    with contextlib.suppress(DataError):
        topic.stamps.append((header_stamp_ns(raw), raw.stamp_ns))


def _nearest(messages: List[RawMessage], targets: List[int], offset_ns: int) -> List[RawMessage]:
    """IMAGES_A_SCAN messages for each target, in their order, each once."""
    keep: Set[int] = set()
    stamps = np.array([header_stamp_ns(raw) for raw in messages], dtype=np.int64) + offset_ns
    for target in targets:
        keep.update(np.argsort(np.abs(stamps - target - 50_000_000), kind="stable")[:IMAGES_A_SCAN])
    return [messages[k] for k in sorted(keep)]


def _decode(raw: RawMessage, camera: CameraSample, into: Dict[int, np.ndarray]) -> None:
    import cv2

    message = raw.message()
    stamp = to_ns(message.header.stamp)
    try:
        if message._type == "sensor_msgs/CompressedImage":
            pixels = decoded(message.data, "color", "format %s" % plain_text(message.format))
        else:
            pixels = image_pixels(message)
    except (cv2.error, DataError, ValueError) as error:
        pixels = None
        camera.problems.append("image %d ns: %s" % (stamp, error))
    if pixels is not None:
        into[stamp] = pixels


_DEPTHS = {"8U": "u1", "8S": "i1", "16U": "u2", "16S": "i2", "32S": "i4", "32F": "f4", "64F": "f8"}
_NAMED = {"mono8": ("u1", 1), "bgr8": ("u1", 3), "rgb8": ("u1", 3), "bgra8": ("u1", 4)}
_NAMED.update({"rgba8": ("u1", 4), "mono16": ("u2", 1)})


def image_pixels(message: Any) -> np.ndarray:
    """(H, W) or (H, W, C) of a sensor_msgs/Image; colour as BGR, 8 bit."""
    import cv2

    encoding = message.encoding
    if encoding in _NAMED:
        code, channels = _NAMED[encoding]
    elif encoding[:2] in _DEPTHS or encoding[:3] in _DEPTHS:
        depth = encoding[:3] if encoding[:3] in _DEPTHS else encoding[:2]
        code, channels = _DEPTHS[depth], int(encoding[len(depth) + 1 :] or 1)
    elif encoding.startswith("bayer_"):
        code, channels = "u1", 1
    else:
        raise DataError("encoding '%s' is not read here" % encoding[:40])
    kind = np.dtype(code).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(message.data, dtype=np.uint8).reshape(message.height, message.step)
    width = message.width * channels * kind.itemsize
    pixels = np.ascontiguousarray(rows[:, :width]).view(kind)
    pixels = pixels.reshape(message.height, message.width, channels)
    if encoding in ("rgb8", "rgba8"):
        pixels = pixels[:, :, 2::-1]
    elif encoding == "bgra8":
        pixels = pixels[:, :, :3]
    elif encoding.startswith("bayer_"):
        pattern = {"rggb8": "BG", "bggr8": "RG", "gbrg8": "GR", "grbg8": "GB"}[encoding[6:]]
        return cv2.cvtColor(pixels, getattr(cv2, "COLOR_Bayer%s2BGR" % pattern))
    elif encoding == "mono16":
        pixels = (pixels >> 8).astype(np.uint8)
    return pixels[:, :, 0] if pixels.shape[2] == 1 else pixels


def _raw_scans(program: str, cut: str, folder: str, rig: Dict[str, Any]) -> List[Scan]:
    """What the lidar measured, uncompensated, through the package's own decoder: a rig without
    cameras, so that nothing of theirs stands in the way."""
    import yaml

    kept = ("classes", "lidar", "fixed_frame", "vehicle_frame", "odometry")
    plain: Dict[str, Any] = {key: rig[key] for key in kept if key in rig}
    plain.update(
        cameras=[], motion={"enabled": False}, reference={"choose": "scan_start"}, name="raw"
    )
    path = os.path.join(folder, "raw.yaml")
    with open(path, "w", encoding="utf-8") as file:
        yaml.safe_dump(plain, file)
    target = os.path.join(folder, "raw.bag")
    run_fuse_bag(program, cut, path, [FuseTarget(target, ())])
    scans = []
    with BagReader(target) as reader:
        for item in reader.read(["/points_compensated"]):
            points = to_array(item.message)
            if len(points):
                scans.append(
                    Scan(to_ns(item.message.header.stamp), item.message.header.frame_id, points)
                )
    return scans


def _pairs(scans: List[Scan]) -> List[Tuple[int, int]]:
    return [
        (k, k + 1)
        for k in range(len(scans) - 1)
        if 0 < scans[k + 1].stamp_ns - scans[k].stamp_ns < 400_000_000
    ]


def _transforms(
    small: List[RawMessage], rig: Dict[str, Any]
) -> Tuple[
    TransformTree,
    Dict[str, List[Tuple[str, np.ndarray]]],
    List[Tuple[int, np.ndarray, np.ndarray]],
]:
    """tf, what was told of each static frame, and the readings of the odometry topic: stamp (ns),
    pose (4, 4), twist (6,)."""
    tree = TransformTree()
    told: Dict[str, List[Tuple[str, np.ndarray]]] = {}
    odometry: List[Tuple[int, np.ndarray, np.ndarray]] = []
    named = str(rig["odometry"].get("topic") or "")
    named = named if named.startswith("/") or not named else "/" + named
    for raw in small:
        kind = raw.connection.get("type", "")
        if kind in ("tf2_msgs/TFMessage", "tf/tfMessage"):
            static = raw.topic.endswith("tf_static")
            for transform in raw.message().transforms:
                tree.add(transform, static)  # says and leaves out what is unusable
                with contextlib.suppress(DataError):
                    if static:
                        entry = (transform.header.frame_id, from_message(transform.transform))
                        told.setdefault(transform.child_frame_id.lstrip("/"), []).append(entry)
        elif kind == "nav_msgs/Odometry" and (raw.topic == named or not named):
            if raw.topic.startswith("/truth"):
                continue
            message = raw.message()
            twist = message.twist.twist
            values = np.array(
                [
                    *(twist.linear.x, twist.linear.y, twist.linear.z),
                    *(twist.angular.x, twist.angular.y, twist.angular.z),
                ]
            )
            with contextlib.suppress(DataError):
                pose = from_message(_as_transform(message))
                odometry.append((to_ns(message.header.stamp), pose, values))
    odometry.sort(key=lambda entry: entry[0])
    return tree, told, odometry


def _as_transform(message: Any) -> Any:
    from geometry_msgs.msg import Transform

    transform = Transform()
    transform.translation = message.pose.pose.position
    transform.rotation = message.pose.pose.orientation
    return transform


def _odometry(
    tree: TransformTree,
    rig: Dict[str, Any],
    message: List[Tuple[int, np.ndarray, np.ndarray]],
) -> PoseSeries:
    """T_fixed_vehicle over time, from where the rig takes it."""
    if rig["odometry"].get("source", "tf") == "topic":
        return PoseSeries(
            np.array([entry[0] for entry in message], dtype=np.int64),
            np.array([entry[1] for entry in message]).reshape(-1, 4, 4),
        )
    stamps = tree.stamps_ns(str(rig["vehicle_frame"]), str(rig["fixed_frame"]))
    if not len(stamps):
        return PoseSeries(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 4)))
    poses, valid = tree.lookup(str(rig["fixed_frame"]), str(rig["vehicle_frame"]), stamps)
    return PoseSeries(stamps[valid], poses[valid])


def _read_fused(
    program: str,
    cut: str,
    folder: str,
    rig_path: str,
    overrides: Sequence[str],
    sample: Sample,
) -> None:
    target = os.path.join(folder, "fused.bag")
    try:
        settings = (*overrides, "keep_unlabelled=true")
        run_fuse_bag(program, cut, rig_path, [FuseTarget(target, settings)])
    except DataError as error:
        sample.failure = str(error)
        return
    with BagReader(target) as reader:
        for item in reader.read(["/points_semantic"]):
            with contextlib.suppress(DataError):
                cloud = SemanticCloud.from_message(item.message)
                sample.fused[cloud.stamp_ns] = cloud


def vehicle_twist(odometry: PoseSeries, time_ns: int) -> Tuple[np.ndarray, np.ndarray]:
    """(3,) velocity m/s and (3,) rate rad/s of the vehicle in its own frame, over 80 ms around a
    time; zeros where the odometry does not cover it."""
    from scipy.spatial.transform import Rotation

    half = 40_000_000
    poses, valid = odometry.lookup(np.array([time_ns - half, time_ns, time_ns + half]))
    if not valid.all():
        return np.zeros(3), np.zeros(3)
    seconds = 2e-9 * half
    velocity = poses[1, :3, :3].T @ (poses[2, :3, 3] - poses[0, :3, 3]) / seconds
    turned = invert(poses[0]) @ poses[2]
    return velocity, Rotation.from_matrix(turned[:3, :3]).as_rotvec() / seconds

# SPDX-License-Identifier: MIT
"""A rig proposed from what a bag holds: topics, types, camera_infos and frames.

What the bag cannot tell is marked CHECK in a comment. check_rig.py is the next step.
"""

import dataclasses
import os
import re
from typing import Any, Dict, List, NamedTuple, Sequence, Set, Tuple

from semantic_lidar_fusion.bags.bag_io import BagReader, write_text
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import package_file

IMAGE, COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"
CAMERA_INFO, CLOUD, PACKETS = (
    "sensor_msgs/CameraInfo",
    "sensor_msgs/PointCloud2",
    "velodyne_msgs/VelodyneScan",
)
ODOMETRY = "nav_msgs/Odometry"
OWN_CLOUDS = ("points_compensated", "points_semantic", "points_truth", "points_pixel")
OWN_IMAGES = ("share", "superpixels", "probabilities", "labels_truth", "overlay")
CLASS_SETS = {
    12: ("classes_usyd12.yaml", "classes_camvid12.yaml"),
    20: ("classes_cityscapes.yaml",),
    19: ("classes_cityscapes.yaml",),
}


class Camera(NamedTuple):
    """A proposed entry of `cameras`; doubts: sentences to print beside it."""

    name: str
    namespace: str
    image: str
    camera_info: str
    compressed: bool
    semantics: str  # topic below the namespace; empty: none in the bag
    kind: str  # scores, labels or probabilities
    channels: int
    frame: str
    doubts: Tuple[str, ...]


@dataclasses.dataclass
class Facts:
    """What was read of the bags."""

    topics: Dict[str, str]
    counts: Dict[str, int]
    first: Dict[str, Any] = dataclasses.field(default_factory=dict)
    moving: Set[Tuple[str, str]] = dataclasses.field(default_factory=set)  # (parent, child)
    static: Set[Tuple[str, str]] = dataclasses.field(default_factory=set)

    def of_type(self, *kinds: str) -> List[str]:
        return sorted(name for name, kind in self.topics.items() if kind in kinds)


def read(bags: Sequence[str]) -> Facts:
    """Topics, the first message of each sensor topic, and the frames of tf."""
    facts = Facts({}, {})
    for path in bags:
        with BagReader(path) as reader:
            for name, kind in reader.topics.items():
                facts.topics[name] = kind
                facts.counts[name] = facts.counts.get(name, 0) + reader.count([name])
            for name in reader.topics:
                if facts.topics[name] in (IMAGE, COMPRESSED, CAMERA_INFO, CLOUD, PACKETS, ODOMETRY):
                    if name not in facts.first:
                        facts.first[name] = next(
                            (item.message for item in reader.read([name])), None
                        )
            for item in reader.read(types=("tf2_msgs/TFMessage", "tf/tfMessage")):
                into = facts.static if item.topic.endswith("tf_static") else facts.moving
                for transform in item.message.transforms:
                    parent = transform.header.frame_id.lstrip("/")
                    into.add((parent, transform.child_frame_id.lstrip("/")))
    return facts


def cameras_of(facts: Facts) -> List[Camera]:
    """One camera for each camera_info that has images beside it."""
    found: List[Camera] = []
    for info_topic in facts.of_type(CAMERA_INFO):
        space, _, info_name = info_topic.rpartition("/")
        images = _images_below(facts, space)
        if not images:
            continue
        doubts: List[str] = []
        image, compressed = images[0]
        if len({name for name, _ in images}) > 1:
            others = ", ".join(sorted({name for name, _ in images} - {image}))
            doubts.append("image could also be %s" % others)
        semantics, kind, channels = _semantics_below(facts, space, {name for name, _ in images})
        if kind == "scores" and semantics:
            doubts.append(
                "scores must be unnormalised; for a softmax's output set input: probabilities"
            )
        info = facts.first.get(info_topic)
        found.append(
            Camera(
                _name(space, [camera.name for camera in found]),
                space,
                image,
                info_name,
                compressed,
                semantics,
                kind,
                channels,
                info.header.frame_id.lstrip("/") if info is not None else "",
                tuple(doubts),
            )
        )
    return found


def _images_below(facts: Facts, space: str) -> List[Tuple[str, bool]]:
    """(name below the namespace, compressed) of colour images, the likeliest first."""
    found: List[Tuple[str, bool]] = []
    for topic in facts.of_type(IMAGE, COMPRESSED):
        if not topic.startswith(space + "/"):
            continue
        name = topic[len(space) + 1 :]
        compressed = facts.topics[topic] == COMPRESSED
        if compressed and name.endswith("/compressed"):
            name = name[: -len("/compressed")]
        message = facts.first.get(topic)
        if any(word in name for word in OWN_IMAGES) or message is None or "/" in name:
            continue
        if not compressed and not _is_picture(message.encoding):
            continue
        if not compressed and _looks_like_labels(name):
            continue
        found.append((name, compressed))
    rank = ("image_color", "image_raw", "image_rect_color", "image_rect", "image", "rgb")
    return sorted(
        found, key=lambda item: (rank.index(item[0]) if item[0] in rank else len(rank), item[1])
    )


def _is_picture(encoding: str) -> bool:
    words = ("mono8", "bgr8", "rgb8", "bgra8", "rgba8", "bayer", "yuv", "mono16", "8UC1", "8UC3")
    return encoding.startswith(words)


def _looks_like_labels(name: str) -> bool:
    return re.search(r"label|semantic|segment|score|prob|class", name) is not None


def _semantics_below(facts: Facts, space: str, images: Set[str]) -> Tuple[str, str, int]:
    for topic in facts.of_type(IMAGE):
        name = topic[len(space) + 1 :]
        message = facts.first.get(topic)
        if not topic.startswith(space + "/") or message is None or name in images:
            continue
        if any(word in name for word in OWN_IMAGES):
            continue
        match = re.fullmatch(r"(?:32F|16U|8U)C(\d+)", message.encoding)
        channels = int(match.group(1)) if match else 1
        if channels > 4:
            return name, "probabilities" if "prob" in name else "scores", channels
        if message.encoding in ("mono8", "8UC1", "mono16", "16UC1") and _looks_like_labels(name):
            return name, "labels", 1
    return "", "scores", 0


def _name(space: str, taken: Sequence[str]) -> str:
    name = re.sub(r"\W", "_", space.strip("/").rpartition("/")[2]) or "camera"
    if not name[0].isalpha():
        name = "camera_" + name
    while name in taken:
        name += "_2"
    return name[:64]


def lidar_of(facts: Facts) -> Tuple[str, str, List[str]]:
    """(`packets` or `points`, topic, doubts). DataError if the bag has no lidar."""
    packets = facts.of_type(PACKETS)
    clouds = [t for t in facts.of_type(CLOUD) if not t.endswith(OWN_CLOUDS)]
    if not packets and not clouds:
        known = ", ".join("%s (%s)" % item for item in sorted(facts.topics.items())) or "nothing"
        raise DataError("no %s and no %s in the bag (it has: %s)" % (PACKETS, CLOUD, known))
    chosen = packets or clouds

    def size(topic: str) -> Tuple[int, int]:
        message = facts.first.get(topic)
        points = getattr(message, "width", 0) * getattr(message, "height", 1)
        return facts.counts.get(topic, 0), int(points)

    best = max(chosen, key=size)
    others = [topic for topic in packets + clouds if topic != best]
    doubts = ["other lidar topics: %s" % ", ".join(others)] if others else []
    return ("packets" if packets else "points"), best, doubts


def frames_of(facts: Facts, sensors: Sequence[str]) -> Tuple[str, str, List[str]]:
    """(fixed frame, vehicle frame, doubts): the moving edge of tf above the sensors' static tree."""
    parents = {child: parent for parent, child in facts.static}

    def root(frame: str) -> str:
        seen: Set[str] = set()
        while frame in parents and frame not in seen:
            seen.add(frame)
            frame = parents[frame]
        return frame

    roots = [root(frame) for frame in sensors if frame]
    common = max(set(roots), key=roots.count) if roots else "base_link"
    up = [parent for parent, child in sorted(facts.moving) if child == common]
    if up:
        rank = [name for name in up if "odom" in name] or up
        doubts = (
            ["%s also moves in %s" % (common, ", ".join(set(up) - {rank[0]}))]
            if len(up) > 1
            else []
        )
        return rank[0], common, doubts
    for topic in facts.of_type(ODOMETRY):
        message = facts.first.get(topic)
        if message is not None:
            child = message.child_frame_id.lstrip("/") or common
            return message.header.frame_id.lstrip("/") or "odom", child, []
    return "odom", common, ["no moving transform above %s and no %s" % (common, ODOMETRY)]


def text_of(facts: Facts, bags: Sequence[str]) -> str:
    """The rig file. DataError without a lidar or without a camera."""
    cameras = cameras_of(facts)
    if not cameras:
        raise DataError(
            "no camera: images and a sensor_msgs/CameraInfo in one namespace are wanted (the bag has: "
            "%s)" % (", ".join(sorted(facts.topics)) or "nothing")
        )
    kind, topic, lidar_doubts = lidar_of(facts)
    message = facts.first.get(topic)
    lidar_frame = message.header.frame_id.lstrip("/") if message is not None else ""
    fixed, vehicle, frame_doubts = frames_of(facts, [lidar_frame, *(c.frame for c in cameras)])
    lines = [
        "# Proposed by make_rig.py from %s. Every key is explained in config/usyd.yaml."
        % ", ".join(os.path.basename(bag) for bag in bags),
        "# Lines marked CHECK are guesses. Next: check_rig.py BAG --rig THIS_FILE",
        "name: proposed",
        *_classes(cameras),
        "cameras:",
    ]
    for camera in cameras:
        lines += _camera_lines(camera)
    lines += _doubts(lidar_doubts)
    lines += ["lidar:", "  input: %s" % kind, "  topic: %s" % topic]
    if kind == "packets":
        lines += ["  # CHECK model: auto reads it from the packets", "  model: auto"]
    lines += _doubts(frame_doubts)
    lines += ["fixed_frame: %s" % fixed, "vehicle_frame: %s" % vehicle]
    lines += _odometry(facts, fixed, vehicle)
    lines += ["reference:", "  choose: closest_image", "  camera: %s" % _forward(cameras).name]
    return "\n".join(lines) + "\n"


def _doubts(sentences: Sequence[str]) -> List[str]:
    return ["# CHECK %s" % sentence for sentence in sentences]


def _classes(cameras: Sequence[Camera]) -> List[str]:
    channels = max((camera.channels for camera in cameras), default=0)
    names = CLASS_SETS.get(channels, ())
    chosen = names[0] if names else "classes_cityscapes.yaml"
    doubt = "the order of the classes must be your network's"
    if channels > 1:
        doubt += "; its scores have %d channels" % channels
    if len(names) > 1:
        doubt += "; also possible: %s" % ", ".join(names[1:])
    path = package_file("config/" + chosen)
    return ["# CHECK " + doubt, "classes:", "  file: %s" % path]


def _camera_lines(camera: Camera) -> List[str]:
    lines = ["  # CHECK %s: %s" % (camera.name, doubt) for doubt in camera.doubts]
    lines += ["  - name: %s" % camera.name, "    namespace: %s" % camera.namespace]
    lines += ["    image: %s" % camera.image]
    if camera.camera_info != "camera_info":
        lines += ["    camera_info: %s" % camera.camera_info]
    if camera.compressed:
        lines += ["    transport: compressed"]
    if re.search(r"rect", camera.image):
        lines += ["    # CHECK the topic's name says that the images are rectified"]
        lines += ["    rectified: true"]
    if camera.kind != "scores":
        lines += ["    input: %s" % camera.kind]
    if camera.semantics:
        lines += ["    scores: %s" % camera.semantics]
    else:
        lines += ["    # CHECK no scores in the bag: name a network in segmentation.model"]
    return lines


def _odometry(facts: Facts, fixed: str, vehicle: str) -> List[str]:
    if (fixed, vehicle) in facts.moving:
        return ["odometry:", "  source: tf"]
    topics = facts.of_type(ODOMETRY)
    if topics:
        lines = _doubts(["other odometry: %s" % ", ".join(topics[1:])] if len(topics) > 1 else [])
        return lines + ["odometry:", "  source: topic", "  topic: %s" % topics[0]]
    return ["# CHECK the bag has no odometry", "motion:", "  enabled: false"]


def _forward(cameras: Sequence[Camera]) -> Camera:
    """The reference camera: one whose name says front or centre, else the first."""
    named = [c for c in cameras if re.search(r"front|cent|forward|A0", c.name + c.frame)]
    return (named or list(cameras))[0]


def write(bags: Sequence[str], path: str, force: bool) -> List[str]:
    """Writes the rig file; returns its lines marked CHECK. DataError if it exists already."""
    if os.path.exists(path) and not force:
        raise DataError("%s: exists; --force replaces it" % path)
    text = text_of(read(bags), bags)
    write_text(path, text)
    return [line.strip(" #") for line in text.splitlines() if "# CHECK" in line]

# SPDX-License-Identifier: MIT
"""A `Drive` as a bag and a rig file.

Topics: <camera>/image/compressed (the file's bytes) or <camera>/image, <camera>/camera_info,
<camera>/scores if asked for; the lidar's PointCloud2 (x y z intensity f32, ring u16, t u32 = ns
after the stamp); points_truth where the points have labels; tf odom -> base_link, and all else static.
"""

import heapq
import os
from typing import Any, Dict, Iterator, List, NamedTuple, Optional, Tuple

import numpy as np
import yaml

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags import bag_io, cloud_io, poses
from semantic_lidar_fusion.datasets import records
from semantic_lidar_fusion.errors import ConfigError, DataError, cannot_write
from semantic_lidar_fusion.labels import NO_LABEL
from semantic_lidar_fusion.pictures import decoded

FIXED_FRAME = "odom"
VEHICLE_FRAME = "base_link"
TRUTH_TOPIC = "/points_truth"


class Options(NamedTuple):
    """`raw_images`: decode images instead of passing their bytes on. `score_stride`: pixels of the
    image per cell of one-hot scores from its human labels, 0 = none; `score_gain`: their height.
    `model`: model file of the segmentation, or empty."""

    raw_images: bool = False
    score_stride: int = 0
    score_gain: float = 10.0
    model: str = ""


class Summary(NamedTuple):
    """What was written."""

    scans: int
    images: int
    score_images: int
    points: int
    odometry: int
    truth_points: int
    scans_with_image: int  # whose middle has an image of the first camera within 50 ms


def write(drive: records.Drive, bag_path: str, rig_path: str, options: Options) -> Summary:
    """Writes the bag and the rig file; either whole or not at all."""
    if os.path.abspath(bag_path) == os.path.abspath(rig_path):
        raise ConfigError("the bag and the rig file have the same name, %s" % bag_path)
    _check_scores(drive, options)
    drive = _near_scans(drive)
    rig = rig_text(drive, rig_path, options)
    rig_file = bag_io.AtomicFile(rig_path)
    counts: Dict[str, int] = {}
    middles: List[int] = []
    try:
        _write_temporary(rig_file, rig)
        with bag_io.BagWriter(bag_path) as writer:
            entries = _entries(drive, options, counts, middles)
            total = _expected(drive, options)
            for stamp_ns, topic, message in cli.progress(entries, total, "writing"):
                writer.write(topic, message, stamp_ns, topic == "/tf_static")
        rig_file.commit()
    finally:
        rig_file.discard()
    return Summary(
        scans=len(drive.scans),
        images=sum(len(camera.images) for camera in drive.cameras),
        score_images=counts.get("scores", 0),
        points=counts.get("points", 0),
        odometry=0 if drive.odometry is None else len(drive.odometry[0]),
        truth_points=counts.get("truth", 0),
        scans_with_image=_with_image(drive, middles),
    )


def _write_temporary(file: bag_io.AtomicFile, text: str) -> None:
    try:
        with open(file.temporary, "w", encoding="utf-8") as stream:
            stream.write(text)
    except OSError as error:
        raise cannot_write(file.path, error) from error


def _wait_s(drive: records.Drive) -> float:
    """How long a scan may have to wait live, s: it comes to the bag at its start, and what it waits
    for may be as rare as the slowest of the others, with as much again for a machine that is busy.
    """
    tracks = [[image.stamp_ns for image in camera.images] for camera in drive.cameras]
    if drive.odometry is not None:
        tracks.append([int(stamp) for stamp in drive.odometry[0]])
    periods = [float(np.median(np.diff(track))) * 1e-9 for track in tracks if len(track) > 1]
    return round(min(1.0, 0.1 + 2 * max(periods, default=0.0)), 2)


def rig_tree(drive: records.Drive, rig_path: str, options: Options) -> Dict[str, Any]:
    """The rig file's contents; keys that have their default are left out."""
    cameras = []
    for camera in drive.cameras:
        entry: Dict[str, Any] = {"name": camera.name}
        if not options.raw_images:
            entry["transport"] = "compressed"
        if camera.rectified:
            entry["rectified"] = True
        if camera.lens:
            folder = os.path.dirname(os.path.abspath(rig_path))
            entry["lens"] = {"file": os.path.relpath(os.path.abspath(camera.lens), folder)}
        cameras.append(entry)
    lidar: Dict[str, Any] = {"input": "points", "topic": drive.lidar_topic}
    tree: Dict[str, Any] = {
        "name": drive.name,
        "classes": drive.labels.tree(),
        "cameras": cameras,
        "lidar": lidar,
        "fixed_frame": FIXED_FRAME,
        "vehicle_frame": VEHICLE_FRAME,
        "motion": {"enabled": drive.motion_enabled},
        "odometry": {"source": "tf", "timeout": _wait_s(drive)},
        "reference": {
            "choose": "closest_image",
            "camera": drive.cameras[0].name,
            "timeout": _wait_s(drive),
        },
    }
    if options.model:
        folder = os.path.dirname(os.path.abspath(rig_path))
        tree["segmentation"] = {"model": os.path.relpath(os.path.abspath(options.model), folder)}
    return tree


class RigDumper(yaml.SafeDumper):
    """Short lists and mappings on one line, as the shipped files have them."""


def _is_flat(values: Any) -> bool:
    return all(not isinstance(value, (dict, list)) for value in values)


RigDumper.add_representer(
    list,
    lambda dumper, data: dumper.represent_sequence(
        "tag:yaml.org,2002:seq", data, flow_style=_is_flat(data)
    ),
)
RigDumper.add_representer(
    dict,
    lambda dumper, data: dumper.represent_mapping(
        "tag:yaml.org,2002:map",
        data.items(),
        flow_style="name" in data
        and all(_is_flat(v) for v in data.values() if isinstance(v, list))
        and not any(isinstance(v, dict) for v in data.values())
        and "classes" not in data,
    ),
)


def rig_text(drive: records.Drive, rig_path: str, options: Options) -> str:
    """The rig file as text, with what the data set's reader has to say about it."""
    lines = ["# Written by import_dataset.py. Every key is explained in config/usyd.yaml."]
    lines += ["# " + note for note in drive.notes]
    tree = rig_tree(drive, rig_path, options)
    text = yaml.dump(tree, Dumper=RigDumper, sort_keys=False, width=100, default_flow_style=False)
    return "\n".join(lines) + "\n" + text


def _check_scores(drive: records.Drive, options: Options) -> None:
    if not drive.cameras:
        raise DataError("%s: no camera" % drive.name)
    if options.score_stride:
        labelled = [i for c in drive.cameras for i in c.images if i.label_path]
        if not labelled or drive.label_values is None:
            raise DataError("--scores onehot: %s has no human image labels" % drive.name)


def _expected(drive: records.Drive, options: Options) -> int:
    images = [image for camera in drive.cameras for image in camera.images]
    scores = sum(1 for i in images if i.label_path) if options.score_stride else 0
    odometry = 0 if drive.odometry is None else len(drive.odometry[0])
    return 1 + odometry + 2 * len(images) + scores + len(drive.scans)


def _entries(
    drive: records.Drive, options: Options, counts: Dict[str, int], middles: List[int]
) -> Iterator[Tuple[int, str, Any]]:
    """(record time ns, topic, message) of everything, in order of time."""
    starts = [drive.scans[0].stamp_ns] + [c.images[0].stamp_ns for c in drive.cameras if c.images]
    if drive.odometry is not None:
        starts.append(int(drive.odometry[0][0]))
    begin = min(starts)
    yield begin, "/tf_static", _static_transforms(drive, begin)
    streams: List[Iterator[Tuple[int, str, Any]]] = []
    if drive.odometry is not None:
        streams.append(_odometry_messages(drive.odometry))
    streams.append(_scan_messages(drive, counts, middles))
    streams += [_camera_messages(camera, drive, options, counts) for camera in drive.cameras]
    # Messages do not compare: of equal times the earlier stream goes first.
    keyed = [_keyed(stream, rank) for rank, stream in enumerate(streams)]
    for stamp_ns, _, _, topic, message in heapq.merge(*keyed, key=lambda entry: entry[:3]):
        yield stamp_ns, topic, message


def _keyed(
    stream: Iterator[Tuple[int, str, Any]], rank: int
) -> Iterator[Tuple[int, int, int, str, Any]]:
    for number, (stamp_ns, topic, message) in enumerate(stream):
        yield stamp_ns, rank, number, topic, message


def _near_scans(drive: records.Drive) -> records.Drive:
    """Without the odometry that lies more than a second before or after the scans."""
    if drive.odometry is None:
        return drive
    stamps, trajectory = drive.odometry
    second = 1000000000
    keep = (stamps >= drive.scans[0].stamp_ns - second) & (
        stamps <= drive.scans[-1].stamp_ns + 2 * second
    )
    return drive._replace(odometry=(stamps[keep], trajectory[keep]) if keep.any() else None)


def _static_transforms(drive: records.Drive, stamp_ns: int) -> Any:
    from tf2_msgs.msg import TFMessage

    transforms = []
    if VEHICLE_FRAME != drive.lidar_frame:
        transforms.append(
            poses.to_message(VEHICLE_FRAME, drive.lidar_frame, drive.t_base_lidar, stamp_ns)
        )
    for camera in drive.cameras:
        transforms.append(
            poses.to_message(camera.parent, camera.frame, camera.t_parent_camera, stamp_ns)
        )
    return TFMessage(transforms)


def _odometry_messages(odometry: Tuple[np.ndarray, np.ndarray]) -> Iterator[Tuple[int, str, Any]]:
    from tf2_msgs.msg import TFMessage

    for stamp_ns, pose in zip(*odometry):
        message = poses.to_message(FIXED_FRAME, VEHICLE_FRAME, pose, int(stamp_ns))
        yield int(stamp_ns), "/tf", TFMessage([message])


def _scan_messages(
    drive: records.Drive, counts: Dict[str, int], middles: List[int]
) -> Iterator[Tuple[int, str, Any]]:
    for record in drive.scans:
        scan = record.load()
        last = 0
        if scan.time_ns is not None and len(scan.time_ns):
            last = int(scan.time_ns.max())
            middles.append(record.stamp_ns + (int(scan.time_ns.min()) + last) // 2)
        else:
            middles.append(record.stamp_ns)
        counts["points"] = counts.get("points", 0) + len(scan.xyz)
        cloud = cloud_io.from_array(cloud_points(scan), record.stamp_ns, drive.lidar_frame)
        yield record.stamp_ns, drive.lidar_topic, cloud
        if scan.label is not None:
            counts["truth"] = counts.get("truth", 0) + int((scan.label != NO_LABEL).sum())
            truth = cloud_io.from_array(truth_points(scan), record.stamp_ns, drive.lidar_frame)
            yield record.stamp_ns, TRUTH_TOPIC, truth


def cloud_points(scan: records.Scan) -> np.ndarray:
    """The structured points of the lidar's message."""
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4")]
    if scan.ring is not None:
        fields.append(("ring", "u2"))
    if scan.time_ns is not None:
        fields.append(("t", "u4"))
    points = np.zeros(len(scan.xyz), dtype=cloud_io.point_dtype(fields))
    points["x"], points["y"], points["z"] = scan.xyz.T
    points["intensity"] = scan.intensity
    if scan.ring is not None:
        points["ring"] = scan.ring
    if scan.time_ns is not None:
        points["t"] = scan.time_ns
    return points


def truth_points(scan: records.Scan) -> np.ndarray:
    """The structured points of points_truth: the same points in the same order."""
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("label", "u1")]
    points = np.zeros(len(scan.xyz), dtype=cloud_io.point_dtype(fields))
    points["x"], points["y"], points["z"] = scan.xyz.T
    points["label"] = scan.label
    return points


def _camera_messages(
    camera: records.CameraRecord, drive: records.Drive, options: Options, counts: Dict[str, int]
) -> Iterator[Tuple[int, str, Any]]:
    from sensor_msgs.msg import CompressedImage

    size: Optional[Tuple[int, int]] = None
    for record in camera.images:
        data = records.read_bytes(record.path)
        width, height, kind = records.image_size(data, record.path)
        # The rectified images of KITTI's days differ in size, never those of one drive.
        if size is not None and size != (width, height):
            raise DataError(
                "%s: %d x %d; the images before it are %d x %d"
                % ((record.path, width, height) + size)
            )
        size = (width, height)
        info = camera_info(camera, width, height, record.stamp_ns)
        yield record.stamp_ns, "/%s/camera_info" % camera.name, info
        if options.raw_images:
            image = _image(data, record.path)
            image.header = info.header
            yield record.stamp_ns, "/%s/image" % camera.name, image
        else:
            compressed = CompressedImage(format=kind, data=data)
            compressed.header = info.header
            yield record.stamp_ns, "/%s/image/compressed" % camera.name, compressed
        if options.score_stride and record.label_path and drive.label_values is not None:
            labels = drive.label_values(record.label_path)
            if labels.shape != (height, width):
                raise DataError(
                    "%s: %d x %d; its image is %d x %d"
                    % (record.label_path, labels.shape[1], labels.shape[0], width, height)
                )
            scores = one_hot_scores(
                labels, len(drive.labels), options.score_stride, options.score_gain
            )
            counts["scores"] = counts.get("scores", 0) + 1
            message = _float_image(scores)
            message.header = info.header
            yield record.stamp_ns, "/%s/scores" % camera.name, message


def camera_info(camera: records.CameraRecord, width: int, height: int, stamp_ns: int) -> Any:
    """The sensor_msgs/CameraInfo of an image."""
    from sensor_msgs.msg import CameraInfo

    message = CameraInfo()
    message.header.stamp = bag_io.to_stamp(stamp_ns)
    message.header.frame_id = camera.frame
    message.width, message.height = width, height
    message.distortion_model = camera.model
    message.D = [float(value) for value in camera.d]
    message.K = [float(value) for value in camera.k.reshape(-1)]
    message.R = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    message.P = [float(v) for v in np.hstack([camera.k, np.zeros((3, 1))]).reshape(-1)]
    return message


def one_hot_scores(labels: np.ndarray, count: int, stride: int, gain: float) -> np.ndarray:
    """Scores (h, w, count) f32 of a label image (H, W) u8, h = ceil(H / stride): `gain` at the
    class of the pixel under each cell's centre, 0 elsewhere (everywhere where it has none)."""
    rows, columns = (-(-extent // stride) for extent in labels.shape)
    v = (2 * np.arange(rows) + 1) * labels.shape[0] // (2 * rows)
    u = (2 * np.arange(columns) + 1) * labels.shape[1] // (2 * columns)
    chosen = labels[np.ix_(v, u)]
    scores = np.zeros((rows, columns, count), dtype=np.float32)
    known = np.flatnonzero(chosen.reshape(-1) < count)
    scores.reshape(-1, count)[known, chosen.reshape(-1)[known]] = gain
    return scores


def _float_image(values: np.ndarray) -> Any:
    from sensor_msgs.msg import Image

    message = Image()
    message.height, message.width = values.shape[:2]
    message.encoding = "32FC%d" % values.shape[2]
    message.step = values.shape[1] * values.shape[2] * 4
    message.data = np.ascontiguousarray(values, dtype="<f4").tobytes()
    return message


def _image(data: bytes, path: str) -> Any:
    from sensor_msgs.msg import Image

    pixels = decoded(data, "anycolor", path)
    message = Image()
    message.height, message.width = pixels.shape[:2]
    message.encoding = "mono8" if pixels.ndim == 2 else "bgr8"
    message.step = message.width * (1 if pixels.ndim == 2 else 3)
    message.data = np.ascontiguousarray(pixels).tobytes()
    return message


def _with_image(drive: records.Drive, middles: List[int]) -> int:
    stamps = np.array(sorted(i.stamp_ns for i in drive.cameras[0].images), dtype=np.int64)
    if not len(stamps):
        return 0
    targets = np.array(middles, dtype=np.int64)
    after = np.clip(np.searchsorted(stamps, targets), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.minimum(np.abs(stamps[after] - targets), np.abs(stamps[before] - targets))
    return int((nearest <= 50000000).sum())

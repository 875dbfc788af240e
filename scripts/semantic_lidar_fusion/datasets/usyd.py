# SPDX-License-Identifier: MIT
"""The USyd Campus data set: a bag with one h264 video a camera beside it -> one bag with images.

Layout: NAME.bag with NAME-<camera>.h264 (in the first week NAME-<camera>_.h264). The bag holds all
but the images: packets, odometry, tf, /gmsl/<camera>/camera_info, and for every frame a message
/gmsl/<camera>/frame_info (gmsl_frame_msg/FrameInfo), whose definition the bag brings along:
  header, ros_timestamp, camera_timestamp (us), frame_counter, global_counter
frame_counter numbers the video's frames. True time of an image = camera_timestamp, plus the bias
between the clocks (the first header stamp minus its camera_timestamp) if that is above half a
second, minus the bag's own time correction, as in the data set's player. Everything else passes as
it is. One frame of each camera is in memory at a time.
"""

import glob
import os
import re
from typing import Any, Dict, List, NamedTuple, Optional, Tuple

import yaml

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags import bag_io
from semantic_lidar_fusion.datasets import writer
from semantic_lidar_fusion.errors import ConfigError, DataError, cannot_write
from semantic_lidar_fusion.labels import LabelSet, load_yaml, package_file

CAMERAS = ("A0", "A1", "A2", "B0", "B1")  # the paper's; A3 looks back
# s, of the bags for which the data set's player has one.
TIME_CORRECTIONS_S = {
    "2018-08-29-17-03-45": 0.015,
    "2018-09-04-17-36-44": 0.0225,
    "2018-10-18-09-19-33": -84606220.67,
}
MAX_BIAS_NS = 500000000
ODOMETRY = ("/zio/odometry/rear", "/vn100/odometry", "/zio/odometry/front")
PACKETS = "/velodyne/front/velodyne_packets"
_FRAMES = {
    "A0": "gmsl_centre_link",
    "A1": "gmsl_left_link",
    "A2": "gmsl_right_link",
    "A3": "gmsl_back_link",
    "B0": "gmsl_left_side_link",
    "B1": "gmsl_right_side_link",
}


class Options(NamedTuple):
    """`cameras`: names, or None for the paper's that have a video. `time_correction_s`: None = what
    is known of the bag. `start_s`, `duration_s`: part of the bag, from its begin (None = to its
    end). `first_frame`: frame_counter of a video's first frame. `jpeg_quality`: 0 = raw images."""

    cameras: Optional[List[str]] = None
    time_correction_s: Optional[float] = None
    start_s: float = 0.0
    duration_s: Optional[float] = None
    first_frame: int = 0
    jpeg_quality: int = 92
    model: str = ""


class Summary(NamedTuple):
    """What was written; `missing`: frames that a camera's video lacks."""

    images: Dict[str, int]
    missing: Dict[str, int]
    scans: int
    bias_s: float
    correction_s: float


class Video:
    """A camera's frames by number, forward only: h264 files cannot be sought in."""

    def __init__(self, path: str, first_frame: int):
        import cv2

        self.path, self._next = path, first_frame
        self._capture = cv2.VideoCapture(path)
        if not self._capture.isOpened():
            raise DataError("%s: not a video that OpenCV can read" % path)

    def frame(self, number: int) -> Optional[Any]:
        """(H, W, 3) uint8 BGR; None if the video has no such frame (any more)."""
        while self._next < number:
            if not self._capture.grab():
                return None
            self._next += 1
        if self._next > number:
            return None
        found, pixels = self._capture.read()
        self._next += 1
        return pixels if found else None

    def close(self) -> None:
        self._capture.release()


def find_bag(path: str) -> str:
    """The bag itself, or the only one in a folder."""
    if not os.path.isdir(path):
        return path
    bags = sorted(glob.glob(os.path.join(glob.escape(path), "*.bag")))
    if len(bags) != 1:
        raise DataError("%s: %d bags in this folder; name the one to import" % (path, len(bags)))
    return bags[0]


def find_videos(bag: str) -> Dict[str, str]:
    """Camera -> path of the h264 files that belong to a bag."""
    stem = os.path.splitext(bag)[0]
    found = {}
    for path in sorted(glob.glob(glob.escape(stem) + "*.h264")):
        name = os.path.splitext(path)[0][len(stem) :].strip("-_")
        if re.fullmatch(r"[A-Za-z][A-Za-z0-9]*", name):
            found[name] = path
    return found


def time_correction(bag: str) -> float:
    """What is known of a bag, by the time in its name (s)."""
    name = os.path.basename(bag)
    return next((value for key, value in TIME_CORRECTIONS_S.items() if name.startswith(key)), 0.0)


def copy(
    source: str,
    bag_path: str,
    rig_path: str,
    labels: LabelSet,
    raw_images: bool,
    model: str,
    cameras: Optional[List[str]],
    time_correction: Optional[float],
    start: float,
    duration: Optional[float],
    first_frame: int,
    jpeg_quality: int,
) -> str:
    """write() as the table of data sets calls it; what was done, in a line."""
    cli.require("cv2")
    quality = 0 if raw_images else jpeg_quality
    options = Options(cameras, time_correction, start, duration, first_frame, quality, model)
    summary = write(source, bag_path, rig_path, labels, options)
    warn_of_missing(summary)
    return describe(summary)


def write(source: str, bag_path: str, rig_path: str, labels: LabelSet, options: Options) -> Summary:
    """Writes the bag with images and its rig file; either whole or not at all."""
    source = find_bag(source)
    if len({os.path.realpath(path) for path in (source, bag_path, rig_path)}) < 3:
        raise ConfigError("the bags and the rig file must have different names")
    videos = find_videos(source)
    if not videos:
        raise DataError("%s: no file %s-CAMERA.h264 beside it" % (source, _stem(source)))
    with bag_io.BagReader(source) as reader:
        reader.require_topic(PACKETS)
        cameras = _chosen(videos, options.cameras, source)
        for camera in cameras:
            reader.require_topic("/gmsl/%s/frame_info" % camera)
            reader.require_topic("/gmsl/%s/camera_info" % camera, "sensor_msgs/CameraInfo")
        rig_file = bag_io.AtomicFile(rig_path)
        try:
            with open(rig_file.temporary, "w", encoding="utf-8") as stream:
                stream.write(_rig_text(reader, source, rig_path, cameras, labels, options))
            with bag_io.BagWriter(bag_path) as writer:
                summary = _Import(reader, source, cameras, videos, options).run(writer)
            rig_file.commit()
        except OSError as error:
            raise cannot_write(rig_path, error) from error
        finally:
            rig_file.discard()
    return summary


def _stem(path: str) -> str:
    return os.path.splitext(os.path.basename(path))[0]


def _chosen(videos: Dict[str, str], wanted: Optional[List[str]], source: str) -> List[str]:
    if wanted is None:
        wanted = [name for name in CAMERAS if name in videos] or sorted(videos)
    for name in wanted:
        if name not in videos:
            raise DataError(
                "%s: no video of camera %s (there are: %s)" % (source, name, ", ".join(videos))
            )
    return wanted


class _Import:
    """One pass over the bag."""

    def __init__(
        self,
        reader: bag_io.BagReader,
        source: str,
        cameras: List[str],
        videos: Dict[str, str],
        options: Options,
    ):
        self._reader, self._options = reader, options
        self._topics = {"/gmsl/%s/frame_info" % camera: camera for camera in cameras}
        self._videos = {name: Video(videos[name], options.first_frame) for name in cameras}
        self._frames = {name: _FRAMES.get(name, "") for name in cameras}
        self._sizes: Dict[str, Tuple[int, int]] = {}
        self._bias_ns: Optional[int] = None
        correction = options.time_correction_s
        self._correction_s = time_correction(source) if correction is None else correction
        self._images = {name: 0 for name in cameras}
        self._missing = {name: 0 for name in cameras}
        self._scans = 0

    def run(self, writer: bag_io.BagWriter) -> Summary:
        try:
            begin_ns = None
            for item in self._reader.read_raw(label="importing"):
                begin_ns = item.stamp_ns if begin_ns is None else begin_ns
                seconds = (item.stamp_ns - begin_ns) * 1e-9
                duration_s = self._options.duration_s
                if duration_s is not None and seconds > self._options.start_s + duration_s:
                    break
                # What holds for the whole bag passes wherever it is.
                inside = seconds >= self._options.start_s
                if inside or item.latched or item.topic.endswith("/camera_info"):
                    writer.write_raw(item)
                    self._scans += item.topic == PACKETS
                self._look(item, inside, writer)
        finally:
            for video in self._videos.values():
                video.close()
        if not any(self._images.values()):
            raise DataError("%s: none of its frames is in the videos" % self._reader.path)
        return Summary(
            self._images, self._missing, self._scans, self._used_bias_s(), self._correction_s
        )

    def _used_bias_s(self) -> float:
        bias_ns = self._bias_ns or 0
        return bias_ns * 1e-9 if abs(bias_ns) > MAX_BIAS_NS else 0.0

    def _look(self, item: bag_io.RawMessage, inside: bool, writer: bag_io.BagWriter) -> None:
        space, _, kind = item.topic.rpartition("/")
        camera = space.rpartition("/")[2]
        if kind == "camera_info" and camera in self._frames:
            info = item.message()
            self._frames[camera] = info.header.frame_id or self._frames[camera]
            self._sizes[camera] = (info.width, info.height)
        elif item.topic in self._topics:
            frame = item.message()
            camera_ns = int(frame.camera_timestamp) * 1000
            if self._bias_ns is None:
                self._bias_ns = bag_io.to_ns(frame.header.stamp) - camera_ns
            if inside:
                self._write_image(camera, int(frame.frame_counter), camera_ns, item, writer)

    def _write_image(
        self,
        camera: str,
        number: int,
        camera_ns: int,
        item: bag_io.RawMessage,
        writer: bag_io.BagWriter,
    ) -> None:
        import cv2
        from sensor_msgs.msg import CompressedImage, Image

        pixels = self._videos[camera].frame(number)
        if pixels is None:
            self._missing[camera] += 1
            return
        height, width = pixels.shape[:2]
        size = self._sizes.get(camera)
        if size is not None and size != (width, height):
            raise DataError(
                "%s: its frames are %d x %d, but camera_info says %d x %d"
                % (self._videos[camera].path, width, height, size[0], size[1])
            )
        assert self._bias_ns is not None
        bias_ns = self._bias_ns if abs(self._bias_ns) > MAX_BIAS_NS else 0
        stamp_ns = camera_ns + bias_ns - int(round(self._correction_s * 1e9))
        topic = "/gmsl/%s/image_color" % camera
        if self._options.jpeg_quality:
            quality = [cv2.IMWRITE_JPEG_QUALITY, self._options.jpeg_quality]
            data = cv2.imencode(".jpg", pixels, quality)[1].tobytes()
            message = CompressedImage(format="bgr8; jpeg compressed bgr8", data=data)
            topic += "/compressed"
        else:
            message = Image(height=height, width=width, encoding="bgr8", step=3 * width)
            message.data = pixels.tobytes()
        message.header.stamp = bag_io.to_stamp(stamp_ns)
        message.header.frame_id = self._frames[camera]
        writer.write(topic, message, item.stamp_ns)
        self._images[camera] += 1


def _rig_text(
    reader: bag_io.BagReader,
    source: str,
    rig_path: str,
    cameras: List[str],
    labels: LabelSet,
    options: Options,
) -> str:
    """config/usyd.yaml for what this bag has."""
    tree = load_yaml(package_file("config/usyd.yaml"))
    tree["name"] = "usyd"
    tree["classes"] = labels.tree()
    transport = "compressed" if options.jpeg_quality else "raw"
    tree["cameras"] = [
        {
            "name": camera,
            "namespace": "/gmsl/" + camera,
            "image": "image_color",
            "transport": transport,
        }
        for camera in cameras
    ]
    tree["reference"]["camera"] = cameras[0]
    known = [topic for topic in ODOMETRY if topic in reader.topics]
    if known:
        tree["odometry"].update(source="topic", topic=known[0])
    else:
        tree["odometry"]["source"] = "tf"
        del tree["odometry"]["topic"]
    if options.model:
        folder = os.path.dirname(os.path.abspath(rig_path))
        tree["segmentation"]["model"] = os.path.relpath(os.path.abspath(options.model), folder)
    lines = [
        "# Written by import_dataset.py from %s. Every key is explained in config/usyd.yaml."
        % os.path.basename(source),
    ]
    text = yaml.dump(
        tree,
        Dumper=writer.RigDumper,
        sort_keys=False,
        width=100,
        default_flow_style=False,
    )
    return "\n".join(lines) + "\n" + text


def describe(summary: Summary) -> str:
    """One line for the user."""
    images = ", ".join("%s %d" % pair for pair in sorted(summary.images.items()))
    return "%d scans; images %s; clocks %.3f s apart, time correction %.4f s" % (
        summary.scans,
        images,
        summary.bias_s,
        summary.correction_s,
    )


def warn_of_missing(summary: Summary) -> None:
    for camera, count in sorted(summary.missing.items()):
        if count:
            cli.warn(
                "camera %s: its video lacks %d of %d frames"
                % (camera, count, count + summary.images[camera])
            )

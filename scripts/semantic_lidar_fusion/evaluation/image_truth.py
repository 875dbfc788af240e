# SPDX-License-Identifier: MIT
"""Labelled images as a bag, so that a network is scored by the very chain that labels points.

Every pixel (of a grid) becomes one point of a cloud on that pixel's ray: camera and lidar coincide,
nothing moves, and nothing hides anything.
"""

import os
from typing import List, NamedTuple

import numpy as np
import yaml

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.bags.bag_io import BagWriter, to_stamp, write_text
from semantic_lidar_fusion.bags.cloud_io import from_array, point_dtype
from semantic_lidar_fusion.datasets.records import read_bytes
from semantic_lidar_fusion.errors import DataError
from semantic_lidar_fusion.labels import NO_LABEL, LabelSet
from semantic_lidar_fusion.pictures import decoded

_START_NS = 10**18
_PERIOD_NS = 10**9
_DEPTH_M = 10.0
_EXTENSIONS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


class LabelledImage(NamedTuple):
    """Paths of a colour image and of its label image (8 bit, class ids)."""

    image: str
    labels: str


def find_images(folder: str, suffix: str) -> List[LabelledImage]:
    """Images NAME.* with a label image NAME<suffix>.png in a folder, by name."""
    if not os.path.isdir(folder):
        raise DataError("%s: no such folder" % folder)
    names = sorted(os.listdir(folder))
    result = []
    for name in names:
        stem, extension = os.path.splitext(name)
        if extension.lower() not in _EXTENSIONS or stem.endswith(suffix):
            continue
        labels = stem + suffix + ".png"
        if labels in names:
            result.append(LabelledImage(os.path.join(folder, name), os.path.join(folder, labels)))
    if not result:
        raise DataError("%s: no image NAME.* with a label image NAME%s.png" % (folder, suffix))
    return result


def write_bag(
    images: List[LabelledImage], labels: LabelSet, model: str, step: int, bag: str, rig: str
) -> None:
    """Writes a bag, one scan an image, with its rig file.

    model: segmentation model file; step: pixels between points. Label ids that the class set lacks
    have no truth."""
    cli.require("cv2")
    from geometry_msgs.msg import TransformStamped
    from sensor_msgs.msg import CameraInfo, Image
    from tf2_msgs.msg import TFMessage

    with BagWriter(bag) as writer:
        transforms = []
        for child in ("camera", "lidar"):
            transform = TransformStamped()
            transform.header.stamp = to_stamp(_START_NS)
            transform.header.frame_id, transform.child_frame_id = "base_link", child
            transform.transform.rotation.w = 1.0
            transforms.append(transform)
        writer.write("/tf_static", TFMessage(transforms), _START_NS, latched=True)
        for number, entry in enumerate(images):
            stamp_ns = _START_NS + number * _PERIOD_NS
            pixels = decoded(read_bytes(entry.image), "color", entry.image)
            truth = decoded(read_bytes(entry.labels), "unchanged", entry.labels)
            if truth.ndim != 2 or truth.dtype != np.uint8 or truth.shape != pixels.shape[:2]:
                raise DataError(
                    "%s: must be an 8-bit grey image of the size of %s"
                    % (entry.labels, entry.image)
                )
            height, width = truth.shape
            focal, center_x, center_y = float(width), (width - 1) / 2.0, (height - 1) / 2.0

            info = CameraInfo(width=width, height=height, distortion_model="plumb_bob")
            info.header.stamp, info.header.frame_id = to_stamp(stamp_ns), "camera"
            info.D = [0.0] * 5
            info.K = [focal, 0.0, center_x, 0.0, focal, center_y, 0.0, 0.0, 1.0]
            info.R = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
            info.P = [focal, 0.0, center_x, 0.0, 0.0, focal, center_y, 0.0, 0.0, 0.0, 1.0, 0.0]
            image = Image(height=height, width=width, encoding="bgr8", step=3 * width)
            image.header, image.data = info.header, pixels.tobytes()

            v, u = (
                axis.ravel()
                for axis in np.mgrid[step // 2 : height : step, step // 2 : width : step]
            )
            kind = [("x", "f4"), ("y", "f4"), ("z", "f4")]
            points = np.zeros(len(u), dtype=point_dtype(kind))
            points["x"] = (u - center_x) / focal * _DEPTH_M
            points["y"] = (v - center_y) / focal * _DEPTH_M
            points["z"] = _DEPTH_M
            known = np.zeros(len(u), dtype=point_dtype(kind + [("label", "u1")]))
            for axis in "xyz":
                known[axis] = points[axis]
            known["label"] = np.where(truth[v, u] < len(labels), truth[v, u], NO_LABEL)

            writer.write("/camera/camera_info", info, stamp_ns)
            writer.write("/camera/image", image, stamp_ns)
            writer.write("/points", from_array(points, stamp_ns, "lidar"), stamp_ns)
            writer.write("/points_truth", from_array(known, stamp_ns, "lidar"), stamp_ns)
    tree = {
        "name": "labelled_images",
        "classes": labels.tree(),
        "cameras": [{"name": "camera"}],
        "lidar": {"input": "points", "topic": "/points"},
        "superpixels": {"warm_start": False},
        "motion": {"enabled": False},
        "occlusion": {"mode": "off"},
        "segmentation": {"model": os.path.abspath(model)},
    }
    write_text(rig, yaml.safe_dump(tree, sort_keys=False))

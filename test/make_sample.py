#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Makes docs/sample/street.bag of a drive of simulate_drive: two of its cameras at half its size, the
labels of their scores in place of these, packets and tf. Small enough to ship, for who has no Embree.

    simulate_drive --out street.bag
    test/make_sample.py street.bag docs/sample/street.bag
"""

import os
import sys

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "scripts"))

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from semantic_lidar_fusion.bags.bag_io import BagReader, BagWriter  # noqa: E402
from semantic_lidar_fusion.figures.paper_figures import image_array  # noqa: E402

CAMERAS = ("A0", "A1")
SHRINK = 2
JPEG_QUALITY = 20


def smaller_info(info):
    """The camera_info of an equidistant lens for images of 1/SHRINK of the size: its coefficients are
    of angles. Integer pixel coordinates are pixel centres."""
    info.width, info.height = info.width // SHRINK, info.height // SHRINK
    for name, centre in (("K", (2, 5)), ("P", (2, 6))):
        values = list(getattr(info, name))
        for index in range(6 if name == "K" else 8):
            shift = 0.5 if index in centre else 0.0
            values[index] = (values[index] + shift) / SHRINK - shift
        setattr(info, name, values)
    return info


def smaller_jpeg(image):
    pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    size = (pixels.shape[1] // SHRINK, pixels.shape[0] // SHRINK)
    pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    image.data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    return image


def labels_of(scores):
    labels = image_array(scores).argmax(axis=-1).astype(np.uint8)
    scores.encoding, scores.step, scores.data = "mono8", labels.shape[1], labels.tobytes()
    return scores


def main(source, target):
    changes = {"/tf": None, "/tf_static": None, "/velodyne/front/velodyne_packets": None}
    for camera in CAMERAS:
        changes["/gmsl/%s/camera_info" % camera] = smaller_info
        changes["/gmsl/%s/image_color/compressed" % camera] = smaller_jpeg
        changes["/gmsl/%s/scores" % camera] = labels_of
    with BagReader(source) as bag, BagWriter(target, compression="bz2") as out:
        for item in bag.read(list(changes)):
            change = changes[item.topic]
            message = change(item.message) if change else item.message
            topic = item.topic.replace("/scores", "/labels")
            out.write(topic, message, item.stamp_ns, latched=item.topic == "/tf_static")
    print("%s: %.2f MB" % (target, os.path.getsize(target) / 1e6))


if __name__ == "__main__":
    main(*sys.argv[1:])

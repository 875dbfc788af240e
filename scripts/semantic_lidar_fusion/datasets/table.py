# SPDX-License-Identifier: MIT
"""The data sets that can be imported: the one table of them. Imports nothing heavy, so that --help can
name them.

A data set is a function `read(folder, labels, first, last, **options)` that returns a
`records.Drive`; CONTRIBUTING.md, "Add a data set", tells the steps."""

import argparse
import importlib
from typing import Any, Callable, Dict, List, NamedTuple, Tuple


class Option(NamedTuple):
    """An argument of the command line, as argparse takes it; its name becomes the function's."""

    flag: str
    settings: Dict[str, Any]

    @property
    def name(self) -> str:
        return self.flag.lstrip("-").replace("-", "_")


class Dataset(NamedTuple):
    """A data set. reader: "module:function" within semantic_lidar_fusion.datasets; classes: the
    default class set, a path within the package; label_images: its images have labels, which can
    become scores; copies_bag: it is a bag itself, and the function is
    `copy(source, bag, rig_path, labels, raw_images, model, **options)`, which returns what it did in
    a line."""

    name: str
    reader: str
    classes: str
    help: str
    description: str
    options: Tuple[Option, ...] = ()
    label_images: bool = False
    copies_bag: bool = False

    def load(self) -> Callable[..., Any]:
        module, _, function = self.reader.partition(":")
        loaded = importlib.import_module("semantic_lidar_fusion.datasets." + module)
        return getattr(loaded, function)  # type: ignore[no-any-return]


def names(text: str) -> List[str]:
    return text.split(",")


def whole(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError("must not be negative")
    return value


def positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be positive")
    return value


def seconds(text: str) -> float:
    value = float(text)
    if not 0 <= value < 1e9:
        raise argparse.ArgumentTypeError("must not be negative")
    return value


def quality(text: str) -> int:
    value = int(text)
    if not 1 <= value <= 100:
        raise argparse.ArgumentTypeError("must be from 1 to 100")
    return value


def option(flag: str, **settings: Any) -> Option:
    return Option(flag, settings)


def _cameras(metavar: str, text: str) -> Option:
    return option("--cameras", type=names, metavar=metavar, help=text)


DATASETS: List[Dataset] = [
    Dataset(
        "kitti",
        "kitti:read",
        "config/classes_cityscapes.yaml",
        "a KITTI raw drive",
        "A KITTI raw drive: DATE/DATE_drive_NNNN_sync (rectified images, odometry at 10 Hz) or "
        "_extract (raw images, 100 Hz), with the calibration files in DATE; or its compact form "
        "(numbered .jpg and .npz files beside calib_and_kissicp_poses.npz).",
        (_cameras("FOLDER,...", "default: image_02,image_03"),),
    ),
    Dataset(
        "semantickitti",
        "semantickitti:read",
        "config/classes_semantickitti.yaml",
        "a SemanticKITTI sequence",
        "A SemanticKITTI sequence, dataset/sequences/NN, with image_2 of KITTI odometry; its labels "
        "become the topic points_truth.",
        (_cameras("FOLDER,...", "default: image_2"),),
    ),
    Dataset(
        "rellis",
        "rellis:read",
        "config/classes_rellis.yaml",
        "a RELLIS-3D sequence",
        "A RELLIS-3D sequence, Rellis-3D/0000N (images, scans as .ply or .bin, camera_info.txt, "
        "transforms.yaml, poses.txt), or the compact form of one frame (frame.npz, image.jpg); its "
        "labels become the topic points_truth.",
        (
            option(
                "--distortion",
                choices=["none", "published"],
                default="none",
                help="published: the coefficients of the data set's own example (default: none, as "
                "in camera_info.txt, which fits better)",
            ),
        ),
        label_images=True,
    ),
    Dataset(
        "usyd",
        "usyd:copy",
        "config/classes_usyd12.yaml",
        "a bag of the USyd Campus data set",
        "A bag of the USyd Campus data set with its videos NAME-<camera>.h264 beside it: the frames "
        "become images, stamped by the bag's frame_info messages; everything else passes as it is.",
        (
            _cameras("NAME,...", "default: those of A0,A1,A2,B0,B1 that have a video"),
            option(
                "--time-correction",
                type=float,
                metavar="S",
                help="what the images' stamps are too late by (default: what is known of the bag, "
                "else 0)",
            ),
            option(
                "--start",
                type=seconds,
                default=0.0,
                metavar="S",
                help="from the bag's begin (default: 0)",
            ),
            option(
                "--duration",
                type=seconds,
                metavar="S",
                help="of the part to import (default: all)",
            ),
            option(
                "--first-frame",
                type=whole,
                default=0,
                metavar="N",
                help="the frame_counter of the videos' first frame (default: 0)",
            ),
            option(
                "--jpeg-quality",
                type=quality,
                default=92,
                metavar="Q",
                help="1 to 100 (default: 92)",
            ),
        ),
        copies_bag=True,
    ),
    Dataset(
        "kitti360",
        "kitti360:read",
        "config/classes_cityscapes.yaml",
        "a KITTI-360 drive",
        "A drive below the folder KITTI-360 (data_2d_raw, data_3d_raw, data_poses, calibration): "
        "perspective cameras and fisheyes, scans, poses, and the labels of data_2d_semantics and "
        "data_3d_semantics where they are.",
        (
            option(
                "--drive", metavar="NAME", help="e.g. 0000 (default: the only one that is there)"
            ),
            _cameras("FOLDER,...", "of image_00 to image_03 (default: all)"),
        ),
    ),
    Dataset(
        "nuscenes",
        "nuscenes:read",
        "config/classes_cityscapes.yaml",
        "a nuScenes scene",
        "A scene of nuScenes v1.0 (the folder with v1.0-mini, samples, sweeps): six cameras, all "
        "lidar sweeps, ego poses; with lidarseg, keyframes become points_truth.",
        (
            option("--scene", metavar="NAME", help="e.g. scene-0061 (default: the first)"),
            _cameras("CHANNEL,...", "e.g. CAM_FRONT (default: all six)"),
        ),
    ),
    Dataset(
        "acfr_calibration",
        "acfr_calibration:read",
        "config/classes_usyd12.yaml",
        "poses of a camera-lidar calibration (cam_lidar_calibration)",
        "A folder of ACFR's calibration tool (images, pcd, camera_info.yaml, calibration runs as "
        "CSV), or its compact form: a standing vehicle, one pose a second.",
        (
            option(
                "--camera-info",
                metavar="FILE",
                help="default: camera_info.yaml of DIR, DIR/cfg or above",
            ),
        ),
        label_images=True,
    ),
]

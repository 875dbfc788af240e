#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Turns a public data set in its own folder layout into a bag and a rig file for fuse_bag, and a bag of
ROS 2 into one of ROS 1."""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402

DEFAULT_CLASSES = {
    "kitti": "config/classes_cityscapes.yaml",
    "semantickitti": "config/classes_semantickitti.yaml",
    "rellis": "config/classes_rellis.yaml",
    "usyd": "config/classes_usyd12.yaml",
    "kitti360": "config/classes_cityscapes.yaml",
    "nuscenes": "config/classes_cityscapes.yaml",
    "acfr_calibration": "config/classes_usyd12.yaml",
}


def make_parser():
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="Then: fuse_bag OUT.bag FUSED.bag --rig OUT.yaml",
    )
    datasets = parser.add_subparsers(dest="dataset", metavar="DATASET")
    kitti = datasets.add_parser(
        "kitti",
        help="a KITTI raw drive",
        description="A KITTI raw drive: DATE/DATE_drive_NNNN_sync (rectified images, odometry at 10 "
        "Hz) or _extract (raw images, 100 Hz), with the calibration files in DATE; or its compact "
        "form (numbered .jpg and .npz files beside calib_and_kissicp_poses.npz).",
    )
    kitti.add_argument(
        "--cameras", type=_names, metavar="FOLDER,...", help="default: image_02,image_03"
    )
    semantickitti = datasets.add_parser(
        "semantickitti",
        help="a SemanticKITTI sequence",
        description="A SemanticKITTI sequence, dataset/sequences/NN, with image_2 of KITTI odometry; "
        "its labels become the topic points_truth.",
    )
    semantickitti.add_argument(
        "--cameras", type=_names, metavar="FOLDER,...", help="default: image_2"
    )
    rellis = datasets.add_parser(
        "rellis",
        help="a RELLIS-3D sequence",
        description="A RELLIS-3D sequence, Rellis-3D/0000N (images, scans as .ply or .bin, "
        "camera_info.txt, transforms.yaml, poses.txt), or the compact form of one frame (frame.npz, "
        "image.jpg); its labels become the topic points_truth.",
    )
    rellis.add_argument(
        "--scores",
        choices=["none", "onehot"],
        default="none",
        help="onehot: write the human label images as score images, so that fuse_bag needs no "
        "network (default: none)",
    )
    rellis.add_argument(
        "--score-stride", type=_positive, default=8, help="pixels per score cell (default: 8)"
    )
    rellis.add_argument(
        "--score-gain", type=float, default=10.0, help="score of the labelled class (default: 10)"
    )
    rellis.add_argument(
        "--distortion",
        choices=["none", "published"],
        default="none",
        help="published: the coefficients of the data set's own example (default: none, as in "
        "camera_info.txt, which fits better)",
    )
    usyd = datasets.add_parser(
        "usyd",
        help="a bag of the USyd Campus data set",
        description="A bag of the USyd Campus data set with its videos NAME-<camera>.h264 beside it: "
        "the frames become images, stamped by the bag's frame_info messages; everything else "
        "passes as it is.",
    )
    usyd.add_argument(
        "--cameras",
        type=_names,
        metavar="NAME,...",
        help="default: those of A0,A1,A2,B0,B1 that have a video",
    )
    usyd.add_argument(
        "--time-correction",
        type=float,
        metavar="S",
        help="what the images' stamps are too late by (default: what is known of the bag, else 0)",
    )
    usyd.add_argument(
        "--start", type=_seconds, default=0.0, metavar="S", help="from the bag's begin (default: 0)"
    )
    usyd.add_argument(
        "--duration", type=_seconds, metavar="S", help="of the part to import (default: all)"
    )
    usyd.add_argument(
        "--first-frame",
        type=_whole,
        default=0,
        metavar="N",
        help="the frame_counter of the videos' first frame (default: 0)",
    )
    usyd.add_argument(
        "--jpeg-quality", type=_quality, default=92, metavar="Q", help="1 to 100 (default: 92)"
    )
    kitti360 = datasets.add_parser(
        "kitti360",
        help="a KITTI-360 drive",
        description="A drive below the folder KITTI-360 (data_2d_raw, data_3d_raw, data_poses, "
        "calibration): perspective cameras and fisheyes, scans, poses, and the labels of "
        "data_2d_semantics and data_3d_semantics where they are.",
    )
    kitti360.add_argument(
        "--drive", metavar="NAME", help="e.g. 0000 (default: the only one that is there)"
    )
    kitti360.add_argument(
        "--cameras",
        type=_names,
        metavar="FOLDER,...",
        help="of image_00 to image_03 (default: all)",
    )
    nuscenes = datasets.add_parser(
        "nuscenes",
        help="a nuScenes scene",
        description="A scene of nuScenes v1.0 (the folder with v1.0-mini, samples, sweeps): six "
        "cameras, all lidar sweeps, ego poses; with lidarseg, keyframes become points_truth.",
    )
    nuscenes.add_argument("--scene", metavar="NAME", help="e.g. scene-0061 (default: the first)")
    nuscenes.add_argument(
        "--cameras", type=_names, metavar="CHANNEL,...", help="e.g. CAM_FRONT (default: all six)"
    )
    calibration = datasets.add_parser(
        "acfr_calibration",
        help="poses of a camera-lidar calibration (cam_lidar_calibration)",
        description="A folder of ACFR's calibration tool (images, pcd, camera_info.yaml, calibration "
        "runs as CSV), or its compact form: a standing vehicle, one pose a second.",
    )
    calibration.add_argument(
        "--camera-info", metavar="FILE", help="default: camera_info.yaml of DIR, DIR/cfg or above"
    )
    for name, what in (("ros2", "a bag of ROS 2"), ("mcap", "an MCAP file of ROS 2")):
        bag = datasets.add_parser(
            name,
            help=what,
            description="A folder with metadata.yaml, or .mcap and .db3 files: messages keep their "
            "times and topics. PyPI's rosbags reads them (pip install rosbags). make_rig.py then "
            "proposes a rig file.",
        )
        bag.add_argument(
            "sources", metavar="IN", nargs="+", help="the bag, or several of one drive"
        )
        bag.add_argument("bag", metavar="OUT.bag", help="the bag to write")
    commands = (kitti, semantickitti, rellis, usyd, kitti360, nuscenes, calibration)
    for command in commands:
        what = (
            "the bag, or its folder" if command is usyd else "the folder of the drive or sequence"
        )
        command.add_argument("folder", metavar="BAG" if command is usyd else "DIR", help=what)
        command.add_argument("bag", metavar="OUT.bag", help="the bag to write")
        command.add_argument("--rig-out", metavar="FILE", help="rig file (default: OUT.yaml)")
        command.add_argument(
            "--classes",
            metavar="FILE",
            help="class set (default: %s)" % DEFAULT_CLASSES[command.prog.split()[-1]],
        )
        command.add_argument(
            "--model", metavar="FILE", default="", help="segmentation model to name in the rig file"
        )
        command.add_argument(
            "--images",
            choices=["compressed", "raw"],
            default="compressed",
            help="JPEG, or decoded (default: compressed)"
            if command is usyd
            else "pass the image files on as they are, or decoded (default: compressed)",
        )
        if command is usyd:
            continue
        command.add_argument(
            "--first", type=_whole, default=0, metavar="N", help="first frame (default: 0)"
        )
        command.add_argument(
            "--last", type=_whole, default=None, metavar="N", help="last frame (default: all)"
        )
    return parser


def _names(text):
    return text.split(",")


def _whole(text):
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError("must not be negative")
    return value


def _seconds(text):
    value = float(text)
    if not 0 <= value < 1e9:
        raise argparse.ArgumentTypeError("must not be negative")
    return value


def _quality(text):
    value = int(text)
    if not 1 <= value <= 100:
        raise argparse.ArgumentTypeError("must be from 1 to 100")
    return value


def _positive(text):
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be positive")
    return value


def read_drive(options, labels):
    """The records.Drive that the options ask for."""
    from semantic_lidar_fusion.datasets import acfr_calibration, kitti, kitti360
    from semantic_lidar_fusion.datasets import nuscenes, rellis, semantickitti

    span = (options.first, options.last)
    if options.dataset == "kitti":
        return kitti.read(options.folder, labels, options.cameras, *span)
    if options.dataset == "semantickitti":
        return semantickitti.read(options.folder, labels, options.cameras, *span)
    if options.dataset == "kitti360":
        return kitti360.read(options.folder, labels, options.drive, options.cameras, *span)
    if options.dataset == "nuscenes":
        return nuscenes.read(options.folder, labels, options.scene, options.cameras, *span)
    if options.dataset == "acfr_calibration":
        return acfr_calibration.read(options.folder, labels, options.camera_info, *span)
    return rellis.read(options.folder, labels, rellis.DISTORTIONS[options.distortion], *span)


def import_usyd(options, labels, rig_path):
    """A bag of the USyd Campus data set, whose messages pass as they are."""
    from semantic_lidar_fusion.datasets import usyd

    summary = usyd.write(
        options.folder,
        options.bag,
        rig_path,
        labels,
        usyd.Options(
            cameras=options.cameras,
            time_correction_s=options.time_correction,
            start_s=options.start,
            duration_s=options.duration,
            first_frame=options.first_frame,
            jpeg_quality=options.jpeg_quality if options.images == "compressed" else 0,
            model=options.model,
        ),
    )
    print("%s: %s" % (options.bag, usyd.describe(summary)))
    usyd.warn_of_missing(summary)
    print("%s: rig file" % rig_path)


def import_ros2(options):
    """A bag of ROS 2, whose messages pass with their times."""
    from semantic_lidar_fusion.datasets import ros2

    summary = ros2.convert(options.sources, options.bag)
    for topic, kind in sorted(summary.left_out.items()):
        cli.warn("%s is left out: nothing defines its type %s" % (topic, kind))
    print("%s: %d messages on %d topics" % (options.bag, summary.messages, summary.topics))
    print("Then: make_rig.py %s --out rig.yaml" % options.bag)


def main():
    parser = make_parser()
    options = parser.parse_args()
    if options.dataset is None:
        parser.error("name a data set: %s" % ", ".join([*DEFAULT_CLASSES, "ros2", "mcap"]))
    if options.dataset in ("ros2", "mcap"):
        return import_ros2(options)
    cli.require("numpy", "scipy", "yaml", "rosbag", "sensor_msgs.msg", "tf2_msgs.msg")
    from semantic_lidar_fusion.datasets import writer
    from semantic_lidar_fusion.labels import LabelSet, package_file

    labels = LabelSet.from_file(options.classes or package_file(DEFAULT_CLASSES[options.dataset]))
    rig_path = options.rig_out or os.path.splitext(options.bag)[0] + ".yaml"
    if options.dataset == "usyd":
        cli.require("cv2")
        return import_usyd(options, labels, rig_path)
    one_hot = getattr(options, "scores", "none") == "onehot"
    summary = writer.write(
        read_drive(options, labels),
        options.bag,
        rig_path,
        writer.Options(
            raw_images=options.images == "raw",
            score_stride=options.score_stride if one_hot else 0,
            score_gain=options.score_gain if one_hot else 0.0,
            model=options.model,
        ),
    )
    print(
        "%s: %d scans (%d points), %d images, %d odometry readings"
        % (options.bag, summary.scans, summary.points, summary.images, summary.odometry)
        + (", %d score images" % summary.score_images if one_hot else "")
        + (", %d labelled points" % summary.truth_points if summary.truth_points else "")
    )
    if summary.scans_with_image < summary.scans:
        cli.warn(
            "%d of %d scans have no image within 50 ms of their middle"
            % (summary.scans - summary.scans_with_image, summary.scans)
        )
    print("%s: rig file" % rig_path)
    return 0


if __name__ == "__main__":
    cli.run(main)

#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Turns a public data set in its own folder layout into a bag and a rig file for fuse_bag, and a bag of
ROS 2 into one of ROS 1."""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402
from semantic_lidar_fusion.datasets import table  # noqa: E402


ROS2 = (("ros2", "a bag of ROS 2"), ("mcap", "an MCAP file of ROS 2"))


def make_parser():
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="Then: fuse_bag OUT.bag FUSED.bag --rig OUT.yaml",
    )
    datasets = parser.add_subparsers(dest="dataset", metavar="DATASET")
    for dataset in table.DATASETS:
        command = datasets.add_parser(
            dataset.name, help=dataset.help, description=dataset.description
        )
        for option in dataset.options:
            command.add_argument(option.flag, **option.settings)
        if dataset.label_images:
            add_score_options(command)
        add_common_options(command, dataset)
        command.set_defaults(entry=dataset)
    for name, what in ROS2:
        add_ros2_command(datasets, name, what)
    return parser


def add_ros2_command(datasets, name, what):
    command = datasets.add_parser(
        name,
        help=what,
        description="A folder with metadata.yaml, or .mcap and .db3 files: messages keep their times "
        "and topics. PyPI's rosbags reads them (pip install rosbags). make_rig.py then proposes a rig "
        "file.",
    )
    command.add_argument(
        "sources", metavar="IN", nargs="+", help="the bag, or several of one drive"
    )
    command.add_argument("bag", metavar="OUT.bag", help="the bag to write")
    command.set_defaults(entry=None)


def add_score_options(command):
    command.add_argument(
        "--scores",
        choices=["none", "onehot"],
        default="none",
        help="onehot: write the human label images as score images, so that fuse_bag needs no "
        "network (default: none)",
    )
    command.add_argument(
        "--score-stride", type=table.positive, default=8, help="pixels per score cell (default: 8)"
    )
    command.add_argument(
        "--score-gain", type=float, default=10.0, help="score of the labelled class (default: 10)"
    )


def add_common_options(command, dataset):
    copies = dataset.copies_bag
    command.add_argument(
        "folder",
        metavar="BAG" if copies else "DIR",
        help="the bag, or its folder" if copies else "the folder of the drive or sequence",
    )
    command.add_argument("bag", metavar="OUT.bag", help="the bag to write")
    command.add_argument("--rig-out", metavar="FILE", help="rig file (default: OUT.yaml)")
    command.add_argument(
        "--classes", metavar="FILE", help="class set (default: %s)" % dataset.classes
    )
    command.add_argument(
        "--model", metavar="FILE", default="", help="segmentation model to name in the rig file"
    )
    command.add_argument(
        "--images",
        choices=["compressed", "raw"],
        default="compressed",
        help="JPEG, or decoded (default: compressed)"
        if copies
        else "pass the image files on as they are, or decoded (default: compressed)",
    )
    if copies:
        return
    command.add_argument(
        "--first", type=table.whole, default=0, metavar="N", help="first frame (default: 0)"
    )
    command.add_argument(
        "--last", type=table.whole, default=None, metavar="N", help="last frame (default: all)"
    )


def import_drive(options, own, labels, rig_path):
    """Folders of frames become messages."""
    from semantic_lidar_fusion.datasets import writer

    drive = options.entry.load()(
        options.folder, labels, first=options.first, last=options.last, **own
    )
    one_hot = getattr(options, "scores", "none") == "onehot"
    summary = writer.write(
        drive,
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
        names = [entry.name for entry in table.DATASETS] + [name for name, _ in ROS2]
        parser.error("name a data set: %s" % ", ".join(names))
    if options.entry is None:
        return import_ros2(options)
    cli.require("numpy", "scipy", "yaml", "rosbag", "sensor_msgs.msg", "tf2_msgs.msg")
    from semantic_lidar_fusion.labels import LabelSet, package_file

    labels = LabelSet.from_file(options.classes or package_file(options.entry.classes))
    rig_path = options.rig_out or os.path.splitext(options.bag)[0] + ".yaml"
    own = {option.name: getattr(options, option.name) for option in options.entry.options}
    if options.entry.copies_bag:
        raw = options.images == "raw"
        copy = options.entry.load()
        said = copy(options.folder, options.bag, rig_path, labels, raw, options.model, **own)
        print("%s: %s" % (options.bag, said))
    else:
        import_drive(options, own, labels, rig_path)
    print("%s: rig file" % rig_path)
    return 0


if __name__ == "__main__":
    cli.run(main)

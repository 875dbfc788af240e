#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Semantic clouds for labelling and evaluation tools that read SemanticKITTI's layout, and labels of
people back as the truth of one's own bag."""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402

EPILOG = """\
  exchange_labels.py export fused.bag sequence --every 10 --unlabelled
  exchange_labels.py import sequence fused.bag truth.bag
  evaluate.py drive.bag --rig rig.yaml --truth truth.bag --out results
"""


def make_parser():
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    out = commands.add_parser(
        "export", help="clouds of a fused bag to velodyne/*.bin, labels/*.label, poses, classes"
    )
    out.add_argument("bag", metavar="FUSED.bag", help="what fuse_bag has written")
    out.add_argument("folder", metavar="DIR", help="the folder to fill; must be new or empty")
    out.add_argument(
        "--every", type=cli.positive, default=1, metavar="N", help="every N-th scan (default: 1)"
    )
    out.add_argument("--unlabelled", action="store_true", help="labels of 0, for people to fill in")
    out.add_argument(
        "--fixed-frame", default="odom", metavar="FRAME", help="of poses.txt (default: odom)"
    )
    back = commands.add_parser(
        "import", help="labels of an exported folder to a bag with the topic points_truth"
    )
    back.add_argument("folder", metavar="DIR", help="the exported folder")
    back.add_argument("bag", metavar="FUSED.bag", help="the bag that it was exported from")
    back.add_argument("truth", metavar="TRUTH.bag", help="the bag to write")
    back.add_argument(
        "--labels", metavar="DIR", help="the .label files, where they are not in DIR/labels"
    )
    for command in (out, back):
        command.add_argument(
            "--ids",
            choices=["own", "semantickitti"],
            default="own",
            help="of .label files: own = 0 for none, class id + 1 (default), or SemanticKITTI's",
        )
    return parser


def main():
    parser = make_parser()
    options = parser.parse_args()
    if options.command is None:
        parser.error("name a command: export, import")
    cli.require("numpy", "scipy", "yaml", "rosbag")
    from semantic_lidar_fusion.datasets import label_files

    if options.command == "export":
        scans, points = label_files.export(
            options.bag,
            options.folder,
            options.ids,
            options.every,
            not options.unlabelled,
            options.fixed_frame,
        )
        print("%s: %d scans (%d points)" % (options.folder, scans, points))
        return 0
    scans, labelled = label_files.bring_back(
        options.folder, options.bag, options.truth, options.ids, options.labels
    )
    print("%s: truth of %d scans (%d labelled points)" % (options.truth, scans, labelled))
    return 0


if __name__ == "__main__":
    cli.run(main)

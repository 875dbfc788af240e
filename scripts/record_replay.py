#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Runs a command that records (rosbag record ...) with the topics of a rig added: what fuse_bag
writes of every scan, and the odometry. replay.launch puts it before its recorder."""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402

TOPICS = ["points_semantic", "points_compensated", "scan_reference", "class_info"]


def make_parser():
    parser = cli.replay_parser(__doc__)
    parser.add_argument("command", nargs=argparse.REMAINDER, help="the command")
    return parser


def main():
    parser = make_parser()
    options = parser.parse_args()
    if not options.command:
        parser.error("a command is missing")
    cli.require("yaml")
    from semantic_lidar_fusion.rig import Rig

    rig = Rig.load(options.rig, options.overrides.split())
    names = TOPICS + [str(c["name"]) + "/selection" for c in rig.tree["cameras"]]
    if rig.text("odometry.source") == "topic":
        names.append(rig.text("odometry.topic"))
    # A recorder writes names as they are given; those of a bag are absolute.
    space = "/" + os.environ.get("ROS_NAMESPACE", "").strip("/")
    topics = [name if name.startswith("/") else os.path.join(space, name) for name in names]
    os.execvp(options.command[0], options.command + topics + ["/tf", "/tf_static"])


if __name__ == "__main__":
    cli.run(main)

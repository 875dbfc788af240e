#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Proposes a rig file from what a bag holds; everything uncertain is marked CHECK."""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402


def parser() -> argparse.ArgumentParser:
    result = argparse.ArgumentParser(
        description=__doc__, epilog="Next: check_rig.py IN.bag --rig my_rig.yaml"
    )
    result.add_argument("bags", nargs="+", metavar="IN.bag", help="the bags of one drive")
    result.add_argument("--out", required=True, metavar="FILE", help="the rig file to write")
    result.add_argument("--force", action="store_true", help="replace FILE if it exists")
    return result


def main() -> int:
    arguments = parser().parse_args()
    cli.require("rosbag", "yaml")
    from semantic_lidar_fusion.rigcheck import propose

    doubts = propose.write(tuple(arguments.bags), arguments.out, arguments.force)
    print("%s: %d lines to check" % (arguments.out, len(doubts)))
    for doubt in doubts:
        print("  " + doubt)
    return 0


if __name__ == "__main__":
    cli.run(main)

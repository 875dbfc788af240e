#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Is a rig right? Looks at an ordinary drive and says what is wrong and what to change.

Compares edges of the lidar with edges of the images, classes with the ground, odometry with the
lidar's own motion, and stamps, topics and calibrations with each other. Changes nothing by itself.
Verdicts: ok, suspect, wrong, not observable (this drive cannot tell).
"""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402


def parser() -> argparse.ArgumentParser:
    result = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="Exit codes: 0 all ok or not observable; 1 something is suspect or wrong, or the check "
        "failed; 2 wrong command line.",
    )
    result.add_argument("bags", nargs="+", metavar="IN.bag", help="the bags of one drive")
    result.add_argument("--rig", required=True, metavar="FILE", help="the rig file")
    result.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override a key of the rig"
    )
    result.add_argument(
        "--out",
        metavar="DIR",
        help="write report.html, findings.json and, if something has to change, patch.yaml there",
    )
    result.add_argument("--fuse-bag", metavar="FILE", help="the program fuse_bag, if not found")
    return result


def main() -> int:
    arguments = parser().parse_args()
    cli.require("numpy", "cv2", "scipy", "rosbag")
    from semantic_lidar_fusion.rigcheck import command

    return command.check(
        command.Request(
            tuple(arguments.bags),
            arguments.rig,
            tuple(arguments.set),
            arguments.out,
            arguments.fuse_bag,
        )
    )


if __name__ == "__main__":
    cli.run(main)

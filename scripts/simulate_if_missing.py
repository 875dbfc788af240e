#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Makes a drive with simulate_drive if there is no such bag yet, then becomes another command:
demo.launch puts it before the player."""

import argparse
import os
import shlex
import subprocess
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402
from semantic_lidar_fusion.errors import DataError  # noqa: E402


def make_parser():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--simulator", metavar="FILE", required=True, help="the simulate_drive")
    parser.add_argument(
        "--options", metavar="TEXT", default="", help="its options, apart from --out"
    )
    parser.add_argument("bag", metavar="BAG", help="the drive")
    parser.add_argument("command", nargs=argparse.REMAINDER, help="what to run afterwards")
    return parser


def main():
    options = make_parser().parse_args()
    if not os.path.exists(options.bag):
        if not os.access(options.simulator, os.X_OK):
            raise DataError(
                "%s: no such bag, and simulate_drive, which would make it, is not built: that needs "
                "Embree" % options.bag
            )
        print("making %s, which takes a minute or more" % os.path.abspath(options.bag))
        sys.stdout.flush()
        command = [options.simulator, "--out", options.bag] + shlex.split(options.options)
        if subprocess.run(command).returncode != 0:
            raise DataError("%s: simulate_drive has failed, see above" % options.bag)
    if options.command:
        os.execvp(options.command[0], options.command)


if __name__ == "__main__":
    cli.run(main)

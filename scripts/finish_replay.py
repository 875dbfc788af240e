#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Waits for the end of a replay and its last scans, says what came out and what was dropped, ends
the recorder, and evaluates what it wrote. replay.launch starts it; its exit ends the launch."""

import atexit
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402


def make_parser():
    parser = cli.replay_parser(__doc__)
    parser.add_argument(
        "--recorded", metavar="BAG", default="", help="what the node `recorder` writes, if it runs"
    )
    parser.add_argument(
        "--evaluate", metavar="DIR", help="write tables and plots of the recorded clouds there"
    )
    parser.add_argument("--bag", metavar="BAG", help="the bag that is played, with points_truth")
    parser.add_argument(
        "--player-within",
        metavar="S",
        type=float,
        default=30.0,
        help="seconds until the node `player` must run (default: 30)",
    )
    return parser


def main():
    parser = make_parser()
    options = parser.parse_args(cli.node_arguments())
    if options.evaluate and not (options.bag and options.recorded):
        parser.error("--evaluate needs --bag and --recorded")
    cli.require("numpy", "yaml", "rospy", "rosgraph")
    from semantic_lidar_fusion.bags import replay

    atexit.register(replay.end_launch)  # after an error's line too
    replay.finish(
        replay.Finish(
            rig=options.rig,
            overrides=options.overrides.split(),
            recorded=options.recorded,
            evaluate=options.evaluate or "",
            bag=options.bag or "",
            player_within_s=options.player_within,
        )
    )


if __name__ == "__main__":
    cli.run(main)

#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Lets the player of a replay go once every link of the chain and the recorder are connected.
replay.launch starts it beside a player that waits."""

import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402


def make_parser():
    parser = cli.replay_parser(__doc__)
    parser.add_argument(
        "--manager", metavar="NODE", default="fusion_manager", help="the nodelet manager"
    )
    parser.add_argument("--recorded", action="store_true", help="wait for the node `recorder` too")
    parser.add_argument(
        "--within",
        metavar="S",
        type=float,
        default=60.0,
        help="seconds after which the bag is played anyway, with a warning (default: 60)",
    )
    parser.add_argument(
        "--player-within",
        metavar="S",
        type=float,
        default=30.0,
        help="seconds until the node `player` must run (default: 30)",
    )
    return parser


def main():
    options = make_parser().parse_args(cli.node_arguments())
    cli.require("numpy", "yaml", "rospy", "rosgraph", "genpy")
    from semantic_lidar_fusion.bags import replay

    replay.start(
        replay.Start(
            rig=options.rig,
            overrides=options.overrides.split(),
            manager=options.manager,
            recorded=options.recorded,
            within_s=options.within,
            player_within_s=options.player_within,
        )
    )


if __name__ == "__main__":
    cli.run(main)

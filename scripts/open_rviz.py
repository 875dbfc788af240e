#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Runs a command (rviz ...) with --fixed-frame added: a frame that tf has, or else that of the
semantic clouds, which can be seen from it without any tf. rviz.launch puts it before rviz."""

import argparse
import os
import sys

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from semantic_lidar_fusion import cli  # noqa: E402


def make_parser():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frame", default="odom", help="the frame that is wanted (default: odom)")
    parser.add_argument(
        "--within",
        metavar="S",
        type=float,
        default=10.0,
        help="seconds that cloud and tf have to show it (default: 10)",
    )
    parser.add_argument("command", nargs=argparse.REMAINDER, help="the command")
    return parser


def main():
    parser = make_parser()
    options = parser.parse_args()
    if not options.command:
        parser.error("a command is missing")
    cli.require("rospy", "tf2_ros")
    frame = existing_frame(options.frame.lstrip("/"), options.within)
    os.execvp(options.command[0], options.command + ["--fixed-frame", frame])


def existing_frame(wanted, within_s):
    """`wanted` as soon as tf joins it to the frame of the clouds. After `within_s` the frame of the
    clouds, or `wanted` all the same if no cloud came."""
    import time

    import rospy
    import tf2_ros
    from sensor_msgs.msg import PointCloud2

    rospy.init_node("open_rviz", anonymous=True)
    buffer = tf2_ros.Buffer()
    listener = tf2_ros.TransformListener(buffer)
    frames = []
    subscriber = rospy.Subscriber(
        "points_semantic", PointCloud2, lambda message: frames.append(message.header.frame_id)
    )
    deadline = time.monotonic() + within_s
    frame = wanted
    while not rospy.is_shutdown():
        if frames and buffer.can_transform(wanted, frames[-1], rospy.Time(0)):
            break
        if time.monotonic() > deadline:
            frame = frames[-1] if frames else wanted
            break
        time.sleep(0.05)
    if frame != wanted:
        print(
            "open_rviz.py: warning: tf does not join %s to %s; RViz looks from %s. Is the rig's "
            "fixed_frame another (rviz.launch frame:=...), or is odometry missing?"
            % (wanted, frame, frame),
            file=sys.stderr,
        )
    subscriber.unregister()
    listener.unregister()
    return frame


if __name__ == "__main__":
    cli.run(main)

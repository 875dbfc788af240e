#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""A bag played through the launch files gives, scan by scan, what fuse_bag gives."""
import os
import sys
import unittest

import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from bag_factory import Camera, Drive  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402


def cameras():
    """Different phases and rates."""
    return [
        Camera("front", 0.0, (1.5, 0.1, 0.2), width=240, height=180, focal=85.0),
        Camera(
            "left",
            1.5707963,
            (0.8, 0.6, 0.1),
            phase_ns=7_000_000,
            period_ns=33_000_000,
            width=240,
            height=180,
            focal=85.0,
        ),
    ]


# Nothing is late on a busy machine, so that all decisions are those of the stamps.
PATIENCE = ["%s.timeout=20" % key for key in ("cameras.front", "cameras.left", "odometry")]
PATIENCE.append("segmentation.mode=free_running")
# Slower than real time: what counts is the result, not whether the machine keeps up.
RATE = 0.25


class ReplayEqualsOffline(unittest.TestCase):
    def assert_same(self, expected, received):
        self.assertEqual(sorted(expected), sorted(m.header.stamp.to_nsec() for m in received))
        for message in received:
            offline = expected[message.header.stamp.to_nsec()]
            self.assertEqual(live.difference(message, offline), "")

    def replay(self, drive):
        with live.folder() as path:
            made = live.Made(path, drive)
            expected = made.fused(*PATIENCE)
            self.assertEqual(len(expected), drive.scans)
            semantic = live.Received("/points_semantic", PointCloud2)
            with live.launched(
                "replay.launch",
                bag=made.bag,
                rig=made.rig,
                paused="true",
                rate=RATE,
                delay=0,
                overrides=" ".join(PATIENCE),
            ):
                live.wait_for_chain(made.topics(), "/player")
                live.resume()
                received = semantic.wait_for(drive.scans)
            semantic.close()
            self.assert_same(expected, received)
            fused = sum((live.bag_factory.read_cloud(m)["status"] == 0).sum() for m in received)
            self.assertGreater(fused, 1000)

    def test_points(self):
        self.replay(Drive(scans=6, cameras=cameras(), points_per_scan=3200))

    def test_packets_without_velodyne_msgs(self):
        self.replay(Drive(scans=4, cameras=cameras(), lidar="packets"))

    def test_second_pass_of_the_bag_gives_the_same(self):
        """The clock and all stamps jump back; nothing of the first pass is left in the second."""
        with live.folder() as path:
            drive = Drive(scans=14, cameras=cameras(), points_per_scan=1600)
            made = live.Made(path, drive)
            expected = made.fused(*PATIENCE)
            rospy.set_param("/use_sim_time", True)
            semantic = live.Received("/points_semantic", PointCloud2)
            overrides = " ".join(PATIENCE)
            with live.launched("fusion.launch", rig=made.rig, bond="false", overrides=overrides):
                for _ in range(2):
                    semantic.clear()
                    with live.played(made.bag, "--rate=%s" % RATE) as player:
                        live.wait_for_chain(made.topics(), "/player")
                        live.resume()
                        received = semantic.wait_for(drive.scans)
                        live.wait_until(lambda: player.poll() is not None, "the end of the bag")
                    self.assert_same(expected, received)
            semantic.close()


if __name__ == "__main__":
    rospy.init_node("test_replay")
    rostest.rosrun("semantic_lidar_fusion", "replay_equals_offline", ReplayEqualsOffline)

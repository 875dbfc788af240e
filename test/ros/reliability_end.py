#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Ending in the middle of work, and parameters that nothing reads.

SLF_SHUTDOWNS: how often the manager is started, loaded, fed and ended (default 3)."""
import copy
import os
import signal
import subprocess
import sys
import unittest

import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from reliability_feed import Drive, small_cameras  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402

ROUNDS = int(os.environ.get("SLF_SHUTDOWNS", "3"))
TYPES = {
    "image_selection": "ImageSelection",
    "superpixel_uncertainty": "SuperpixelUncertainty",
    "motion_compensation": "MotionCompensation",
    "projection": "Projection",
}


class End(unittest.TestCase):
    def test_the_manager_ends_with_0_in_the_middle_of_work(self):
        prefix = os.environ.get("SLF_LAUNCH_PREFIX", "")
        run = ["rosrun"] + (["--prefix", prefix] if prefix else [])
        with live.folder() as path:
            drive = Drive(scans=6, cameras=small_cameras(), points_per_scan=3200)
            made = live.Made(path, drive)
            messages = made.messages()
            kinds = {topic: type(message) for _, topic, message in messages}
            semantic = live.Received("/points_semantic", PointCloud2)
            said = live.Said()
            for name in TYPES:
                rospy.set_param("/%s/rig_file" % name, made.rig)
            rospy.set_param("/projection/rig_fil", "x")
            codes = []
            for index in range(ROUNDS):
                # Anew: the connections of the manager before count as listeners until they are used.
                publishers = {
                    topic: rospy.Publisher(topic, kind, queue_size=1000, tcp_nodelay=True)
                    for topic, kind in kinds.items()
                }
                manager = subprocess.Popen(
                    run + ["nodelet", "nodelet", "manager", "__name:=ending"]
                )
                loaders = [
                    subprocess.Popen(
                        ["rosrun", "nodelet", "nodelet", "load"]
                        + ["semantic_lidar_fusion/%sNodelet" % kind, "ending", "--no-bond"]
                        + ["__name:=" + name]
                    )
                    for name, kind in TYPES.items()
                ]
                try:
                    live.wait_for_chain(publishers, rospy.get_name(), 60.0, "/ending")
                    semantic.clear()
                    shift = rospy.Duration(20 * index)
                    for count, (_, topic, original) in enumerate(messages):
                        message = copy.deepcopy(original)
                        for stamped in getattr(message, "transforms", [message]):
                            stamped.header.stamp += shift
                        publishers[topic].publish(message)
                        rospy.rostime.wallsleep(0.002)
                        # Another moment in each round, with scans under way.
                        if semantic.messages and count > len(messages) // 2 + 5 * index % 40:
                            break
                    live.wait_until(lambda: semantic.messages, "a cloud in round %d" % index)
                    manager.send_signal(signal.SIGINT)
                    codes.append(manager.wait(30))
                finally:
                    for process in [manager] + loaders:
                        if process.poll() is None:
                            process.kill()
                        process.wait()
                    for publisher in publishers.values():
                        publisher.unregister()
            self.assertEqual(codes, [0] * ROUNDS)
            # Row 28: a parameter that nothing reads, with the name that was meant
            self.assertTrue(
                said.find(r"/projection/rig_fil: nothing reads it; is 'rig_file' meant\?")
            )
            semantic.close()


if __name__ == "__main__":
    rospy.init_node("reliability_end")
    rostest.rosrun("semantic_lidar_fusion", "reliability_end", End)

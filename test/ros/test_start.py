#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""What a user sees who starts it wrong: a clear line, and a manager that lives."""
import os
import sys
import unittest

import rospy
import rostest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from bag_factory import Drive  # noqa: E402
from live import Said  # noqa: E402
from rosgraph_msgs.msg import Log  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402
from std_msgs.msg import String  # noqa: E402


class Start(unittest.TestCase):
    """Each case with a manager of its own."""

    def setUp(self):
        self.said = Said()

    def test_bad_rig_is_told_whole_and_the_manager_lives(self):
        with live.folder() as path:
            rig = os.path.join(path, "rig.yaml")
            with open(rig, "w") as file:
                file.write("classes: {classes: []}\nlidar: {input: sonar}\noclusion: {mode: off}\n")
            with live.launched("fusion.launch", rig=rig, bond="false"):
                for key in ("lidar.input", "oclusion", "classes"):
                    self.said.wait_for(key, Log.FATAL)
                self.assertTrue(live.pid_of(live.MANAGER))

    def test_a_file_that_is_no_yaml_is_told_with_its_line(self):
        with live.folder() as path:
            rig = os.path.join(path, "rig.yaml")
            with open(rig, "w") as file:
                file.write("name: broken\ncameras: [{name: front}\nlidar: {input: points}\n")
            with live.launched("fusion.launch", rig=rig, bond="false"):
                self.said.wait_for(r"rig\.yaml:3:\d+: is not YAML", Log.FATAL)
                self.assertTrue(live.pid_of(live.MANAGER))

    def test_a_rig_file_that_is_not_there_is_named(self):
        with live.launched("fusion.launch", rig="/nowhere/rig.yaml", bond="false"):
            self.said.wait_for(r"/nowhere/rig\.yaml: cannot be read", Log.FATAL)
            self.assertTrue(live.pid_of(live.MANAGER))

    def test_what_an_earlier_launch_left_is_cleared_or_told(self):
        rospy.set_param("/superpixel_uncertainty/camera", "of_another_rig")
        rospy.set_param("/rig", {"name": "another"})
        self.addCleanup(rospy.delete_param, "/rig")
        with live.folder() as path:
            made = live.Made(path, Drive(scans=1, points_per_scan=160))
            with live.launched("fusion.launch", rig=made.rig, bond="false"):
                for nodelet in ("projection", "superpixel_uncertainty"):
                    self.said.wait_for(
                        r"parameter /%s/rig_file counts, and parameter /rig is not read" % nodelet
                    )
                told = rospy.wait_for_message("/superpixel_uncertainty/configuration", String, 20)
                self.assertIn("room", told.data)
                self.assertFalse(rospy.has_param("/superpixel_uncertainty/camera"))

    def test_a_missing_topic_is_named_with_one_that_looks_like_it(self):
        with live.folder() as path:
            made = live.Made(path, Drive(scans=1, points_per_scan=160))
            similar = rospy.Publisher("/lidar/points", PointCloud2, queue_size=1)
            semantic = live.Received("/points_semantic", PointCloud2)
            with live.launched("fusion.launch", rig=made.rig, bond="false", manager="other"):
                self.said.wait_for(
                    r"no message on /points.*nobody advertises.*similar: /lidar/points"
                )
            semantic.close()
            similar.unregister()


if __name__ == "__main__":
    rospy.init_node("test_start")
    rostest.rosrun("semantic_lidar_fusion", "start", Start)

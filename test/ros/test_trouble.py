#!/usr/bin/python3
# SPDX-License-Identifier: MIT
"""Cameras that fail, and messages that are wrong: a clear line, and the chain goes on.

One manager serves all cases, in the order of their names; its process id must not change.
"""
import itertools
import json
import os
import sys
import unittest

import numpy as np
import rospy
import rostest
import yaml

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import live  # noqa: E402
from bag_factory import CLASS_NAMES, Drive, read_cloud  # noqa: E402
from rosgraph_msgs.msg import Log  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402
from std_msgs.msg import String  # noqa: E402

# One more than make an epoch, so that the loss of one is no matter of time.
SCANS = 3
NODELETS = ("image_selection", "superpixel_uncertainty", "motion_compensation", "projection")


class Trouble(unittest.TestCase):
    """Messages are published by the test itself, as fast as they are taken, on the wall clock."""

    @classmethod
    def setUpClass(cls):
        cls.said = live.Said()
        cls.diagnostics = live.Diagnostics()
        cls.context = live.folder()
        cls.folder = cls.context.__enter__()
        cls.drive = Drive(scans=SCANS, points_per_scan=1600)
        cls.made = live.Made(cls.folder, cls.drive)
        cls.expected = cls.made.fused()
        cls.feed = live.Feed(cls.made)
        cls.semantic = live.Received("/points_semantic", PointCloud2)
        # Patient with a machine that is busy, and still far shorter than the test.
        overrides = ["%s.timeout=3" % key for key in ("cameras.front", "cameras.left", "odometry")]
        cls.overrides = " ".join(overrides + ["reference.timeout=3"])
        cls.launch = live.launched(
            "fusion.launch", rig=cls.made.rig, bond="false", overrides=cls.overrides
        )
        cls.launch.__enter__()
        live.wait_for_chain(cls.feed.topics, rospy.get_name())
        cls.pid = live.pid_of(live.MANAGER)

    @classmethod
    def tearDownClass(cls):
        cls.launch.__exit__(None, None, None)
        cls.context.__exit__(None, None, None)

    def tearDown(self):
        self.assertEqual(live.pid_of(live.MANAGER), self.pid, "the manager has died")

    def run_drive(self, change=None, scans=SCANS):
        self.semantic.clear()
        self.feed.publish(self.feed.next_drive(), change)
        return [read_cloud(m) for m in self.semantic.wait_for(scans)[:scans]]

    def assert_good(self):
        """An unchanged drive gives what fuse_bag gives."""
        self.semantic.clear()
        self.feed.publish(self.feed.next_drive())
        received = self.semantic.wait_for(SCANS)
        self.assertEqual(len(received), len(self.expected))
        for message, stamp in zip(received, sorted(self.expected)):
            ours, theirs = read_cloud(message), read_cloud(self.expected[stamp])
            self.assertEqual(ours["status"].tobytes(), theirs["status"].tobytes())
            self.assertEqual(ours["label"].tobytes(), theirs["label"].tobytes())

    def test_00_good(self):
        self.assert_good()

    def test_01_a_camera_that_stops_affects_only_itself(self):
        clouds = self.run_drive(lambda topic, m: None if topic == "/left/image" else m)
        for cloud, stamp in zip(clouds, sorted(self.expected)):
            whole = read_cloud(self.expected[stamp])
            self.assertFalse((cloud["cameras"] & 2).any(), "a camera without images contributed")
            only_front = whole["cameras"] == 1
            self.assertGreater(only_front.sum(), 100)
            self.assertTrue((cloud["status"][only_front] == 0).all())
            only_left = whole["cameras"] == 2
            self.assertGreater(only_left.sum(), 100)
            # A point can be hidden in the other camera's image, or leave this one's when the
            # vehicle's motion to the image is left out; all others wait in vain.
            self.assertLessEqual(set(cloud["status"][only_left]), {1, 2, 3})
            self.assertGreater((cloud["status"][only_left] == 3).sum(), 100)
        live.wait_until(
            lambda: any(
                "left" in text and level > 0
                for level, text in self.diagnostics.summaries.get("image_selection", ())
            ),
            lambda: "diagnostics that name the camera: %s" % self.diagnostics.summaries,
        )
        self.assert_good()

    def test_02_scores_that_do_not_come_affect_only_their_camera(self):
        clouds = self.run_drive(lambda topic, m: None if topic == "/front/scores" else m)
        for cloud in clouds:
            self.assertEqual(set(cloud["cameras"][cloud["status"] == 0]), {2})
            self.assertTrue((cloud["status"] == 3).any())
        live.wait_until(
            lambda: self.diagnostics.value("projection", "front: timed out"),
            "a count of the camera",
        )
        self.assert_good()

    def test_03_wrong_number_of_channels(self):
        def change(topic, message):
            if topic == "/front/scores":
                message.encoding = "32FC3"
                message.data = message.data[: 12 * message.width * message.height]
                message.step = 12 * message.width
            return message

        for cloud in self.run_drive(change):
            self.assertEqual(set(cloud["cameras"][cloud["status"] == 0]), {2})
        self.said.wait_for(r"/front/scores: .*3.*4", Log.ERROR)
        self.assert_good()

    def test_04_wrong_encoding(self):
        def change(topic, message):
            if topic == "/left/image":
                message.encoding = "klingon16"
            return message

        for cloud in self.run_drive(change):
            self.assertEqual(set(cloud["cameras"][cloud["status"] == 0]), {1})
        self.said.wait_for(r"left image_selected: .*klingon16", Log.ERROR)
        self.assert_good()

    def test_05_image_whose_data_is_cut_off(self):
        def change(topic, message):
            if topic == "/left/image":
                message.data = message.data[: len(message.data) // 2]
            return message

        for cloud in self.run_drive(change):
            self.assertEqual(set(cloud["cameras"][cloud["status"] == 0]), {1})
        self.assert_good()

    def test_06_unknown_camera_model(self):
        def change(topic, message):
            if topic == "/left/camera_info":
                message.distortion_model = "pear_shaped"
            return message

        for cloud in self.run_drive(change):
            self.assertEqual(set(cloud["cameras"][cloud["status"] == 0]), {1})
        self.said.wait_for(r"/left/camera_info: .*pear_shaped", Log.ERROR)
        self.assert_good()

    def test_07_malformed_cloud(self):
        first = []

        def change(topic, message):
            if topic == "/points" and not first:
                first.append(True)
                message.point_step = 7
            return message

        self.assertEqual(len(self.run_drive(change, scans=SCANS - 1)), SCANS - 1)
        self.said.wait_for(r"/points: .*", Log.ERROR)
        self.assert_good()

    def test_08_empty_cloud_gives_an_empty_cloud(self):
        # Each drive is a jump of time, which scans without points alone must tell, too.
        for emptied in ({0, 1, 2}, {1}, {0}):
            scan, headers = itertools.count(), set()

            def change(topic, message):
                if topic == "/points" and next(scan) in emptied:
                    message.width, message.row_step, message.data = 0, 0, b""
                    headers.add(message.header.stamp.to_nsec())
                return message

            sizes = [len(cloud) for cloud in self.run_drive(change)]
            self.assertEqual([i for i, size in enumerate(sizes) if size == 0], sorted(emptied))
            clouds = self.semantic.by_stamp()
            self.assertEqual({s for s, m in clouds.items() if m.width == 0}, headers)
            self.assertEqual(len(self.semantic), SCANS)
            self.assert_good()

    def test_09_image_with_stamp_zero(self):
        def change(topic, message):
            if topic == "/left/image":
                message.header.stamp = rospy.Time()
            return message

        for cloud in self.run_drive(change):
            self.assertEqual(set(cloud["cameras"][cloud["status"] == 0]), {1})
        self.said.wait_for(r"/?left/image: header.stamp is 0", Log.ERROR)
        self.assert_good()

    def test_10_every_nodelet_reports(self):
        live.wait_until(
            lambda: all(
                any("rate (Hz)" in key for key in self.diagnostics.values.get(name, ()))
                for name in NODELETS
            ),
            lambda: "diagnostics of %s; came: %s" % (NODELETS, sorted(self.diagnostics.values)),
        )

    def test_11_what_is_latched_comes_to_those_who_ask_late(self):
        info = json.loads(rospy.wait_for_message("/class_info", String, 20.0).data)
        self.assertEqual([c["name"] for c in info["classes"]], list(CLASS_NAMES))
        for nodelet in NODELETS:
            text = rospy.wait_for_message("/%s/configuration" % nodelet, String, 20.0).data
            known = yaml.safe_load(text)
            self.assertRegex(text, r"^# semantic_lidar_fusion \d+\.\d+\.\d+\n")
            self.assertEqual(known["name"], "room")
            # Of an override, not of the file.
            self.assertEqual(float(known["reference"]["timeout"]), 3.0)

    def test_12_a_pose_beyond_every_float_moves_nothing(self):
        readings = itertools.count()

        def change(topic, message):
            if topic == "/tf" and next(readings) % 5 == 2:
                message.transforms[0].transform.translation.x = 1e39
            return message

        for cloud in self.run_drive(change):
            for field in ("x", "y", "z"):
                self.assertTrue(np.isfinite(cloud[field]).all())
            self.assertTrue((cloud["status"] == 0).any())
        self.said.wait_for(r"odom <- base_link .*1e\+39")
        self.assert_good()

    def test_13_images_of_another_size_than_camera_info_says(self):
        def change(topic, message):
            if topic == "/left/image":
                message.height //= 2
                message.data = message.data[: message.step * message.height]
            return message

        for cloud in self.run_drive(change):
            self.assertEqual(set(cloud["cameras"][cloud["status"] == 0]), {1})
        left = self.drive.cameras[1]
        sizes = (left.width, left.height // 2, left.width, left.height)
        self.said.wait_for("left/image: is %dx%d; camera_info says %dx%d" % sizes, Log.ERROR)
        self.assert_good()


if __name__ == "__main__":
    rospy.init_node("test_trouble")
    rostest.rosrun("semantic_lidar_fusion", "trouble", Trouble)
